"""Viscosity, diffusion and pressure of one-species fluids all over the atlas.

    python tests/atlas/survey.py quadratic        # the full grid at exponent 2
    python tests/atlas/survey.py exponents        # states spread evenly over other exponents
    python tests/atlas/survey.py fresh            # states at random, which no fit sees

Each is a scan with a store of its own, ``tests/atlas/*.nc``, which holds the table at every moment:
the same command goes on where one was ended. ``1/2`` and ``2/2`` after the name do half of it
each, in stores of their own, which ``python tests/atlas/survey.py join quadratic`` makes one.
A state takes two minutes of a core in the median; four of the grid, of little or no repulsion and
the strongest drag at density 6 and 8, would take hours each, and are left out. Single precision,
as users run, thermal units throughout: kT, mass and reach are one.
"""

import dataclasses
import math
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import beta
from scipy.stats import qmc

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.goal import rough_viscosity, structure_rate, viscosity_goal
from dpdjax.engine.choice import suited
from dpdjax.engine.observables import STATIC
from dpdjax.measure.statistics import block_average
from dpdjax.model.rates import repulsion_energy

HERE = Path(__file__).parent
KEY = jax.random.key(20)
E = tuple(math.exp(k) for k in range(7))
GRIDS = {
    "quadratic": {
        "density": (2.5, 3.3, 4.5, 6.0, 8.0),
        "a": (0.0, 3.0, 10.0, 25.0, 50.0, 100.0),
        "gamma": tuple(round(g, 4) for g in (*E[:-1], 400.0)),
        "s": (2.0,),
    },
    "exponents": {"state": tuple(range(96))},
    "fresh": {"state": tuple(range(40))},
}
BEADS = 1500
"""In a box."""
HEAT, FASTER = 0.04, 2.0
"""Excess temperature that a shear rate is chosen for by a mean field (it comes to two thirds of
it), and how much faster a second shear is: how far the first is from zero rate follows."""
FASTEST = 0.8
"""Shear rate of the second at most."""
ERRORS = 0.01, 0.02, 0.009
"""Relative errors of the viscosities at both rates, and of the diffusion."""
FINER = 0.8
"""Of the errors of fresh states."""
PATIENCE = 1.2e9
"""Particle-steps of a measurement at most."""
PILOT = 40
"""Frames of the run that tells how long the other must be."""
LAGS, FRAMES = 32, 8
"""Length of a run at rest in first lags of its displacements, and frames in each."""


def fluid_of(a: float, gamma: float, s: float) -> dpd.Fluid:
    """The one-species fluid in thermal units."""
    how = {} if s == 2.0 else {"s": s}
    law = dpd.central_drag if s == 2.0 else dpd.laws.power_drag
    repulsion = dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)
    return dpd.fluid([repulsion], [dpd.term(law, gamma=gamma, r_c=1.0, **how)], kT=1.0)


def gamma_of(strength: float, s: float) -> float:
    """Friction that at an exponent damps as ``strength`` does at 2."""
    return strength / (30.0 * float(beta(3.0, s + 1.0)))


def measured_at(key, state: int) -> dict:
    """All numbers of a state of another exponent, and what it is."""
    point = spread(state)
    return point | measured(key, **point)


def measured(key, density: float, a: float, gamma: float, s: float, finer: float = 1.0) -> dict:
    """All numbers of one state."""
    fluid = fluid_of(a, gamma, s)
    slow, fast, still = (finer * error for error in ERRORS)
    found = at_rest(jax.random.fold_in(key, 0), fluid, density, still)
    sheared = Sheared.of(jax.random.fold_in(key, 1), fluid, density)
    found |= sheared.measured(1.0, slow, "")
    return found | sheared.measured(FASTER, fast, "_fast")


def measured_finely(key, state: int) -> dict:
    """All numbers of a fresh state, and what it is."""
    point = drawn(state)
    return point | measured(key, **point, finer=FINER)


def drawn(state: int) -> dict:
    """A fresh state; half of them at exponent 2."""
    u = np.random.default_rng(2020 + state).uniform(size=4)
    return placed(u if state % 2 else (*u[:3], 1.0))


def spread(state: int) -> dict:
    """A state of the sequence of Sobol: so many of them as there are fill the atlas evenly."""
    return placed(qmc.Sobol(4, seed=20).random(128)[state])


def placed(u) -> dict:
    """The state at four numbers from 0 to 1: even in the logarithms of density, strength and
    exponent, and in the root of the repulsion. Strength is the friction that would damp as much
    at exponent 2."""
    between = lambda x, low, high: round(low * (high / low) ** float(x), 4)
    s, strength = between(u[3], 0.25, 2.0), between(u[2], 1.0, 400.0)
    gamma, a = round(gamma_of(strength, s), 4), round(100.0 * float(u[1]) ** 2, 3)
    return {"density": between(u[0], 2.5, 8.0), "a": a, "gamma": gamma, "s": s}


# ------------------------------------------------------------ under shear


