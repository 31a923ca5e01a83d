"""Physics of colloids at production accuracy: writes suspensions.json, and SUSPENSIONS.md from it.

    python tests/physics/suspensions.py              # everything
    python tests/physics/suspensions.py viscosity ...   # only these

Single precision, as users run.
"""

import dataclasses
import json
import math
import sys

import jax
import jax.numpy as jnp
import numpy as np
import rooms
from rooms import row, stacked
from scipy.interpolate import CubicSpline

import dpdjax as dpd
from dpdjax.measure.statistics import Estimate, block_average, from_replicas
from dpdjax.pairs import box as boxes
from dpdjax.pairs.geometry import Columns, Moment, geometry
from dpdjax.pairs.laws import evaluate
from dpdjax.pairs.sums import sum_onto_beads
from dpdjax.prepare import packing
from dpdjax.prepare.start import placed, plan_lists

KEY = jax.random.key(2026)
VERLET = dpd.integrators.VelocityVerlet()
KT, MASS = 0.1, 4 * math.pi  # of a colloid of radius 1 in a solvent of density 3


def go(fluid, state, key, dt, total, every, flow=None, observe=None, integrator=None):
    """A run of ``total`` time units, by velocity-Verlet where no integrator is given."""
    plan = dpd.Plan(max(2, round(total / dt / every)), every)
    return dpd.run(
        fluid, state, key, dt, plan, flow, observe=observe, integrator=integrator, progress=False
    )


# ------------------------------------------------------------ pairs of colloids


def spring(h, *, k, h0):
    """Holds two colloids at a gap."""
    return 0.5 * k * (h - h0) ** 2


def approach(fluid, state):
    """Relative kinetic temperature along the line of centres, of beads 2 k and 2 k + 1."""
    d = boxes.displacement(state.box, state.position[0::2], state.position[1::2])
    e = d / jnp.linalg.norm(d, axis=1, keepdims=True)
    v = jnp.sum((state.velocity[0::2] - state.velocity[1::2]) * e, axis=1)
    return {"T": 0.5 * MASS * jnp.mean(v * v)}


