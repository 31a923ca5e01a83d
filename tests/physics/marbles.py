"""Physics of a marble at production accuracy: grows marbles.csv piece by piece, and writes
MARBLES.md from it.

    python tests/physics/marbles.py viscosity temperatures schmidt    # what the rest is set beside:
    an hour python tests/physics/marbles.py run --minutes 30          # more pieces, where errors
    are furthest from their targets python tests/physics/marbles.py run --minutes 30 --worker 1
    --workers 2 python tests/physics/marbles.py marble                    # the table of what there
    is

Every piece is a replica of its own, so pieces can be made by several workers, machines and
sessions. Single precision, as users run. Solvent of Zhou & Schmid (2015): a 0, gamma 5, kT 1,
density 3; marble of radius 3.
"""

import argparse
import csv
import dataclasses
import datetime
import io
import json
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
from dpdjax.measure import transport
from dpdjax.measure.hydrodynamics import LATTICE
from dpdjax.measure.rotation import angle_turned
from dpdjax.measure.statistics import Estimate, block_average

KEY = jax.random.key(2026)
DT, RADIUS, DENSITY = 0.01, 3.0, 3.0
EVERY = 10
LENGTH = 600.0
"""Time that a piece runs."""
FEWEST = 4
"""Pieces whose scatter is an error."""


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
        return (
            dpd.drive(self.force, self.torque, reaction=self.reaction)
            if self.force or self.torque
            else None
        )

    @property
    def fit(self) -> tuple[float, float]:
        """Lags at which the velocity is forgotten: it decays with the slowest wave, at
        ``nu (2 pi/L)^2``."""
        return (0.15 * self.box**2, 0.25 * self.box**2)

    @property
    def settle(self) -> float:
        """Time a piece settles: three lives of the slowest wave."""
        return 0.2 * self.box**2


CASES = (
    # Forces: a Reynolds number of 0.2 at most. Some of the first pieces of boxes of 10, 15 and 20
    # were driven up to a fifth harder.
    Case("L 10, gamma_cs 5", 10, 5, 8.0, 9.0, target=0.035),
    Case("L 10, gamma_cs 5, half the force", 10, 5, 4.0, 4.5, target=0.09),
    Case("L 10, gamma_cs 5, reaction on the others", 10, 5, 6.5, reaction="others", target=0.08),
    Case("L 10, gamma_cs 5, equilibrium", 10, 5, target=0.05),
    Case("L 10, gamma_cs 1", 10, 1, 4.0, 6.0, target=0.05),
    Case("L 10, gamma_cs 10", 10, 10, 8.5, 9.0, target=0.05),
    Case("L 10, gamma_cs 20", 10, 20, 8.5, 9.0, target=0.05),
    Case("L 15, gamma_cs 5", 15, 5, 4.2, 9.0, target=0.06),
    Case("L 20, gamma_cs 5", 20, 5, 3.4, 9.0, target=0.06),
)
TABLE = rooms.HERE / "marbles.csv"
READINGS = (
    "D_drag",
    "D_msd",
    "D_vacf",
    "Dr_torque",
    "Dr_msd",
    "Dr_vacf",
    "velocity",
    "omega",
    "T",
    "v2",
    "w2",
)
TITLES = {
    "D_drag": "D, drag",
    "D_msd": "D, displacement",
    "D_vacf": "D, velocity",
    "Dr_torque": "D_r, torque",
    "Dr_msd": "D_r, angle",
    "Dr_vacf": "D_r, spin",
    "T": "kinetic temperature",
    "v2": "M <v^2>/(1 - M/M_total)",
    "w2": "I <omega^2>",
}
"""Of the readings that make a row."""
COLUMNS = (
    "case",
    "piece",
    *READINGS,
    "dt",
    "time",
    "beads",
    "particle_steps",
    "seconds",
    "commit",
    "device",
    "date",
)


def piece(case: Case, number: int) -> dict:
    """One piece of a case: a box of its own, settled and run."""
    began = time.monotonic()
    key = jax.random.fold_in(jax.random.fold_in(KEY, 1 + CASES.index(case)), number)
    made = dpd.marbles(key, box=case.box, gamma_cs=case.gamma_cs, dt=DT, report=None)
    plan = lambda length: dpd.Plan(round(length / DT / EVERY), EVERY)
    observe = [dpd.observe.positions_of(1), dpd.observe.rotations, dpd.mean(thermal)]
    go = lambda state, length: dpd.run(
        made.fluid, state, key, DT, plan(length), case.flow, observe=observe, progress=False
    )
    run = go(go(made.state, case.settle).final, LENGTH)
    return {
        "case": case.name,
        "piece": number,
        **readings(case, run),
        "dt": DT,
        "time": LENGTH,
        "beads": made.state.n,
        "particle_steps": round((case.settle + LENGTH) / DT) * made.state.n,
        "seconds": round(time.monotonic() - began),
        "commit": commit(),
        "device": device(),
        "date": datetime.date.today().isoformat(),
    }


