"""Pair laws of colloids, on the gap ``h`` between surfaces: contact, attraction, lubrication.

Radii ``R_i``, ``R_j`` and ``kT`` are asked for by name, the engine gives them. Laws named after a
source reproduce it to the letter, where the default here differs.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.model.declare import (
    attracts,
    bounded,
    friction,
    of_viscosity,
    potential,
    proportional_to,
    reaches,
)


def solvent_cut(*, r_c: ArrayLike) -> jax.Array:
    """The reach of solvent beads, taken for a gap [length]: a ``reach=`` that is ``r_c``.

    Example:
        >>> dpd.term(dpd.laws.yukawa, epsilon=1.0, kappa=8.0, reach=dpd.laws.solvent_cut, r_c=1.0)
        yukawa(epsilon=1, kappa=8, r_c=1)
    """
    return r_c


def balanced_cut(*, r_c: ArrayLike, R_i: ArrayLike, R_j: ArrayLike) -> jax.Array:
    """Gap up to which a colloid and a solvent bead interact, ``(r_c^3 + R^3)^(1/3) - R`` [length].

    The shell around the colloid then has the volume of the sphere around a solvent bead, so as many
    beads press on either. ``R`` is the radius of the colloid; that of a solvent bead is 0.

    Example:
        >>> [round(dpd.laws.balanced_cut(r_c=1.0, R_i=0.0, R_j=R), 3) for R in (0.0, 1.0, 3.0)]
        [1.0, 0.26, 0.037]
    """
    R = R_i + R_j
    return (r_c**3 + R**3) ** (1 / 3) - R


@potential
@reaches(balanced_cut)
@proportional_to("strength")
@bounded(r_c="positive")
def balanced_repulsion(
    h: ArrayLike, *, strength: ArrayLike, r_c: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """Soft repulsion of colloid and solvent, force ``strength/r' (1 - h/r')``, with ``r'`` of
    :func:`dpdjax.laws.balanced_cut`.

    ``strength`` [energy], 25 kT in :func:`dpdjax.colloid_fluid`, is what ``a r_c`` is between
    solvent beads. Inside the colloid (h < 0) the force goes on growing. Returns the energy.

    Example:
        >>> at = dict(strength=25.0, r_c=1.0, R_i=0.0)
        >>> [dpd.laws.balanced_repulsion(0.0, **at, R_j=R) for R in (0.0, 1.0, 3.0)]
        [12.5, 12.5, 12.5]
    """
    cut = balanced_cut(r_c=r_c, R_i=R_i, R_j=R_j)
    return 0.5 * strength * (1.0 - h / cut) ** 2


@potential
@reaches(balanced_cut)
@proportional_to("strength")
@bounded(r_c="positive")
def scripts_repulsion(
    h: ArrayLike, *, strength: ArrayLike, r_c: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """:func:`dpdjax.laws.balanced_repulsion` as the group's scripts have it: ``strength`` over the
    cut-off from the *centre* [energy].

    Example:
        >>> at = dict(strength=25.0, r_c=1.0, R_i=0.0, R_j=1.0)
        >>> both = dpd.laws.scripts_repulsion, dpd.laws.balanced_repulsion
        >>> [round(law(0.0, **at), 2) for law in both]
        [2.58, 12.5]
        >>> as_there = dpd.colloid_fluid(solvent_repulsion=dpd.laws.scripts_repulsion)
    """
    cut = balanced_cut(r_c=r_c, R_i=R_i, R_j=R_j)
    return (
        balanced_repulsion(h, strength=strength, r_c=r_c, R_i=R_i, R_j=R_j)
        * cut
        / (cut + R_i + R_j)
    )


@friction
@reaches(balanced_cut)
@bounded(gamma="not negative", r_c="positive")
def balanced_drag(
    h: ArrayLike, *, gamma: ArrayLike, r_c: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """DPD friction of colloid and solvent, ``gamma (1 - h/r')^2`` with ``r'`` of
    :func:`dpdjax.laws.balanced_cut`.

    Gap ``h`` [length], ``gamma`` [mass / time], ``r_c`` [length]. Returns the friction.

    Example:
        >>> at = dict(gamma=4.5, r_c=1.0, R_i=0.0, R_j=1.0)
        >>> [round(dpd.laws.balanced_drag(h, **at), 2) for h in (0.0, 0.1, 0.25)]
        [4.5, 1.7, 0.01]
    """
    return gamma * (1.0 - h / balanced_cut(r_c=r_c, R_i=R_i, R_j=R_j)) ** 2


@potential
@reaches(lambda *, Delta: Delta)
@proportional_to("f")
@bounded(f="not negative", Delta="positive", r_c="positive")
def contact(h: ArrayLike, *, f: ArrayLike, Delta: ArrayLike, r_c: ArrayLike) -> jax.Array:
    """Semi-hard contact (after Jamali & Boromand 2015): force ``f (1 - h/Delta)^3`` up to
    ``Delta``, ``f (1 - h/r_c)`` in overlap.

    ``f`` [energy / length], ``10^4 kT/r_c`` in :func:`dpdjax.colloid_fluid`; ``Delta`` [length] is
    the roughness of the surface. It stands for no force of nature: it keeps hard spheres apart at a
    finite time step. Returns the energy.

    Example:
        >>> def push(h):
        ...     return -jax.grad(dpd.laws.contact)(h, f=1000.0, Delta=0.001, r_c=1.0)
        >>> [round(float(push(h)), 1) for h in (0.0005, 0.0, -0.1)]
        [125.0, 1000.0, 1100.0]
    """
    outside = 0.25 * f * Delta * (1.0 - h / Delta) ** 4
    inside = f * (0.25 * Delta - h + 0.5 * h * h / r_c)
    return jnp.where(h > 0, outside, inside)


@potential
@reaches(lambda *, Delta: Delta)
@proportional_to("f")
@bounded(f="not negative", Delta="positive", r_c="positive")
def scaled_contact(
    h: ArrayLike, *, f: ArrayLike, Delta: ArrayLike, r_c: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """:func:`dpdjax.laws.contact` times ``((R_i + R_j)/2)^3``, as in the code behind the published
    data [energy].

    Example:
        >>> at = dict(f=1000.0, Delta=0.001, r_c=1.0)
        >>> scaled = dpd.laws.scaled_contact(0.0, **at, R_i=2.0, R_j=2.0)
        >>> round(float(scaled / dpd.laws.contact(0.0, **at)), 2)
        8.0
    """
    return contact(h, f=f, Delta=Delta, r_c=r_c) * (0.5 * (R_i + R_j)) ** 3


@potential
@reaches(lambda *, kappa, r0: r0 + 6.0 / kappa)
@attracts(lambda *, kappa, r0: r0 + 3.0 / kappa)
@proportional_to("D0")
@bounded(D0="not negative", kappa="positive")
def morse(h: ArrayLike, *, D0: ArrayLike, kappa: ArrayLike, r0: ArrayLike) -> jax.Array:
    """Morse potential ``D0 (exp(-2 kappa (h - r0)) - 2 exp(-kappa (h - r0)))`` [energy] (Morse
    1929, eq. 4).

    Depth ``D0`` [energy] at ``h = r0`` [length]; range about ``3/kappa``, where a tenth of it is
    left, ``kappa`` [1 / length]. Ends at ``r0 + 6/kappa`` unless told otherwise.

    Example:
        >>> at = dict(D0=1.2, kappa=30.0, r0=0.0)
        >>> [round(float(dpd.laws.morse(h, **at)), 2) for h in (0.0, 0.1, 0.2)]
        [-1.2, -0.12, -0.01]
        >>> dpd.term(dpd.laws.morse, D0=1.2, kappa=30.0, r0=0.0)
        morse(D0=1.2, kappa=30, r0=0)
    """
    e = jnp.exp(-kappa * (h - r0))
    return D0 * (e * e - 2.0 * e)


@potential
@reaches(lambda *, r_g: 2.0 * r_g)
@attracts(lambda *, r_g: 2.0 * r_g * (1.0 - 0.1**0.5))
@proportional_to("kT")
@bounded(phi_p="not negative", r_g="positive")
def asakura_oosawa(
    h: ArrayLike, *, phi_p: ArrayLike, r_g: ArrayLike, kT: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """Depletion attraction by ideal polymer (Asakura & Oosawa 1954): osmotic pressure times the
    overlap of the depletion zones [energy].

    ``phi_p`` is the volume fraction of polymer coils of radius of gyration ``r_g`` [length]. The
    overlap is that of two spheres of radii ``R_i + r_g`` and ``R_j + r_g``, exact for unequal ones
    too. Two equal spheres that touch have ``-kT phi_p (1 + 3 R / 2 r_g)``. Ends at ``2 r_g``.

    Example:
        >>> at = dict(phi_p=0.3, r_g=0.1, kT=0.1, R_i=1.0, R_j=1.0)
        >>> [round(dpd.laws.asakura_oosawa(h, **at), 2) for h in (0.0, 0.1)]
        [-0.48, -0.12]
        >>> polymer = dpd.term(dpd.laws.asakura_oosawa, phi_p=0.3, r_g=0.1)
        >>> depleted = dpd.colloid_fluid(kT=0.1, attraction=polymer)
    """
    A, B = R_i + r_g, R_j + r_g
    r = h + R_i + R_j
    lens = (A + B - r) ** 2 * (r * r + 2.0 * r * (A + B) - 3.0 * (A - B) ** 2) / (12.0 * r)
    # Volumes in units of 4 pi/3 r_g^3, whose polymer holds kT each.
    return -kT * phi_p * 0.75 * lens / r_g**3


@potential
@reaches(lambda *, kappa: 8.0 / kappa)
@proportional_to("epsilon")
@bounded(kappa="positive")
def yukawa(
    h: ArrayLike, *, epsilon: ArrayLike, kappa: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """Screened Coulomb potential of two spheres, ``epsilon (R_i + R_j)/r exp(-kappa h)`` [energy].

    ``epsilon`` is the energy at contact, ``1/kappa`` the screening length (Verwey & Overbeek 1948).
    Below zero it attracts. Ends at ``8/kappa``.

    Example:
        >>> at = dict(epsilon=1.0, kappa=8.0, R_i=1.0, R_j=1.0)
        >>> [round(float(dpd.laws.yukawa(h, **at)), 3) for h in (0.0, 0.125, 1.0)]
        [1.0, 0.346, 0.0]
    """
    return epsilon * (R_i + R_j) / (h + R_i + R_j) * jnp.exp(-kappa * h)


@friction
@of_viscosity("eta_0")
@bounded(eta_0="not negative", delta="positive")
def squeezing_lubrication(
    h: ArrayLike, *, eta_0: ArrayLike, delta: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """Squeezing friction ``3 pi eta_0/(2 h) ((R_i + R_j)/2)^2`` [mass / time], constant below
    ``delta`` (Ball & Melrose 1997, appendix A).

    Exact to leading order for equal spheres; for unequal ones see
    :func:`dpdjax.laws.unequal_lubrication`. ``eta_0`` [energy time / volume] is the viscosity of
    the solvent, ``delta`` [length]. It declares no end: give ``reach=``.

    Example:
        >>> at = dict(eta_0=0.3, delta=0.001, R_i=1.0, R_j=1.0)
        >>> gaps = (0.1, 0.01, 0.001, 0.0)
        >>> [round(float(dpd.laws.squeezing_lubrication(h, **at)), 1) for h in gaps]
        [14.1, 141.4, 1413.7, 1413.7]
    """
    return 1.5 * jnp.pi * eta_0 / jnp.maximum(h, delta) * (0.5 * (R_i + R_j)) ** 2


@friction
@of_viscosity("eta_0")
@bounded(eta_0="not negative", delta="positive")
def unequal_lubrication(
    h: ArrayLike, *, eta_0: ArrayLike, delta: ArrayLike, R_i: ArrayLike, R_j: ArrayLike
) -> jax.Array:
    """Squeezing friction ``6 pi eta_0/h (R_i R_j/(R_i + R_j))^2`` [mass / time], constant below
    ``delta``; exact to leading order (Jeffrey & Onishi 1984, eq. 3.17).

    ``eta_0`` [energy time / volume], ``delta`` [length]. It declares no end: give ``reach=``.

    Example:
        >>> both = dpd.laws.unequal_lubrication, dpd.laws.squeezing_lubrication
        >>> at = dict(eta_0=0.3, delta=0.001, R_i=1.0)
        >>> [round(float(law(0.01, **at, R_j=1.0)), 1) for law in both]
        [141.4, 141.4]
        >>> [round(float(law(0.01, **at, R_j=3.0)), 1) for law in both]
        [318.1, 565.5]
    """
    return 6.0 * jnp.pi * eta_0 / jnp.maximum(h, delta) * (R_i * R_j / (R_i + R_j)) ** 2


@friction
@of_viscosity("eta_0")
@bounded(gamma="not negative", eta_0="not negative", delta="positive", r_c="positive")
def literal_drag(
    h: ArrayLike,
    *,
    gamma: ArrayLike,
    eta_0: ArrayLike,
    delta: ArrayLike,
    r_c: ArrayLike,
    R_i: ArrayLike,
    R_j: ArrayLike,
) -> jax.Array:
    """Drag of lubricated colloids as first published [mass / time]:
    :func:`dpdjax.laws.central_drag` and :func:`dpdjax.laws.squeezing_lubrication`, none of either
    in overlap.

    Example:
        >>> at = dict(gamma=4.5, eta_0=0.3, delta=0.001, r_c=1.0, R_i=1.0, R_j=1.0)
        >>> [round(float(dpd.laws.literal_drag(h, **at)), 2) for h in (0.5, -0.01)]
        [3.95, 0.0]
        >>> as_published = dpd.colloid_fluid(noise="literal")
    """
    lubrication = squeezing_lubrication(h, eta_0=eta_0, delta=delta, R_i=R_i, R_j=R_j)
    return jnp.where(h > 0, gamma * (1.0 - h / r_c) ** 2 + lubrication, 0.0)


@friction
@of_viscosity("eta_0")
@bounded(gamma="not negative", eta_0="not negative", delta="positive", r_c="positive")
def literal_noise(
    h: ArrayLike,
    *,
    gamma: ArrayLike,
    eta_0: ArrayLike,
    delta: ArrayLike,
    r_c: ArrayLike,
    R_i: ArrayLike,
    R_j: ArrayLike,
) -> jax.Array:
    """The friction behind the noise of lubricated colloids as first published,
    ``(gamma + a_sq) w^2`` [mass / time], ``a_sq`` the lubrication and ``w = 1 - h/r_c``.

    Give it as ``random=`` next to :func:`dpdjax.laws.literal_drag`. It is less than the drag: close
    pairs are colder than kT, half as warm at h = 0.5.

    Example:
        >>> at = dict(gamma=4.5, eta_0=0.3, delta=0.001, r_c=1.0, R_i=1.0, R_j=1.0)
        >>> round(float(dpd.laws.literal_noise(0.5, **at) / dpd.laws.literal_drag(0.5, **at)), 2)
        0.46
    """
    lubrication = squeezing_lubrication(h, eta_0=eta_0, delta=delta, R_i=R_i, R_j=R_j)
    return jnp.where(h > 0, (gamma + lubrication) * (1.0 - h / r_c) ** 2, 0.0)
