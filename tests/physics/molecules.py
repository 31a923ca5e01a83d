"""Melts, solutions, lamellae and bilayers: writes molecules.json, and MOLECULES.md.

    python tests/physics/molecules.py               # everything, an hour on two cores
    python tests/physics/molecules.py melt bilayer  # only these

Single precision, at the default step unless said otherwise, as users run.
"""

import json
import math
import sys
import time
from pathlib import Path

import jax
import numpy as np
import rooms
from rooms import row

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate

KEY = jax.random.key(2121)
HERE = Path(__file__).parent
HEADING = """# Molecules

What chains, copolymers and lipids do, beside what is exact, LAMMPS and published
(`python tests/physics/molecules.py`, `lammps_melt.py`)."""
LIPID, WATER = "H3(T4)2", "W"
REPULSION = {"HH": 30, "HT": 35, "HW": 30, "TT": 10, "TW": 75, "WW": 25}
"""Of Shillcock & Lipowsky's lipids with two tails, as the issue of tension has them."""
SPRING = {"k": 128.0, "r0": 0.5}
BEND = 15.0


def go(made, steps, every, key=KEY, state=None, flow=None, observe=None, dt=None, how=None):
    """A run of so many steps from the start or another state."""
    plan = dpd.Plan(steps // every, every)
    state = made.state if state is None else state
    given = made.fluid, state, key, made.dt if dt is None else dt, plan, flow
    how = made.integrator if how is None else how
    return dpd.run(*given, observe=observe, integrator=how, progress=False)


# ------------------------------------------------------------------------------ phantoms


def dimers():
    """Two beads on a spring that repel each other besides

    Springs k (r - r0)^2/2 with a soft repulsion a of the same bond, rubbed by beads that do nothing
    else; exact by one integral. Measured by `phantom.py`, kept in `phantom.json`.
    """
    rows = []
    for one in _phantom()["dimers"]["rows"]:
        state = f"k {one['k']:g}, r0 {one['r0']:g}, a {one['a']:g}"
        for name, key in (("<r>", "r"), ("<r^2>", "r2")):
            rows.append(_beside_exact(name, state, one[key]))
    return rows


def phantom():
    """A chain that does not see itself

    50 beads, k 4: sizes, and every Rouse mode kT/(4 k sin^2(p pi/2N)) a component. Measured by
    `phantom.py` too.
    """
    (one,) = _phantom()["chains"]["rows"]
    names = (("<R^2>", "R2"), ("<Rg^2>", "Rg2"), ("<r^2>", "r2"))
    rows = [_beside_exact(name, "N 50", one[key]) for name, key in names]
    rows += [_beside_exact(f"mode {m['p']}", "N 50", m) for m in one["modes"][:4]]
    off = np.array([m["off_in_errors"] for m in one["modes"]])
    told = f"largest {np.abs(off).max():.1f}"
    return [
        *rows,
        row("all 49 modes, rms in errors", "N 50", float(np.sqrt(np.mean(off**2))), 1.0, "", told),
    ]


def _phantom() -> dict:
    return json.loads((HERE / "phantom.json").read_text())


def _beside_exact(name: str, state: str, found: dict):
    value = Estimate(found["value"], found["error"])
    return row(name, state, value, found["exact"], "exact", f"{found['off_in_errors']:+.1f} sigma")


# ------------------------------------------------------------------------------ melts


def melt():
    """A sheared melt beside LAMMPS

    Chains of 10 beads, k 4, r0 0, a 25, gamma 4.5, rate 0.1, dt 0.01, box 10; LAMMPS from
    `lammps_melt.json`.
    """
    made = dpd.molecules(KEY, "A10", box=10.0, report=None)
    flow = dpd.shear(0.1)
    rested = go(made, 20_000, 1000, flow=flow, dt=0.01)
    how = [dpd.mean(dpd.observe.standard), dpd.observe.positions]
    run = go(made, 200_000, 250, state=rested.final, flow=flow, observe=how, dt=0.01)
    pressure = run.frames["pressure_tensor"].trace(axis1=1, axis2=2) / 3
    mine = {
        "temperature": dpd.measure.block_average(run.frames["temperature"], 20),
        "pressure": dpd.measure.block_average(pressure, 20),
        "viscosity": dpd.shear_viscosity(run),
        "squared_end_to_end": dpd.measure.end_to_end(run).mean_square,
    }
    told = json.loads((HERE / "lammps_melt.json").read_text())
    rows = []
    for name, value in mine.items():
        theirs = np.array([one[name] for one in told])
        weight = theirs[:, 1] ** -2
        other = Estimate(float((weight * theirs[:, 0]).sum() / weight.sum()), weight.sum() ** -0.5)
        off = (value.value - other.value) / math.hypot(value.error, other.error)
        rows.append(
            row(name.replace("_", " "), "N 10", value, other, "LAMMPS", f"{off:+.1f} sigma")
        )
    return rows


def exponent(sizes, squares):
    """The slope of log R with log (N - 1), R the root of R^2, all sizes alike, and its error."""
    x = np.log(np.array(sizes) - 1.0)
    y = 0.5 * np.log([s.value for s in squares])
    error = np.array([0.5 * s.error / s.value for s in squares])
    off = (x - x.mean()) / ((x - x.mean()) ** 2).sum()
    return Estimate(float((off * y).sum()), float(np.sqrt(((off * error) ** 2).sum())))


def exponents(sizes, squares, due, source):
    """That of all sizes, and that of the two largest."""
    told = lambda few: f"N {few[0]} to {few[-1]}"
    return [
        row("nu", told(few), exponent(few, squares[-len(few) :]), due, source)
        for few in (sizes, sizes[-2:])
    ]


def memory():
    """How a melt of phantom chains forgets its stress

    N 10, k 4, a 0. The bond stress of independent Gaussian modes is remembered as
    G(t) = (rho kT/N) sum_p C_p(t)^2, C_p the autocorrelation of a mode as measured: exp(-t/tau_p)
    in the model of Rouse, swinging where drag is weak. G from the bond stress of the whole box.
    """
    made = dpd.molecules(KEY, "A10", box=7.0, a=0.0, report=None)
    rested = go(made, 20_000, 1000)
    seen = [dpd.observe.stresses, dpd.observe.positions]
    every = max(1, round(0.05 / made.dt))
    run = go(made, 4_000 * every, every, state=rested.final, observe=seen)
    modes = dpd.measure.rouse_modes(run)
    lags = np.array([0, 2, 5, 10, 20, 40, 80, 160])
    memory = _stress_memory(run, lags)
    due = (
        3.0
        / 10
        * sum(np.interp(lags * every * made.dt, c.time, c.value) ** 2 for c in modes.correlations)
    )
    told = lambda k: f"t {lags[k] * every * made.dt:.2f}"
    return [
        row("G(t), bonds", told(k), memory[k], float(due[k]), "modes") for k in range(len(lags))
    ]


def _stress_memory(run, lags):
    """The autocorrelation of the off-diagonal bond stress, V/kT <s(0) s(t)>, by ten blocks."""
    stress = np.asarray(run.frames["pressure_bond"], float)
    series = np.stack([stress[:, 0, 1], stress[:, 0, 2], stress[:, 1, 2]])
    volume = float(run.final.box.volume)
    count = series.shape[1] - lags.max()
    each = [volume * (series[:, :count] * series[:, lag : lag + count]).mean(0) for lag in lags]
    return [dpd.measure.block_average(one, 10) for one in each]


def cost():
    """What bonds cost

    A melt of chains of 10 beside the same number of beads without bonds, box of 20, 300 steps each,
    in turn; the median of seven.
    """
    made = dpd.molecules(KEY, "A10", box=20.0, report=None)
    (among,) = made.fluid.interactions
    bare = dpd.fluid(among.conservative, among.drag, kT=1.0)
    state = dpd.initial_state(bare, KEY, box=20.0, density=3.0)
    states = [go(made, 600, 300, dt=0.01).final, _bare(bare, state, 600).final]
    ratios = []
    for _ in range(7):
        seconds = []
        for k, run in enumerate(
            (lambda s: go(made, 300, 300, state=s, dt=0.01), lambda s: _bare(bare, s, 300))
        ):
            began = time.perf_counter()
            states[k] = jax.block_until_ready(run(states[k]).final)
            seconds.append(time.perf_counter() - began)
        ratios.append(seconds[0] / seconds[1])
    rate = made.state.n * 300 / seconds[0]
    return [
        row(
            "step of a melt over one without bonds",
            "24000 beads",
            float(np.median(ratios)),
            1.15,
            "wanted",
        ),
        row("particle-steps a second of the melt", "24000 beads", rate),
    ]


def _bare(fluid, state, steps):
    return dpd.run(fluid, state, KEY, 0.01, dpd.Plan(steps // 300, 300), progress=False)


def scaling():
    """Size of the chains of a melt

    R ~ (N - 1)^nu, nu 1/2: chains in a melt are ideal (Flory). Short ones swell with their length:
    <R^2>/(N - 1) approaches its limit as 1 - c/sqrt(N) (Wittmer et al. 2004), so that the exponent
    of few beads is above that of many.
    """
    sizes, squares, rows = (5, 10, 20, 40), [], []
    for n in sizes:
        made = dpd.molecules(jax.random.fold_in(KEY, n), f"A{n}", box=11.0, report=None)
        time = 4.0 * n**2 / 20  # longest Rouse times, roughly
        rested = go(made, int(max(2000, time / made.dt)), 1000)
        run = go(made, 150_000, 1500, state=rested.final, observe=dpd.observe.positions)
        ends, gyration = dpd.measure.end_to_end(run), dpd.measure.radius_of_gyration(run)
        squares.append(ends.mean_square)
        rows.append(row("<R^2>", f"N {n}", ends.mean_square))
        rows.append(row("<Rg^2>", f"N {n}", gyration.mean_square))
    return [*rows, *exponents(sizes, squares, 0.5, "ideal chains")]


def solution():
    """Size of chains in a good solvent

    Few chains among single beads that repel them as they repel each other: nu .588 (Le Guillou &
    Zinn-Justin 1977), approached from below by so short chains.
    """
    rows, sizes, squares = [], (5, 10, 20, 40), []
    for n, box, count in ((5, 8.0, 40), (10, 9.0, 20), (20, 11.0, 10), (40, 14.0, 8)):
        water = round(3 * box**3) - n * count
        made = dpd.molecules(
            jax.random.fold_in(KEY, n), {f"A{n}": count, WATER: water}, box=box, report=None
        )
        rested = go(made, 20_000, 1000)
        run = go(made, 300_000, 1000, state=rested.final, observe=dpd.observe.positions)
        ends = dpd.measure.end_to_end(run, length=n).mean_square
        squares.append(ends)
        rows.append(row("<R^2>", f"N {n}, {count} chains in a box of {box:g}", ends))
    return [*rows, *exponents(sizes, squares, 0.588, "renormalisation group")]


def lamellae():
    """A melt of A5B5 orders into lamellae

    From random walks, a 25 and a_AB 40 (chi N about 46), box of 20: the peak of S(q) of the A
    beads. Groot & Madden (1998) find lamellae.
    """
    made = dpd.molecules(KEY, "A5B5", box=20.0, a={"AA": 25, "BB": 25, "AB": 40}, report=None)
    rows, state = [], made.state
    for k in range(4):
        run = go(made, 25_000, 12_500, state=state, observe=dpd.observe.positions)
        state = run.final
        found = dpd.measure.structure_factor(run, species=0, q_max=3.0)
        peak = int(np.nanargmax(found.s))
        rows.append(
            row(
                "peak of S(q)",
                f"after {25_000 * (k + 1)} steps",
                float(found.s[peak]),
                "",
                "",
                f"q {found.q[peak]:.3f}",
            )
        )
    dpd.plot_box(state, colour="species", axis=1).figure.savefig(HERE / "lamellae.png", dpi=110)
    return rows


# ------------------------------------------------------------------------------ lipids


def bilayer(lipids: int, area: float, key=KEY, height: float = 14.0, bend: float = BEND):
    """A bilayer of so many lipids at an area of each, in water."""
    side = math.sqrt(lipids / 2 * area)
    water = round(3.0 * side**2 * height) - 11 * lipids
    springs = dpd.term(dpd.laws.harmonic_bond, **SPRING)
    stiff = dpd.term(dpd.laws.cosine_angle, k=bend)
    return dpd.molecules(
        key,
        {LIPID: lipids, WATER: water},
        box=[side, side, height],
        a=REPULSION,
        bonds=springs,
        angles={"HTT": stiff, "TTT": stiff, "HHT": stiff},
        arrangement="bilayer",
        report=None,
    )


def tension():
    """Tension of a bilayer against the area of a lipid

    H3(T4)2, 162 lipids, a as REPULSION, k 128, r0 .5, angles 15, three beads in a volume of 1 in
    all, as Shillcock & Lipowsky (2002) have it: the pressure is that, and with it the area.
    """
    rows = []
    for area in (1.0, 1.1, 1.2, 1.3, 1.4):
        made = bilayer(162, area)
        rested = go(made, 20_000, 1000)
        run = go(made, 60_000, 100, state=rested.final, observe=dpd.mean(dpd.observe.standard))
        found = dpd.measure.surface_tension(run, interfaces=1)
        rows.append(
            row("tension", f"area {area:g}", found, "", "", f"p {normal_pressure(run):.2f}")
        )
    return rows


def normal_pressure(run) -> float:
    """The mean pressure across the bilayer."""
    return float(np.mean(run.frames["pressure_tensor"][:, 2, 2]))


def stays():
    """A bilayer without tension for 1e5 steps

    Under the barostat, tension 0 in the plane and across it the pressure that the bilayer has at
    the area, 1.06, at which it has no tension at constant volume: there the area stays.
    """
    made = bilayer(162, 1.06)
    fixed = go(made, 40_000, 100, observe=dpd.mean(dpd.observe.standard))
    pressure = normal_pressure(fixed)
    how = dpd.integrators.CellRescaling(pressure, coupling="semi-isotropic", base=made.integrator)
    rested = go(made, 20_000, 1000, state=fixed.final, how=how)
    seen = [dpd.mean(dpd.observe.standard), dpd.observe.positions, dpd.observe.box]
    run = go(made, 100_000, 500, state=rested.final, observe=seen, how=how)
    final = run.final
    dpd.plot_box(final, colour="species", axis=1).figure.savefig(HERE / "bilayer.png", dpi=110)
    return [
        row("area of a lipid", f"p {pressure:.2f}", dpd.measure.area_per_lipid(run), 1.06, "start"),
        row("tension", "", dpd.measure.surface_tension(run, interfaces=1), 0.0, "wanted"),
        row("order parameter", "", dpd.measure.order_parameter(run)),
        row("lipids in the larger leaflet", "of 162", leaflets(made, final)),
    ]


def leaflets(made, state) -> int:
    """Lipids whose head is above their tail, or below it, whichever are more."""
    z = np.asarray(state.unwrapped)[:, 2][made.ids[LIPID]]
    up = int(np.sum(z[:, 0] > z[:, 3:].mean(axis=1)))
    return max(up, len(z) - up)


ROOMS = (dimers, phantom, memory, melt, scaling, solution, lamellae, tension, stays, cost)


if __name__ == "__main__":
    rooms.measure(ROOMS, sys.argv[1:], "molecules.json", "MOLECULES.md", HEADING)