def pair_temperature():
    """Relative kinetic temperature of two colloids held at a gap, over kT"""
    rows = []
    held = (
        (0.01, 1e5, 2e-4, 30.0),
        (0.1, 2e4, 1e-3, 220.0),
        (0.5, 1000.0, 4e-3, 900.0),
        (0.9, 400.0, 6e-3, 2000.0),
    )
    for h0, k, dt, total in held:
        gamma, eta_0, w = 4.5, 0.3, 1.0 - h0
        a_sq = 1.5 * math.pi * eta_0 / h0
        numbers = dict(eta_0=eta_0, delta=0.5 * h0)
        for noise, expected in (
            ("exact", 1.0),
            ("literal", (gamma + a_sq) * w**2 / (gamma * w**2 + a_sq)),
        ):
            random = None
            drag = [
                dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0),
                dpd.term(dpd.laws.squeezing_lubrication, reach=1.0, **numbers),
            ]
            if noise == "literal":
                drag = [dpd.term(dpd.laws.literal_drag, gamma=gamma, r_c=1.0, **numbers)]
                random = [dpd.term(dpd.laws.literal_noise, gamma=gamma, r_c=1.0, **numbers)]
            hold = dpd.term(spring, k=k, h0=h0, reach=1.2)
            fluid = dpd.fluid(
                interactions=[dpd.interaction((0, 0), hold, drag, random)],
                kT=KT,
                mass=MASS,
                radius=(1.0,),
            )
            run = go(
                fluid,
                *held_pairs(fluid, h0),
                dt,
                total * (1.0 if noise == "exact" else 0.2),
                50,
                observe=dpd.mean(approach),
            )
            T = block_average(run.frames["T"][len(run.frames["T"]) // 20 :] / KT)
            source = "exact" if noise == "exact" else "zeta of noise over zeta of drag"
            rows.append(
                row(
                    f"T/kT at h = {h0:g}, {noise} noise",
                    f"eta_0 0.3, gamma 4.5, dt {dt:g}",
                    T,
                    expected,
                    source,
                )
            )
    return rows


def held_pairs(fluid, h0, side=8, count=8):
    """512 pairs far from each other; each has no momentum, so it stays where it is."""
    cell = (
        np.stack(np.meshgrid(*[np.arange(count)] * 3, indexing="ij"), -1).reshape(-1, 3)
        * float(side)
        + 0.5 * side
    )
    axis = np.array([2.0 + h0, 0.0, 0.0])
    position = np.stack([cell - 0.5 * axis, cell + 0.5 * axis], axis=1).reshape(-1, 3)
    space, counts = boxes.box(float(side * count)), [len(position)]
    grids = plan_lists(fluid, space, counts, sheared=False)
    state = placed(fluid, KEY, space, jnp.asarray(position, jnp.float32), counts, grids)
    v = state.velocity[0::2]
    velocity = jnp.stack([v, -v], axis=1).reshape(-1, 3)
    return dataclasses.replace(state, velocity=velocity), KEY


# ------------------------------------------------------------ temperatures and diffusion


def temperatures():
    """Temperatures of solvent and colloids at phi = 0.2"""
    made = dpd.suspension(KEY, phi=0.2, box=10.0, report=None, sheared=False, integrator=VERLET)
    keys = jax.random.split(KEY, 2)
    state = go(made.fluid, _batch(made.state, 2), keys, made.dt, 20.0, 100).final
    run = go(made.fluid, state, keys, made.dt, 140.0, 40, observe=dpd.mean(by_species))
    where = (
        f"kT 0.1, gamma 4.5, eta_0 0.3, dt {made.dt:g}, {made.colloids} colloids, "
        f"{made.solvents} solvent, 2 boxes"
    )
    return [
        row(
            f"kinetic temperature of the {who} over kT",
            where,
            block_average(run.frames[who] / KT),
            1.0,
            "exact, up to O(dt)",
        )
        for who in ("solvent", "colloid")
    ]


def by_species(fluid, state):
    """Kinetic temperature of solvent and colloids; with the total momentum fixed, each has its
    share of kT."""
    colloid = state.species == 1
    mass = fluid.mass[state.species]
    energy = jnp.sum(mass[:, None] * state.velocity**2, axis=1)
    total = jnp.sum(mass)

    def of(mine):
        # <m v^2> = 3 kT (1 - m / M).
        return jnp.sum(jnp.where(mine, energy, 0.0)) / jnp.sum(
            jnp.where(mine, 3.0 * (1.0 - mass / total), 0.0)
        )

    return {"solvent": of(~colloid), "colloid": of(colloid)}


def _batch(state, count):
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))), state)


