"""Time steps and skins that suit a fluid whose numbers are known."""

import math
from typing import Any

import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import Numbers, not_negative, plain, positive
from dpdjax.model.fluid import Fluid
from dpdjax.model.rates import (
    CLOSE_NEIGHBOURS,
    bond_frequency,
    damping_rate,
    extreme,
    is_between_colloids,
    lightest,
    network_rate,
    over,
    pair_frequency,
    repulsion_energies,
    solvent_of,
    thermal_time,
    worst_cases,
)

REBUILD_COST = 1.0
"""One rebuild in units of one force pass over the same list (measured: tests/benchmarks)."""
SORTING_COST = 2.4
"""Sorting one bead of the larger of two groups, in units of the forces of one pair (measured:
tests/benchmarks)."""


ERROR = 0.005
"""Of temperature, configurational temperature and structure, where no other is asked for."""
SAFETY = 0.7
"""Share of what stability allows that is suggested."""
HEAT, HEAT_RATE, HEAT_SHARED = 1.2, 0.8, 0.1
STIFF, STIFFER = 20.0, 1.75
FREEZE, FREEZE_POWER = 1.2, 3.7
THIN, THICK = 0.15, 1.6
"""Errors of velocity-Verlet, as :func:`dt_errors` has them (measured:
tests/physics/INTEGRATORS.md)."""
HELD, MOVED = 0.007, 4.0
"""Errors of drag by the midpoint rule, as :func:`held_errors` has them (measured there too)."""


STRETCHED = 0.25
"""Error of the mean square of a bond over ``(w dt)^2``, w its frequency: exact for velocity-Verlet,
which samples a spring softer by that."""


LENGTH = "length of bonds"
ERRING = TEMPERATURE, STIFFNESS, *_ = (
    "temperature",
    "configurational temperature of a stiff repulsion",
    "configurational temperature at strong drag",
    "structure at strong drag",
    LENGTH,
)
"""What errs, as :func:`dt_errors` names it."""
ERRING_HELD = (
    STIFFNESS,
    "viscosity, drag held in a step",
    "diffusion, drag held in a step",
    LENGTH,
)
"""What errs, as :func:`held_errors` names it."""
_close = f"the damping rate of a colloid with {CLOSE_NEIGHBOURS} close neighbours"
LIMITS = DRAG, REPULSION, LUBRICATION, CONTACT, BOND = (
    "drag: dt times the damping rate of a bead is to stay below 0.5",
    "conservative force: dt times the frequency of a pair is to stay below 0.5",
    f"lubrication: dt times {_close} is to stay below 1",
    "contact force: dt times the frequency of two touching colloids is to stay below 1",
    "bonds: dt times the frequency of a bond or an angle is to stay below 0.5",
)
"""What is unstable, as :func:`dt_limits` names it."""


def suggest_dt(
    fluid: Fluid,
    density: Numbers,
    sizes: tuple[float, float] = (1.0, 1.0),
    *,
    integrator: Any = None,
    error: float = ERROR,
) -> float:
    """The longest time step at which a run is right to ``error`` [time].

    That is what accuracy allows (kinetic and configurational temperature, structure, the lengths of
    bonds), and at most 0.7 of what stability allows (drag, stiff potentials, lubrication, contacts,
    bonds); both are those of the integrator.

    Args:
        fluid: what runs; of a scan the member that needs the shortest step counts.
        density: beads per volume of all, or one number for each species.
        sizes: relative sizes of the smallest and the largest colloid.
        integrator: whose step it is; by default velocity-Verlet.
        error: relative error that is allowed.

    Raises ValueError where nothing limits the step.

    Example:
        >>> round(dpd.suggest_dt(water, density=3.0), 4)
        0.0094
        >>> thick = water.set(gamma=100.0, a=0.0)
        >>> how = dpd.integrators.ImplicitDrag()
        >>> [round(dpd.suggest_dt(thick, 3.0, integrator=i), 4) for i in (None, how)]
        [0.0008, 0.0202]
    """
    error, density = plain(error, "error", positive), not_negative(density, "density")
    if density.shape not in ((), (fluid.species,)):
        raise ValueError(
            f"density has shape {density.shape}; give one number, or one for each species"
        )
    errors = dt_errors if integrator is None else integrator.dt_errors
    stable = dt_limits if integrator is None else integrator.dt_limits
    limits = [limit for _, limit in errors(fluid, density, error)]
    limits += [SAFETY * limit for _, limit in stable(fluid, density, sizes)]
    dt = min(limits, default=math.inf)
    if not math.isfinite(dt):
        raise ValueError(
            "nothing limits the time step: the fluid has neither kT nor a force; give dt="
        )
    return dt


def dt_errors(fluid: Fluid, density: Numbers, error: float = ERROR) -> list[tuple[str, float]]:
    """What errs with the time step of velocity-Verlet, and the dt at which it errs by ``error``
    [time].

    In thermal units, ``w`` the :func:`damping_rate` and ``u`` the mean-field repulsion of a bead:
    the kinetic temperature by ``1.2 dt w/(w + 0.8 + 0.1 u)``; the configurational one by ``(20 +
    1.75 u) dt^2``, and at strong drag by ``-1.2 (w dt)^3.7``; how often beads overlap by ``-0.15 w
    dt/(1 + u/1.6)``, which beads that do not repel each other feel first; the mean square of a
    bond of frequency f by ``(f dt)^2 / 4``.
    """
    cases = (_errors(case, density, error) for case in worst_cases(fluid))
    return list(zip(ERRING, (min(limits) for limits in zip(*cases))))


