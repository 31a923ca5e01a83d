"""The command line: ``dpdjax design``, ``viscosity``, ``calibrate``, ``suspension``, ``bench``, and
``run``, ``scan`` and ``init`` of TOML files."""

import argparse
import importlib.metadata
import importlib.util
import json
import math
import os
import sys
import time


def main(argv=None) -> int:
    """Entry point; returns the exit status. Heavy imports wait until the work starts."""
    arguments = _parser().parse_args(argv)
    try:
        _check_plot(arguments.plot)
        if not arguments.no_cache:
            _keep_programs()
        result, figure = arguments.work(arguments)
    except (ValueError, TypeError, RuntimeError, OSError, ImportError) as error:
        print(f"dpdjax {arguments.command}: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f"dpdjax {arguments.command}: interrupted", file=sys.stderr)
        return 130
    if arguments.json:
        print(json.dumps(result))
    else:
        print(arguments.readable(result))
    if result.get("stopped"):
        status = STOPPED
    else:
        status = FAILED if result.get("failed") else 0
    return _drawn(figure, arguments) or status if arguments.plot else status


def _drawn(figure, arguments) -> int:
    """Write the picture; the exit status where there is none to be drawn."""
    try:
        figure().figure.savefig(arguments.plot, dpi=150, bbox_inches="tight")
    except (ValueError, OSError) as error:
        print(f"dpdjax {arguments.command}: --plot {arguments.plot}: {error}", file=sys.stderr)
        return 2
    print(f"wrote {arguments.plot}", file=sys.stderr)
    return 0


STOPPED, FAILED = 75, 1
"""Exit status of a run that was ended before its plan, and can be gone on with; and of a scan some
runs of which failed."""
FORMATS = ("png", "pdf", "svg", "eps", "ps", "jpg", "jpeg", "tif", "tiff", "webp")
"""Endings of pictures."""


def _keep_programs():
    """Keep compiled programs on disk; where there is no place for them, go on without."""
    from dpdjax.host.compilation import compilation_cache

    try:
        compilation_cache()
    except OSError as error:
        print(f"dpdjax: compiled programs are not kept: {error}", file=sys.stderr)


def _check_plot(path):
    """Raise ValueError before the work where its picture could not be written."""
    if path is None:
        return
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError('--plot needs matplotlib: pip install "dpdjax[plot]"')
    folder = os.path.dirname(path) or "."
    if not os.path.isdir(folder):
        raise ValueError(f"--plot {path}: there is no folder {folder}")
    if path.rpartition(".")[2] not in FORMATS:
        raise ValueError(f"--plot {path}: give a name in .png, .pdf or .svg")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="dpdjax",
        description="Dissipative particle dynamics: the viscosity of a friction, the friction of "
        "a viscosity.",
    )
    version = importlib.metadata.version("dpdjax")
    parser.add_argument("--version", action="version", version=f"dpdjax {version}")
    commands = parser.add_subparsers(dest="command", required=True)
    _of_files(commands)

    design = commands.add_parser(
        "design", help="the fluids that have wanted properties, at once, from the atlas"
    )
    _designed(design)
    design.set_defaults(work=_design, readable=_designs, plot=None, no_cache=True)

    viscosity = commands.add_parser(
        "viscosity", help="the shear viscosity of a DPD fluid, with an error bar"
    )
    _common(viscosity)
    viscosity.add_argument(
        "--gamma", type=float, default=4.5, help="friction [mass/time] (default: 4.5)"
    )
    viscosity.set_defaults(work=_viscosity, readable=_answer)

    calibrate = commands.add_parser(
        "calibrate", help="the friction gamma that gives a wanted viscosity"
    )
    _common(calibrate)
    calibrate.add_argument("--viscosity", type=float, required=True, help="the wanted viscosity")
    calibrate.add_argument(
        "--gamma", type=float, default=None, help="first guess (default: from the drag stress)"
    )
    calibrate.add_argument(
        "--branch",
        choices=("upper", "lower"),
        default="upper",
        help="of two gammas (default: upper)",
    )
    calibrate.set_defaults(work=_calibrate, readable=_answer)

    suspension = commands.add_parser(
        "suspension", help="colloids in a solvent: prepare, run, write GSD frames"
    )
    _suspended(suspension)
    _kept(suspension)
    suspension.set_defaults(work=_suspension, readable=_suspended_answer, plot=None)

    bench = commands.add_parser("bench", help="how fast this machine runs a fluid")
    _fluid(bench)
    bench.add_argument(
        "--gamma", type=float, default=4.5, help="friction [mass/time] (default: 4.5)"
    )
    bench.add_argument(
        "--beads", type=int, default=24_000, help="beads of one box (default: 24000)"
    )
    bench.add_argument("--batch", type=int, default=1, help="boxes side by side (default: 1)")
    bench.add_argument(
        "--skin", type=float, default=None, help="margin of the lists (default: the cheapest)"
    )
    steps = "steps of one timed run, medians of five (default: 200, fewer in large boxes)"
    bench.add_argument("--steps", type=int, default=None, help=steps)
    _moved(bench, "velocity-verlet")
    bench.add_argument(
        "--tangent", action="store_true", help="time the derivative with respect to gamma too"
    )
    # What it says of compiling is that of a new program.
    bench.set_defaults(work=_bench, readable=_speed, plot=None, no_cache=True)
    return parser


