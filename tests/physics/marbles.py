"""Physics of a marble at production accuracy: grows marbles.csv piece by piece, and writes MARBLES.md from it.

    python tests/physics/marbles.py viscosity temperatures    # what the rest is set beside: an hour
    python tests/physics/marbles.py run --minutes 30          # more pieces, where errors are furthest from their targets
    python tests/physics/marbles.py run --minutes 30 --worker 1 --workers 2
    python tests/physics/marbles.py table

Every piece is a batch of replicas of its own, so pieces can be made by several workers, machines and sessions. Single
precision, as users run. Solvent of Zhou & Schmid (2015): a 0, gamma 5, kT 1, density 3; marble of radius 3.
"""

import argparse
import csv
import dataclasses
import datetime
import math
import platform
import subprocess
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
import rooms
from rooms import row

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate, block_average

KEY = jax.random.key(2026)
DT, RADIUS, DENSITY = 0.006, 3.0, 3.0
EVERY = 10
SETTLE, LENGTH, REPLICAS = 20.0, 150.0, 4
"""Time a replica settles and runs, and replicas of a piece."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One cell of the table: what runs, and the relative error of D wanted."""

    name: str
    box: float
    gamma_cs: float
    force: float = 0.0
    torque: float = 0.0
    reaction: str = "all"
    target: float = 0.05

    @property
    def flow(self):
        return dpd.drive(self.force, self.torque, reaction=self.reaction) if self.force or self.torque else None

    @property
    def fit(self) -> tuple[float, float]:
        """Lags at which the velocity is forgotten: it decays with the slowest wave, at ``nu (2 pi/L)^2``."""
        return (15.0, 25.0) if self.box <= 10 else (0.16 * self.box**2, 0.24 * self.box**2)


CASES = (
    Case("L 10, gamma_cs 5", 10, 5, 7.0, 9.0, target=0.04),
    Case("L 10, gamma_cs 5, half the force", 10, 5, 3.5, 4.5, target=0.08),
    Case("L 10, gamma_cs 5, reaction on the others", 10, 5, 7.0, reaction="others", target=0.06),
    Case("L 10, gamma_cs 5, equilibrium", 10, 5, target=0.04),
    Case("L 10, gamma_cs 1", 10, 1, 4.0, 6.0, target=0.05),
    Case("L 10, gamma_cs 10", 10, 10, 7.0, 9.0, target=0.05),
    Case("L 10, gamma_cs 20", 10, 20, 7.0, 9.0, target=0.05),
    Case("L 15, gamma_cs 5", 15, 5, 4.0, 9.0, target=0.06),
    Case("L 20, gamma_cs 5", 20, 5, 3.2, 9.0, target=0.08),
)
TABLE = rooms.HERE / "marbles.csv"
READINGS = ("D_drag", "D_msd", "D_vacf", "Dr_torque", "Dr_msd", "Dr_vacf", "velocity", "omega", "T", "v2", "w2")
COLUMNS = ("case", "piece", *READINGS, "dt", "time", "replicas", "beads", "particle_steps", "seconds", "commit", "device", "date")


def piece(case: Case, number: int) -> dict:
    """One piece of a case: a batch of replicas, settled and run."""
    began = time.monotonic()
    keys = jax.random.split(jax.random.fold_in(jax.random.fold_in(KEY, 1 + CASES.index(case)), number), REPLICAS)
    made = [dpd.marbles(key, box=case.box, gamma_cs=case.gamma_cs, dt=DT, report=None) for key in keys]
    state = jax.tree.map(lambda *leaves: jnp.stack(leaves), *[m.state for m in made])
    fluid, go = made[0].fluid, lambda state, length: dpd.Plan(round(length / DT / EVERY), EVERY)
    settled = dpd.run(fluid, state, keys, DT, go(state, SETTLE), case.flow, progress=False).final
    observe = [dpd.positions_of(1), dpd.mean(dpd.rotations), dpd.mean(thermal)]
    # The mean angular velocity of every frame; the orientation at its end is not wanted.
    run = dpd.run(fluid, settled, keys, DT, go(settled, LENGTH), case.flow, observe=observe, progress=False)
    return {
        "case": case.name, "piece": number, **readings(case, run, made[0].share),
        "dt": DT, "time": LENGTH * REPLICAS, "replicas": REPLICAS, "beads": made[0].state.n,
        "particle_steps": round((SETTLE + LENGTH) / DT) * REPLICAS * made[0].state.n,
        "seconds": round(time.monotonic() - began), "commit": commit(), "device": device(),
        "date": datetime.date.today().isoformat(),
    }  # fmt: skip


