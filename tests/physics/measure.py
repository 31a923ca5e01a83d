"""Physics at production accuracy: measures, writes results.json, and RESULTS.md from it.

    python tests/physics/measure.py              # everything, about an hour and a half on 2 cores
    python tests/physics/measure.py pressure ... # only these

Single precision, as users run. The slow tests call this and judge the numbers.
"""

import json
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import rooms
from rooms import row

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.goal import viscosity_goal
from dpdjax.measure.statistics import Estimate, block_average, from_replicas

HERE = Path(__file__).parent
KEY = jax.random.key(2024)


def fluid(a, gamma, kT=1.0):
    return dpd.fluid(
        conservative=[dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)],
        drag=[dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=kT,
    )


IDEAL, WATER = fluid(0.0, 5.0), fluid(25.0, 4.5)


def boxes(matter, side, count, dt, seed=0, density=3.0, settle=8.0):
    """``count`` boxes in equilibrium, and their keys."""
    keys = jax.random.split(jax.random.fold_in(KEY, seed), count)
    state = jax.vmap(lambda k: dpd.initial_state(matter, k, box=side, density=density, dt=dt))(keys)
    plan = dpd.Plan(10, max(1, round(settle / dt / 10)))
    return dpd.run(matter, state, keys, dt, plan, progress=False).final, keys


def go(matter, state, keys, dt, total, every, flow=None, observe=None):
    plan = dpd.Plan(max(1, round(total / dt / every)), every)
    return dpd.run(matter, state, keys, dt, plan, flow, observe=observe, progress=False)


def sheared(matter, dt, rate, particle_time, side=10.0, count=4, seed=0):
    """Viscosity under shear from ``particle_time`` bead-time-units, and the run."""
    state, keys = boxes(matter, side, count, dt, seed)
    beads = count * state.position.shape[1]
    state = go(matter, state, keys, dt, 4.0, 50, dpd.shear(rate)).final
    run = go(
        matter,
        state,
        keys,
        dt,
        particle_time / beads,
        20,
        dpd.shear(rate),
        dpd.observe.shear_record,
    )
    return dpd.shear_viscosity(run, skip=0.0, blocks=32), run


def lammps(**wanted):
    """The referee's run with these parameters, from lammps.json."""
    for r in json.loads((HERE / "lammps.json").read_text()):
        if all(math.isclose(r[k], v) for k, v in wanted.items()):
            return Estimate(r["viscosity"], r["viscosity_error"], r["blocks"])
    raise LookupError(f"lammps.json has no run with {wanted}")


# ------------------------------------------------------------ statics


def pressure():
    """Pressure, energy and structure of water at a small step."""
    dt = 0.0025
    state, keys = boxes(WATER, 10.0, 2, dt, seed=1)
    run = go(WATER, state, keys, dt, 40.0, 40, observe=[dpd.observe.stresses, dpd.observe.standard])
    static = run.frames["pressure_kinetic"] + run.frames["pressure_conservative"]
    p = block_average(np.trace(static, axis1=-2, axis2=-1) / 3)
    energy = block_average(run.frames["potential_energy"] / 1000.0)
    config = lambda f, s: {"config": dpd.observe.configurational_temperature(f, s)}
    shots = go(WATER, run.final, keys, dt, 10.0, 80, observe=[dpd.observe.positions, config])
    g = dpd.measure.radial_distribution(shots, bins=125, r_max=2.5)
    where = "rho 3, a 25, kT 1, gamma 4.5, dt 0.0025"
    at = lambda r: Estimate(float(np.interp(r, g.r, g.g)), float(np.interp(r, g.r, g.error)))
    top = int(np.argmax(g.g))
    return [
        row("pressure", where, p, Estimate(23.65, 0.02), "P. Warren, Monte Carlo"),
        row(
            "excess energy density", where, energy, Estimate(13.63, 0.02), "P. Warren, Monte Carlo"
        ),
        row(
            "g(r) at 0.88",
            where,
            at(0.88),
            1.16,
            "HNC",
            f"highest {g.g[top]:.3f} at r = {g.r[top]:.2f}",
        ),
        row("g(r) at 1.19", where, at(1.19), 0.95, "HNC"),
        row(
            "g(r) at 0.50",
            where,
            at(0.5),
            0.59,
            "HNC",
            "an approximation, worst where beads overlap",
        ),
        row(
            "kinetic temperature",
            where,
            block_average(run.frames["temperature"]),
            1.0,
            "exact, up to O(dt)",
        ),
        row(
            "configurational temperature",
            where,
            block_average(shots.frames["config"]),
            1.0,
            "exact, up to O(dt)",
        ),
    ]


