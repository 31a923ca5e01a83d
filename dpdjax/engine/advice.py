"""Time steps and skins that suit a fluid, and the rates they follow from.

Host side numbers: everything here needs a fluid whose numbers are known.
"""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete
from dpdjax.model import summary
from dpdjax.model.colloids import diffusion_time
from dpdjax.model.declare import name_of
from dpdjax.model.fluid import Fluid, Interaction
from dpdjax.model.term import ACROSS, ALONG, CENTRAL, FULL, TRANSVERSE, Whole

REBUILD_COST = 1.0
"""One rebuild in units of one force pass over the same list (measured: tests/benchmarks)."""
SORTING_COST = 2.4
"""Sorting one bead of the larger of two groups, in units of the forces of one pair (measured:
tests/benchmarks)."""
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
DEEP = 40.0
"""Depth of a potential [kT] that is seldom meant."""
PRODUCTION_SIDE = 30.0
"""Shortest side at which a suspension counts as large, in reaches of its solvent."""


def suggest_dt(fluid: Fluid, density, sizes: tuple[float, float] = (1.0, 1.0)) -> float:
    """The time step that keeps the temperature error of velocity-Verlet below 0.5 %.

    The error is about 0.7 omega dt in an unstructured fluid, with omega the
    :func:`damping_rate`, and 0.3 to 0.4 omega dt in one that repels like water (measured:
    tests/physics/RESULTS.md). Never above a hundredth of the thermal time
    ``r_c sqrt(m / kT)``, nor above 0.7 of what :func:`dt_limits` allows colloids.

    ``density``: beads per volume of all, or one number for each species; ``sizes``: relative sizes
    of the smallest and the largest colloid.
    """
    numbers = extreme(fluid)
    error = 0.7 / (
        1.0 + min(_over(repulsion_energy(numbers, density), float(numbers.kT)), 16.0) / 20.0
    )
    rate = damping_rate(numbers, density)
    limits = [0.7 * limit for _, limit in dt_limits(fluid, density, sizes)[1:]]
    dt = min(_over(0.005 / error, rate), 0.01 * thermal_time(numbers), *limits)
    if not math.isfinite(dt):
        raise ValueError(
            "nothing limits the time step: the fluid has neither kT nor a force; give dt="
        )
    return dt


def thermal_time(fluid: Fluid) -> float:
    """``r_c sqrt(m / kT)`` of the lightest beads and the shortest reach [time]; infinite at kT
    0."""
    return shortest_reach(fluid) * math.sqrt(
        _over(float(np.min(fluid.mass)), float(np.max(fluid.kT)))
    )


def _over(number: float, rate: float) -> float:
    """``number / rate``, infinite for a rate of 0: a floor under it would be a number in some
    unit."""
    return number / rate if rate > 0 else math.inf


def dt_limits(
    fluid: Fluid, density, sizes: tuple[float, float] = (1.0, 1.0)
) -> list[tuple[str, float]]:
    """What limits the time step, and the largest dt it allows [time].

    Damping is stable below 2 over its largest rate, accurate below 1 over it; the beads of a
    solvent, whose damping is known on average only, are kept below half of that. Oscillations are
    stable below 2 over their frequency. ``sizes``: relative sizes of the smallest and the largest
    colloid; the smallest is the first to suffer.
    """
    close = f"the damping rate of a colloid with {CLOSE_NEIGHBOURS} close neighbours"
    names = (
        "drag: dt times the damping rate of a bead is to stay below 0.5",
        "conservative force: dt times the frequency of a pair is to stay below 0.5",
        f"lubrication: dt times {close} is to stay below 1",
        "contact force: dt times the frequency of two touching colloids is to stay below 1",
    )
    return list(
        zip(
            names,
            (
                min(limits)
                for limits in zip(*(_limits(case, density, sizes) for case in _cases(fluid)))
            ),
        )
    )


def _limits(numbers, density, sizes) -> tuple[float, float, float, float]:
    """The largest dt that drag, conservative forces, lubrication and contacts allow."""
    colloidal = [i for i in numbers.interactions if _is_between_colloids(numbers, i)]
    others = [i for i in numbers.interactions if not _is_between_colloids(numbers, i)]
    meetings = {(sizes[0], sizes[0]), sizes}
    longest = lambda most, rates: _over(most, max(rates, default=0.0))
    return (
        longest(0.5, [damping_rate(numbers, density)]),
        longest(0.5, [pair_frequency(numbers, i) for i in others]),
        longest(1.0, [_network_rate(numbers, i, pair) for i in colloidal for pair in meetings]),
        longest(1.0, [pair_frequency(numbers, i, pair) for i in colloidal for pair in meetings]),
    )