def thermal(fluid, state):
    """Kinetic temperatures: of all beads; of the marbles' velocity and spin across the drive, over
    what they should be."""
    marbles = len(state.rotation.velocity)
    mass, inertia, rest = fluid.mass[1], fluid.inertia[1], fluid.mass[0] * (state.n - marbles)
    share = mass / (marbles * mass + rest)
    v2, w2 = (
        jnp.mean(state.velocity[-marbles:, 1:] ** 2),
        jnp.mean(state.rotation.velocity[:, 1:] ** 2),
    )
    return {
        "T": dpd.observe.temperature(fluid, state),
        "v2": v2 * mass / fluid.kT / (1 - share),
        "w2": w2 * inertia / fluid.kT,
    }


def readings(case: Case, run) -> dict:
    """What a piece says: driven cases by their drift, all of them by their fluctuations across
    it."""
    found = {name: float(np.mean(run.frames[name])) for name in ("T", "v2", "w2")}
    if case.force:
        driven = dpd.measure.driven_diffusion(run, skip=0.0)
        found |= {"D_drag": driven.diffusion.value, "velocity": driven.velocity.value}
    if case.torque:
        driven = dpd.measure.driven_rotation(run, skip=0.0)
        found |= {"Dr_torque": driven.diffusion.value, "omega": driven.velocity.value}
    # Motion across the drive, along y and z, is that of equilibrium: two of the three directions
    # that D is the mean of.
    axes = np.sqrt([0.0, 1.5, 1.5] if case.flow else [1.0, 1.0, 1.0])
    interval = float(run.interval)
    time = interval * np.arange(round(case.fit[1] / interval) + 1)
    named = {"D": (run.frames["unwrapped"], run.frames["velocity"])}
    named["Dr"] = angle_turned(run.frames["orientation"]), run.frames["angular_velocity"]
    ways = {
        "msd": (transport.squared_displacement, transport.einstein),
        "vacf": (transport.autocorrelation, transport.green_kubo_integral),
    }
    for name, both in named.items():
        for values, (way, (correlate, read)) in zip(both, ways.items()):
            curve = correlate(np.asarray(values, float) * axes, len(time) - 1)
            found[f"{name}_{way}"] = float(read(time, curve[None], time >= case.fit[0])[0])
    return found


# ------------------------------------------------------------ keeping pieces


def commit() -> str:
    found = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, cwd=rooms.HERE
    )
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
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    if not TABLE.exists():
        writer.writeheader()
    writer.writerow(
        {
            name: f"{value:.7g}" if isinstance(value, float) else value
            for name, value in line.items()
        }
    )
    with TABLE.open("a") as file:
        file.write(text.getvalue())


def reading(lines: list[dict], name: str) -> Estimate | None:
    """Mean of a reading over pieces, and its standard error."""
    values = np.array([float(line[name]) for line in lines if line[name]])
    if not len(values):
        return None
    error = values.std(ddof=1) / math.sqrt(len(values)) if len(values) > 1 else math.nan
    return Estimate(float(values.mean()), float(error), len(values))


def drag(lines: list[dict]) -> Estimate:
    """D from the drift in several pieces, weighed by the errors that fluctuation and dissipation
    give each."""
    D, error = _drags(lines)
    weight = error**-2.0
    return Estimate(float(np.sum(weight * D) / weight.sum()), float(weight.sum() ** -0.5), len(D))


def _drags(lines):
    """D of each piece and its error: the displacement in a time t scatters by ``sqrt(2 D t)``, and
    ``kT/F`` is ``D/v``."""
    D, velocity, time = np.array(
        [[float(line[name]) for name in ("D_drag", "velocity", "time")] for line in lines]
    ).T
    return D, D / velocity * np.sqrt(2 * D.mean() / time)


def scatter(cases: list[list[dict]]) -> Estimate:
    """Mean square of the drags of pieces about their case, over the square of the errors above: 1
    if those are right."""
    squares, free = 0.0, 0
    for lines in cases:
        D, error = _drags(lines)
        squares, free = squares + np.sum(((D - drag(lines).value) / error) ** 2), free + len(D) - 1
    return Estimate(float(squares / free), math.sqrt(2 / free), free)