def temperature():
    """Temperature error of velocity-Verlet against the time step."""
    rows = []
    for name, matter, steps in (
        ("a 0", fluid(0.0, 4.5), (0.05, 0.02, 0.01, 0.005)),
        ("a 25", WATER, (0.02, 0.01, 0.005)),
    ):
        for dt in steps:
            state, keys = boxes(matter, 10.0, 2, dt, seed=2)
            run = go(matter, state, keys, dt, 40.0, max(1, round(0.1 / dt)))
            excess = block_average(100 * (run.frames["temperature"] - 1.0))
            reference = {0.02: "about 1.4", 0.05: "about 4.5"}.get(dt, "") if name == "a 0" else ""
            note = f"{excess.value / 100 / (4.5 * dt):.2f} gamma dt"
            rows.append(
                row(
                    "temperature error [%]",
                    f"{name}, gamma 4.5, dt {dt:g}",
                    excess,
                    reference,
                    "",
                    note,
                )
            )
    rule = dpd.suggest_dt(WATER, 3.0)
    state, keys = boxes(WATER, 10.0, 2, rule, seed=3)
    run = go(WATER, state, keys, rule, 80.0, 15)
    excess = block_average(100 * (run.frames["temperature"] - 1.0))
    return [
        *rows,
        row(
            "temperature error [%], default dt",
            f"a 25, gamma 4.5, dt {rule:.2g}",
            excess,
            "below 0.5",
            "",
        ),
    ]


# ------------------------------------------------------------------------- viscosity


def ideal_shear():
    """(a 0, gamma 5): homogeneous shear, and its limits of small rate and step."""
    where = "a 0, gamma 5, kT 1"
    main, _ = sheared(IDEAL, 0.01, 0.2, 3e6, seed=4)
    fast, _ = sheared(IDEAL, 0.01, 0.4, 6e5, seed=5)
    fine, _ = sheared(IDEAL, 0.005, 0.4, 5e5, seed=6)
    limit = plane([(0.04, 0.01, main), (0.16, 0.01, fast), (0.16, 0.005, fine)])
    referee = lammps(repulsion=0, gamma=5, dt=0.01, rate=0.2)
    return [
        row(
            "viscosity, shear",
            f"{where}, dt 0.01, rate 0.2",
            main,
            referee,
            "LAMMPS, same dt and rate",
        ),
        row("viscosity, shear", f"{where}, dt 0.01, rate 0.4", fast),
        row("viscosity, shear", f"{where}, dt 0.005, rate 0.4", fine),
        row(
            "viscosity, shear",
            f"{where}, dt -> 0, rate -> 0",
            limit,
            Estimate(1.23, 0.01),
            "Zhou & Schmid 2013",
        ),
        row(
            "viscosity, LAMMPS",
            f"{where}, dt 0.01, rate 0.2",
            referee,
            Estimate(1.23, 0.01),
            "Zhou & Schmid 2013",
        ),
    ]


def plane(points):
    """Value at zero of the plane through estimates at (rate^2, dt)."""
    design = np.array([[1.0, x, y] for x, y, _ in points])
    inverse = np.linalg.inv(design)[0]
    values = np.array([e.value for *_, e in points])
    errors = np.array([e.error for *_, e in points])
    return Estimate(float(inverse @ values), float(np.sqrt(inverse**2 @ errors**2)))


