"""What of a diffusion coefficient is yet to come at the lags it is read off at.

A bead forgets its velocity in two stages: by drag, within ``m D / kT``, and long after that what it
has stirred up around it, which comes back to it until the longest wave of the box has died out.
"""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from dpdjax.errors import warn
from dpdjax.measure.hydrodynamics import velocity_tail
from dpdjax.measure.replicas import shared, volume_of
from dpdjax.measure.statistics import Estimate
from dpdjax.model import rates

FLYING = 0.25
"""Share of a diffusion coefficient yet to come by drag alone, above which nothing was measured."""
ENOUGH = 0.005
"""Share that later lags, which a warning names, leave out."""
LIKELY = 0.5
"""Share of the error above which what is missing is told of: the estimate of it is often half of
what it is."""
ROUNDS, LEAST_SHOWN = 60, 0.1
"""To find what drag hides, and the share of a diffusion coefficient that is seen at least."""
MOMENTS = 200
"""Times at which the tail is added up, evenly in their logarithm."""


class Memory(NamedTuple):
    """How beads forget their velocities.

    Attributes:
        inertia: mass of a bead, or moment of inertia.
        kT: thermal energy.
        viscosity, density, side: rough viscosity of the solvent, its mass density, side of the box;
            None without a solvent.
    """

    inertia: float
    kT: float
    viscosity: float | None = None
    density: float | None = None
    side: float | None = None


def memory_of_beads(trajectory, beads, masses, of_bead) -> Memory:
    """That of ``beads`` by their numbers; ``masses`` (n,) and species ``of_bead`` (n,) are of
    all."""
    kT, inertia = shared(trajectory.fluid.kT), float(np.mean(masses[beads]))
    volume = volume_of(trajectory)
    viscosity = _solvent_viscosity(
        trajectory.fluid, np.bincount(of_bead, minlength=trajectory.fluid.species) / volume
    )
    return Memory(inertia, kT, viscosity, float(np.sum(masses)) / volume, volume ** (1 / 3))


def _solvent_viscosity(fluid, densities) -> float | None:
    """That of kinetic theory, of the points of a fluid among themselves; None where no drag acts
    between them."""
    points = [k for k, radius in enumerate(fluid.radius) if radius is None]
    among = tuple(i for i in fluid.interactions if set(i.groups[0] + i.groups[1]) <= set(points))
    numbers = rates.extreme(dataclasses.replace(fluid, interactions=among))
    density = float(densities[points].sum())
    if not among or density == 0 or rates.damping_rate(numbers, density) == 0:
        return None
    return rates.kinetic_theory_viscosity(numbers, density)


def is_forgotten(memory: Memory, found: Estimate, lags, pieces: int) -> bool:
    """Whether next to nothing of a diffusion coefficient, an estimate of the slope at ``lags``
    (lags,), is yet to come there.

    Raises ValueError where the beads still fly as they started, warns where what is missing is as
    much as the error.
    """
    if memory.kT <= 0 or found.value <= 0:
        return True
    span = f"between lags of {lags[0]:.4g} and {lags[-1]:.4g}"
    whole = _with_what_drag_hides(memory, found.value, lags)
    if found.value < (1.0 - FLYING) * whole:
        raise ValueError(
            f"{span} the velocities are not yet forgotten, which takes several times "
            f"{memory.inertia * found.value / memory.kT:.3g} at least, and a slope of "
            f"{found.value:.3g} is not that of diffusion; {_cure(memory, whole, pieces)}"
        )
    missing = float(np.mean(_missing(memory, whole, lags)))
    if missing <= LIKELY * found.error:
        return True
    warn(
        f"{span} velocities are still remembered, by the flow that the beads have stirred up too: "
        f"the diffusion coefficient {found} is too small by about {missing:.2g}, or more; "
        f"{_cure(memory, whole, pieces)}",
    )
    return False


def _with_what_drag_hides(memory: Memory, found: float, lags) -> float:
    """The diffusion coefficient of which a memory ``exp(-t kT / m D)`` shows ``found`` at the
    lags."""
    whole = found
    for _ in range(ROUNDS):
        whole = found / max(
            1.0 - float(np.mean(_by_drag(memory, whole, lags))) / whole, LEAST_SHOWN
        )
    return whole


def _missing(memory: Memory, whole: float, lags):
    """What of a diffusion coefficient is yet to come at each lag, (lags,)."""
    return _by_drag(memory, whole, lags) + _by_tail(memory, whole, lags)


def _by_drag(memory: Memory, whole: float, lags):
    return whole * np.exp(-lags * memory.kT / (memory.inertia * whole))


def _by_tail(memory: Memory, diffusion: float, lags):
    """A third of the integral of :func:`velocity_tail` from each lag on, (lags,): the waves of the
    solvent and their beads' own diffusion."""
    if memory.viscosity is None:
        return np.zeros_like(lags)
    viscosity = memory.viscosity + memory.density * diffusion
    longest = (memory.side / (2 * math.pi)) ** 2 * memory.density / viscosity
    # Before a lag of zero, and after the longest wave is gone, there is nothing to add.
    first = max(float(lags[0]), 1e-6 * longest)
    time = np.geomspace(first, max(float(lags[-1]), first) + 40 * longest, MOMENTS)
    tail = (
        velocity_tail(
            time, kT=memory.kT, viscosity=viscosity, density=memory.density, box=memory.side
        )
        / 3
    )
    steps = 0.5 * (tail[1:] + tail[:-1]) * np.diff(time)
    later = np.concatenate([np.cumsum(steps[::-1])[::-1], [0.0]])
    return np.interp(lags, time, later)


def _cure(memory: Memory, whole: float, pieces: int) -> str:
    """The lags that would do, and the run that holds ``pieces`` independent pieces of them."""
    lag = memory.inertia * whole / memory.kT
    while float(_missing(memory, whole, np.array([lag]))[0]) > ENOUGH * whole:
        lag *= 1.05
    last = 1.5 * lag
    return (
        f"fit later lags, fit=({lag:.2g}, {last:.2g}), of a run or replicas of "
        f"{2 * pieces * last:.2g} or more in all"
    )
