"""Pair laws: what two beads at surface gap ``h`` do to each other.

A law is one pure function of the gap; its keyword-only arguments are its
coefficients. A *potential* returns an energy, a *drag* a friction coefficient
``zeta`` [mass / time]. The engine differentiates potentials, projects drags on
the line of centres, derives the random force from the sum of all drags, and
truncates every law at its reach, so a law never mentions its cut-off twice.
For point beads the gap is the centre distance.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.model.declare import (
    TRANSVERSE,
    bounded,
    friction,
    potential,
    projected,
    proportional_to,
)


@potential
@proportional_to("a")
@bounded(r_c="positive")
def soft_repulsion(h: ArrayLike, *, a: ArrayLike, r_c: ArrayLike) -> jax.Array:
    """Soft repulsion of Groot & Warren (1997, eq. 4): the force is ``a (1 - h/r_c)``.

    Gap ``h`` [length], ``a`` [energy / length], ``r_c`` [length]. Returns the energy
    ``a r_c (1 - h/r_c)**2 / 2``, of the shape of ``h``.

    Example:
        >>> dpd.soft_repulsion(jnp.array([0.0, 0.5, 1.0]), a=25.0, r_c=1.0).tolist()
        [12.5, 3.125, 0.0]
        >>> dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)
        soft_repulsion(a=25, r_c=1)
    """
    return 0.5 * a * r_c * (1.0 - h / r_c) ** 2


@friction
@bounded(gamma="not negative", r_c="positive")
def central_drag(h: ArrayLike, *, gamma: ArrayLike, r_c: ArrayLike) -> jax.Array:
    """DPD friction ``gamma (1 - h/r_c)**2`` along the line of centres.

    Groot & Warren (1997, eqs. 5 and 8). Gap ``h`` [length], ``gamma`` [mass / time], ``r_c``
    [length]. Returns the friction [mass / time], of the shape of ``h``.

    Example:
        >>> dpd.central_drag(jnp.array([0.0, 0.5, 1.0]), gamma=4.5, r_c=1.0).tolist()
        [4.5, 1.125, 0.0]
        >>> dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=1.0)
        Fluid(kT=1, 1 species, 0-0: central_drag)
    """
    return gamma * (1.0 - h / r_c) ** 2


@friction
@bounded(gamma="not negative", r_c="positive", s="not negative")
def power_drag(h: ArrayLike, *, gamma: ArrayLike, r_c: ArrayLike, s: ArrayLike) -> jax.Array:
    """DPD friction ``gamma (1 - h/r_c)**s`` with a free weight exponent ``s``.

    Small ``s`` raises viscosity and Schmidt number (Fan et al. 2006). Values are
    right for every ``s > 0``. Tangents through the noise, which goes as
    ``(1 - h/r_c)**(s/2)``, have a finite variance only for ``s > 1``: do not
    differentiate runs below that. ``gamma`` [mass / time], ``r_c`` [length].

    Example:
        >>> weak = dpd.term(dpd.laws.power_drag, gamma=4.5, r_c=1.0, s=0.5)
        >>> damped_more = dpd.fluid(drag=[weak], kT=1.0)
        >>> [round(dpd.theory.damping_rate(f, 3.0), 2) for f in (water, damped_more)]
        [1.88, 8.62]
    """
    w = jnp.maximum(1.0 - h / r_c, 0.0)
    inside = w > 0.0
    return gamma * jnp.where(inside, jnp.where(inside, w, 1.0) ** s, 0.0)


@friction
@projected(TRANSVERSE)
@bounded(gamma_t="not negative", r_c="positive")
def transverse_drag(h: ArrayLike, *, gamma_t: ArrayLike, r_c: ArrayLike) -> jax.Array:
    """Friction ``gamma_t (1 - h/r_c)**2`` across the line of centres (Junghans, Praprotnik & Kremer
    2008, eqs. 3 and 4).

    Raises the Schmidt number of a solvent, and its viscosity once that is carried by drag more than
    by beads; keeps momentum, not angular momentum. ``gamma_t`` [mass / time], ``r_c`` [length].

    Example:
        >>> across = dpd.term(dpd.laws.transverse_drag, gamma_t=4.5, r_c=1.0)
        >>> across
        transverse_drag(gamma_t=4.5, r_c=1, projector='transverse')
        >>> sideways = dpd.fluid(drag=[across], kT=1.0)
        >>> along, sides = (dpd.theory.drag_viscosity(f, 3.0) for f in (water, sideways))
        >>> round(sides / along, 2)
        4.0
    """
    return gamma_t * (1.0 - h / r_c) ** 2