def ideal_equilibrium():
    """(a 0, gamma 5): Einstein-Helfand and Green-Kubo in many small boxes."""
    dt, side, count = 0.01, 5.0, 24
    state, keys = boxes(IDEAL, side, count, dt, seed=7)
    observe = [*dpd.observe.einstein_helfand_record, dpd.observe.green_kubo_record]
    run = go(IDEAL, state, keys, dt, 400.0, 5, observe=observe)
    helfand = dpd.measure.einstein_helfand(run, window=3.0, start=1.0, blocks=96)
    kubo = dpd.measure.green_kubo(run, window=2.5, blocks=96)
    where = "a 0, gamma 5, kT 1, dt 0.01, 24 boxes of side 5"
    return [
        row("viscosity, Einstein-Helfand", where, helfand, "", "", "slope between t = 1 and 3"),
        row("viscosity, Green-Kubo", where, kubo, "", "", "integral to t = 2.5"),
    ]


def ideal_sine():
    """(a 0, gamma 5): sinusoidal body force at two wavelengths, extrapolated in k^2."""
    dt, found, squares, rows = 0.01, [], [], []
    for wavelength, other, count, total, seed in (
        (10.0, 6.0, 8, 260.0, 8),
        (20.0, 6.0, 6, 420.0, 9),
    ):
        k = 2 * math.pi / wavelength
        amplitude = 1.25 * k * 0.2 / 3.0
        state, keys = boxes(IDEAL, jnp.array([other, wavelength, other]), count, dt, seed)
        flow = dpd.flows.sinusoidal_force(amplitude, wavelength)
        relax = 4 * 3.0 / (1.25 * k**2)
        state = go(IDEAL, state, keys, dt, relax, 100, flow).final
        run = go(IDEAL, state, keys, dt, total, 50, flow, dpd.observe.wave_of(1))
        found.append(dpd.measure.sinusoidal_viscosity(run, skip=0.0, blocks=2 * count))
        squares.append(k**2)
        where = f"a 0, gamma 5, kT 1, dt 0.01, wavelength {wavelength:g}, k U 0.2"
        rows.append(row("viscosity, sinusoidal force", where, found[-1]))
    limit = dpd.measure.extrapolate(squares, found)
    return [*rows, row("viscosity, sinusoidal force", "a 0, gamma 5, kT 1, dt 0.01, k -> 0", limit)]


def water_shear():
    """(a 25, gamma 4.5) against LAMMPS at the same step and rate."""
    where = "a 25, gamma 4.5, kT 1, dt 0.01, rate 0.2"
    eta, run = sheared(WATER, 0.01, 0.2, 3e6, seed=10)
    referee = lammps(repulsion=25, gamma=4.5, dt=0.01, rate=0.2)
    heat = block_average(run.frames["temperature"])
    return [
        row("viscosity, shear", where, eta, referee, "LAMMPS, same dt and rate"),
        row("viscosity, shear", where, eta, Estimate(0.85, 0.1), "seed 002 / Boromand et al. 2015"),
        row("kinetic temperature under shear", where, heat, 1.0111, "LAMMPS, same dt and rate"),
    ]


# ------------------------------------------------------------------------- gradients


def tangents(matter, name, dt, rate, duration, windows, side=10.0, count=4, seed=20, frames=20):
    """Mean tangent of the viscosity in ``name`` over a window: times, values, errors."""
    goal = viscosity_goal(1.0, rate)
    state, keys = boxes(matter, side, count, dt, seed)
    state = go(matter, state, keys, dt, 5.0, 50, goal.flow).final
    ensemble = experiment.Ensemble(matter, goal, 3.0, state, keys, dt)
    plan = dpd.Plan(frames, max(1, round(duration / dt / frames)))
    found = [
        experiment.window_tangents(ensemble, matter, (name,), 0, dt, plan) for _ in range(windows)
    ]
    slopes = goal.scale * np.concatenate(found) / float(matter.value(name))
    each = [from_replicas(c) for c in slopes.T]
    times = dt * plan.every * np.arange(1, frames + 1)
    return times, each, slopes


