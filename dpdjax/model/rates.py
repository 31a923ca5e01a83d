"""The rates and lengths of a fluid that time steps and lists follow from.

Every number of the fluid is to be known.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import Numbers, is_concrete
from dpdjax.model.bonded import Bonded
from dpdjax.model.fluid import Fluid, Interaction
from dpdjax.model.term import ACROSS, ALONG, CENTRAL, FULL, TRANSVERSE, Whole

CLOSE_NEIGHBOURS = 6
"""Of a colloid in a gel; each shares half of the damping of its pair."""
SAMPLES = 400
DIRECTIONS = {CENTRAL: 1, TRANSVERSE: 2, FULL: 3}
"""In which a friction acts."""
DRAG_STRESS = {CENTRAL: 1, TRANSVERSE: 4, FULL: 5}
"""What a friction adds to the viscosity, over one along the line of centres: the mean of (x y)^2
and of y^2 over a sphere."""
TOUCHING = 1e-6
"""Gap of colloids that all but touch, in reaches: some laws are zero in overlap."""


def thermal_time(fluid: Fluid) -> float:
    """``r_c sqrt(m / kT)`` of the lightest beads and the shortest reach [time]; infinite at kT 0.

    Example:
        >>> dpd.theory.thermal_time(water)
        1.0
        >>> dpd.theory.thermal_time(water.set(mass=4.0))
        2.0
    """
    return shortest_reach(fluid) * math.sqrt(
        over(float(np.min(fluid.mass)), float(np.max(fluid.kT)))
    )


def solvent_of(fluid: Fluid) -> Fluid:
    """The fluid with the interactions between points alone, where there are any."""
    is_point = lambda group: _largest_radius(fluid, group) == 0
    places = [k for k, i in enumerate(fluid.interactions) if all(map(is_point, i.groups))]
    return fluid.only(places) if places else fluid


def over(number: float, rate: float) -> float:
    """``number / rate``, infinite for a rate of 0: a floor under it would be a number in some
    unit."""
    return number / rate if rate > 0 else math.inf


def damping_rate(fluid: Fluid, density: Numbers) -> float:
    """Largest rate at which drag damps the velocity of a bead in a solvent, ``density / 3 m`` times
    the integral of zeta over the volume [1 / time].

    Twice or three times that for frictions across the line of centres, or in all directions. Or
    that of the spin of a sphere, twice ``density R^2 / 3 I`` times the integral for what acts
    across.

    ``density`` as for :func:`dpdjax.suggest_dt`. Drag between colloids is not in it.

    Example:
        >>> round(dpd.theory.damping_rate(water, density=3.0), 3)  # 2 pi gamma density / 45
        1.885
    """
    densities = _densities(fluid, density)
    rates, spins = np.zeros(fluid.species), np.zeros(fluid.species)
    for i in (i for i in fluid.interactions if not is_between_colloids(fluid, i)):
        integrals = [(t.projector, _volume_integral(fluid, i, t)) for t in i.drag]
        friction = sum(DIRECTIONS[projector] * integral for projector, integral in integrals)
        across = sum(2 * integral for projector, integral in integrals if projector in ACROSS)
        # Within one group both directions are the same.
        for mine, other in {i.groups, i.groups[::-1]}:
            rates[list(mine)] += friction * densities[list(other)].sum()
            spins[list(mine)] += across * densities[list(other)].sum()
    return float(max(np.max(rates / np.asarray(fluid.mass)), np.max(spins * _arms(fluid)))) / 3.0


def drag_viscosity(fluid: Fluid, density: float) -> float:
    """Viscosity of the drag among beads of one kind, without correlations [energy time/volume].

    ``2 pi/15 density^2`` times the integral of ``zeta r^4`` (Marsh et al. 1997), which is
    ``2 pi gamma density^2 r_c^5 / 1575`` for ``zeta = gamma w^2``; four times that for frictions
    across the line of centres, five times for those in all directions, as beads that do not turn
    feel the whole flow.

    Example:
        >>> round(dpd.theory.drag_viscosity(water, density=3.0), 4)
        0.1616
        >>> round(2 * np.pi * 4.5 * 3.0**2 / 1575, 4)
        0.1616
    """
    fourth = [
        (DRAG_STRESS[t.projector], _integral(fluid, i, t, 4))
        for i in fluid.interactions
        for t in i.drag
    ]
    return 2 * math.pi / 15 * density**2 * sum(share * integral for share, integral in fourth)


def kinetic_theory_viscosity(fluid: Fluid, density: float) -> float:
    """The viscosity without correlations [energy time / volume], ``rho m D / 2`` and
    :func:`dpdjax.theory.drag_viscosity` (Marsh et al. 1997); 40 % off.

    Infinite without drag.

    Example:
        >>> round(dpd.theory.kinetic_theory_viscosity(water, density=3.0), 3)
        0.957
        >>> share = dpd.theory.drag_viscosity(water, 3.0)
        >>> round(3.0 / 2 / dpd.theory.damping_rate(water, 3.0) + share, 3)
        0.957
    """
    return over(0.5 * density * float(fluid.kT), damping_rate(fluid, density)) + drag_viscosity(
        fluid, density
    )


def repulsion_energies(fluid: Fluid, density) -> list[float]:
    """Mean-field repulsion of the beads of each group, ``density`` times the integral of the
    potentials within it, at least 0 [energy]."""
    densities = _densities(fluid, density)
    within = [
        i
        for i in fluid.interactions
        if i.groups[0] == i.groups[1] and not is_between_colloids(fluid, i)
    ]
    energies = [
        densities[list(i.groups[0])].sum()
        * sum(_volume_integral(fluid, i, t) for t in i.conservative)
        for i in within
    ]
    return [max(0.0, float(energy)) for energy in energies]


def repulsion_energy(fluid: Fluid, density) -> float:
    """The largest of :func:`repulsion_energies`, 0 of none [energy]."""
    return max(repulsion_energies(fluid, density), default=0.0)


def pair_frequency(
    fluid: Fluid, interaction: Interaction, sizes: tuple[float, float] = (1.0, 1.0)
) -> float:
    """Fastest oscillation of two beads, ``sqrt(U'' / mu)``, at distances they reach with 4 kT
    [1/time]."""
    stiffest = 0.0
    for t in interaction.conservative:
        _, energy, curvature, _ = _sampled(
            fluid, interaction, t, curved=True, sizes=sizes, inside=True
        )
        # The well is where beads are: laws need not make sense in deep overlap.
        reached = energy - energy[-SAMPLES:].min() <= 4.0 * float(fluid.kT)
        stiffest = max(stiffest, float(np.max(curvature[reached], initial=0.0)))
    a, b = _masses(fluid, interaction, sizes)
    return math.sqrt(stiffest * (1.0 / a + 1.0 / b))


def bond_frequency(fluid: Fluid) -> float:
    """Fastest oscillation of two beads of a bond, of three of an angle or four of a dihedral, by
    the curvature of its energy where they are with 4 kT [1/time]; 0 without bonds.

    ``sqrt(U'' / mu)``, and ``sqrt(6 U_theta / m) / l`` of an angle between bonds of length l: of a
    chain the mean square over its modes; ``sqrt(10 U_phi / m) / l`` of a dihedral, roughly. The
    lightest beads there are count.
    """
    mass = float(np.min(fluid.mass))
    bonds = [_of_bond(fluid, b) for b in fluid.bonded if b.kind == "bond"]
    stretch = max((2.0 * curvature / mass for curvature, _ in bonds), default=0.0)
    length = min((length for _, length in bonds), default=shortest_reach(fluid))
    turning = [TURNS[b.kind] * _turning(fluid, b)[0] for b in fluid.bonded if b.kind in TURNS]
    return math.sqrt(max(stretch, over(max(turning, default=0.0), mass * length**2)))


TURNS = {"angle": 6.0, "dihedral": 10.0}
"""What the curvature of an energy with an angle is multiplied by, over m l^2, for the square of a
frequency."""


def thermal_length(fluid: Fluid, b: Bonded) -> float:
    """Root of the mean square length of a bond by itself [length]; of one that can break, while it
    holds."""
    return _of_bond(fluid, b)[1]


def stiffness(fluid: Fluid) -> float:
    """By how much the bending of angles swells long chains: ``(1 + c)/(1 - c)``, c the mean cosine
    between bonds (Flory 1969); of the stiffest type, 1 without angles."""
    bends = [-_turning(fluid, b)[1] for b in fluid.bonded if b.kind == "angle"]
    return max([1.0, *((1.0 + c) / (1.0 - c) for c in bends)])


def _of_bond(fluid, b: Bonded) -> tuple[float, float]:
    """Largest curvature of the energy of a bond where it is with 4 kT, and its thermal length."""
    r = shortest_reach(fluid) * np.geomspace(1e-3, 1e2, 10 * SAMPLES)
    energy, _, curvature = _along(fluid, b, r)
    above, kT = energy - energy.min(), float(fluid.kT)
    # In equal steps of the logarithm: r^2 dr is r^3.
    weight = _held(_boltzmann(above, kT) * r**3, int(np.argmin(energy)))
    length = math.sqrt(float((weight * r**2).sum() / weight.sum()))
    return float(np.max(curvature[above <= 4.0 * kT], initial=0.0)), length


def _held(weight, lowest: int):
    """Weights up to where, beyond the well, they rise again: a bond of finite depth is broken
    there."""
    rises = np.diff(weight) > 0
    past = lowest + int(np.argmin(rises[lowest:]))
    again = np.flatnonzero(rises[past:])
    end = past + again[0] if again.size else len(weight)
    return np.where(np.arange(len(weight)) <= end, weight, 0.0)


def _turning(fluid, b: Bonded) -> tuple[float, float]:
    """Largest curvature of the energy of an angle or a dihedral with the angle, where it is with 4
    kT, and its mean cosine."""
    angle = np.pi * (np.arange(SAMPLES) + 0.5) / SAMPLES
    energy, slope, curvature = _along(fluid, b, np.cos(angle))
    bent = np.sin(angle) ** 2 * curvature - np.cos(angle) * slope
    above, kT = energy - energy.min(), float(fluid.kT)
    weight = _boltzmann(above, kT) * (np.sin(angle) if b.kind == "angle" else 1.0)
    mean = float((weight * np.cos(angle)).sum() / weight.sum())
    return float(np.max(bent[above <= 4.0 * kT], initial=0.0)), mean


def _boltzmann(above, kT: float):
    """Weights of energies above the lowest; at no temperature of that alone."""
    if kT <= 0:
        return (above == 0).astype(float)
    with np.errstate(over="ignore"):
        return np.exp(-above / kT)


def _along(fluid, b: Bonded, q):
    """Energy, slope and curvature of a type at coordinates; infinite where the law is no number."""
    energy, slope, curvature = np.zeros_like(q), np.zeros_like(q), np.zeros_like(q)
    with jax.ensure_compile_time_eval():
        at, one = jnp.asarray(q), jnp.ones(len(q))
        for t in b.terms:
            law, reach = t.between(np.max, kT=float(np.max(fluid.kT)))
            inside = True if reach is None else q < float(reach)
            rise = lambda x, law=law: jax.jvp(law, (x,), (one,))[1]
            values = (law(at), *jax.jvp(rise, (at,), (one,)))
            known = lambda x: np.nan_to_num(np.asarray(x, float), nan=np.inf, posinf=np.inf)
            u, du, ddu = map(known, values)
            u = u if reach is None else u - float(law(jnp.asarray(reach)))
            energy, slope = energy + np.where(inside, u, 0.0), slope + np.where(inside, du, 0.0)
            curvature = curvature + np.where(inside, ddu, 0.0)
    return energy, slope, curvature


def network_rate(fluid, interaction, sizes) -> float:
    """Damping rate of the first colloid among close neighbours like the second, of its velocity or
    its spin [1/time].

    Neighbours as heavy as it give way, which is in it: each pair's rate counts half.
    """
    largest = lambda t: _largest_friction(fluid, interaction, t, sizes)
    friction = lambda projectors: sum(
        largest(t) for t in interaction.drag if t.projector in projectors
    )
    mass, arm = (
        _masses(fluid, interaction, sizes)[0],
        np.max(_arms(fluid)[list(interaction.groups[0])]) / sizes[0] ** 3,
    )
    return CLOSE_NEIGHBOURS * max(friction(ALONG) / mass, friction(ACROSS) * (1.0 / mass + arm))


def shortest_reach(fluid: Fluid) -> float:
    """Shortest gap at which any friction, or else potential, between other beads than two colloids
    ends [length]."""
    solvent = [
        i for i in fluid.interactions if not is_between_colloids(fluid, i)
    ] or fluid.interactions
    terms = [(i, t) for i in solvent for t in i.drag] or [(i, t) for i in solvent for t in i.terms]
    return min(float(np.min(t.between(**at_largest(fluid, i))[1])) for i, t in terms)


def extreme(fluid: Fluid, least: str | None = None, member: int = 0) -> Fluid:
    """The fluid with every scan and every table replaced by its largest number; masses and
    ``least`` by the smallest.

    Raises ValueError for numbers that are being traced.
    """
    if not is_concrete(fluid):
        raise ValueError(
            "this needs plain numbers: build the state with one fluid outside vmap or grad, then "
            "scan or differentiate the run"
        )
    largest = lambda leaf: np.max(np.asarray(leaf, float))

    def of_term(t):
        t = t.members[member % len(t.members)]
        of = lambda k, c: np.min(np.asarray(c, float)) if k == least else largest(c)
        coefficients = {
            k: c if isinstance(c, Whole) else of(k, c) for k, c in t.coefficients.items()
        }
        return dataclasses.replace(
            t, coefficients=coefficients, cut=None if t.cut is None else largest(t.cut)
        )

    mass = np.asarray(fluid.mass, float)
    of_each = lambda values, extreme: tuple(
        None if x is None else extreme(np.asarray(x, float)) for x in values
    )
    radius, inertia = of_each(fluid.radius, np.max), of_each(fluid.inertia, np.min)
    return Fluid(
        tuple(i.map_terms(of_term) for i in fluid.interactions),
        largest(fluid.kT),
        mass.reshape(-1, mass.shape[-1]).min(0),
        radius,
        inertia,
        tuple(b.map_terms(of_term) for b in fluid.bonded),
    )


def _densities(fluid, density):
    """Beads per volume by species; a single number is that of the first group, where solvent is."""
    if np.ndim(density):
        return np.asarray(density, float)
    return np.eye(fluid.species)[0] * float(density)


def lightest(fluid, group) -> float:
    return float(np.min(np.asarray(fluid.mass)[..., list(group)]))


def _largest_radius(fluid, group) -> float:
    return max(0.0 if fluid.radius[k] is None else float(np.max(fluid.radius[k])) for k in group)


def is_between_colloids(fluid, interaction: Interaction) -> bool:
    return all(_largest_radius(fluid, group) > 0 for group in interaction.groups)


def at_largest(fluid, interaction, sizes=(1.0, 1.0)) -> dict:
    R_i, R_j = (
        _largest_radius(fluid, group) * size for group, size in zip(interaction.groups, sizes)
    )
    return {"R_i": R_i, "R_j": R_j, "kT": float(np.max(fluid.kT))}


def _masses(fluid, interaction, sizes=(1.0, 1.0)) -> tuple[float, float]:
    return tuple(lightest(fluid, group) * size**3 for group, size in zip(interaction.groups, sizes))


def _arms(fluid):
    """``R^2 / I`` of each species: what a friction across the line of centres does to its spin; 0
    where there is none."""
    arm = lambda R, inertia: (
        0.0 if inertia is None else float(np.max(R)) ** 2 / float(np.min(inertia))
    )
    return np.array([arm(R, inertia) for R, inertia in zip(fluid.radius, fluid.inertia)])


def _largest_friction(fluid, interaction, term, sizes) -> float:
    """Largest value of a drag from contact on; from where it is sampled for one without a limit at
    contact."""
    law, reach = term.between(np.max, **at_largest(fluid, interaction, sizes))
    with jax.ensure_compile_time_eval():
        touching = np.asarray(law(jnp.asarray([0.0, TOUCHING * float(reach)])), float)
    sampled = float(np.max(_sampled(fluid, interaction, term, sizes=sizes)[1]))
    return max(sampled, float(touching.max())) if np.all(np.isfinite(touching)) else sampled


def _volume_integral(fluid, interaction, term) -> float:
    """Integral of a law over the volume outside the surfaces."""
    return 4 * math.pi * _integral(fluid, interaction, term, 2)


def _integral(fluid, interaction, term, power: int) -> float:
    """Integral of a law times a power of the distance, by the midpoint rule."""
    r, values, _, width = _sampled(fluid, interaction, term)
    return float(np.sum(r**power * values) * width)


def _sampled(
    fluid, interaction, term, curved: bool = False, sizes=(1.0, 1.0), inside: bool = False
):
    """Centre distances in equal steps of the gap up to the reach, the law there, its curvature, and
    the step.

    ``inside``: of a point and a sphere from as deep inside on, where a wall may be that starts
    outside.
    """
    given = at_largest(fluid, interaction, sizes)
    law, reach = term.between(np.max, **given)
    width = float(reach) / SAMPLES
    wall = (given["R_i"] > 0) != (given["R_j"] > 0) and float(reach) < given["R_i"] + given["R_j"]
    count = SAMPLES if inside and wall else 0
    gap = (np.arange(-count, SAMPLES) + 0.5) * width
    with jax.ensure_compile_time_eval():
        h, one = jnp.asarray(gap), jnp.ones(len(gap))
        slope = lambda h: jax.jvp(law, (h,), (one,))[1]
        curvature = np.asarray(jax.jvp(slope, (h,), (one,))[1], float) if curved else None
        values = np.asarray(jnp.broadcast_to(law(h), h.shape), float)
    return gap + given["R_i"] + given["R_j"], values, curvature, width


def worst_cases(fluid):
    """Fluids one of which is the worst of a scan: all numbers at their largest, and one of them at
    its smallest."""
    terms = [t for part in fluid.parts for t in part.terms]
    coefficients = [(name, c) for t in terms for name, c in t.coefficients.items()]
    scanned = {name for name, c in coefficients if not isinstance(c, Whole) and np.size(c) > 1}
    for member in range(max(len(t.members) for t in terms)):
        yield extreme(fluid, member=member)
        yield from (extreme(fluid, name, member) for name in sorted(scanned))