@dataclasses.dataclass
class Sheared:
    """A box that is sheared, faster and faster."""

    ensemble: experiment.Ensemble
    fluid: dpd.Fluid
    rate: float

    @classmethod
    def of(cls, key, fluid, density):
        rough = rough_viscosity(fluid, density)
        damping = dpd.theory.damping_rate(fluid, density)
        heated = math.sqrt(HEAT / 2.5 * 3 * density * damping / rough)
        ordered = math.sqrt(0.01 / 2.8e-5) * structure_rate(fluid, density)
        rate = min(heated, ordered, FASTEST / FASTER)
        side = (BEADS / density) ** (1 / 3)
        goal = viscosity_goal(rough, rate)
        ensemble = experiment.prepare(fluid, goal, key, density=density, side=side, boxes=1)
        return cls(ensemble, fluid, rate)

    def measured(self, faster: float, error: float, name: str) -> dict:
        """Viscosity and excess temperature at a multiple of the rate."""
        rate, ensemble = faster * self.rate, self.ensemble
        ensemble.goal = viscosity_goal(ensemble.goal.target, rate)
        settle = 2 * experiment.remembered(self.fluid, ensemble.density)
        say = lambda text: None
        first = experiment.measure(
            ensemble, self.fluid, 3 * error * ensemble.goal.target, settle, int(PATIENCE), say
        )
        wanted = error * first.estimate.value
        ran = experiment.measure(ensemble, self.fluid, wanted, 0.0, int(PATIENCE), say)
        return {
            f"viscosity{name}": ran.estimate,
            f"heat{name}": ran.temperature / float(self.fluid.kT) - 1,
            f"rate{name}": rate,
        }


# ------------------------------------------------------------ at rest


def resting(fluid, state) -> dict:
    return {
        "pressure": jnp.trace(dpd.observe.pressure_tensor(fluid, state, STATIC)) / 3,
        "temperature": dpd.observe.temperature(fluid, state),
    }


RESTING = [dpd.mean(resting), dpd.observe.positions]


def at_rest(key, fluid, density: float, error: float) -> dict:
    """Diffusion in the box, the lag it is read off from, and pressure."""
    how, dt = suited(fluid, density)
    side = (BEADS / density) ** (1 / 3)
    state = dpd.initial_state(fluid, jax.random.fold_in(key, 0), box=side, density=density, dt=dt)
    weak = experiment.weakly_damped(fluid, density)
    weakly, short = suited(weak, density)
    plan = lambda time, frames: dpd.Plan.over(time, dt, frames)
    go = lambda k, fluid, state, dt, plan, how: dpd.run(
        fluid, state, jax.random.fold_in(key, k), dt, plan,
        observe=RESTING, integrator=how, progress=False,
    )  # fmt: skip
    state = go(1, weak, state, short, dpd.Plan.over(10.0, short, 4), weakly).final
    pilot = go(2, fluid, state, dt, plan(pilot_time(fluid, density), PILOT), how)
    lag = min(lag_of(pilot, fluid, density, side), PATIENCE / (BEADS * LAGS) * dt)
    main = plan(LAGS * lag, LAGS * FRAMES)
    state, parts = pilot.final, []
    while True:
        ran = go(3 + len(parts), fluid, state, dt, main, how)
        state = ran.final
        parts.append(read(ran, lag))
        found, spent = joined(parts), len(parts) * main.steps * BEADS
        if found["diffusion"].error <= error * found["diffusion"].value or spent > PATIENCE:
            return found | {"lag": lag, "side": side}


def read(ran, lag: float) -> dict:
    later = {name: block_average(ran.frames[name]) for name in ("pressure", "temperature")}
    return later | {"diffusion": dpd.diffusion(ran, fit=(lag, 2 * lag))}


def joined(parts: list[dict]) -> dict:
    """Means of runs of one length, one after another."""
    n, first = len(parts), parts[0]
    return {
        name: dpd.Estimate(
            float(np.mean([p[name].value for p in parts])),
            math.sqrt(sum(p[name].error ** 2 for p in parts)) / n,
            sum(p[name].blocks for p in parts),
        )
        for name in first
    }


def pilot_time(fluid, density: float) -> float:
    """Long enough for velocities to be forgotten, by drag or by collisions."""
    return max(4.0, 3.0 / dpd.theory.damping_rate(fluid, density))


def lag_of(pilot, fluid, density: float, side: float) -> float:
    """Time after which beads have forgotten their velocity, the flow they stirred up in the box,
    and the friction of where they were."""
    msd = dpd.measure.mean_squared_displacement(pilot, t_max=0.4 * PILOT * float(pilot.interval))
    half = len(msd.time) // 2
    diffusion = float(np.polyfit(msd.time[half:], msd.value[half:], 1)[0]) / 6
    viscosity = rough_viscosity(fluid, density) / density
    repulsion = 1.0 + repulsion_energy(fluid, density)
    return max(
        7.0 * diffusion,
        3.0 * side**2 / (4 * math.pi**2 * (viscosity + diffusion)),
        0.5 / (diffusion * repulsion),
    )


# ------------------------------------------------------------ stores


def scanned(name: str, shard: str | None = None):
    """The scan of that name, or a part ``i/n`` of it."""
    part = None if shard is None else tuple(int(x) for x in shard.split("/"))
    store = HERE / (f"{name}.nc" if part is None else f"{name}-{part[0]}.nc")
    key = jax.random.fold_in(KEY, 1 + list(GRIDS).index(name))
    how = {"quadratic": measured, "exponents": measured_at, "fresh": measured_finely}[name]
    return dpd.scan(how, GRIDS[name], key=key, store=store, shard=part, retry=False)


def join(name: str):
    """Make one store of the parts of a scan."""
    dpd.merge_scans(sorted(HERE.glob(f"{name}-*.nc")), store=HERE / f"{name}.nc")


if __name__ == "__main__":
    if sys.argv[1] == "join":
        join(sys.argv[2])
    else:
        scanned(*sys.argv[1:])