def need(case: Case, lines: list[dict]) -> float:
    """How far the error of a case is from its target; infinite for too few pieces to tell."""
    if len(lines) < FEWEST:
        return 1e6 / (1 + len(lines))
    found = drag(lines) if case.force else reading(lines, "D_msd")
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
        print(
            f"{case.name}, piece {number}: {line['seconds']} s",
            {k: line.get(k) for k in READINGS},
            flush=True,
        )


# ------------------------------------------------------------ rooms


def viscosity():
    """Viscosity of the solvent: a 0, gamma 5, kT 1, density 3"""
    pure = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=5.0, r_c=1.0)], kT=1.0)
    eta = dpd.measure_viscosity(pure, key=KEY, density=DENSITY, tolerance=0.015, dt=DT).estimate
    return [
        row(
            "viscosity, shear",
            f"dt {DT:g}",
            eta,
            Estimate(1.23, 0.01),
            "Zhou & Schmid, method not stated",
        )
    ]


def temperatures():
    """Temperatures of 20 marbles of radius 1 in a box of side 8, kT 1"""
    rows, dt = [], 0.006
    for coupling in ("full", "transverse", "central"):
        for gamma_cs in (1.0, 5.0, 20.0):
            made = dpd.marbles(
                KEY,
                box=8.0,
                count=20,
                radius=1.0,
                gamma_cs=gamma_cs,
                coupling=coupling,
                dt=dt,
                report=None,
            )
            state = dpd.run(
                made.fluid, made.state, KEY, dt, dpd.Plan(20, 200), progress=False
            ).final
            run = dpd.run(
                made.fluid,
                state,
                KEY,
                dt,
                dpd.Plan(2000, 100),
                observe=dpd.mean(thermal),
                progress=False,
            )
            where = f"{coupling}, gamma_cs {gamma_cs:g}, dt {dt:g}, {made.solvents} solvent beads"
            names = {
                "T": "kinetic temperature of all beads",
                "v2": TITLES["v2"],
                "w2": TITLES["w2"],
            }
            for name, title in names.items():
                if name != "w2" or coupling != "central":
                    mean = block_average(run.frames[name])
                    rows.append(
                        row(
                            f"{title}, per component, over kT",
                            where,
                            mean,
                            1.0,
                            "exact, up to O(dt)",
                        )
                    )
            print(*map(rooms.text, rows[-3:]), sep="\n", flush=True)
    return rows


def schmidt():
    """Transverse drag in the solvent: the Schmidt number

    Drag across the line of centres beside gamma 5 along it, at kT 1 and density 3. Beads that are
    dragged more carry less momentum, so the viscosity falls before it rises. D is the large
    system's: that of a box of side 10 and 2.837 kT/(6 pi eta 10).
    """
    rows = []
    for gamma_t in (0.0, 5.0, 20.0):
        frictions = [
            dpd.term(dpd.central_drag, gamma=5.0, r_c=1.0),
            dpd.term(dpd.laws.transverse_drag, gamma_t=gamma_t, r_c=1.0),
        ]
        fluid, where = dpd.fluid(drag=frictions, kT=1.0), f"gamma_t {gamma_t:g}, dt 0.005"
        eta = dpd.measure_viscosity(
            fluid, key=KEY, density=DENSITY, tolerance=0.02, dt=0.005
        ).estimate
        state = dpd.initial_state(fluid, KEY, box=10.0, density=DENSITY, dt=0.005)
        state = dpd.run(fluid, state, KEY, 0.005, dpd.Plan(20, 100), progress=False).final
        observe = [
            dpd.observe.positions,
            dpd.mean(lambda fluid, state: {"T": dpd.observe.temperature(fluid, state)}),
        ]
        run = dpd.run(fluid, state, KEY, 0.005, dpd.Plan(600, 50), observe=observe, progress=False)
        box = dpd.diffusion(run, fit=(5.0, 10.0))
        D = Estimate(box.value + LATTICE / (6 * math.pi * eta.value * 10), box.error, box.blocks)
        rows += [
            row(
                "kinetic temperature",
                where,
                block_average(run.frames["T"]),
                1.0,
                "exact, up to O(dt)",
            ),
            row("viscosity, shear", where, eta),
            row("D of a solvent bead", where, D),
            row("Schmidt number, eta/(rho D)", where, eta.over(D).scaled(1 / DENSITY)),
        ]
        print(*map(rooms.text, rows[-4:]), sep="\n", flush=True)
    return rows


