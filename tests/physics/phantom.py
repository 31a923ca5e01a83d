"""Bonds by what is exact: dimers in a spring and a repulsion, phantom chains and their Rouse modes.

    python tests/physics/phantom.py                # everything, some ten minutes on a busy core
    python tests/physics/phantom.py dimers         # only these

Beads at density 3 rub each other (gamma 4.5, kT 1) and have no potential but that of their bonds.
They start from the exact distribution, and go on in single precision, as users run, their drag
implicit. Writes phantom.json: of each number what was measured, its error, what is exact, by how
many errors it is off; the steps, and the seconds. Errors are the larger of those of stretches of
the run and of groups of molecules, 12 each, and so uncertain by a fifth.
"""

import datetime
import json
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.engine.state import assemble
from dpdjax.measure.statistics import Estimate

FILE = Path(__file__).parent / "phantom.json"
KEY = jax.random.key(2028)
DENSITY, GAMMA = 3.0, 4.5
HOW, ERROR = dpd.integrators.ImplicitDrag(), 0.001
"""How they move, and the error of the step: velocity-Verlet at its usual step is hotter than kT by
0.5 %, and longer by half of that, which would show."""
DIMERS = ((4.0, 0.0, 0.0), (4.0, 0.0, 25.0), (2.0, 0.0, 25.0), (128.0, 0.5, 25.0))
"""Spring, its length, and the repulsion of the two beads."""
SIDE, TOTAL, APART = 8.0, {4.0: 400.0, 2.0: 400.0, 128.0: 120.0}, 0.25
"""Box, time of a run by the spring, and time between frames."""
LENGTH, SPRING = 50, 4.0
CHAIN_SIDE, CHAIN_TOTAL, CHAIN_APART = 18.0, 30.0, 0.2


def matter(*bonds):
    """Beads that rub, and their bonds."""
    drag = [dpd.term(dpd.central_drag, gamma=GAMMA, r_c=1.0)]
    return dpd.fluid(drag=drag, kT=1.0, bonds=list(bonds))


def started(fluid, molecules, side: float, key):
    """A state of molecules (count, beads, 3), each with its first bead thrown at random."""
    count, n = molecules.shape[:2]
    made = dpd.initial_state(fluid, key, box=side, n=count * n)
    x = np.asarray(made.position)[::n, None] + molecules - molecules[:, :1]
    given = jnp.asarray(x.reshape(-1, 3), made.position.dtype), made.velocity, made.species
    grids = tuple(held.grid for held in made.neighbours)
    made = assemble(made.box, *given, grids, origins=tuple(made.tally.virial))
    ids = np.arange(count * n).reshape(count, n)
    return made.bonded({"bond": np.stack([ids[:, :-1], ids[:, 1:]], axis=-1).reshape(-1, 2)})


def go(fluid, state, total: float, apart: float):
    """A run at the suggested step, and what it took."""
    dt = dpd.suggest_dt(fluid, DENSITY, integrator=HOW, error=ERROR)
    every = max(1, round(apart / dt))
    plan = dpd.Plan(round(total / dt / every), every)
    began = time.monotonic()
    what = {"observe": [dpd.observe.positions, temperature], "integrator": HOW, "progress": False}
    run = dpd.run(fluid, state, KEY, dt, plan, **what)
    seconds = round(time.monotonic() - began, 1)
    return run, {"dt": dt, "steps": plan.steps, "beads": state.n, "seconds": seconds}


def temperature(fluid, state):
    return {"temperature": dpd.observe.temperature(fluid, state)}


def compared(found: Estimate, exact: float) -> dict:
    """A line of the file."""
    sigma = (found.value - exact) / found.error
    return {
        "value": found.value,
        "error": found.error,
        "exact": float(exact),
        "off_in_errors": round(float(sigma), 2),
    }