def _of_files(commands):
    """``run``, ``scan`` and ``init``."""
    run = commands.add_parser("run", help="run what a TOML file says")
    scan = commands.add_parser("scan", help="scan what a TOML file says")
    for parser, work, told in ((run, _run, "GSD file"), (scan, _scan, "netCDF file of the table")):
        parser.add_argument("config", metavar="FILE.toml", help="see dpdjax init")
        parser.add_argument("--out", metavar="FILE", help=f"{told} (default: what FILE.toml says)")
        hours = f"end after so many hours of wall time, with status {STOPPED}; the same command"
        parser.add_argument("--hours", type=float, default=None, help=f"{hours} goes on")
        parser.add_argument("--json", action="store_true", help="one JSON object at the end")
        _kept(parser)
        parser.set_defaults(work=work, readable=_came_to, plot=None)
    resume = "go on with what is there; begin where nothing is"
    run.add_argument("--resume", action="store_true", help=resume)
    shard = "part i of n, from 1 on, into a table of its own: for arrays of jobs"
    scan.add_argument("--shard", metavar="i/n", type=_shard, default=None, help=shard)
    scan.add_argument(
        "--workers", metavar="n", type=int, default=None, help="processes of their own"
    )
    scan.add_argument("--retry", action="store_true", help="do again what failed")
    scan.add_argument("--csv", metavar="FILE.csv", default=None, help="write the points as text")
    scan.add_argument("--plot", metavar="FILE.png", default=None, help="draw the table into a file")
    merge = commands.add_parser("merge", help="the tables of the parts of a scan as one")
    merge.add_argument("parts", metavar="PART.nc", nargs="+")
    merge.add_argument("--out", metavar="FILE.nc", required=True)
    merge.set_defaults(work=_merge, readable=_came_to, plot=None, json=False, no_cache=True)
    init = commands.add_parser("init", help="write a TOML file to begin with, with comments")
    init.add_argument("kind", choices=KINDS)
    init.add_argument("file", metavar="FILE.toml", nargs="?", default=None)
    init.set_defaults(work=_init, readable=_came_to, plot=None, json=False, no_cache=True)


KINDS = ("fluid", "suspension", "marbles", "molecules", "scan")


def _shard(text: str) -> tuple[int, int]:
    i, slash, n = text.partition("/")
    if not (slash and i.isdigit() and n.isdigit()):
        raise argparse.ArgumentTypeError(f"{text!r} is no part; give i/n, such as 1/3")
    return int(i), int(n)


def _run(arguments):
    from dpdjax.configs.running import run_file

    report = lambda text: print(text, file=sys.stderr, flush=True)
    result, is_complete = run_file(
        arguments.config,
        out=arguments.out,
        hours=arguments.hours,
        resume=arguments.resume,
        report=None if arguments.json else report,
        progress=not arguments.json,
    )
    return result | ({} if is_complete else {"stopped": True}), None


def _scan(arguments):
    from dpdjax.configs.running import scan_file
    from dpdjax.scans.table import scan_points

    result, is_complete = scan_file(
        arguments.config,
        out=arguments.out,
        hours=arguments.hours,
        shard=arguments.shard,
        workers=arguments.workers,
        retry=arguments.retry,
        progress=not arguments.json,
    )
    table = result.pop("table")
    points = scan_points(table)
    if arguments.csv:
        points.to_csv(arguments.csv, index=False)
    shown = points.to_dict("records") if arguments.json else f"\n{points.to_string(index=False)}"

    def figure():
        import dpdjax as dpd

        is_curve = "rate" in table.dims and "viscosity" in table
        return dpd.plot_flow_curve(table) if is_curve else dpd.plot_scan(table)

    stopped = {} if is_complete else {"stopped": True}
    return result | {"points": shown} | stopped, figure


