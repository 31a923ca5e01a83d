"""Suspensions and marbles at their long default step: writes longsteps.json, and LONGSTEPS.md.

    python tests/physics/longsteps.py                # everything, two hours on two cores
    python tests/physics/longsteps.py held ageing    # only these

Beside each number stands what velocity-Verlet gives at a step short enough for lubrication and
contacts, measured here or in SUSPENSIONS.md and MARBLES.md, or what is exact. Single precision, as
users run.
"""

import dataclasses
import json
import math
import sys

import jax
import jax.numpy as jnp
import marbles as marbled
import numpy as np
import rooms
import suspensions
from rooms import row, stacked
from suspensions import KT, by_species

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate, block_average, from_replicas

KEY = jax.random.key(2027)
VERLET = dpd.integrators.VelocityVerlet()
SHORT = 3.2e-4
"""Step that lubrication of eta_0 0.95 allows velocity-Verlet."""
THICK = dict(gamma=45.0, eta_0=0.95)


def go(made, state, key, total, between, flow=None, observe=None, dt=None, how=None, fluid=None):
    """A run of ``total`` time units at the default step, or at another, frames so far apart."""
    dt, how = made.dt if dt is None else dt, made.integrator if how is None else how
    every = max(1, round(between / dt))
    plan = dpd.Plan(max(2, round(total / dt / every)), every)
    fluid = made.fluid if fluid is None else fluid
    return dpd.run(
        fluid, state, key, dt, plan, flow, observe=observe, integrator=how, progress=False
    )


def named(how) -> str:
    """An integrator in a few words."""
    short = f", {how.inner} short steps" if hasattr(how, "inner") else ""
    return type(how).__name__ + short


# ------------------------------------------------------------ temperatures by the step


def thermometers(fluid, state):
    """Temperatures, pressure of motion and potentials, energy of the potentials."""
    parts = dpd.observe.pressure_tensor(fluid, state, ("kinetic", "conservative"))
    return by_species(fluid, state) | {"p": jnp.trace(parts) / 3.0, "U": state.tally.energy}


TITLES = {
    "solvent": "temperature of the solvent over kT",
    "colloid": "temperature of the colloids over kT",
    "p": "pressure of motion and potentials",
    "U": "energy of the potentials",
}


def steps():
    """Hard suspension at phi 0.2, gamma 45, eta_0 0.95, by the step

    Steps are that suggested, half and twice of it, with as many short ones in each as contacts
    need.
    """
    made = dpd.suspension(KEY, phi=0.2, box=10.0, report=None, sheared=False, **THICK)
    keys = jax.random.split(KEY, 2)
    settled = go(made, made.state, keys, 20.0, 2.0).final
    reached = {}
    ways = [(f * made.dt, _stepped(made.integrator, f)) for f in (0.5, 1.0, 2.0)]
    for dt, how in [(SHORT, VERLET), *ways]:
        state = settled if how is not VERLET else settled.restarted()
        start = go(made, state, keys, 5.0, 1.0, dt=dt, how=how).final
        run = go(made, start, keys, 120.0, 0.2, observe=dpd.mean(thermometers), dt=dt, how=how)
        reached[dt, named(how)] = run.frames
    due = reached[SHORT, named(VERLET)]
    rows = []
    for (dt, how), frames in reached.items():
        for name, title in TITLES.items():
            scale = KT if name in ("solvent", "colloid") else 1.0
            exact = scale == KT
            reference = 1.0 if exact else block_average(due[name])
            source = "exact" if exact else f"velocity-Verlet, dt {SHORT:g}"
            value = block_average(frames[name] / scale)
            rows.append(row(title, f"{how}, dt {dt:.3g}", value, reference, source))
    return rows


def _stepped(how, factor):
    return dataclasses.replace(how, inner=max(1, math.ceil(how.inner * factor)))


# ------------------------------------------------------------ pairs


