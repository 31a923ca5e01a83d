"""What the barostat and the pressure profile are right to: measures, writes barostat.json, and
BAROSTAT.md from it.

    python tests/physics/barostat.py              # everything, ten minutes on 2 cores
    python tests/physics/barostat.py water        # one room

Single precision, as users run.
"""

import sys

import jax
import jax.numpy as jnp
import numpy as np
from rooms import measure, row

import dpdjax as dpd
from dpdjax.engine.observables import STATIC
from dpdjax.engine.state import assemble
from dpdjax.measure.statistics import Estimate, block_average

KEY = jax.random.key(2026)
PRESSURE, DENSITY, SIDE, DT = 23.66, 3.0, 8.0, 0.01
RELAXATION = 0.5


def water(a=25.0, **how):
    repulsion = [dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)]
    return dpd.fluid(repulsion, [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0, **how)


def still(fluid, state):
    """The pressure that the volume answers to, and how hot the beads are."""
    tensor = dpd.observe.pressure_tensor(fluid, state, STATIC)
    return {"static": jnp.trace(tensor) / 3.0, "temperature": dpd.observe.temperature(fluid, state)}


def run(fluid, state, steps, every=5, **how):
    plan = dpd.Plan(steps // every, every=every)
    return dpd.run(fluid, state, KEY, DT, plan, progress=False, **how)


def volumes(done, skip=0.1):
    volume = np.prod(np.asarray(done.frames["lengths"], float), axis=-1)
    return volume[int(skip * len(volume)) :]


def variance(values) -> Estimate:
    """Of correlated values, its error over pieces of the series."""
    return block_average((values - values.mean()) ** 2)


def pressure_at(density) -> Estimate:
    """That of the fluid at a density, plus that of the three momenta that are fixed."""
    state = dpd.initial_state(water(), KEY, box=SIDE, density=density)
    done = run(water(), run(water(), state, 1000).final, 8000, observe=dpd.mean(still))
    found = block_average(done.frames["static"])
    return Estimate(found.value + 1.0 / SIDE**3, found.error, found.blocks)


def water_at_a_pressure():
    """The usual fluid at p = 23.66: its density, and how compressible it is

    a 25, gamma 4.5, kT 1, 1536 beads, dt 0.01, relaxation time 0.5; the compressibility is that of
    the fluctuations, ``<dV^2> / kT <V>``, beside that of pressures at densities 2.9 and 3.1 at
    constant volume, ``ln(3.1 / 2.9) / (p(3.1) - p(2.9))``. The variance of the volume errs by
    ``dt / 2 tau``, 1 %, at this step.
    """
    fluid, how = water(), dpd.integrators.CellRescaling(PRESSURE, relaxation=RELAXATION)
    state = dpd.initial_state(fluid, KEY, box=SIDE, density=DENSITY)
    start = run(fluid, state, 2000, integrator=how).final
    done = run(fluid, start, 40000, integrator=how, observe=[dpd.observe.box, dpd.mean(still)])
    volume = volumes(done)
    density, spread = block_average(state.n / volume), variance(volume)
    low, high = pressure_at(2.9), pressure_at(3.1)
    slope = Estimate(high.value - low.value, np.hypot(high.error, low.error), low.blocks)
    from_slope = np.log(3.1 / 2.9) / slope.value
    told = Estimate(from_slope, from_slope * slope.error / slope.value)
    at = "p 23.66"
    wanted = PRESSURE - np.mean(1.0 / volume)
    return [
        row("density", at, density, DENSITY, "Groot & Warren 1997"),
        row("pressure recorded", at, block_average(done.frames["static"]), wanted, "p - kT <1/V>"),
        row("temperature", at, block_average(done.frames["temperature"]), 1.0),
        row("compressibility", at, spread.scaled(1.0 / volume.mean()), told, "p(rho)"),
    ]


def gas():
    """An ideal gas, whose volumes are known: V^n exp(-p V / kT)

    The mean is ``(n + 1) kT / p``, the variance ``(n + 1) (kT / p)^2``, kT here the kinetic
    temperature of the run, by which velocity-Verlet errs at this step; 100 beads that only rub,
    gamma 5, over a time of 3000 at relaxation time 1.
    """
    fluid, n = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=5.0, r_c=1.0)], kT=1.0), 100
    verlet, implicit = dpd.integrators.VelocityVerlet(), dpd.integrators.ImplicitDrag()
    cases = (
        (verlet, "isotropic", 0.01, 4.2, 1.6),
        (verlet, "normal", 0.01, [4.0, 4.0, 6.0], 1.05),
        (implicit, "isotropic", 0.02, 4.2, 1.6),
    )
    rows = []
    for base, coupling, dt, box, p in cases:
        state = dpd.initial_state(fluid, KEY, box=box, n=n, skin=0.15)
        # One side alone moves a third as fast.
        beta = (3.0 if coupling == "normal" else 1.0) / p
        how = dpd.integrators.CellRescaling(p, 1.0, beta, coupling=coupling, base=base)
        record = [dpd.observe.box, dpd.observe.temperature]
        plan = dpd.Plan.over(3000.0, dt, 20000)
        done = dpd.run(fluid, state, KEY, dt, plan, integrator=how, observe=record, progress=False)
        volume, kT = volumes(done), float(np.mean(done.frames["temperature"]))
        at = f"{coupling}, {type(base).__name__}, dt {dt:g}"
        mean, square = block_average(volume, 60), block_average((volume - volume.mean()) ** 2, 60)
        rows.append(row("kT", at, block_average(done.frames["temperature"], 60), 1.0))
        rows.append(row("mean", at, mean, (n + 1) * kT / p, "at that kT"))
        rows.append(row("variance", at, square, (n + 1) * (kT / p) ** 2, "at that kT"))
    return rows