def _merge(arguments):
    import dpdjax as dpd

    table = dpd.merge_scans(arguments.parts, arguments.out)
    done, runs = int((table.status == 1).sum()), int(table.status.size)
    left = {} if done == runs else {"left": f"{runs - done} runs, of parts not given or not ended"}
    return {"done": f"{done} of {runs} runs"} | left | {"file": arguments.out}, None


def _init(arguments):
    from importlib.resources import files

    target = arguments.file or f"{arguments.kind}.toml"
    if os.path.exists(target):
        raise FileExistsError(f"{target} is there already; give another name")
    example = files("dpdjax.configs") / "examples" / f"{arguments.kind}.toml"
    with open(target, "w", encoding="utf-8") as file:
        file.write(example.read_text(encoding="utf-8"))
    command = "scan" if arguments.kind == "scan" else "run"
    return {"wrote": target, "next": f"dpdjax {command} {target}"}, None


def _came_to(result) -> str:
    shown = lambda value: f"{value:.6g}" if isinstance(value, float) else str(value)
    return "\n".join(f"{name:15s} {shown(value)}" for name, value in result.items())


def _suspended(parser):
    parser.add_argument(
        "--phi", type=float, required=True, help="volume fraction of the colloids, up to 0.45"
    )
    parser.add_argument("--box", type=float, default=30.0, help="side of the box (default: 30)")
    parser.add_argument(
        "--times", type=float, default=1.0, help="how long, in diffusion times tau (default: 1)"
    )
    parser.add_argument(
        "--out", metavar="FILE.gsd", default=None, help="write frames into a GSD file"
    )
    parser.add_argument("--frames", type=int, default=100, help="frames to record (default: 100)")
    settle = "time the solvent settles before, without attraction, in DPD units (default: 10)"
    parser.add_argument("--settle", type=float, default=10.0, help=settle)
    parser.add_argument(
        "--D0", type=float, default=0.0, help="depth of the Morse attraction [energy] (default: 0)"
    )
    parser.add_argument("--kappa", type=float, default=30.0, help="its inverse range (default: 30)")
    parser.add_argument("--radius", type=float, default=1.0, help="of a colloid (default: 1)")
    parser.add_argument(
        "--spread",
        type=float,
        default=0.0,
        help="relative standard deviation of the radii (default: 0)",
    )
    _numbers(parser, kT=0.1, suits="drag, lubrication and contacts")
    parser.add_argument(
        "--gamma", type=float, default=4.5, help="friction [mass/time] (default: 4.5)"
    )
    parser.add_argument(
        "--eta_0",
        type=float,
        default=0.3,
        help="viscosity of the solvent, for lubrication (default: 0.3)",
    )
    parser.add_argument("--rate", type=float, default=0.0, help="shear rate [1/time] (default: 0)")
    _moved(parser)


def _fluid(parser):
    _numbers(parser, kT=1.0, suits="drag: right to 0.5 %%")
    parser.add_argument(
        "--repulsion", type=float, default=25.0, help="a of the soft repulsion (default: 25)"
    )


def _numbers(parser, *, kT: float, suits: str):
    parser.add_argument(
        "--density", type=float, default=3.0, help="solvent beads per volume (default: 3)"
    )
    parser.add_argument("--kT", type=float, default=kT, help=f"thermal energy (default: {kT:g})")
    parser.add_argument(
        "--dt", type=float, default=None, help=f"time step (default: suits {suits})"
    )
    parser.add_argument("--seed", type=int, default=0, help="of all random numbers (default: 0)")
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")


WANTED = {
    "viscosity": "at small shear rates",
    "diffusion": "self-diffusion in a large system",
    "schmidt": "viscosity over mass density and diffusion",
    "pressure": "of motion and repulsion",
    "compressibility": "isothermal",
}
"""What a fluid may be designed for."""


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


WAYS = ("velocity-verlet", "implicit-drag", "multiple-time-step")


def _moved(parser, default="what covers most time for its cost; with --dt velocity-verlet"):
    parser.add_argument(
        "--integrator", choices=WAYS, default=None, help=f"how beads move on (default: {default})"
    )


def _integrator(arguments):
    """The integrator that is named; None for that of the door."""
    import dpdjax as dpd

    name = arguments.integrator
    return name and getattr(dpd.integrators, name.title().replace("-", ""))()


def _kept(parser):
    kept = "compile anew; by default compiled programs are kept in the user's folder for caches"
    parser.add_argument("--no-cache", action="store_true", help=kept)