def held():
    """Relative kinetic temperature of two colloids held at a gap, over kT"""
    rows = []
    for gamma, eta_0 in ((4.5, 0.3), (45.0, 0.95)):
        made = dpd.suspension(
            KEY, phi=0.2, box=10.0, gamma=gamma, eta_0=eta_0, report=None, sheared=False
        )
        for h0, k, total in (
            (0.01, 1e5, 400.0),
            (0.1, 2e4, 800.0),
            (0.5, 1e3, 2e3),
            (0.9, 400.0, 4e3),
        ):
            drag = [
                dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0),
                dpd.term(dpd.laws.squeezing_lubrication, eta_0=eta_0, delta=0.5 * h0, reach=1.0),
            ]
            hold = dpd.term(suspensions.spring, k=k, h0=h0, reach=1.2)
            fluid = dpd.fluid(
                interactions=[dpd.interaction((0, 0), hold, drag)],
                kT=KT,
                mass=suspensions.MASS,
                radius=(1.0,),
            )
            state, key = suspensions.held_pairs(fluid, h0)
            run = go(made, state, key, total, 1.0, observe=suspensions.approach, fluid=fluid)
            T = block_average(run.frames["T"][len(run.frames["T"]) // 20 :] / KT)
            where = f"gamma {gamma:g}, eta_0 {eta_0:g}, {named(made.integrator)}, dt {made.dt:.3g}"
            rows.append(row(f"T/kT at h = {h0:g}", where, T, 1.0, "exact"))
    return rows


def well():
    """g(h) of a dilute pair with Morse attraction of 2 kT and hard contacts

    Repulsion between colloid and solvent off, drag on.
    """
    until, count = 0.3, 6
    morse = dpd.term(dpd.laws.morse, D0=0.2, kappa=30.0, r0=0.0, reach=1.0)
    wall = dpd.term(suspensions.hold_near, stiffness=40.0, until=until, reach=1.0)
    fluid = dpd.colloid_fluid(attraction=[morse, wall], eta_0=0.05).set(strength=0.0)
    how, dt = _suited(fluid, (1.0, 1e-3))
    gaps = suspensions.gaps_of_pairs(
        fluid, count, 6.4, round(6.4**3), 0.15, dt, 15000.0, integrator=how
    )
    edges = np.array([0.0, 0.02, 0.04, 0.06, 0.09, 0.13, 0.2, 0.3])
    U = lambda h: 0.2 * (np.exp(-60 * h) - 2 * np.exp(-30 * h)) + _contact_energy(fluid, h)
    where = (
        f"D0 2 kT, kappa 30, solvent density 1, {named(how)}, dt {dt:.3g}, {count} boxes, "
        f"wall beyond h = {until:g}"
    )
    shares = suspensions.shares(gaps, edges, lambda h: np.exp(-U(h) / KT))
    return [
        row(f"P(h) over r^2 exp(-U/kT), h from {a:g} to {b:g}", where, share, 1.0, "exact")
        for a, b, share in zip(edges, edges[1:], shares)
    ]


def _contact_energy(fluid, h):
    """Of the contact ``f (1 - h/Delta)^3``, ``f = 1000``, ``Delta = 0.001``."""
    f, Delta = float(fluid.value("f")), float(fluid.value("Delta"))
    return 0.25 * f * Delta * np.maximum(1.0 - h / Delta, 0.0) ** 4


def _suited(fluid, density):
    how = dpd.integrators.cheapest(fluid, density)
    return how, dpd.suggest_dt(fluid, density, integrator=how)


def free_pair():
    """g(h) of a dilute pair with D0 = 0 in the solvent, against exp(-W/kT) of held pairs

    W is that of SUSPENSIONS.md, with an error of 0.06 kT across the barrier; beside each share is
    the one that velocity-Verlet gave with a contact soft enough for its step.
    """
    until, count, side = 0.9, 4, 7.0
    wall = dpd.term(suspensions.hold_near, stiffness=20.0, until=until, reach=until + 0.4)
    fluid = dpd.colloid_fluid(attraction=wall)
    solvents = round(3.0 * (side**3 - 2 * 3.4))
    how, dt = _suited(fluid, (solvents / side**3, 2 / side**3))
    gaps = suspensions.gaps_of_pairs(fluid, count, side, solvents, 0.6, dt, 6000.0, integrator=how)
    edges, weight = suspensions.weight_of_held_pairs()
    where = f"a_cs 9.62, kT 0.1, gamma 4.5, {named(how)}, dt {dt:.3g}, {count} boxes of {side:g}"
    before = _known("free_pair")
    return [
        row(
            f"P(h) over r^2 exp(-W/kT), h from {a:g} to {b:g}",
            where,
            share,
            Estimate(*old["value"]),
            "velocity-Verlet, SUSPENSIONS.md",
        )
        for a, b, share, old in zip(
            edges, edges[1:], suspensions.shares(gaps, edges, weight), before
        )
    ]


def _known(room):
    """Rows of SUSPENSIONS.md."""
    return json.loads((rooms.HERE / "suspensions.json").read_text())[room]["rows"]


# ------------------------------------------------------------ motion and flow


def diffusion():
    """Diffusion of hard colloids at phi = 0.05"""
    count, side = 9, 12.0
    keys = jax.random.split(jax.random.fold_in(KEY, 1), count)
    made = [dpd.suspension(k, phi=0.05, box=side, report=None, sheared=False) for k in keys]
    state = stacked([m.state for m in made])
    state = go(made[0], state, keys, 30.0, 10.0).final
    observe = [dpd.observe.positions_of(1), dpd.mean(by_species)]
    run = go(made[0], state, keys, 480.0, 0.35, observe=observe)
    D = dpd.diffusion(run, species=1, fit=(10.0, 30.0))
    where = (
        f"kT 0.1, gamma 4.5, R 1, {made[0].colloids} colloids in {side:g}, {count} boxes, "
        f"{named(made[0].integrator)}, dt {made[0].dt:.3g}"
    )
    old = Estimate(*_known("diffusion")[0]["value"])
    T = block_average(run.frames["colloid"] / KT)
    return [
        row("D from the slope of the MSD", where, D, old, "velocity-Verlet, dt 0.0014"),
        row("colloid temperature over kT", where, T, 1.0, "exact"),
    ]


ORIGINS = ("kinetic", "conservative", "contact", "drag", "colloid", "lubrication")


def flow():
    """Viscosity of hard suspensions, and the stress by origin

    References are those of SUSPENSIONS.md, by velocity-Verlet at dt 0.0004: one box for each, whose
    errors do not know how colloids came to lie; those of the parts are not told there.
    """
    rows, rate = [], 0.15
    for phi in (0.05, 0.1, 0.2):
        made = dpd.suspension(KEY, phi=phi, box=10.0, report=None, **THICK)
        shear, keys = dpd.shear(rate), jax.random.split(KEY, 2)
        state = go(made, made.state, keys, 15.0, 1.0, shear).final
        observe = [dpd.observe.shear_record, dpd.mean(dpd.observe.stresses)]
        run = go(made, state, keys, 150.0, 0.1, shear, observe)
        eta = dpd.shear_viscosity(run, skip=0.0)
        where = (
            f"phi {phi:g}, rate {rate:g}, {made.colloids} colloids in 10, "
            f"{named(made.integrator)}, dt {made.dt:.3g}, 2 boxes"
        )
        old = next(r for r in _known("viscosity") if r["state"].startswith(f"phi {phi:g},"))
        rows.append(row("viscosity", where, eta, Estimate(*old["value"]), "velocity-Verlet"))
        for name in ORIGINS:
            part = block_average(-run.frames[f"pressure_{name}"][..., 0, 1] / rate)
            due = float(old["note"].split(f"{name} ")[1].split(",")[0])
            rows.append(row(f"viscosity, {name}", where, part, due, "velocity-Verlet"))
    return rows


def ageing():
    """Contact number and stress of an ageing gel: phi 0.2, Morse 12 kT, gamma 45, eta_0 0.95

    Eight boxes, each from one settled hard suspension, by both integrators. Times are since the
    attraction was switched on; tau is 179. Velocity-Verlet runs at half the step that lubrication
    allows it: at the whole of it colloids were at 0.9931(31) kT, and their contact number at the
    end 1.156(44).
    """
    reached = {}
    for seed in range(8):
        key = jax.random.fold_in(KEY, seed)
        made = dpd.suspension(
            key, phi=0.2, box=10.0, D0=1.2, kappa=30.0, report=None, sheared=False, **THICK
        )
        hard = made.fluid.set(D0=0.0)
        state = go(made, made.state, key, 20.0, 2.0, fluid=hard).final.restarted()
        ways = [(f * made.dt, _stepped(made.integrator, f)) for f in (1.0, 0.25)]
        for dt, how in ((0.5 * SHORT, VERLET), *ways):
            observe = [dpd.observe.positions_of(1), dpd.mean(thermometers)]
            run = go(made, state, key, 60.0, 0.5, observe=observe, dt=dt, how=how)
            contacts = dpd.measure.contact_number(run).series
            reached.setdefault((dt, named(how)), []).append((np.ravel(contacts), run.frames))
    (short, old), *others = reached.items()
    source = f"{short[1]}, dt {short[0]:g}"
    return [line for way, new in others for line in _aged(way, new, old, source)]


def _aged(way, new, old, source):
    rows, where = [], f"{way[1]}, dt {way[0]:.3g}, 8 boxes"
    for begin, end in ((2, 6), (6, 14), (14, 30), (30, 60)):
        window = slice(2 * begin, 2 * end)
        mean = lambda runs: from_replicas([float(np.mean(z[window])) for z, _ in runs])
        rows.append(row(f"contact number, t {begin} to {end}", where, mean(new), mean(old), source))
    late = slice(60, None)
    for name, title in TITLES.items():
        scale = KT if name in ("solvent", "colloid") else 1.0
        mean = lambda runs: from_replicas([float(np.mean(f[name][late])) / scale for _, f in runs])
        rows.append(row(f"{title}, t 30 to 60", where, mean(new), mean(old), source))
    return rows


# ------------------------------------------------------------ marbles


def marbles():
    """Temperatures of 20 marbles of radius 1 in a box of side 8, gamma_cs 20, kT 1"""
    rows = []
    for coupling in ("full", "transverse", "central"):
        made = dpd.marbles(
            KEY, box=8.0, count=20, radius=1.0, gamma_cs=20.0, coupling=coupling, report=None
        )
        keys = jax.random.split(KEY, 2)
        state = go(made, made.state, keys, 10.0, 1.0).final
        run = go(made, state, keys, 150.0, 0.2, observe=dpd.mean(marbled.thermal))
        where = f"{coupling}, {named(made.integrator)}, dt {made.dt:.3g}"
        for name in ("T", "v2", "w2"):
            if name != "w2" or coupling != "central":
                title = f"{marbled.TITLES[name]}, per component, over kT"
                rows.append(row(title, where, block_average(run.frames[name]), 1.0, "exact"))
    return rows


def marble_drag():
    """Drag on a marble of radius 3 in a box of 10, gamma_cs 20"""
    case = next(c for c in marbled.CASES if c.name == "L 10, gamma_cs 20")
    made = dpd.marbles(KEY, box=case.box, gamma_cs=case.gamma_cs, report=None)
    keys, observe = jax.random.split(KEY, 6), [dpd.observe.positions_of(1), dpd.observe.rotations]
    state = go(made, made.state, keys, case.settle, 1.0, case.flow).final
    run = go(made, state, keys, marbled.LENGTH, 0.1, case.flow, observe)
    driven, spun = dpd.measure.driven_diffusion(run), dpd.measure.driven_rotation(run)
    where = f"gamma_cs 20, {named(made.integrator)}, dt {made.dt:.3g}, 6 boxes"
    old = {r["quantity"]: Estimate(*r["value"]) for r in _of_marble(case.name)}
    source = "velocity-Verlet, dt 0.01, MARBLES.md"
    return [
        row("D, drag", where, driven.diffusion, old["D, drag"], source),
        row("D_r, torque", where, spun.diffusion, old["D_r, torque"], source),
    ]


def _of_marble(state):
    rows = json.loads((rooms.HERE / "marbles.json").read_text())["marble"]["rows"]
    return [r for r in rows if r["state"] == state]


# ------------------------------------------------------------ momentum


def momentum():
    """Total momentum after 100,000 steps of single precision, over sqrt(sum m kT)

    Zero at the start but for rounding. Sheared at a rate of 0.1 in thermal units.
    """
    rows = []
    gas = dpd.fluid([], [dpd.term(dpd.central_drag, gamma=90.0, r_c=1.0)], kT=1.0)
    water = dpd.water()
    for name, fluid, how in (
        ("water, a 25, gamma 4.5", water, VERLET),
        ("a 0, gamma 90", gas, dpd.integrators.ImplicitDrag()),
    ):
        dt = dpd.suggest_dt(fluid, 3.0, integrator=how)
        rows.append(
            _drifted(
                name, fluid, dpd.initial_state(fluid, KEY, box=6.0, density=3.0, dt=dt), dt, how
            )
        )
    made = dpd.suspension(KEY, phi=0.2, box=7.1, report=None, **THICK)
    name = "suspension, phi 0.2, gamma 45"
    return [*rows, _drifted(name, made.fluid, made.state, made.dt, made.integrator)]


def _drifted(name, fluid, state, dt, how):
    rate = 0.1 * float(fluid.kT) ** 0.5
    run = dpd.run(
        fluid, state, KEY, dt, dpd.Plan(20, 5000), dpd.shear(rate), integrator=how, progress=False
    )
    mass = np.asarray(fluid.mass)[np.asarray(state.species)].sum()
    total = np.linalg.norm(dpd.observe.momentum(fluid, run.final))
    relative = float(total / math.sqrt(mass * float(fluid.kT)))
    return row("momentum", f"{name}, {named(how)}, dt {dt:.3g}", relative, 0.0, "exact")


HEADING = """# Suspensions and marbles at the default step

Written by `python tests/physics/longsteps.py`; do not edit.
Reduced units, standard errors."""
ROOMS = (steps, held, well, free_pair, diffusion, flow, ageing, marbles, marble_drag, momentum)


if __name__ == "__main__":
    rooms.measure(ROOMS, sys.argv[1:], "longsteps.json", "LONGSTEPS.md", HEADING)