def slope_ideal():
    """d eta / d gamma at (a 0, gamma 5): tangent against independent runs."""
    times, slopes, _ = tangents(IDEAL, "gamma", 0.01, 0.3, 0.9, 48)
    at = int(np.argmin(np.abs(times - 0.8)))
    low, _ = sheared(fluid(0.0, 4.0), 0.01, 0.4, 9e5, seed=21)
    high, _ = sheared(fluid(0.0, 6.0), 0.01, 0.4, 9e5, seed=22)
    difference = Estimate((high.value - low.value) / 2, math.hypot(high.error, low.error) / 2)
    where = "a 0, gamma 5, kT 1, dt 0.01"
    course = ", ".join(f"{e} at {t:.2f}" for t, e in list(zip(times, slopes))[3::4])
    return [
        row(
            "d eta / d gamma, tangent",
            f"{where}, t = 0.8, rate 0.3",
            slopes[at],
            difference,
            "runs at gamma 4 and 6",
            course,
        ),
        row("viscosity, shear", "a 0, gamma 4, dt 0.01, rate 0.4", low),
        row("viscosity, shear", "a 0, gamma 6, dt 0.01, rate 0.4", high),
    ]


def slope_water():
    """d eta / d gamma of water and of the flow solvent, by tangents."""
    times, slopes, _ = tangents(WATER, "gamma", 0.005, 0.3, 0.6, 16, seed=23)
    at = int(np.argmin(np.abs(times - 0.4)))
    return [
        row(
            "d eta / d gamma, tangent",
            "a 25, gamma 4.5, kT 1, t = 0.4",
            slopes[at],
            Estimate(0.015, 0.003),
            "earlier study",
        ),
    ]


def diffusion_tangents(matter, dt, duration, windows, side=6.0, count=8, seed=25, frames=12):
    """The slope in gamma of ``<v(0) (r(t) - r(0))>/3``, which grows to the diffusion: times
    (frames,), and slopes of each window of each box (windows, frames)."""
    state, keys = boxes(matter, side, count, dt, seed)
    plan = dpd.Plan(frames, round(duration / dt / frames))

    @jax.jit
    def window(state, key):
        first = dpd.observe.positions(matter, state)

        def grown(gamma):
            here = matter.set(gamma=gamma)
            ran = dpd.simulate(here, state, key, dt, plan, observe=dpd.observe.positions)
            way = ran.frames["unwrapped"] - first["unwrapped"]
            return jnp.mean(jnp.sum(way * first["velocity"], axis=-1), axis=-1) / 3, ran.final

        _, slope, final = jax.jvp(grown, (matter.value("gamma"),), (1.0,), has_aux=True)
        return slope, final

    slopes = []
    for k in range(count):
        here = jax.tree.map(lambda leaf: leaf[k], state)
        for w in range(windows):
            slope, here = window(here, jax.random.fold_in(keys[k], w))
            slopes.append(slope)
    return dt * plan.every * np.arange(1, frames + 1), np.array(slopes, float)


def slope_diffusion():
    """d D / d gamma at both: tangents of the velocity autocorrelation against independent runs.

    The start of a window knows nothing of gamma, so what the tangent has is exact for the integral
    of the autocorrelation up to the window's end. It carries the slope of the diffusion from where
    velocities are forgotten to where the noise has grown: the note has its course.
    """
    rows = []
    for matter, dt, at, near in ((IDEAL, 0.01, 1.5, (4.0, 6.0)), (WATER, 0.01, 0.8, (3.5, 5.5))):
        a, gamma = float(matter.value("a")), float(matter.value("gamma"))
        times, slopes = diffusion_tangents(matter, dt, 1.5 * at, 40)
        each = [from_replicas(c.reshape(64, -1).mean(axis=1)) for c in slopes.T]
        low, high = (diffused(fluid(a, g), dt, 30 + k) for k, g in enumerate(near))
        chord = Estimate(high.value - low.value, math.hypot(high.error, low.error))
        where = f"a {a:g}, gamma {gamma:g}, kT 1, dt {dt}"
        course = ", ".join(f"{e} at {t:.2f}" for t, e in zip(times[1::2], each[1::2]))
        rows.append(
            row(
                "d D / d gamma, tangent",
                f"{where}, t = {at}",
                each[int(np.argmin(np.abs(times - at)))],
                chord.scaled(1.0 / (near[1] - near[0])),
                f"runs at gamma {near[0]:g} and {near[1]:g}",
                course,
            )
        )
        for g, D in zip(near, (low, high)):
            rows.append(row("diffusion, in the box", f"a {a:g}, gamma {g:g}, side 10", D))
    return rows