def _common(parser):
    _fluid(parser)
    _kept(parser)
    _moved(parser)
    parser.add_argument(
        "--rate",
        type=float,
        default=None,
        help="shear rate (default: bias below half the tolerance)",
    )
    parser.add_argument(
        "--box",
        type=float,
        default=None,
        help="side of each of the two boxes (default: 10; less, to 6, at tolerances above 0.05)",
    )
    parser.add_argument(
        "--tolerance",
        type=float,
        default=0.02,
        help="relative; the standard error is a third (default: 0.02)",
    )
    parser.add_argument(
        "--plot", metavar="FILE.png", default=None, help="draw the result into a file"
    )


def _water(arguments, gamma):
    import dpdjax as dpd

    return dpd.fluid(
        conservative=[dpd.term(dpd.soft_repulsion, a=arguments.repulsion, r_c=1.0)],
        drag=[dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=arguments.kT,
    )


def _reporter():
    began = time.monotonic()
    return lambda text: print(
        f"[{time.monotonic() - began:5.0f} s] {text}", file=sys.stderr, flush=True
    )


def _calibrate(arguments):
    import jax

    import dpdjax as dpd

    fit = dpd.calibrate(
        _water(arguments, 4.5 if arguments.gamma is None else arguments.gamma),
        "gamma",
        viscosity=arguments.viscosity,
        key=jax.random.key(arguments.seed),
        density=arguments.density,
        tolerance=arguments.tolerance,
        branch=arguments.branch,
        guess=arguments.gamma,
        dt=arguments.dt,
        rate=arguments.rate,
        box=arguments.box,
        integrator=_integrator(arguments),
        report=_reporter(),
    )
    result = {
        "gamma": fit.value,
        "gamma_error": fit.error,
        "target": fit.target,
        "viscosity": fit.measured.value,
        "viscosity_error": fit.measured.error,
        "temperature": fit.temperature,
        "dt": fit.dt,
        "rate": fit.rate,
        "seconds": round(fit.seconds, 1),
        "compile_seconds": round(fit.compile_seconds, 1),
        "particle_steps": fit.particle_steps,
        "history": [
            {
                "gamma": math.exp(p.x),
                "viscosity": p.value.value,
                "viscosity_error": p.value.error,
                "slope": p.slope.value,
                "slope_error": p.slope.error,
            }
            for p in fit.history
        ],
    }
    return result, lambda: fit.plot()


def _viscosity(arguments):
    import jax

    import dpdjax as dpd

    measured = dpd.measure_viscosity(
        _water(arguments, arguments.gamma),
        key=jax.random.key(arguments.seed),
        density=arguments.density,
        tolerance=arguments.tolerance,
        dt=arguments.dt,
        rate=arguments.rate,
        box=arguments.box,
        integrator=_integrator(arguments),
        report=_reporter(),
    )
    result = {
        "gamma": arguments.gamma,
        "gamma_error": 0.0,
        "viscosity": measured.estimate.value,
        "viscosity_error": measured.estimate.error,
        "temperature": measured.temperature,
        "dt": measured.dt,
        "rate": measured.rate,
        "seconds": round(measured.seconds, 1),
        "compile_seconds": round(measured.compile_seconds, 1),
        "particle_steps": measured.particle_steps,
    }
    return result, lambda: measured.plot()


def _suspension(arguments):
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("once")
        warnings.showwarning = lambda message, *_: print(
            f"dpdjax suspension: note: {message}", file=sys.stderr
        )
        return _run_suspension(arguments), None


def _run_suspension(arguments) -> dict:
    import jax

    import dpdjax as dpd

    _check_suspension(arguments)
    began, key = time.monotonic(), jax.random.key(arguments.seed)
    names = ("phi", "box", "radius", "spread", "density", "kT", "gamma", "D0", "kappa", "dt")
    numbers = {name: getattr(arguments, name) for name in names}
    report = lambda text: print(text, file=sys.stderr, flush=True)
    made = dpd.suspension(
        key,
        eta_0=arguments.eta_0,
        sheared=arguments.rate != 0,
        integrator=_integrator(arguments),
        report=report,
        **numbers,
    )
    flow = dpd.shear(arguments.rate) if arguments.rate else None
    how = dict(integrator=made.integrator, progress=not arguments.json)
    state, spent = made.state, 0
    if arguments.settle > 0:
        calm = dpd.Plan.over(arguments.settle, made.dt, 10)
        hard = made.fluid.set(D0=0.0)
        settled = dpd.run(hard, state, key, made.dt, calm, **how)
        _go_on_with(settled.complete)
        state = settled.final.restarted()
        spent = calm.steps
    steps = arguments.times * made.tau / made.dt
    frames = max(2, min(arguments.frames, round(steps)))
    plan = dpd.Plan(frames, max(1, round(steps / frames)))
    ran = _run_to(arguments.out, made, state, key, plan, flow, how)
    _go_on_with(ran.frames)
    return {
        "colloids": made.colloids,
        "solvents": made.solvents,
        "phi": made.phi,
        "tau": made.tau,
        "dt": made.dt,
        "integrator": str(made.integrator),
        "frames": len(ran.frames["time"]),
        "times": len(ran.frames["time"]) * plan.every * made.dt / made.tau,
        "temperature": float(ran.frames["temperature"][len(ran.frames["time"]) // 2 :].mean()),
        "contact_number": _contacts(made, ran.final),
        "file": arguments.out,
        "particle_steps": (spent + len(ran.frames["time"]) * plan.every) * made.state.n,
        "seconds": round(time.monotonic() - began, 1),
    }


def _go_on_with(what):
    """Ctrl-C ends a run quietly; raise it again where it left nothing to go on with."""
    if not what:
        raise KeyboardInterrupt


def _check_suspension(arguments):
    """Raise ValueError before the work for numbers that cannot be, or a file that could not be
    written."""
    from dpdjax.checks import not_negative, positive

    folder = os.path.dirname(arguments.out or "") or "."
    if not os.path.isdir(folder):
        raise ValueError(f"--out {arguments.out}: there is no folder {folder}")
    if arguments.out and os.path.exists(arguments.out):
        raise ValueError(f"--out {arguments.out} is there already; give another name, or remove it")
    for name in ("times", "kappa"):
        positive(getattr(arguments, name), name)
    not_negative(arguments.settle, "settle")
    if arguments.frames < 2:
        raise ValueError(f"frames is {arguments.frames}; it must be at least 2")


def _run_to(path, made, state, key, plan, flow, how):
    """The run, with its frames in a GSD file where one is wanted."""
    import dpdjax as dpd

    return dpd.run(made.fluid, state, key, made.dt, plan, flow, out=path, **how)


def _contacts(made, state) -> float:
    """Contact number of one state."""
    import dpdjax as dpd
    from dpdjax.model.colloids import attraction_range

    spheres = dpd.measure.spheres_of(made.fluid, state)
    return float(dpd.measure.contact_number(spheres, gap=attraction_range(made.fluid)).mean.value)


def _suspended_answer(result) -> str:
    lines = [
        f"{result['frames']} frames over {result['times']:.3g} tau, "
        f"{result['particle_steps']:.2g} particle-steps in {result['seconds']:.0f} s",
        f"kinetic temperature {result['temperature']:.4g}, contact number "
        f"{result['contact_number']:.3g} at the end",
    ]
    return "\n".join(lines + ([f"wrote {result['file']}"] if result["file"] else []))


def _bench(arguments):
    import jax

    import dpdjax as dpd

    fluid, how = _water(arguments, arguments.gamma), _integrator(arguments)
    dt = arguments.dt
    result = dpd.bench(
        fluid,
        jax.random.key(arguments.seed),
        beads=arguments.beads,
        dt=dpd.suggest_dt(fluid, arguments.density, integrator=how) if dt is None else dt,
        integrator=how,
        density=arguments.density,
        batch=arguments.batch,
        skin=arguments.skin,
        steps=arguments.steps,
        tangent=arguments.tangent,
    )
    return result, None


def _speed(result) -> str:
    shown = lambda value: f"{value:.4g}" if isinstance(value, float) else str(value)
    return "\n".join(
        f"{name.replace('_', ' '):26s} {shown(value)}" for name, value in result.items()
    )


def _answer(result) -> str:
    from dpdjax.measure.statistics import Estimate

    lines = []
    if "target" in result:
        lines.append(f"wanted viscosity {result['target']:g}")
        lines.append(f"gamma     = {Estimate(result['gamma'], result['gamma_error'])}")
    else:
        lines.append(f"gamma     = {result['gamma']:g}")
    viscosity = Estimate(result["viscosity"], result["viscosity_error"])
    lines.append(f"viscosity = {viscosity}   (a fresh run at this gamma)")
    lines.append(f"kinetic temperature {result['temperature']:.4g}")
    lines.append(
        f"dt {result['dt']:.3g}, shear rate {result['rate']:.3g}, "
        f"{result['particle_steps']:.2g} particle-steps in {result['seconds']:.0f} s, "
        f"of which {result['compile_seconds']:.0f} s compiling"
    )
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
