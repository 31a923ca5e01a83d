"""``dpdjax design``."""

import argparse

WANTED = {
    "viscosity": "at small shear rates [energy time/length^3]",
    "diffusion": "self-diffusion in a large system [length^2/time]",
    "schmidt": "viscosity over mass density and diffusion",
    "pressure": "of motion and repulsion [energy/length^3]",
    "compressibility": "isothermal [length^3/energy]",
}
"""What a fluid may be designed for."""


def add(commands):
    design = commands.add_parser(
        "design",
        help="the fluids that have wanted properties, at once, from the atlas",
        description="The fluids that have wanted properties, at once, from the atlas of measured\n"
        "ones: one parameter is found for each number that is wanted.",
        epilog="dpdjax design --viscosity 1.1 --kT 0.1 --repulsion 2.5\n"
        "dpdjax design --viscosity 0.89e-3 --diffusion 2.3e-9 --celsius 25",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    wanted = design.add_argument_group("wanted, one or more")
    for name, told in WANTED.items():
        wanted.add_argument(f"--{name}", type=float, default=None, help=told)
    _given(design)
    _in_si(design)
    design.add_argument("--json", action="store_true", help="one JSON object on standard output")
    design.set_defaults(work=_design, readable=_designs, plot=None, no_cache=True)


def _given(parser):
    given = parser.add_argument_group("given, or found, one for each number that is wanted")
    given.add_argument("--gamma", type=float, default=None, help="friction [mass/time]")
    exponent = "of the weight of the friction (otherwise 2)"
    given.add_argument("--exponent", type=float, default=None, help=exponent)
    repulsion = "a [energy/length] (otherwise 25 kT/r_c)"
    given.add_argument("--repulsion", type=float, default=None, help=repulsion)
    given = parser.add_argument_group("given")
    for name, value, told in (
        ("density", 3.0, "beads per volume"),
        ("kT", 1.0, "thermal energy"),
        ("mass", 1.0, "of a bead"),
        ("r_c", 1.0, "reach"),
    ):
        told = f"{told} (default: {value:g})"
        given.add_argument(f"--{name}", type=float, default=value, help=told)


def _in_si(parser):
    si = parser.add_argument_group("in SI")
    celsius = "wanted numbers are in Pa s, m^2/s, Pa and 1/Pa, of a liquid at so many degrees; "
    time = "viscosity and diffusion go together, and a unit of time is found that makes both right"
    si.add_argument("--celsius", type=float, default=None, help=celsius + time)
    molecules = "to a bead, of the volume of water's; the diffusion is of one (default: 1)"
    si.add_argument("--molecules", type=float, default=None, help=molecules)


def _design(arguments):
    import dpdjax as dpd

    names = (*WANTED, "gamma", "exponent", "repulsion", "density", "kT", "mass", "r_c")
    asked = {name: getattr(arguments, name) for name in names}
    if arguments.celsius is not None:
        asked |= _asked_in_si(arguments)
    elif arguments.molecules is not None:
        raise ValueError("--molecules is for numbers in SI; give --celsius too")
    found = dpd.design(**asked)
    return (found.told() if arguments.json else {"found": found}), None


def _asked_in_si(arguments) -> dict:
    """What SI changes of what is asked."""
    import dpdjax as dpd

    if arguments.celsius <= -273.15:
        raise ValueError(f"--celsius is {arguments.celsius:g}; nothing is colder than -273.15")
    if arguments.mass != 1.0 or arguments.r_c != 1.0:
        raise ValueError("--mass and --r_c are units of the fluid; with --celsius leave them out")
    has = {name: getattr(arguments, name) is not None for name in WANTED}
    if has["viscosity"] != has["diffusion"] or has["schmidt"]:
        raise ValueError(
            "with --celsius give --viscosity and --diffusion together, and no --schmidt: the unit "
            "of time is found, and that of mass is formal"
        )
    molecules = 1.0 if arguments.molecules is None else arguments.molecules
    units = dpd.water_units(
        molecules=molecules,
        density=arguments.density,
        temperature=arguments.celsius + 273.15,
        kT=arguments.kT,
    )
    found = {"units": units, "find_time": has["viscosity"]}
    # A bead is its molecules together, and diffuses as their centre does.
    return found | ({"diffusion": arguments.diffusion / molecules} if has["diffusion"] else {})


def _designs(result) -> str:
    return str(result["found"])
