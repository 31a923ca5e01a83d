"""``dpdjax viscosity``, ``calibrate`` and ``bench``."""

import math

from dpdjax.cli.arguments import integrator, of_fluid, of_motion, of_viscosity, reporter, water


def add(commands):
    """``viscosity``, ``calibrate`` and ``bench``."""
    viscosity = commands.add_parser(
        "viscosity", help="the shear viscosity of a DPD fluid, with an error bar"
    )
    of_viscosity(viscosity)
    viscosity.add_argument(
        "--gamma", type=float, default=4.5, help="friction [mass/time] (default: 4.5)"
    )
    viscosity.set_defaults(work=_viscosity, readable=_answer)

    calibrate = commands.add_parser(
        "calibrate", help="the friction gamma that gives a wanted viscosity"
    )
    of_viscosity(calibrate)
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

    bench = commands.add_parser("bench", help="how fast this machine runs a fluid")
    of_fluid(bench)
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
    of_motion(bench, "velocity-verlet")
    bench.add_argument(
        "--tangent", action="store_true", help="time the derivative with respect to gamma too"
    )
    # What it says of compiling is that of a new program.
    bench.set_defaults(work=_bench, readable=_speed, plot=None, no_cache=True)


def _calibrate(arguments):
    import dpdjax as dpd

    fit = dpd.calibrate(
        water(arguments, 4.5 if arguments.gamma is None else arguments.gamma),
        "gamma",
        viscosity=arguments.viscosity,
        branch=arguments.branch,
        guess=arguments.gamma,
        **_how(arguments),
    )
    result = {
        "gamma": fit.value,
        "gamma_error": fit.error,
        "target": fit.target,
        "viscosity": fit.measured.value,
        "viscosity_error": fit.measured.error,
        **_ran(fit),
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
    import dpdjax as dpd

    measured = dpd.measure_viscosity(water(arguments, arguments.gamma), **_how(arguments))
    result = {
        "gamma": arguments.gamma,
        "gamma_error": 0.0,
        "viscosity": measured.estimate.value,
        "viscosity_error": measured.estimate.error,
        **_ran(measured),
    }
    return result, lambda: measured.plot()


def _how(arguments) -> dict:
    """How boxes are sheared, as calibrations and measurements take it."""
    import jax

    names = ("density", "tolerance", "dt", "rate", "box")
    given = {name: getattr(arguments, name) for name in names}
    key = jax.random.key(arguments.seed)
    return given | {"key": key, "integrator": integrator(arguments), "report": reporter()}


def _ran(found) -> dict:
    """How they were sheared, and what that cost."""
    return {
        "temperature": found.temperature,
        "dt": found.dt,
        "rate": found.rate,
        "seconds": round(found.seconds, 1),
        "compile_seconds": round(found.compile_seconds, 1),
        "particle_steps": found.particle_steps,
    }


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


def _bench(arguments):
    import jax

    import dpdjax as dpd

    fluid, how = water(arguments, arguments.gamma), integrator(arguments)
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