def diffused(matter, dt, seed) -> Estimate:
    """Diffusion in boxes of side 10."""
    state, keys = boxes(matter, 10.0, 4, dt, seed)
    ran = go(matter, state, keys, dt, 120.0, 50, observe=dpd.observe.positions)
    return dpd.diffusion(ran, fit=(3.0, 9.0))


def growth():
    """How fast a tangent grows: the noise of d eta / d gamma over long windows."""
    rows = []
    for name, matter, dt in (("a 0, gamma 5", IDEAL, 0.01), ("a 25, gamma 4.5", WATER, 0.01)):
        times, _, slopes = tangents(matter, "gamma", dt, 0.3, 4.0, 3, side=8.0, seed=24)
        spread = np.log(slopes.std(axis=0))
        late = (times > 1.2) & (times < 3.6)
        (rate, _), cov = np.polyfit(times[late], spread[late], 1, cov=True)
        value = Estimate(float(rate), float(math.sqrt(cov[0, 0])))
        rows.append(
            row(
                "growth rate of a tangent",
                f"{name}, kT 1",
                value,
                "about 2.7",
                "earlier study, a 0",
            )
        )
    return rows


def identities():
    """Averages whose derivatives are known: dp/da at a = 0, d<v^2>/dkT, d<p>/d gamma."""
    ideal = fluid(0.0, 20.0)  # strong drag and small boxes: what switching on heats is gone soon
    dt, count, side = 0.0025, 192, 3.0
    state, keys = boxes(ideal, side, count, dt, seed=30)
    beads = state.position.shape[1]

    def static_pressure(f, s):
        tensor = dpd.observe.pressure_tensor(f, s, parts=("kinetic", "conservative"))
        return {"value": jnp.trace(tensor) / 3}

    def kinetic(f, s):
        return {"value": jnp.mean(jnp.sum(s.velocity**2, axis=1))}

    def slopes(matter, state, keys, dt, name, observe, duration, windows):
        def one(s, k):
            def f(x):
                t = dpd.simulate(
                    matter.set(**{name: x}),
                    s,
                    k,
                    dt,
                    dpd.Plan(10, round(duration / dt / 10)),
                    observe=observe,
                )
                return t.frames["value"][-1], t.final

            return jax.jvp(f, (matter.value(name),), (jnp.ones(()),), has_aux=True)

        go = jax.jit(jax.vmap(one))
        found = []
        for _ in range(windows):
            _, slope, state = go(state, keys)
            found += [float(x) for x in slope]
        return from_replicas(found)

    first = slopes(ideal, state, keys, dt, "a", static_pressure, 0.9, 6)
    second = slopes(ideal, state, keys, dt, "kT", kinetic, 0.9, 6)
    state, keys = boxes(WATER, 8.0, 4, 0.01, seed=31)
    third = slopes(WATER, state, keys, 0.01, "gamma", static_pressure, 0.5, 24)
    finite = 1 - 1 / beads  # N (N - 1) pairs; three of 3 N velocities belong to the fixed momentum
    where = f"a 0, gamma 20, t = 0.9, boxes of {beads}"
    pairs = math.pi * (beads / side**3) ** 2 / 30 * finite
    return [
        row("dp/da at a = 0, tangent", where, first, pairs, "pi rho^2 / 30 (1 - 1/N), exact"),
        row("d<v^2>/dkT, tangent", where, second, 3 * finite, "3/m (1 - 1/N), exact once relaxed"),
        row("d<p>/d gamma, tangent", "a 25, gamma 4.5, t = 0.5", third, 0.0, "0 as dt -> 0, exact"),
    ]


