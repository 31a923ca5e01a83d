"""What errs with the time step: measures, writes integrators.json, and INTEGRATORS.md from it.

    python tests/physics/integrators.py               # everything, an hour and a half on 2 cores
    python tests/physics/integrators.py "a 0" grid    # only rooms with one of these in their name
    python tests/physics/integrators.py page          # the page alone

Single precision, as users run; density 3, boxes of 10, thermal units (kT, m, r_c = 1). Rooms may
run beside each other in processes of their own.
"""

import dataclasses
import fcntl
import json
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate, block_average
from dpdjax.theory import damping_rate

HERE = Path(__file__).parent
DATA, PAGE = HERE / "integrators.json", HERE / "INTEGRATORS.md"
KEY, DENSITY, BOX = jax.random.key(2026), 3.0, 10.0
GAMMAS, REPULSIONS = (4.5, 20.0, 45.0, 90.0, 142.0, 300.0), (0.0, 10.0, 25.0, 75.0)
STEPS = (0.003, 0.006, 0.01, 0.014, 0.02, 0.028, 0.04, 0.055)
STATES = ((25.0, 4.5), (25.0, 45.0), (0.0, 20.0), (0.0, 90.0), (25.0, 142.3))
"""Repulsion and friction; the last is (a 2.5, kT 0.1, gamma 45) in thermal units."""
SHARES = {"VelocityVerlet": (0.5, 1.0, 1.5, 2.5), "ImplicitDrag": (0.5, 1.0, 2.0, 4.0)}
"""Time steps, over the suggested one."""
HOT = 1.06
VERLET = dpd.integrators.VelocityVerlet()


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Unlimited(dpd.integrators.Integrator):
    """An integrator whose steps are not refused: here those that are too long are looked at."""

    of: dpd.integrators.Integrator

    @property
    def kinds(self):
        return self.of.kinds

    def step(self, system, state, key, tally):
        return self.of.step(system, state, key, tally)

    def dt_limits(self, *_):
        return []


def fluid(a, gamma):
    return dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=1.0,
    )


def thermometers(fluid, state):
    parts = dpd.observe.pressure_tensor(fluid, state, ("kinetic", "conservative"))
    drag = dpd.observe.pressure_tensor(fluid, state, ("drag",))
    return {
        "T": dpd.observe.temperature(fluid, state),
        "p": jnp.trace(parts) / 3.0,
        "p drag": jnp.trace(drag) / 3.0,
    }


def structure(fluid, state):
    """Configurational temperature, 0 without a potential; and ``sum zeta r^2 e_x^2 e_y^2 / V``,
    which counts overlaps."""
    return {
        "Tc": jnp.nan_to_num(dpd.observe.configurational_temperature(fluid, state)),
        "overlap": dpd.observe.instantaneous_viscosity(fluid, state),
    }


def settled(a, gamma):
    """A box in equilibrium, which does not depend on the drag."""
    matter = fluid(a, gamma)
    state = dpd.initial_state(matter, KEY, box=BOX, density=DENSITY, skin=0.25, dt=0.01)
    weak = fluid(a, 4.5)
    run = dpd.run(weak, state, KEY, 0.005, dpd.Plan(200, 10), progress=False)
    return matter, run.final.restarted()


def go(matter, state, dt, how, duration, between, observe, flow=None):
    """A run of a duration, frames so far apart."""
    every = max(1, round(between / dt))
    plan = dpd.Plan(max(2, round(duration / dt / every)), every)
    how = Unlimited(how)
    return dpd.run(
        matter, state, KEY, dt, plan, flow, observe=observe, integrator=how, progress=False
    )


def at_rest(matter, state, dt, how, duration, between):
    observe = [dpd.mean(thermometers), structure]
    settled = go(matter, state, dt, how, 2.0, between, observe).final
    return go(matter, settled, dt, how, duration, between, observe)


def means(run, names=("T", "p", "p drag", "Tc", "overlap")):
    return {name: pair(block_average(np.asarray(run.frames[name], float), 16)) for name in names}


def pair(estimate):
    return [estimate.value, estimate.error]


def grid_of(a):
    """Velocity-Verlet over frictions and steps, 40 thermal times each."""
    rows = []
    for gamma in GAMMAS:
        matter, state = settled(a, gamma)
        for dt in STEPS:
            row = {"a": a, "gamma": gamma, "dt": dt}
            try:
                run = at_rest(matter, state, dt, VERLET, 40.0, 4 * dt)
            except dpd.RunError as error:
                rows.append(row | {"failed": str(error)})
                break
            rows.append(row | means(run))
            state = run.final.restarted()
            if rows[-1]["T"][0] > HOT:
                break
    return rows


def state_of(a, gamma, name):
    """An integrator at one state, at rest and in shear."""
    matter, state = settled(a, gamma)
    how = getattr(dpd.integrators, name)()
    suggested, rows = dpd.suggest_dt(matter, DENSITY, integrator=how), []
    for share in SHARES[name]:
        rows.append({"integrator": name, "share": share, "dt": share * suggested})
        rows[-1] |= one_step(matter, state, share * suggested, how)
        print(rows[-1], flush=True)
    return rows