def marble():
    """A marble of radius 3: diffusion from its drift, its displacement and its velocity

    D where the whole has no momentum. Drag: driven along x; displacement and velocity: along y and
    z in the same runs, or in equilibrium. Theory: no slip, the bare radius and the viscosity
    measured above; the hydrodynamic radius is what no slip would take. Errors are the scatter of
    pieces, but for the drag: there each piece has the error that fluctuation and dissipation give
    it, kT/F sqrt(2 D/t), and the last row compares with their scatter. A case of fewer than four
    pieces is not shown.

    With the reaction on the others a force F drives as F/(1 - M/M_total) does (Zhou & Schmid divide
    by it once more, for the velocity relative to the solvent); D is corrected for it.
    """
    there = pieces()
    found = {case: there[case.name] for case in CASES if len(there[case.name]) >= FEWEST}
    eta = json.loads((rooms.HERE / "marbles.json").read_text())["viscosity"]["rows"][0]["value"][0]
    rows = [line for case, lines in found.items() for line in _of_case(case, lines, eta)]
    alike = [case for case in found if (case.box, case.gamma_cs) == (10, 5)]
    together = [line for case in alike for line in found[case]]
    rows += _of_readings(
        alike[0],
        "L 10, gamma_cs 5, all runs",
        together,
        eta,
        ("D_msd", "D_vacf", "Dr_msd", "Dr_vacf"),
    )
    rows.append(
        row(
            "D, drag",
            "L 10, gamma_cs 5, all runs",
            drag([line for case in alike if case.force for line in found[case]]),
        )
    )
    driven = scatter([lines for case, lines in found.items() if case.force])
    rows.append(
        row(
            "scatter of drags over that expected, squared",
            "all pieces",
            driven,
            1.0,
            "fluctuation and dissipation",
        )
    )
    several = [
        case
        for case in found
        if case.name in ("L 10, gamma_cs 5", "L 15, gamma_cs 5", "L 20, gamma_cs 5")
    ]
    if len(several) > 1:
        estimates = [drag(found[case]) for case in several]
        radius = dpd.theory.hydrodynamic_radius(
            [case.box for case in several], estimates, kT=1.0, viscosity=eta
        )
        rows.append(
            row(
                "hydrodynamic radius",
                ", ".join(case.name for case in several),
                radius,
                note="from the drag",
            )
        )
    return rows


def _of_case(case, lines, eta):
    """The rows of one case, with what they cost and how fast the marble went."""
    rows = _of_readings(case, case.name, lines, eta, TITLES)
    steps = sum(float(line["particle_steps"]) for line in lines)
    rows[0]["note"] = (
        f"{len(lines)} pieces, {steps:.2g} particle-steps, "
        f"{sum(float(line['seconds']) for line in lines):.0f} s"
    )
    if case.force:
        Re = DENSITY * abs(reading(lines, "velocity").value) * RADIUS / eta
        radius = dpd.theory.hydrodynamic_radius([case.box], [drag(lines)], kT=1.0, viscosity=eta)
        rows.append(
            row(
                "hydrodynamic radius",
                case.name,
                radius,
                note=f"from the drag, this box alone; Re {Re:.2f}",
            )
        )
    return rows


def _of_readings(case, where, lines, eta, names):
    at = dict(kT=1.0, viscosity=eta, radius=RADIUS, box=case.box)
    beside = {name: (1.0, "exact, up to O(dt)") for name in names}
    for kind, theory in (
        ("D_", dpd.theory.sphere_diffusion(**at)),
        ("Dr_", dpd.theory.sphere_rotational_diffusion(**at)),
    ):
        beside |= {name: (theory, "no slip, radius 3") for name in names if name.startswith(kind)}
    estimates = {
        name: drag(lines) if name == "D_drag" and case.force else reading(lines, name)
        for name in names
    }
    return [
        row(TITLES[name], where, value, *beside[name])
        for name, value in estimates.items()
        if value is not None
    ]


HEADING = """# A marble at production accuracy

Written by `python tests/physics/marbles.py`; do not edit.
Reduced units, standard errors. Pieces: marbles.csv."""
ROOMS = (viscosity, temperatures, schmidt, marble)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "what",
        nargs="+",
        help="run, or the names of rooms: " + ", ".join(room.__name__ for room in ROOMS),
    )
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