def weights(k, r0, a):
    """Lengths, and how often a dimer has each, up to a factor."""
    r = np.linspace(1e-4, r0 + 12 / np.sqrt(k), 20_000)
    repulsion = np.where(r < 1.0, 0.5 * a * (1 - r) ** 2, 0.0)
    return r, r**2 * np.exp(-0.5 * k * (r - r0) ** 2 - repulsion)


def dimers() -> list[dict]:
    """Lengths of two beads on a spring that repel each other besides."""
    rows = []
    for k, r0, a in DIMERS:
        fluid = matter(
            dpd.term(dpd.laws.harmonic_bond, k=k, r0=r0), dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)
        )
        r, weight = weights(k, r0, a)
        draw, count = np.random.default_rng(7), round(DENSITY * SIDE**3 / 2)
        length = np.interp(draw.random(count), np.cumsum(weight) / weight.sum(), r)
        way = draw.normal(size=(count, 3))
        way *= (length / np.linalg.norm(way, axis=1))[:, None]
        state = started(fluid, np.stack([0 * way, way], axis=1), SIDE, KEY)
        run, took = go(fluid, state, TOTAL[k], APART)
        found = dpd.measure.bond_lengths(run)
        exact = [np.average(r**power, weights=weight) for power in (1, 2)]
        rows.append(
            {"k": k, "r0": r0, "a": a}
            | took
            | {
                "r": compared(found.mean, exact[0]),
                "r2": compared(found.mean_square, exact[1]),
                "temperature": float(np.mean(run.frames["temperature"])),
            }
        )
        print(rows[-1], flush=True)
    return rows


def chains() -> list[dict]:
    """Size and Rouse modes of phantom chains of 50 beads."""
    fluid = matter(dpd.term(dpd.laws.harmonic_bond, k=SPRING))
    count = round(DENSITY * CHAIN_SIDE**3 / LENGTH)
    steps = np.random.default_rng(11).normal(size=(count, LENGTH, 3)) / np.sqrt(SPRING)
    state = started(fluid, np.cumsum(steps, axis=1), CHAIN_SIDE, KEY)
    run, took = go(fluid, state, CHAIN_TOTAL, CHAIN_APART)
    ends = dpd.measure.end_to_end(run).mean_square
    gyration = dpd.measure.radius_of_gyration(run).mean_square
    lengths = dpd.measure.bond_lengths(run).mean_square
    modes = dpd.measure.rouse_modes(run)
    due = 1 / (4 * SPRING * np.sin(0.5 * np.pi * modes.p / LENGTH) ** 2)
    of_mode = [Estimate(*one) for one in zip(modes.mean_square.tolist(), modes.error.tolist())]
    told = {
        "N": LENGTH,
        "k": SPRING,
        "chains": count,
        "R2": compared(ends, 3 * (LENGTH - 1) / SPRING),
        "Rg2": compared(gyration, (LENGTH**2 - 1) / (2 * LENGTH * SPRING)),
        "r2": compared(lengths, 3 / SPRING),
        "modes": [{"p": k + 1} | compared(e, x) for k, (e, x) in enumerate(zip(of_mode, due))],
        "relaxation_times": [None if np.isnan(t) else float(t) for t in modes.relaxation_time],
        "temperature": float(np.mean(run.frames["temperature"])),
    }
    off = np.array([one["off_in_errors"] for one in told["modes"]])
    told["modes_off"] = {
        "root_mean_square": float(np.sqrt(np.mean(off**2))),
        "most": float(max(abs(off))),
    }
    print({k: v for k, v in (told | took).items() if k != "modes"}, flush=True)
    return [told | took]


if __name__ == "__main__":
    for room in (dimers, chains):
        if len(sys.argv) > 1 and room.__name__ not in sys.argv[1:]:
            continue
        results = json.loads(FILE.read_text()) if FILE.exists() else {}
        results[room.__name__] = {
            "title": room.__doc__,
            "date": datetime.date.today().isoformat(),
            "versions": f"dpdjax {dpd.__version__}, jax {jax.__version__}",
            "rows": room(),
        }
        FILE.write_text(json.dumps(results, indent=1) + "\n")