def thermal(fluid, state):
    """Kinetic temperatures: of all beads; of the marble's velocity and spin, over what they should be."""
    mass, inertia, rest = fluid.mass[1], fluid.inertia[1], fluid.mass[0] * (state.n - 1)
    share = mass / (mass + rest)
    v2, w2 = jnp.mean(state.velocity[-1] ** 2), jnp.mean(state.rotation.velocity**2)
    return {"T": dpd.temperature(fluid, state), "v2": v2 * mass / fluid.kT / (1 - share), "w2": w2 * inertia / fluid.kT}


def readings(case: Case, run, share) -> dict:
    """What a piece says: driven cases by their drift, all of them by their fluctuations across it."""
    found = {name: float(np.mean(run.frames[name])) for name in ("T", "v2", "w2")}
    if case.force:
        driven = dpd.driven_diffusion(run, skip=0.0)
        found |= {"D_drag": driven.diffusion.value, "velocity": driven.velocity.value}
    if case.torque:
        driven = dpd.driven_rotation(run, skip=0.0)
        found |= {"Dr_torque": driven.diffusion.value, "omega": driven.velocity.value}
    still = at_rest(run)
    for method in ("msd", "vacf"):
        found[f"D_{method}"] = dpd.diffusion(still, species=1, method=method, fit=case.fit).value
        found[f"Dr_{method}"] = dpd.rotational_diffusion(still, method=method, fit=case.fit).value
    return found


def at_rest(run):
    """The run without its drift, which is that of the whole case to a part in a hundred: fluctuations are as in equilibrium."""
    frames = dict(run.frames)
    if hasattr(run.flow, "push"):
        for name in ("velocity", "angular_velocity"):
            frames[name] = frames[name] - frames[name].mean(axis=(0, 1), keepdims=True)
        drift = np.diff(frames["unwrapped"], axis=1).mean(axis=(0, 1), keepdims=True)
        frames["unwrapped"] = frames["unwrapped"] - drift * np.arange(frames["unwrapped"].shape[1])[None, :, None, None]
    return dataclasses.replace(run, frames=frames)


# ---------------------------------------------------------------------------- keeping pieces


def commit() -> str:
    found = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=rooms.HERE)
    return found.stdout.strip() or "unknown"


def device() -> str:
    kind = jax.devices()[0].device_kind
    return f"{kind}, jax {jax.__version__}, Python {platform.python_version()}"


def pieces() -> dict[str, list[dict]]:
    """The pieces there are, by case."""
    found = {case.name: [] for case in CASES}
    if TABLE.exists():
        for line in csv.DictReader(TABLE.open()):
            found.setdefault(line["case"], []).append(line)
    return found


def keep(line: dict):
    """Append a piece; one write, so that several workers do not mix theirs."""
    text = "" if TABLE.exists() else ",".join(COLUMNS) + "\n"
    quoted = lambda v: f'"{v}"' if isinstance(v, str) else f"{v:.7g}" if isinstance(v, float) else str(v)
    text += ",".join(quoted(line.get(name, "")) for name in COLUMNS) + "\n"
    with TABLE.open("a") as file:
        file.write(text)


