"""Theory of a sphere in a viscous fluid, alone or in a periodic cube, with a slip length: what
measurements are set beside.

A slip length ``b`` is the depth below the surface at which the velocity of the fluid, extrapolated,
would be that of the sphere: 0 without slip, infinite for full slip.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jax.typing import ArrayLike
from scipy.optimize import brentq

from dpdjax.checks import positive
from dpdjax.measure.statistics import Estimate

LATTICE = 2.837297
"""Of a simple cubic array of point forces (Hasimoto 1959)."""
EARLIEST = 1e-8
"""``nu k^2 t`` of the longest wave of a box from which its waves are added up."""


def sphere_diffusion(
    *,
    kT: ArrayLike,
    viscosity: ArrayLike,
    radius: ArrayLike,
    box: ArrayLike = math.inf,
    slip_length: ArrayLike = 0.0,
) -> Any:
    """Diffusion coefficient of a sphere in a periodic cube [length^2/time].

    ``kT/(6 pi viscosity) [(1 + 3 b/R)/((1 + 2 b/R) R) - 2.837297/L + 4 pi R^2/(3 L^3 (1 + 2
    b/R))]``: Hasimoto (1959, eq. 4.5) for ``b = 0``, to the third order in R/L. The next term
    without slip is ``-27.4 R^5/L^6``, 2 % of the first at R/L = 0.3.

    Args:
        kT, viscosity: of the fluid [energy], [energy time/volume].
        radius: of the sphere, as the fluid feels it [length].
        box: side of the cube [length].
        slip_length: [length]; infinite for full slip.

    Example:
        >>> sphere = {"kT": 1.0, "viscosity": 1.0, "radius": 1.0}
        >>> free = dpd.theory.sphere_diffusion(**sphere)
        >>> boxed = dpd.theory.sphere_diffusion(**sphere, box=10.0)
        >>> round(float(free), 4), round(float(boxed / free), 3)
        (0.0531, 0.72)
    """
    translation, quadrupole = _slip_factors(slip_length, radius)
    box = np.asarray(box, float)
    inverse = (
        translation / radius - LATTICE / box + 4 * math.pi / 3 * quadrupole * radius**2 / box**3
    )
    return kT / (6 * math.pi * viscosity) * inverse


def sphere_rotational_diffusion(
    *,
    kT: ArrayLike,
    viscosity: ArrayLike,
    radius: ArrayLike,
    box: ArrayLike = math.inf,
    slip_length: ArrayLike = 0.0,
) -> Any:
    """Rotational diffusion coefficient of a sphere in a periodic cube [1/time].

    ``kT (1 + 3 b/R)/(8 pi viscosity R^3) - kT/(6 viscosity L^3)``, the latter as Linke, Koefinger &
    Hummer (2018) have it; infinite for full slip.

    Arguments as in :func:`sphere_diffusion`.

    Example:
        >>> sphere = {"kT": 1.0, "viscosity": 1.0, "radius": 1.0}
        >>> free = dpd.theory.sphere_rotational_diffusion(**sphere)
        >>> boxed = dpd.theory.sphere_rotational_diffusion(**sphere, box=4.0)
        >>> round(float(free), 4), round(float(boxed / free), 3)
        (0.0398, 0.935)
    """
    box = np.asarray(box, float)
    return (
        kT
        / viscosity
        * ((1 + 3 * slip_length / radius) / (8 * math.pi * radius**3) - 1 / (6 * box**3))
    )


def _slip_factors(slip_length, radius):
    """``(1 + 3 beta)/(1 + 2 beta)`` and ``1/(1 + 2 beta)``, with ``beta = b/R``."""
    if np.isinf(slip_length):
        return 1.5, 0.0
    beta = slip_length / radius
    return (1 + 3 * beta) / (1 + 2 * beta), 1 / (1 + 2 * beta)


def velocity_tail(
    time: ArrayLike,
    *,
    kT: ArrayLike,
    viscosity: ArrayLike,
    density: ArrayLike,
    box: ArrayLike | None = None,
) -> Any:
    """Velocity autocorrelation of any sphere that the fluid carries, at late times
    [length^2/time^2], (times,).

    ``<v(t) . v(0)>`` at ``t`` well above ``R^2/nu``: ``kT/(4 density (pi nu t)^(3/2))`` with
    ``nu = viscosity/density`` (Alder & Wainwright 1970), its own diffusion left out; in a periodic
    cube the sum ``2 kT/(density V) sum exp(-nu k^2 t)`` over all waves but the zeroth, which ends
    in an exponential.

    Args:
        time: [time], above zero: leave out the first lag of a correlation, ``time[1:]``.
        kT, viscosity, density: of the fluid; mass density.
        box: side of a periodic cube [length].

    Example:
        >>> fluid = {"kT": 1.0, "viscosity": 1.0, "density": 3.0}
        >>> tail = dpd.theory.velocity_tail(np.array([2.0, 8.0]), **fluid)
        >>> round(float(tail[0] / tail[1]), 3)  # as t^(-3/2)
        8.0
    """
    nu_t = viscosity / density * np.asarray(positive(time, "time"), float)
    if box is None:
        return kT / (4 * density * (math.pi * nu_t) ** 1.5)
    return 2 * kT / (density * box**3) * _wave_sum(nu_t, box, 0)


def angular_velocity_tail(
    time: ArrayLike,
    *,
    kT: ArrayLike,
    viscosity: ArrayLike,
    density: ArrayLike,
    box: ArrayLike | None = None,
) -> Any:
    """Autocorrelation of the angular velocity of any sphere that turns with the fluid, at late
    times [1/time^2], (times,).

    ``<omega(t) . omega(0)>`` at ``t`` well above ``R^2/nu``:
    ``3 pi kT/(density (4 pi nu t)^(5/2))`` (Berne 1972): half the curl of the fluid's velocity
    fluctuations; in a periodic cube ``kT/(2 density V) sum k^2 exp(-nu k^2 t)``. Arguments as in
    :func:`velocity_tail`.

    Example:
        >>> fluid = {"kT": 1.0, "viscosity": 1.0, "density": 3.0}
        >>> tail = dpd.theory.angular_velocity_tail(np.array([2.0, 8.0]), **fluid)
        >>> round(float(tail[0] / tail[1]), 3)  # as t^(-5/2)
        32.0
    """
    nu_t = viscosity / density * np.asarray(positive(time, "time"), float)
    if box is None:
        return 3 * math.pi * kT / (density * (4 * math.pi * nu_t) ** 2.5)
    return kT / (2 * density * box**3) * _wave_sum(nu_t, box, 1)


def _wave_sum(nu_t, box, power: int):
    """``sum k^(2 power) exp(-k^2 nu t)`` over the waves of a cube but the zeroth, (times,)."""
    unit = (2 * math.pi / box) ** 2
    decayed = unit * float(np.min(nu_t))
    if decayed < EARLIEST:
        raise ValueError(
            f"the longest wave has decayed by {decayed:.2g} alone, and the box is not felt yet: "
            "leave out box="
        )
    # The sum over three directions from that over one, in which far waves are dropped once they are
    # nothing.
    most = int(math.ceil(math.sqrt(40.0 / decayed))) + 1
    squares = unit * np.arange(-most, most + 1) ** 2
    decay = np.exp(-np.multiply.outer(nu_t, squares))
    one, weighted = decay.sum(-1), (decay * squares).sum(-1)
    return one**3 - 1.0 if power == 0 else 3.0 * weighted * one**2


def hydrodynamic_radius(
    box: Sequence,
    diffusion: Sequence[Estimate],
    *,
    kT: float,
    viscosity: float,
    slip_length: float = 0.0,
) -> Estimate:
    """The radius with which :func:`sphere_diffusion` fits diffusion coefficients in cubes of
    several sides [length].

    Least squares over the errors of ``diffusion``, from which that of the radius follows; the
    viscosity is taken as it is. The drag of a surface reaches into the fluid, so the radius is not
    that of the surface.

    Args:
        box: sides (m,) [length].
        diffusion: one estimate for each.
        kT, viscosity, slip_length: as in :func:`sphere_diffusion`.

    Raises ValueError where numbers of sides and estimates differ, an error is missing, or no radius
    below half a side fits.

    Example:
        >>> fluid = {"kT": 1.0, "viscosity": 1.0}
        >>> boxes = [8.0, 12.0]
        >>> D = [float(dpd.theory.sphere_diffusion(radius=1.2, box=box, **fluid)) for box in boxes]
        >>> measured = [dpd.Estimate(each, 0.01 * each) for each in D]
        >>> dpd.theory.hydrodynamic_radius(boxes, measured, **fluid)
        1.20... +- 0.0...
    """
    box = np.asarray(box, float)
    value, error = np.array([[e.value, e.error] for e in diffusion]).T
    if box.shape != value.shape or not np.all(error > 0):
        raise ValueError(
            f"{box.size} sides and {value.size} estimates: give one with an error for each side"
        )
    theory = lambda R: sphere_diffusion(
        kT=kT, viscosity=viscosity, radius=R, box=box, slip_length=slip_length
    )
    slope = lambda R: (theory(R * (1 + 1e-5)) - theory(R * (1 - 1e-5))) / (2e-5 * R)
    gradient = lambda R: float(np.sum((theory(R) - value) * slope(R) / error**2))
    grid = np.linspace(1e-3, 0.45, 200) * box.min()
    misfit = [float(np.sum(((theory(R) - value) / error) ** 2)) for R in grid]
    best = int(np.argmin(misfit))
    if best in (0, len(grid) - 1):
        smallest, largest = (theory(R).round(6).tolist() for R in grid[[-1, 0]])
        raise ValueError(
            f"diffusion coefficients {value.tolist()} are those of no radius between {grid[0]:.3g} "
            f"and {grid[-1]:.3g} in boxes of {box.tolist()}: the formula spans {smallest} to "
            f"{largest}; run longer, or check kT and viscosity"
        )
    radius = brentq(gradient, grid[best - 1], grid[best + 1])
    return Estimate(radius, float(np.sum((slope(radius) / error) ** 2)) ** -0.5, len(value))
