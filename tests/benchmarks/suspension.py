"""What colloids cost: a suspension and its pure solvent, a particle-step of either in turn.

    python tests/benchmarks/suspension.py

Both in one process, runs of either by turns, medians; 2 minutes on two cores. Writes
``tests/benchmarks/SUSPENSION.md``. phi 0.2 in a box of 30: 1,289 colloids of radius 1 with Morse
attraction of 12 kT, kT 0.1, gamma 4.5, eta_0 0.3. By
velocity-Verlet: what the long steps of a suspension gain is in STEPS.md.
"""

import argparse
import datetime
import platform
import statistics
import time
import warnings
from pathlib import Path

import jax
import numpy as np

import dpdjax as dpd

HERE = Path(__file__).parent
STEPS, VERLET = 200, dpd.integrators.VelocityVerlet()


def settled(fluid, state, key, dt):
    """The state after the solvent has found its structure."""
    return dpd.run(fluid, state, key, dt, dpd.Plan(20, 100), progress=False).final


def program(fluid, state, key, dt):
    run = lambda state: dpd.simulate(fluid, state, key, dt, dpd.Plan(2, STEPS // 2)).final.velocity
    return jax.jit(run).lower(state).compile()


def seconds(compiled, state) -> float:
    began = time.perf_counter()
    jax.block_until_ready(compiled(state))
    return (time.perf_counter() - began) / (STEPS * state.n)


def pairs_per(neighbours, count) -> float:
    """Pairs in a list over ``count``."""
    return (
        float(np.sum(np.asarray(neighbours.list.idx[0]) < len(neighbours.list.reference_position)))
        / count
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--box", type=float, default=30.0)
    arguments = parser.parse_args()
    warnings.filterwarnings("ignore", message="box side")
    key = jax.random.key(0)
    made = dpd.suspension(key, phi=0.2, box=arguments.box, D0=1.2, integrator=VERLET, report=None)
    pure = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=2.5, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=0.1,
    )
    solvent = dpd.initial_state(pure, key, box=arguments.box, density=3.0, dt=made.dt)
    states = [
        settled(fluid, state, key, made.dt)
        for fluid, state in ((made.fluid, made.state), (pure, solvent))
    ]
    programs = [
        program(fluid, state, key, made.dt) for fluid, state in zip((made.fluid, pure), states)
    ]
    times = [
        [seconds(p, s) for p, s in zip(programs, states)] for _ in range(arguments.rounds + 1)
    ][1:]
    each = [statistics.median(t) for t in zip(*times)]
    ratio = statistics.median(a / b for a, b in times)
    names = ("solvent-solvent", "colloid-solvent", "colloid-colloid")
    lists = "\n".join(
        f"| {name} | {n.grid.reach:.3f} | {n.grid.skin:.3f} | {pairs_per(n, made.solvents):.2f} |"
        for name, n in zip(names, states[0].neighbours)
    )
    where = (
        f"{datetime.date.today()}, Python {platform.python_version()}, {arguments.rounds} rounds"
    )
    text = f"""# What colloids cost

Written by `python tests/benchmarks/suspension.py`; {where}.
phi 0.2, box {arguments.box:g}: {made.colloids} colloids, {made.solvents} solvent beads;
dt {made.dt:.3g}.

| box | particle-steps/s | cost of a particle-step over the solvent's |
|---|---|---|
| suspension | {1 / each[0]:.3g} | {ratio:.2f} |
| pure solvent, density 3, {solvent.n} beads | {1 / each[1]:.3g} | 1 |

| list | reach | skin | pairs per solvent bead |
|---|---|---|---|
{lists}
"""
    (HERE / "SUSPENSION.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