def one_step(matter, state, dt, how):
    """All that is told of one step: at rest, of a diffusion, and sheared at a rate of 0.5."""
    try:
        rest = at_rest(matter, state, dt, how, 80.0, 0.05)
        walk = go(matter, rest.final, dt, how, 40.0, 0.4, dpd.observe.positions)
        flow = dpd.shear(0.5)
        start = go(matter, walk.final, dt, how, 5.0, 0.1, dpd.observe.shear_record, flow).final
        shear = go(matter, start, dt, how, 120.0, 0.1, dpd.observe.shear_record, flow)
    except dpd.RunError as error:
        return {"failed": str(error)}
    viscosity = dpd.shear_viscosity(shear, skip=0.0, blocks=32)
    return means(rest) | {"D": pair(dpd.diffusion(walk)), "viscosity": pair(viscosity)}


ROOMS = {f"grid a {a:g}": (grid_of, a) for a in REPULSIONS} | {
    f"state a {a:g}, gamma {gamma:g}, {name}": (state_of, a, gamma, name)
    for a, gamma in STATES
    for name in SHARES
}


def main(wanted):
    for name, (room, *numbers) in ROOMS.items():
        if wanted and not any(part in name for part in wanted):
            continue
        began = time.monotonic()
        rows = room(*numbers)
        store(name, {"rows": rows, "seconds": round(time.monotonic() - began)})
        print(name, "done", flush=True)


def store(name, result):
    """Keep a room's result, and write the page; other rooms may do so at the same time."""
    with open(Path(tempfile.gettempdir()) / "dpdjax-integrators.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        results = json.loads(DATA.read_text()) if DATA.exists() else {}
        results[name] = result
        DATA.write_text(json.dumps(results, indent=1) + "\n")
        PAGE.write_text(page(results))


COLUMNS = ("T", "Tc", "p", "p drag", "overlap", "D", "viscosity")
HEADING = """# What errs with the time step

Density 3, 3,000 beads, thermal units (kT, m, r_c = 1), single precision. `integrators.py` measures
and writes this page from `integrators.json`.

- `T - 1`, `Tc - 1`: kinetic and configurational temperature, per cent. `p`: pressure of motion and
  potentials; `p drag`: the mean of the drag's part, which is 0 in equilibrium. Velocity-Verlet has
  its drag from the velocity before a step, so that this part errs in first order of dt: it belongs
  to no pressure.
- `overlap`: `sum zeta r^2 e_x^2 e_y^2 / V`, what beads overlap by; at a = 0 exactly `2 pi gamma
  rho^2 / 1575`, and told as its error, per cent.
- `D`: of this box. `viscosity`: at a shear rate of 0.5.
- `share`: dt over what `dpd.suggest_dt` says, which is to keep T, Tc and overlap right to 0.5 %.
"""
FITTED = """## Velocity-Verlet over frictions and steps

What `dpdjax.model.advice.dt_errors` is fitted to: errors in per cent, with standard errors; 40
thermal times each.
"""


def page(results) -> str:
    grids = {name: r for name, r in results.items() if name.startswith("grid")}
    text = [HEADING]
    heads = (
        "| integrator | dt | share | T - 1, % | Tc - 1, % | p | p drag | overlap | D | viscosity |"
    )
    for a, gamma in STATES:
        where = f"a {a:g}, gamma {gamma:g}"
        text += [f"## {where}\n", heads, "|" + "---|" * heads[1:].count("|")]
        rooms = [f"state {where}, {name}" for name in SHARES]
        text += [
            told(a, gamma, row) for room in rooms for row in results.get(room, {}).get("rows", [])
        ]
        text.append("")
    text += [FITTED, "| a | gamma | dt | w dt | T - 1 | Tc - 1 | p |", "|" + "---|" * 7]
    text += [fitted(row) for name in sorted(grids) for row in grids[name]["rows"]]
    return "\n".join(text) + "\n"


def told(a, gamma, row) -> str:
    how = getattr(dpd.integrators, row["integrator"])()
    share = row["dt"] / dpd.suggest_dt(fluid(a, gamma), DENSITY, integrator=how)
    head = f"| {row['integrator']} | {row['dt']:.4f} | {share:.2g} | "
    if "failed" in row:
        return head + f"{row['failed'].split(': ')[-1]} |" + " |" * 6
    shown = {key: str(Estimate(*row[key])) for key in COLUMNS}
    shown |= {"T": in_per_cent(row["T"]), "Tc": in_per_cent(row["Tc"]) if a else ""}
    if not a:
        exact = 2 * np.pi * gamma * DENSITY**2 / 1575
        shown["overlap"] = in_per_cent([x / exact for x in row["overlap"]]) + " %"
    return head + " | ".join(shown[key] for key in COLUMNS) + " |"


def fitted(row) -> str:
    rate = damping_rate(fluid(row["a"], row["gamma"]), DENSITY) * row["dt"]
    head = f"| {row['a']:g} | {row['gamma']:g} | {row['dt']:g} | {rate:.3f} | "
    if "failed" in row:
        return head + "ran away | | |"
    hot = in_per_cent(row["Tc"]) if row["a"] else ""
    return head + f"{in_per_cent(row['T'])} | {hot} | {Estimate(*row['p'])} |"


def in_per_cent(measured) -> str:
    return str(Estimate(100 * (measured[0] - 1), 100 * measured[1]))


if __name__ == "__main__":
    if sys.argv[1:] == ["page"]:
        PAGE.write_text(page(json.loads(DATA.read_text())))
    else:
        main(sys.argv[1:])