def main_job():
    """The README's main job with twelve seeds, and against LAMMPS at the gamma they give.

    Seed 0 is the README's. The scatter is that of the answers, over the errors they state. LAMMPS
    runs of this fluid at other frictions nearby are brought to the mean one by the slope of the
    calibrations, at a lower rate of shear.
    """
    matter = fluid(2.5, 4.5, 0.1)
    fits = [
        dpd.calibrate(matter, "gamma", viscosity=1.1, key=jax.random.key(seed))
        for seed in range(12)
    ]
    gammas = np.array([fit.value for fit in fits])
    gamma = from_replicas(gammas)
    scatter = np.std([(fit.value - gamma.value) / fit.error for fit in fits], ddof=1)
    x = math.log(gamma.value)
    slope = np.mean([fit.curve.slope(x) for fit in fits])
    runs = json.loads((HERE / "lammps.json").read_text())
    runs = [
        r
        for r in runs
        if (r["repulsion"], r["rate"]) == (2.5, 0.1) and abs(r["gamma"] / gamma.value - 1) < 0.05
    ]
    brought = [r["viscosity"] + slope * (x - math.log(r["gamma"])) for r in runs]
    weights = np.array([r["viscosity_error"] for r in runs]) ** -2.0
    referee = Estimate(np.average(brought, weights=weights), weights.sum() ** -0.5, len(runs))
    first, where = fits[0], f"a 2.5, kT 0.1, gamma {gamma.value:.2f}"
    seconds = f"{np.median([fit.seconds for fit in fits]):.0f} s each"
    told = lambda fit: (
        f"fresh run {fit.measured}, {fit.particle_steps:.2g} particle-steps, {fit.seconds:.0f} s"
    )
    others = [
        row(
            f"gamma of viscosity 1.1, seed {seed}",
            "a 2.5, kT 0.1",
            fit.estimate,
            gamma.value,
            "the mean of all",
            told(fit),
        )
        for seed, fit in enumerate(fits)
        if seed > 0
    ]
    return others + [
        row(
            "gamma of viscosity 1.1, seed 0",
            "a 2.5, kT 0.1",
            first.estimate,
            45.0,
            "the guess of seed 000",
            told(first),
        ),
        row(
            "viscosity, fresh run, seed 0",
            f"a 2.5, kT 0.1, gamma {first.value:.2f}",
            first.measured,
            1.1,
            "target",
        ),
        row(
            "gamma of viscosity 1.1, mean",
            "a 2.5, kT 0.1",
            gamma,
            45.0,
            "the guess of seed 000",
            seconds,
        ),
        row(
            "scatter of gamma over its error",
            "a 2.5, kT 0.1",
            Estimate(scatter, scatter / math.sqrt(22)),
            1.0,
            "exact",
        ),
        row(
            "viscosity, fresh runs, mean",
            where,
            from_replicas([fit.measured.value for fit in fits]),
            1.1,
            "target",
        ),
        row(
            "viscosity, LAMMPS, dt 0.0005, rate 0.1",
            where,
            referee,
            1.1,
            "target, within 3 %",
            f"{len(runs)} runs",
        ),
    ]


ROOMS = (
    pressure,
    temperature,
    ideal_shear,
    ideal_equilibrium,
    ideal_sine,
    water_shear,
    slope_ideal,
    slope_water,
    slope_diffusion,
    growth,
    identities,
    main_job,
)


HEADING = """# Physics at production accuracy

Written by `python tests/physics/measure.py`; do not edit.
Reduced units, density 3, standard errors."""


def measure(names=()):
    """Run the named rooms, all by default."""
    rooms.measure(ROOMS, names, "results.json", "RESULTS.md", HEADING)


if __name__ == "__main__":
    measure(sys.argv[1:])
