"""Pair laws of marbles, large spheres whose surface drags the solvent (Zhou & Schmid 2015)."""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.model.declare import (
    FULL,
    bounded,
    friction,
    potential,
    projected,
    proportional_to,
    reaches,
)

WIDEST = 2 ** (1 / 6)
"""Where the Lennard-Jones potential is lowest, in sigma."""
STEEPEST = 0.5
"""Distance in sigma below which the potential goes on as a straight line: no bead gets there, and
one put there is pushed out."""


@potential
@reaches(lambda *, sigma, r_0, R_i, R_j: r_0 + WIDEST * sigma - R_i - R_j)
@proportional_to("epsilon")
@bounded(epsilon="not negative", sigma="positive")
def shifted_repulsion(
    h: ArrayLike,
    *,
    epsilon: ArrayLike,
    sigma: ArrayLike,
    r_0: ArrayLike,
    R_i: ArrayLike,
    R_j: ArrayLike,
) -> jax.Array:
    """Lennard-Jones repulsion of the distance ``r - r_0`` between centre and shell [energy] (Zhou &
    Schmid 2015, eq. 5).

    ``4 epsilon [(sigma/(r - r_0))^12 - (sigma/(r - r_0))^6 + 1/4]``, cut where it vanishes, at
    ``r - r_0 = 2^(1/6) sigma`` (the cut printed there, ``sigma``, leaves a jump of ``epsilon``).
    ``epsilon`` [energy], ``sigma`` and ``r_0`` [length]; ``r = h + R_i + R_j``.

    Example:
        >>> at = dict(epsilon=1.0, sigma=1.0, r_0=2.0, R_i=0.0, R_j=3.0)
        >>> [round(float(dpd.laws.shifted_repulsion(h, **at)), 2) for h in (0.0, 0.05)]
        [1.0, 0.24]
        >>> reach = 2 ** (1 / 6) - 1.0
        >>> abs(float(dpd.laws.shifted_repulsion(reach, **at))) < 1e-5
        True
    """
    # A power of a negative number of whole sixths has no slope problem, but beads inside must be
    # pushed out, not in.
    x = (h + R_i + R_j - r_0) / sigma
    y = jnp.maximum(x, STEEPEST) ** -6
    least = STEEPEST**-6
    slope = 24.0 * (least - 2.0 * least**2) / STEEPEST
    return epsilon * (4.0 * (y * y - y) + 1.0 + slope * jnp.minimum(x - STEEPEST, 0.0))


@friction
@projected(FULL)
@reaches(lambda *, r_c: r_c)
@bounded(gamma_cs="not negative", r_c="positive")
def surface_drag(h: ArrayLike, *, gamma_cs: ArrayLike, r_c: ArrayLike) -> jax.Array:
    """Friction ``gamma_cs (1 - |h|/r_c)^2`` of a solvent bead and the surface next to it (Zhou &
    Schmid 2015, eq. 12).

    The gap ``|h| = |r - R|`` is the distance from the bead to the surface. Acts on the whole
    relative velocity unless told otherwise: ``dpd.term(dpd.laws.surface_drag, projector="central",
    ...)`` is their eq. 8, ``"transverse"`` their eq. 10. ``gamma_cs`` [mass / time] tunes slip.

    Example:
        >>> [float(dpd.laws.surface_drag(h, gamma_cs=5.0, r_c=1.0)) for h in (-0.5, 0.0, 0.5)]
        [1.25, 5.0, 1.25]
        >>> dpd.term(dpd.laws.surface_drag, gamma_cs=5.0, r_c=1.0)
        surface_drag(gamma_cs=5, r_c=1, projector='full')
    """
    return gamma_cs * jnp.maximum(1.0 - jnp.abs(h) / r_c, 0.0) ** 2
