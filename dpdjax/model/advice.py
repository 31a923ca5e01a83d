"""Time steps and skins that suit a fluid whose numbers are known."""

import math

import numpy as np
from jax.typing import ArrayLike

from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import (
    CLOSE_NEIGHBOURS,
    damping_rate,
    extreme,
    is_between_colloids,
    lightest,
    network_rate,
    over,
    pair_frequency,
    repulsion_energy,
    thermal_time,
    worst_cases,
)

REBUILD_COST = 1.0
"""One rebuild in units of one force pass over the same list (measured: tests/benchmarks)."""
SORTING_COST = 2.4
"""Sorting one bead of the larger of two groups, in units of the forces of one pair (measured:
tests/benchmarks)."""


def suggest_dt(fluid: Fluid, density: ArrayLike, sizes: tuple[float, float] = (1.0, 1.0)) -> float:
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
        1.0 + min(over(repulsion_energy(numbers, density), float(numbers.kT)), 16.0) / 20.0
    )
    rate = damping_rate(numbers, density)
    limits = [0.7 * limit for _, limit in dt_limits(fluid, density, sizes)[1:]]
    dt = min(over(0.005 / error, rate), 0.01 * thermal_time(numbers), *limits)
    if not math.isfinite(dt):
        raise ValueError(
            "nothing limits the time step: the fluid has neither kT nor a force; give dt="
        )
    return dt


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
                for limits in zip(*(_limits(case, density, sizes) for case in worst_cases(fluid)))
            ),
        )
    )


def _limits(numbers, density, sizes) -> tuple[float, float, float, float]:
    """The largest dt that drag, conservative forces, lubrication and contacts allow."""
    colloidal = [i for i in numbers.interactions if is_between_colloids(numbers, i)]
    others = [i for i in numbers.interactions if not is_between_colloids(numbers, i)]
    meetings = {(sizes[0], sizes[0]), sizes}
    longest = lambda most, rates: over(most, max(rates, default=0.0))
    return (
        longest(0.5, [damping_rate(numbers, density)]),
        longest(0.5, [pair_frequency(numbers, i) for i in others]),
        longest(1.0, [network_rate(numbers, i, pair) for i in colloidal for pair in meetings]),
        longest(1.0, [pair_frequency(numbers, i, pair) for i in colloidal for pair in meetings]),
    )


def suggest_skin(fluid: Fluid, dt: ArrayLike, interaction: int = 0, sorting: float = 0.0) -> float:
    """The skin of one list that costs least: wide lists hold more pairs, narrow ones are built more
    often.

    ``sorting``: what a rebuild costs besides, in units of one force pass over the list.
    """
    numbers = extreme(fluid)
    reach = numbers.reaches()[interaction]
    groups = numbers.interactions[interaction].groups
    fastest = sum(4.5 * math.sqrt(float(numbers.kT) / lightest(numbers, group)) for group in groups)
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