def diffusion():
    """Diffusion of hard colloids at phi = 0.05

    D is that of a sphere without slip among neighbours (1 - 2.1 phi = 0.90 of stick), within its
    error, although every force between colloid and solvent is along the line of centres, from which
    one expects slip. Two things stand against it. The shell in which both rub reaches 0.26 beyond
    the surface, and with full slip the hydrodynamic radius that gives this D would have to be 1.46,
    more than the shell's 1.26. And, likely, a bead that passes through the shell at any angle but a
    right one is rubbed along the line of centres on its way in and out, which takes momentum along
    the surface too. So: partial slip of a sphere of about the shell's size, and by accident about
    the stick value of the bare one. Images are taken off with the viscosity of the suspension,
    1.125 times the solvent's; with the solvent's own the D would be 3 % higher.
    """
    count, side = 3, 12.0
    keys = jax.random.split(jax.random.fold_in(KEY, 1), count)
    made = [
        dpd.suspension(k, phi=0.05, box=side, report=None, sheared=False, dt=1.4e-3) for k in keys
    ]
    fluid, dt = made[0].fluid, 1.4e-3
    state = stacked([m.state for m in made])
    state = go(fluid, state, keys, dt, 30.0, 100).final
    run = go(
        fluid,
        state,
        keys,
        dt,
        240.0,
        250,
        observe=[dpd.observe.positions_of(1), dpd.mean(by_species)],
    )
    D = dpd.diffusion(run, species=1, fit=(10.0, 30.0))
    rho, eta = _solvent(run.final, fluid, keys)
    # Periodic images slow a sphere down (Duenweg & Kremer 1993), by the suspension's own viscosity,
    # (1 + 2.5 phi) eta.
    correction = 2.837297 * KT / (6 * math.pi * 1.125 * eta.value * side)
    infinite = Estimate(D.value + correction, D.error, D.blocks)
    stick, slip = KT / (6 * math.pi * eta.value), KT / (4 * math.pi * eta.value)
    others = "neighbours at phi 0.05 slow a sphere with stick to 1 - 2.1 phi = 0.90"
    where = (
        f"kT 0.1, gamma 4.5, R 1, {made[0].colloids} colloids in {side:g}, {count} boxes, dt {dt:g}"
    )
    return [
        row("D from the slope of the MSD", where, D, "", "", "fit 10 to 30 time units"),
        row("density of the solvent between them", where, rho, 3.0, "nominal"),
        row(
            "viscosity of the solvent at that density",
            "gamma 4.5",
            eta,
            0.3,
            "the guess of seed 000",
        ),
        row("D without periodic images", where, infinite, "", "", f"+ {correction:.5f}"),
        row(
            "D over stick, kT/(6 pi eta R)",
            where,
            infinite.scaled(1 / stick),
            1.0,
            "Stokes-Einstein, no slip",
            others,
        ),
        row(
            "D over slip, kT/(4 pi eta R)",
            where,
            infinite.scaled(1 / slip),
            1.0,
            "Stokes-Einstein, full slip",
        ),
        row(
            "colloid temperature over kT",
            where,
            block_average(run.frames["colloid"] / KT),
            1.0,
            "exact, up to O(dt)",
        ),
    ]


def _solvent(state, fluid, keys, gamma=4.5, tolerance=0.02):
    """Density of the solvent between the colloids of a batch, and the viscosity of the pure solvent
    there."""
    densities = [
        dpd.measure.solvent_density(fluid, jax.tree.map(lambda leaf: leaf[k], state))
        for k in range(len(keys))
    ]
    rho = from_replicas(densities)
    return rho, solvent_viscosity(gamma, rho.value, tolerance)


def solvent_viscosity(gamma, density, tolerance=0.02):
    """Viscosity of the pure solvent."""
    pure = dpd.pure_solvent(dpd.colloid_fluid(kT=KT, gamma=gamma))
    return dpd.measure_viscosity(pure, key=KEY, density=density, tolerance=tolerance).estimate


# ------------------------------------------------------------ viscosity


DENSITY_POWER = 2.6
"""Of the solvent's viscosity, measured between densities 2.87 and 2.96: what an error of the
density does to it."""