def slab():
    """Two fluids that do not mix, one slab of each: the tension of their interfaces

    a 25 and 50 between them, gamma 4.5, density 3, 8 x 8 x 16, dt 0.01, means over every step; from
    the whole pressure tensor and from its profile, at constant volume, and then with the normal
    pressure held at what it was on average. Of the normal pressure the error is the spread over the
    48 slabs, in which it is to be the same.
    """
    fluid = water(a=jnp.array([[25.0, 50.0], [50.0, 25.0]]))
    state = run(fluid, apart(fluid, int(DENSITY * 2 * SIDE**3)), 4000).final
    record = [
        dpd.mean(dpd.observe.standard),
        dpd.mean(dpd.observe.pressure_in_slabs(48)),
        dpd.observe.box,
    ]
    rows, how = [], None
    for at in ("at constant volume", "at constant normal pressure"):
        done = run(fluid, state, 12000, every=20, observe=record, integrator=how)
        profile = dpd.measure.pressure_profile(done)
        whole = dpd.measure.surface_tension(done)
        rows.append(row("tension", at, whole, profile.tension, "profile"))
        normal = Estimate(float(profile.normal.mean()), float(profile.normal.std()))
        rows.append(row("normal pressure", at, normal))
        how = dpd.integrators.CellRescaling(normal.value, coupling="normal")
    return rows


def apart(fluid, n):
    """Beads of species 0 in the lower half of the box and of species 1 in the upper one."""
    box = [SIDE, SIDE, 2 * SIDE]
    state = dpd.initial_state(fluid, KEY, box=box, n=n, fractions=[0.5, 0.5])
    place = np.array(state.position)
    upper = np.asarray(state.species) == 1
    place[:, 2] = 0.5 * place[:, 2] + SIDE * upper
    grids = tuple(held.grid for held in state.neighbours)
    given = jnp.asarray(place), state.velocity, state.species, grids
    return assemble(state.box, *given, origins=tuple(state.tally.virial))


if __name__ == "__main__":
    measure(
        [water_at_a_pressure, gas, slab],
        sys.argv[1:],
        "barostat.json",
        "BAROSTAT.md",
        "# Constant pressure and surface tension",
    )
