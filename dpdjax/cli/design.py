"""``dpdjax design``."""

WANTED = {
    "viscosity": "at small shear rates",
    "diffusion": "self-diffusion in a large system",
    "schmidt": "viscosity over mass density and diffusion",
    "pressure": "of motion and repulsion",
    "compressibility": "isothermal",
}
"""What a fluid may be designed for."""


def add(commands):
    design = commands.add_parser(
        "design", help="the fluids that have wanted properties, at once, from the atlas"
    )
    _designed(design)
    design.set_defaults(work=_design, readable=_designs, plot=None, no_cache=True)


def _designed(parser):
    wanted = parser.add_argument_group("wanted, one or more")
    for name, told in WANTED.items():
        wanted.add_argument(f"--{name}", type=float, default=None, help=told)
    given = parser.add_argument_group("given; as much of the first three as is wanted is found")
    given.add_argument("--gamma", type=float, default=None, help="friction [mass/time]")
    given.add_argument("--exponent", type=float, default=None, help="of its weight (else 2)")
    given.add_argument("--repulsion", type=float, default=None, help="a (else 25 kT/r_c)")
    for name, value, told in (
        ("density", 3.0, "beads per volume"),
        ("kT", 1.0, "thermal energy"),
        ("mass", 1.0, "of a bead"),
        ("r_c", 1.0, "reach"),
    ):
        given.add_argument(f"--{name}", type=float, default=value, help=f"{told} ({value:g})")
    si = parser.add_argument_group("in SI: Pa s, m^2/s, Pa, 1/Pa")
    celsius = "wanted numbers are in SI, those of a liquid at so many degrees; the unit of time is "
    si.add_argument("--celsius", type=float, default=None, help=f"{celsius}found")
    molecules = "of water to a bead, whose volume a bead then has (default: 3)"
    si.add_argument("--molecules", type=float, default=3.0, help=molecules)
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


def _design(arguments):
    import dpdjax as dpd

    names = (*WANTED, "gamma", "exponent", "repulsion", "density", "kT", "mass", "r_c")
    asked, si = {name: getattr(arguments, name) for name in names}, {}
    if arguments.celsius is not None:
        units = dpd.water_units(
            molecules=arguments.molecules,
            density=arguments.density,
            temperature=arguments.celsius + 273.15,
            kT=arguments.kT,
        )
        both = arguments.viscosity is not None and arguments.diffusion is not None
        si = {"units": units, "find_time": both}
    found = dpd.design(**asked, **si)
    return (found.told() if arguments.json else {"found": found}), None


def _designs(result) -> str:
    return str(result["found"])