def reading(lines: list[dict], name: str) -> Estimate | None:
    """Mean of a reading over pieces, and its standard error."""
    values = np.array([float(line[name]) for line in lines if line[name] not in ("", '""')])
    if not len(values):
        return None
    error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return Estimate(float(values.mean()), float(error), len(values))


def need(case: Case, lines: list[dict]) -> float:
    """How far the error of a case is from its target; infinite for too few pieces to tell."""
    if len(lines) < 6:
        return 1e6 / (1 + len(lines))
    found = reading(lines, "D_drag" if case.force else "D_msd")
    return found.error / abs(found.value) / case.target


def run(minutes: float, worker: int, workers: int, only: str | None):
    """Pieces where they are needed most, for some minutes; the last may take longer."""
    end = time.monotonic() + 60 * minutes
    while time.monotonic() < end:
        there = pieces()
        chosen = [case for case in CASES if only is None or only in case.name]
        case = max(chosen, key=lambda case: need(case, there[case.name]))
        if need(case, there[case.name]) <= 1:
            print("every error is at its target")
            return
        taken = {int(line["piece"]) for line in there[case.name]}
        number = next(k for k in range(worker, 10**6, workers) if k not in taken)
        line = piece(case, number)
        keep(line)
        print(f"{case.name}, piece {number}: {line['seconds']} s", {k: line.get(k) for k in READINGS}, flush=True)


# ---------------------------------------------------------------------------- rooms


def viscosity():
    """Viscosity of the solvent: a 0, gamma 5, kT 1, density 3"""
    pure = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=5.0, r_c=1.0)], kT=1.0)
    eta = dpd.measure_viscosity(pure, key=KEY, density=DENSITY, tolerance=0.015, dt=DT).estimate
    return [row("viscosity, shear", f"dt {DT:g}", eta, Estimate(1.23, 0.01), "Zhou & Schmid, method not stated")]


def temperatures():
    """Temperatures of a marble of radius 1.5 and mass 30, kT 1"""
    rows = []
    for coupling in ("central", "transverse", "full"):
        for gamma_cs in (1.0, 5.0, 20.0):
            light = dict(radius=1.5, mass=30.0, inertia=27.0)
            made = dpd.marbles(KEY, box=6.0, gamma_cs=gamma_cs, coupling=coupling, skin=0.3, dt=0.005, report=None, **light)
            keys = jax.random.split(KEY, 4)
            state = dpd.run(made.fluid, made.state, keys, made.dt, dpd.Plan(20, 200), progress=False).final
            run = dpd.run(made.fluid, state, keys, made.dt, dpd.Plan(1000, 150), observe=dpd.mean(thermal), progress=False)
            where = f"{coupling}, gamma_cs {gamma_cs:g}, dt {made.dt:g}, {made.solvents} solvent beads, 4 boxes"
            names = {"T": "kinetic temperature of all beads", "v2": "M <v^2>/(1 - M/M_total)", "w2": "I <omega^2>"}
            for name, title in names.items():
                if name != "w2" or coupling != "central":
                    mean = block_average(run.frames[name])
                    rows.append(row(f"{title}, per component, over kT", where, mean, 1.0, "exact, up to O(dt)"))
    return rows


HEADING = """# A marble at production accuracy

Written by `python tests/physics/marbles.py`; do not edit. Reduced units, standard errors. Pieces: marbles.csv."""
ROOMS = (viscosity, temperatures)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="+", help="run, or the names of rooms: " + ", ".join(room.__name__ for room in ROOMS))
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--worker", type=int, default=0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", default=None, help="part of the name of a case")
    arguments = parser.parse_args()
    if "run" in arguments.what:
        run(arguments.minutes, arguments.worker, arguments.workers, arguments.only)
    names = [name for name in arguments.what if name != "run"]
    if names:
        rooms.measure(ROOMS, names, "marbles.json", "MARBLES.md", HEADING)


if __name__ == "__main__":
    sys.exit(main())
