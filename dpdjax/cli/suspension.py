"""``dpdjax suspension``."""

import os
import sys
import time

from dpdjax.cli.arguments import integrator, of_motion, of_numbers, of_programs


def add(commands):
    suspension = commands.add_parser(
        "suspension", help="colloids in a solvent: prepare, run, write GSD frames"
    )
    _suspended(suspension)
    of_programs(suspension)
    suspension.set_defaults(work=_suspension, readable=_suspended_answer, plot=None)


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
    of_numbers(parser, kT=0.1, suits="drag, lubrication and contacts")
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
    of_motion(parser)


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
        integrator=integrator(arguments),
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