def cautions(fluid: Fluid, state, dt, plan) -> list[str]:
    """What is allowed in a run with colloids but seldom meant, each with the number that would
    pass."""
    numbers = extreme(fluid)
    if not numbers.has_radii:
        return deep_wells(fluid)
    side, tau = float(np.min(state.box.lengths)), _diffusion_time(numbers)
    found = []
    least = PRODUCTION_SIDE * min(numbers.reaches())
    if side < least * (1 - 1e-6) and not fluid.rotating:
        small = f"box side {side:.4g} is small for a suspension, whose images are felt"
        found.append(f"{small}: use {least:.4g} or more for production")
    found += cut_short(fluid) + deep_wells(fluid)
    interval = float(np.max(np.asarray(dt))) * plan.every
    if interval > tau:
        found.append(
            f"frames are {interval:.4g} apart, more than the diffusion time {tau:.4g}: "
            f"use Plan(every={max(1, math.floor(tau / float(np.max(np.asarray(dt)))))}) or less"
        )
    return found


def deep_wells(fluid: Fluid) -> list[str]:
    """Which potentials are so deep that beads never leave: often a depth meant in kT."""
    if not np.all(np.asarray(fluid.kT) > 0):
        return []
    depths = [
        (t, summary.depth_in_kT(fluid, i, t)[1]) for i in fluid.interactions for t in i.conservative
    ]
    return [
        f"{name_of(t.law)} is {depth:.3g} kT deep, and beads that meet there stay for good: "
        "energies are given in the unit of energy, in which kT is "
        f"{float(np.min(np.asarray(fluid.kT))):.3g}"
        for t, depth in depths
        if depth > DEEP
    ]


def cut_short(fluid: Fluid) -> list[str]:
    """Which potentials are cut off before the reach that their law declares."""
    worst = {}
    for case in _cases(fluid):
        for k, i in enumerate(case.interactions):
            for n, t in enumerate(i.conservative):
                declared = getattr(t.law, "reach", None)
                if declared is None:
                    continue
                given = _given(case, i)
                far = float(dataclasses.replace(t, cut=None, reach=declared).between(**given)[1])
                cut = float(t.between(**given)[1])
                if cut < far * (1 - 1e-6) and far > worst.get((k, n), ("", 0.0, 0.0))[1]:
                    worst[k, n] = name_of(t.law), far, cut
    return [
        f"{name} is cut off at h = {cut:.3g}, short of the reach that its law declares: give it a "
        f"reach of {far:.3g}"
        for name, far, cut in worst.values()
    ]


def _diffusion_time(numbers) -> float:
    """That of the colloids, the last species; infinite without a viscosity to tell it from."""
    known = any(hasattr(t.law, "viscosity") for i in numbers.interactions for t in i.drag)
    if not known or numbers.kT <= 0 or numbers.radius[-1] is None:
        return math.inf
    tau = float(diffusion_time(numbers))
    return tau if tau > 0 else math.inf