def held_errors(fluid: Fluid, density: Numbers, error: float = ERROR) -> list[tuple[str, float]]:
    """As :func:`dt_errors`, for drag by the midpoint rule, its pairs held for a step.

    The temperature is right at any dt. In the units there, the configurational temperature of beads
    that repel each other errs as there; the viscosity by ``0.007 (w dt)^2``, the diffusion by ``-4
    dt^2``.
    """
    cases = (_held(case, density, error) for case in worst_cases(fluid))
    return list(zip(ERRING_HELD, (min(limits) for limits in zip(*cases))))


def _held(numbers, density, error: float) -> tuple[float, float, float, float]:
    repels = any(pair_frequency(numbers, i) > 0 for i in numbers.interactions)
    _, stiff, _, _, length = _errors(numbers, density, error)
    return (
        stiff if repels else math.inf,
        over(math.sqrt(error / HELD), damping_rate(numbers, density)),
        math.sqrt(error / MOVED) * thermal_time(solvent_of(numbers)),
        length,
    )


def _errors(numbers, density, error: float) -> tuple[float, float, float, float, float]:
    """The dt at which each of the errors of :func:`dt_errors` is ``error``."""
    kT, rate = float(numbers.kT), damping_rate(numbers, density)
    thermal = thermal_time(solvent_of(numbers))
    # Mean-field energies beyond a few hundred kT are those of beads that never come so near.
    energies = [min(over(u, kT), 250.0) for u in repulsion_energies(numbers, density)]
    hard, soft = max(energies, default=0.0), min(energies, default=0.0)
    shared = HEAT_RATE + HEAT_SHARED * soft
    # Without a temperature there is no thermal unit, and beads at rest are not heated.
    heated = thermal + over(shared, rate) if math.isfinite(thermal) else math.inf
    return (
        error / HEAT * heated,
        math.sqrt(error / (STIFF + STIFFER * hard)) * thermal,
        over((error / FREEZE) ** (1.0 / FREEZE_POWER), rate),
        over(error / THIN * (1.0 + soft / THICK), rate),
        over(math.sqrt(error / STRETCHED), bond_frequency(numbers)),
    )


def dt_limits(
    fluid: Fluid, density, sizes: tuple[float, float] = (1.0, 1.0)
) -> list[tuple[str, float]]:
    """What limits the time step, and the largest dt it allows [time].

    Damping is stable below 2 over its largest rate, accurate below 1 over it; the beads of a
    solvent, whose damping is known on average only, are kept below half of that. Oscillations are
    stable below 2 over their frequency. ``sizes``: relative sizes of the smallest and the largest
    colloid; the smallest is the first to suffer.
    """
    cases = (_limits(case, density, sizes) for case in worst_cases(fluid))
    return list(zip(LIMITS, (min(limits) for limits in zip(*cases))))


def _limits(numbers, density, sizes) -> tuple[float, float, float, float, float]:
    """The largest dt that drag, conservative forces, lubrication, contacts and bonds allow."""
    colloidal = [i for i in numbers.interactions if is_between_colloids(numbers, i)]
    others = [i for i in numbers.interactions if not is_between_colloids(numbers, i)]
    meetings = {(sizes[0], sizes[0]), sizes}
    longest = lambda most, rates: over(most, max(rates, default=0.0))
    return (
        longest(0.5, [damping_rate(numbers, density)]),
        longest(0.5, [pair_frequency(numbers, i) for i in others]),
        longest(1.0, [network_rate(numbers, i, pair) for i in colloidal for pair in meetings]),
        longest(1.0, [pair_frequency(numbers, i, pair) for i in colloidal for pair in meetings]),
        longest(0.5, [bond_frequency(numbers)]),
    )


def suggest_skin(
    fluid: Fluid, dt: ArrayLike, interaction: int = 0, sorting: float = 0.0, passes: float = 1.0
) -> float:
    """The skin of one list that costs least [length]: wide lists hold more pairs, narrow ones are
    built more often.

    Args:
        fluid: what runs.
        dt: time step [time]; of several the longest counts.
        interaction: place in ``fluid.interactions`` of the one whose list it is.
        sorting: what a rebuild costs besides, in units of one force pass over the list.
        passes: what a step costs in these units, the ``cost`` of its integrator.

    Example:
        >>> [round(dpd.theory.suggest_skin(water, dt=dt), 2) for dt in (0.002, 0.01)]
        [0.07, 0.15]
    """
    numbers = extreme(fluid)
    reach = numbers.reaches()[interaction]
    groups = numbers.interactions[interaction].groups
    fastest = sum(4.5 * math.sqrt(float(numbers.kT) / lightest(numbers, group)) for group in groups)
    skins = np.round(np.linspace(0.02, 0.6, 59), 2) * reach
    rebuilds = fastest * float(np.max(np.asarray(dt))) / skins
    cost = (1 + skins / reach) ** 3 * (passes + REBUILD_COST * rebuilds) + sorting * rebuilds
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