def viscosity():
    """Relative viscosity of hard suspensions

    The dilute ones lie between spheres with full slip and with none, as partial slip would have
    them: (eta_r - 1)/phi is 1.7 at phi 0.05 and 2.0 at 0.1, where full slip gives 1.0 and no slip
    2.5 to first order. At 0.2 the suspension is a little above Batchelor's second order for no
    slip: lubrication alone, which acts between colloids whatever their slip, carries 0.26 of 1.65.
    Shear thinning is behind (Peclet number 25) and inertia hardly felt (Reynolds number 0.5). The
    error of the relative viscosity has that of the density in it, to which the solvent's viscosity
    answers with the power 2.6.
    """
    rows, rate, dt, gamma, side = [], 0.15, 4e-4, 45.0, 10.0
    for phi, batchelor in ((0.05, 1.14), (0.1, 1.31), (0.2, 1.75)):
        made = dpd.suspension(KEY, phi=phi, box=side, gamma=gamma, eta_0=0.95, dt=dt, report=None)
        flow = dpd.shear(rate)
        state = go(made.fluid, made.state, KEY, dt, 15.0, 100, flow).final
        runs, densities = [], []
        for _ in range(48):
            run = go(
                made.fluid,
                state,
                KEY,
                dt,
                1.6,
                20,
                flow,
                observe=[dpd.observe.shear_record, dpd.mean(dpd.observe.stresses)],
            )
            runs, state = [*runs, run], run.final
            densities.append(
                dpd.measure.solvent_density(made.fluid, state, probe=0.3, points=100_000)
            )
        frames = {name: np.concatenate([r.frames[name] for r in runs]) for name in run.frames}
        eta = dpd.shear_viscosity(dataclasses.replace(run, frames=frames), skip=0.0, blocks=24)
        rho = from_replicas(densities)
        solvent = solvent_viscosity(gamma, rho.value)
        solvent = dpd.Estimate(
            solvent.value,
            math.hypot(solvent.error, DENSITY_POWER * solvent.value * rho.error / rho.value),
        )
        Re, Pe = 3.0 * rate / solvent.value, 6 * math.pi * solvent.value * rate / KT
        where = (
            f"phi {phi:g}, gamma 45, eta_0 of lubrication 0.95, rate {rate:g}, dt {dt:g}, "
            f"{made.colloids} colloids in {side:g}"
        )
        left_out = ("pressure_tensor", "pressure_random")
        origins = [name for name in frames if name.startswith("pressure_") and name not in left_out]
        parts = ", ".join(
            f"{name[9:]} {-np.mean(frames[name][:, 0, 1]) / rate:.3f}" for name in origins
        )
        first_order = f"first order in phi: {1 + 2.5 * phi:.3g} no slip, {1 + phi:.3g} full slip"
        rows += [
            row("viscosity", where, eta, "", "", f"Re {Re:.2f}, Pe {Pe:.0f}; {parts}"),
            row("density of the solvent between colloids", where, rho, 3.0, "nominal"),
            row(
                "viscosity of the solvent at that density",
                "gamma 45",
                solvent,
                1.1,
                "the guess of seed 000",
            ),
            row(
                "relative viscosity",
                where,
                eta.over(solvent),
                batchelor,
                "no slip, Pe and Re to 0",
                first_order,
            ),
        ]
    return rows


# ------------------------------------------------------------ forces through the solvent


def solvent_force(fluid, state):
    """Mean of what the solvent pushes two held colloids apart by, along the line of centres."""
    beads = Columns.of(fluid, state, state.velocity)
    interaction, neighbours = fluid.interactions[1], state.neighbours[1]
    pairs = geometry(fluid, interaction, beads, neighbours.list.idx, Moment(state.box))
    f = sum_onto_beads(
        pairs,
        evaluate(interaction.conservative, pairs, fluid.kT, derivative=True)[1],
        state.position.shape[0],
    )
    d = boxes.displacement(state.box, state.position[-2], state.position[-1])
    return {"push": 0.5 * jnp.dot(f[-2] - f[-1], d / jnp.linalg.norm(d))}


GAPS = np.array([0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.15, 1.3, 1.5, 1.8])