def damping_rate(fluid: Fluid, density) -> float:
    """Largest rate at which drag damps the velocity of a bead in a solvent, ``density / 3 m`` times
    the integral of zeta [1/time].

    Twice or three times that for frictions across the line of centres, or in all directions. Or
    that of the spin of a sphere, twice ``density R^2 / 3 I`` times the integral for what acts
    across.

    ``density`` as for :func:`suggest_dt`. Drag between colloids is not in it.
    """
    densities = _densities(fluid, density)
    rates, spins = np.zeros(fluid.species), np.zeros(fluid.species)
    for i in (i for i in fluid.interactions if not _is_between_colloids(fluid, i)):
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
    """
    fourth = [
        (DRAG_STRESS[t.projector], _integral(fluid, i, t, 4))
        for i in fluid.interactions
        for t in i.drag
    ]
    return 2 * math.pi / 15 * density**2 * sum(share * integral for share, integral in fourth)


def kinetic_theory_viscosity(fluid: Fluid, density: float) -> float:
    """The viscosity without correlations, ``rho m D / 2`` and :func:`drag_viscosity` (Marsh et al.
    1997); 40 % off.

    Infinite without drag.
    """
    return _over(0.5 * density * float(fluid.kT), damping_rate(fluid, density)) + drag_viscosity(
        fluid, density
    )


def repulsion_energy(fluid: Fluid, density) -> float:
    """Mean-field repulsion of a solvent bead, ``density`` times the integral of the potentials, at
    least 0 [energy]."""
    densities = _densities(fluid, density)
    within = [
        i
        for i in fluid.interactions
        if i.groups[0] == i.groups[1] and not _is_between_colloids(fluid, i)
    ]
    energies = [
        densities[list(i.groups[0])].sum()
        * sum(_volume_integral(fluid, i, t) for t in i.conservative)
        for i in within
    ]
    return max([0.0, *map(float, energies)])


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


def shortest_reach(fluid: Fluid) -> float:
    """Shortest gap at which any friction, or else potential, between other beads than two colloids
    ends [length]."""
    solvent = [
        i for i in fluid.interactions if not _is_between_colloids(fluid, i)
    ] or fluid.interactions
    terms = [(i, t) for i in solvent for t in i.drag] or [(i, t) for i in solvent for t in i.terms]
    return min(float(np.min(t.between(**_given(fluid, i))[1])) for i, t in terms)


def suggest_skin(fluid: Fluid, dt, interaction: int = 0, sorting: float = 0.0) -> float:
    """The skin of one list that costs least: wide lists hold more pairs, narrow ones are built more
    often.

    ``sorting``: what a rebuild costs besides, in units of one force pass over the list.
    """
    numbers = extreme(fluid)
    reach = numbers.reaches()[interaction]
    groups = numbers.interactions[interaction].groups
    fastest = sum(
        4.5 * math.sqrt(float(numbers.kT) / _lightest(numbers, group)) for group in groups
    )
    skins = np.round(np.linspace(0.02, 0.6, 59), 2) * reach
    rebuilds = fastest * float(np.max(np.asarray(dt))) / skins
    cost = (1 + skins / reach) ** 3 * (1 + REBUILD_COST * rebuilds) + sorting * rebuilds
    return float(skins[np.argmin(cost)])


def suggest_skins(fluid: Fluid, dt, counts, volume: float) -> list[float]:
    """The cheapest skin of each list, for ``counts`` beads of each species in a volume."""

    def sorting(interaction, reach):
        """Between two groups, what sorting the larger one costs over what the forces of the pairs
        do."""
        first, second = (sum(counts[k] for k in group) for group in interaction.groups)
        pairs = first * second / volume * 4 / 3 * math.pi * reach**3
        return (
            0.0
            if interaction.groups[0] == interaction.groups[1]
            else SORTING_COST * max(first, second) / max(pairs, 1.0)
        )

    each = enumerate(zip(fluid.interactions, fluid.reaches()))
    return [suggest_skin(fluid, dt, k, sorting(i, reach)) for k, (i, reach) in each]


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
    interactions = tuple(i.map_terms(of_term) for i in fluid.interactions)
    return Fluid(
        interactions, largest(fluid.kT), mass.reshape(-1, mass.shape[-1]).min(0), radius, inertia
    )


def _cases(fluid):
    """Fluids one of which is the worst of a scan: all numbers at their largest, and one of them at
    its smallest."""
    terms = [t for i in fluid.interactions for t in i.terms]
    coefficients = [(name, c) for t in terms for name, c in t.coefficients.items()]
    scanned = {name for name, c in coefficients if not isinstance(c, Whole) and np.size(c) > 1}
    for member in range(max(len(t.members) for t in terms)):
        yield extreme(fluid, member=member)
        yield from (extreme(fluid, name, member) for name in sorted(scanned))


def _densities(fluid, density):
    """Beads per volume by species; a single number is that of the first group, where solvent is."""
    if np.ndim(density):
        return np.asarray(density, float)
    return np.eye(fluid.species)[0] * float(density)


def _lightest(fluid, group) -> float:
    return float(np.min(np.asarray(fluid.mass)[..., list(group)]))


def _largest_radius(fluid, group) -> float:
    return max(0.0 if fluid.radius[k] is None else float(np.max(fluid.radius[k])) for k in group)


def _is_between_colloids(fluid, interaction: Interaction) -> bool:
    return all(_largest_radius(fluid, group) > 0 for group in interaction.groups)


def _given(fluid, interaction, sizes=(1.0, 1.0)) -> dict:
    R_i, R_j = (
        _largest_radius(fluid, group) * size for group, size in zip(interaction.groups, sizes)
    )
    return {"R_i": R_i, "R_j": R_j, "kT": float(np.max(fluid.kT))}


def _masses(fluid, interaction, sizes=(1.0, 1.0)) -> tuple[float, float]:
    return tuple(
        _lightest(fluid, group) * size**3 for group, size in zip(interaction.groups, sizes)
    )


def _arms(fluid):
    """``R^2 / I`` of each species: what a friction across the line of centres does to its spin; 0
    where there is none."""
    turns = lambda R, inertia: (
        0.0 if inertia is None else float(np.max(R)) ** 2 / float(np.min(inertia))
    )
    return np.array([turns(R, inertia) for R, inertia in zip(fluid.radius, fluid.inertia)])


def _network_rate(fluid, interaction, sizes) -> float:
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


def _largest_friction(fluid, interaction, term, sizes) -> float:
    """Largest value of a drag from contact on; from where it is sampled for one without a limit at
    contact."""
    law, reach = term.between(np.max, **_given(fluid, interaction, sizes))
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
    given = _given(fluid, interaction, sizes)
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
