"""Physical time per second at the suggested step, beside that at the step of an older rule.

    python tests/benchmarks/steps.py

Boxes of 3,000 beads at rest, and suspensions of 4,200, each step with lists that suit it, by turns;
writes ``tests/benchmarks/STEPS.md``; 8 minutes on two cores.
"""

import datetime
import os
import platform
import statistics
import time
import warnings
from pathlib import Path

import jax

import dpdjax as dpd
from dpdjax.theory import damping_rate

HERE, KEY, ROUNDS, DENSITY = Path(__file__).parent, jax.random.key(4), 5, 3.0
STATES = {
    "colloid solvent (a 2.5, kT 0.1, gamma 45)": (2.5, 0.1, 45.0),
    "(a 25, kT 1, gamma 45)": (25.0, 1.0, 45.0),
    "(a 0, kT 1, gamma 90)": (0.0, 1.0, 90.0),
    "water (a 25, kT 1, gamma 4.5)": (25.0, 1.0, 4.5),
}
SUSPENSIONS = {
    "hard, gamma 45, eta_0 0.95": dict(gamma=45.0, eta_0=0.95),
    "Morse 12 kT, gamma 45, eta_0 0.95": dict(gamma=45.0, eta_0=0.95, D0=1.2),
    "hard, gamma 4.5, eta_0 0.3": {},
}


def fluid(a, kT, gamma):
    return dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=kT,
    )


def older(matter, a, kT):
    """The step at which a temperature error linear in the damping rate is 0.5 %."""
    repulsion = min(0.628 * a / kT, 16.0)
    return 0.005 / (0.7 / (1 + repulsion / 20)) / damping_rate(matter, DENSITY)


def case(matter, dt, how):
    """A function that runs a box for a time and returns what that took."""
    state = dpd.initial_state(matter, KEY, box=10.0, density=DENSITY, dt=dt)
    weak = matter.set(gamma=4.5 * float(matter.kT) ** 0.5, energies="keep")
    state = dpd.run(weak, state, KEY, dt, dpd.Plan(10, 200), progress=False).final.restarted()
    return timed(matter, state, dt, how)


def timed(matter, state, dt, how):
    """A function that runs a state for a time and returns what that took."""

    def go(duration):
        nonlocal state
        plan = dpd.Plan(2, max(1, round(duration / dt / 2)))
        began = time.perf_counter()
        run = dpd.run(matter, state, KEY, dt, plan, integrator=how, progress=False)
        state = jax.block_until_ready(run.final)
        return time.perf_counter() - began

    go(20 * dt)
    return go


def row(name, numbers) -> str:
    matter = fluid(*numbers)
    verlet, implicit = dpd.integrators.VelocityVerlet(), dpd.integrators.ImplicitDrag()
    steps = [
        (older(matter, *numbers[:2]), verlet),
        (dpd.suggest_dt(matter, DENSITY), verlet),
        (dpd.suggest_dt(matter, DENSITY, integrator=implicit), implicit),
    ]
    cases = [case(matter, dt, how) for dt, how in steps]
    duration = 1500 * steps[0][0]
    turns = [[go(duration) for go in cases] for _ in range(ROUNDS)]
    ratios = [statistics.median(t[0] / t[k] for t in turns) for k in (1, 2)]
    dts = " | ".join(f"{dt:.4f}" for dt, _ in steps)
    print(name, dts, ratios, flush=True)
    return f"| {name} | {dts} | {ratios[0]:.1f} | {ratios[1]:.1f} |"


def suspended(name, numbers) -> str:
    """Velocity-Verlet at the step that lubrication and contacts allow, and the default."""
    verlet = dpd.integrators.VelocityVerlet()
    make = lambda how: dpd.suspension(
        KEY, phi=0.2, box=12.0, sheared=False, report=None, integrator=how, **numbers
    )
    made = [make(verlet), make(None)]
    # Both from one settled state, its lists made for either step.
    settle = lambda m: dpd.run(
        m.fluid, m.state, KEY, m.dt, dpd.Plan(2, round(5.0 / m.dt)), integrator=m.integrator
    )
    cases = [timed(m.fluid, settle(m).final, m.dt, m.integrator) for m in made]
    duration = 800 * made[0].dt
    turns = [[go(duration) for go in cases] for _ in range(ROUNDS)]
    ratio = statistics.median(old / new for old, new in turns)
    cost = made[1].dt / made[0].dt / ratio
    spent = [made[0].tau / duration * statistics.median(t) for t in zip(*turns)]
    dts = f"{made[0].dt:.5f} | {made[1].dt:.4f}, {made[1].integrator.inner} short"
    print(name, dts, ratio, cost, spent, flush=True)
    return (
        f"| {name} | {dts} | {ratio:.1f} | {cost:.2f} | {made[0].tau:.1f} | {spent[0]:.0f} s | "
        f"{spent[1]:.0f} s |"
    )


def main():
    warnings.simplefilter("ignore")
    rows = [row(name, numbers) for name, numbers in STATES.items()]
    colloids = [suspended(name, numbers) for name, numbers in SUSPENSIONS.items()]
    (HERE / "STEPS.md").write_text(
        "# Physical time per second\n\n"
        f"{datetime.date.today()}, {os.cpu_count()} cores, {platform.machine()}, float32, dpdjax "
        f"{dpd.__version__}, jax {jax.__version__}. The older rule took the temperature to err by "
        "0.7 dt times the damping rate. What each step errs by is in "
        "[INTEGRATORS.md](../physics/INTEGRATORS.md). Ratios by turns, medians of "
        f"{ROUNDS}; written by `steps.py`.\n\n"
        "| state | dt, older rule | dt, suggested | dt, ImplicitDrag | time per second, suggested "
        "over older | ImplicitDrag over older |\n|---|---|---|---|---|---|\n"
        + "\n".join(rows)
        + "\n\nAt (a 25, gamma 45) no longer step is suggested: the temperature of velocity-Verlet "
        "is 0.55 % too high at this one."
        "\n\nSuspensions: phi 0.2, box 12, 83 colloids and 4,147 solvent beads, from "
        "velocity-Verlet to MultipleTimeStep. Their physics at this step: "
        "[LONGSTEPS.md](../physics/LONGSTEPS.md).\n\n"
        "| suspension | dt, velocity-Verlet | dt, default | time per second, default over "
        "velocity-Verlet | cost of a step | tau | one tau, velocity-Verlet | one tau, default |\n"
        "|---|---|---|---|---|---|---|---|\n" + "\n".join(colloids) + "\n"
    )


if __name__ == "__main__":
    main()