def mediated():
    """Potential of mean force W(h) of two colloids through the solvent, D0 = 0

    With the strength of the repulsion over the cut-off from the surface the solvent is layered: the
    colloids meet a barrier before contact and have a shallow minimum at the distance of one layer.
    With the strength over the cut-off from the centre, a fifth of it, W is flat within its errors
    but for contact. Attractions of a few kT are to be seen against this.
    """
    rows, dt, side = [], 0.02, 7.0
    for repulsion, name, a_cs in (
        (dpd.laws.balanced_repulsion, "surface", 9.62),
        (dpd.laws.scripts_repulsion, "centre", 1.98),
    ):
        # Too heavy to move, so they need no contact, and the step can be long.
        fluid = dpd.colloid_fluid(solvent_repulsion=repulsion, eta_0=0.0).set(
            mass=jnp.array([1.0, 1e12])
        )
        fluid, pushes = fluid.set(f=0.0, between=(1, 1)), []
        for h in GAPS:
            key = jax.random.fold_in(KEY, int(1000 * h))
            state = _pair_in_solvent(fluid, key, side, round(3.0 * (side**3 - 2 * 3.4)), h, dt)
            state = dataclasses.replace(state, velocity=state.velocity.at[-2:].set(0.0))
            state = go(fluid, state, key, dt, 20.0, 50).final
            run = go(fluid, state, key, dt, 1400.0, 20, observe=dpd.mean(solvent_force))
            pushes.append(block_average(run.frames["push"]))
        where = (
            f"a_cs {a_cs:g} (over the cut-off from the {name}), kT 0.1, gamma 4.5, dt {dt:g}, "
            f"box {side:g}"
        )
        for h, push, w in zip(GAPS, pushes, _integrated(GAPS, pushes)):
            rows.append(row(f"W/kT at h = {h:g}", where, w, "", "", f"mean force {push}"))
    return rows


def _integrated(h, pushes):
    """``W(h) = integral from h on of the mean force`` in units of kT, of a cubic spline, 0 at the
    last gap."""
    integral = CubicSpline(h, np.eye(len(h))).antiderivative()
    weights = (integral(h[-1]) - integral(h)) / KT
    values, errors = np.array([[p.value, p.error] for p in pushes]).T
    return [
        Estimate(float(w), float(e))
        for w, e in zip(weights @ values, np.sqrt(weights**2 @ errors**2))
    ]


def hold_near(h, *, stiffness, until):
    """Keeps two colloids from parting: a harmonic wall beyond a gap."""
    return 0.5 * stiffness * jnp.maximum(h - until, 0.0) ** 2


SOFT = dict(modulus=300.0, Delta=0.02)
"""A contact soft enough for a long step: at h = 0 it ends as the hard one does, in the exponential.
"""


def separation(fluid, state):
    """Gap of the two colloids."""
    return {
        "h": jnp.linalg.norm(boxes.displacement(state.box, state.position[-2], state.position[-1]))
        - 2.0
    }


def gaps_of_pairs(fluid, count, side, solvents, h, dt, total, integrator=None):
    """Gaps over time (boxes, frames) of two colloids that cannot part, in several boxes."""
    keys = jax.random.split(jax.random.fold_in(KEY, 5), count)
    state = stacked([_pair_in_solvent(fluid, k, side, solvents, h, dt) for k in keys])
    state = go(fluid, state, keys, dt, 20.0, 50, integrator=integrator).final
    run = go(fluid, state, keys, dt, total, 20, observe=separation, integrator=integrator)
    return run.frames["h"]


def shares(gaps, edges, weight):
    """Share of the gaps in each bin over that of ``r^2 weight(h)``, an estimate each; 4 pieces of
    each box."""
    middle = np.linspace(edges[:-1], edges[1:], 21)
    ideal = np.mean((2 + middle) ** 2 * weight(middle), axis=0) * np.diff(edges)
    counts = np.stack(
        [np.histogram(h, edges)[0] for member in gaps for h in np.array_split(member, 4)]
    )
    share, expected = counts / counts.sum(1, keepdims=True), ideal / ideal.sum()
    return [from_replicas(share[:, k] / expected[k]) for k in range(len(expected))]


def well():
    """g(h) of a dilute pair with Morse attraction of 2 kT, colloid-solvent repulsion off and drag
    on"""
    dt, until, count = 5e-3, 0.3, 6
    morse = dpd.term(dpd.laws.morse, D0=0.2, kappa=30.0, r0=0.0, reach=1.0)
    wall = dpd.term(hold_near, stiffness=40.0, until=until, reach=1.0)
    fluid = dpd.colloid_fluid(attraction=[morse, wall], eta_0=0.05, **SOFT).set(strength=0.0)
    gaps = gaps_of_pairs(fluid, count, 6.4, round(6.4**3), 0.15, dt, 15000.0)
    edges = np.array([0.02, 0.04, 0.06, 0.09, 0.13, 0.2, 0.3])
    U = lambda h: 0.2 * (np.exp(-60 * h) - 2 * np.exp(-30 * h))
    where = (
        f"D0 2 kT, kappa 30, solvent density 1, dt {dt:g}, {count} boxes, wall beyond h = {until:g}"
    )
    found = shares(gaps, edges, lambda h: np.exp(-U(h) / KT))
    return [
        row(f"P(h) over r^2 exp(-U/kT), h from {a:g} to {b:g}", where, share, 1.0, "exact")
        for a, b, share in zip(edges, edges[1:], found)
    ]


def free_pair():
    """g(h) of a dilute pair with D0 = 0 in the solvent, against exp(-W/kT) of held pairs

    Errors are those of g(h) alone; W across the barrier has one of 0.06 kT more. With it the bin
    that is furthest off, on the flank of the barrier, is off by 2.3 standard errors.
    """
    dt, until, count, side = 0.02, 0.9, 4, 7.0
    wall = dpd.term(hold_near, stiffness=20.0, until=until, reach=until + 0.4)
    fluid = dpd.colloid_fluid(attraction=wall, eta_0=0.0, **SOFT)
    gaps = gaps_of_pairs(fluid, count, side, round(3.0 * (side**3 - 2 * 3.4)), 0.6, dt, 6000.0)
    edges, weight = weight_of_held_pairs()
    where = (
        f"a_cs 9.62, kT 0.1, gamma 4.5, dt {dt:g}, {count} boxes of {side:g}, wall beyond h = "
        f"{until:g}"
    )
    found = shares(gaps, edges, weight)
    return [
        row(
            f"P(h) over r^2 exp(-W/kT), h from {a:g} to {b:g}",
            where,
            share,
            1.0,
            "W from the mean force on held pairs",
        )
        for a, b, share in zip(edges, edges[1:], found)
    ]


def weight_of_held_pairs():
    """Edges of bins of the gap, and ``exp(-W/kT)`` from the mean force on held pairs."""
    held = json.loads((rooms.HERE / "suspensions.json").read_text())["mediated"]["rows"]
    W = CubicSpline(GAPS, [r["value"][0] for r in held[: len(GAPS)]])
    edges = np.array([0.02, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9])
    return edges, lambda h: np.exp(-W(h))


def _pair_in_solvent(fluid, key, side, solvents, h, dt):
    """Two colloids at a gap in the middle of a cube, and solvent around them."""
    space = boxes.box(side)
    centres = 0.5 * side + jnp.array([[-0.5], [0.5]]) * jnp.array([[2.0 + h, 0.0, 0.0]])
    beads = packing.fill(key, space, centres, np.ones(2), solvents)
    grids = plan_lists(fluid, space, (len(beads), 2), dt=dt, sheared=False)
    return placed(fluid, key, space, jnp.concatenate([beads, centres]), (len(beads), 2), grids)


HEADING = """# Colloids at production accuracy

Written by `python tests/physics/suspensions.py`; do not edit.
Reduced units, radius 1, standard errors."""
ROOMS = (pair_temperature, temperatures, diffusion, viscosity, mediated, free_pair, well)


if __name__ == "__main__":
    rooms.measure(ROOMS, sys.argv[1:], "suspensions.json", "SUSPENSIONS.md", HEADING)
