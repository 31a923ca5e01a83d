"""Laws of bonds, of angles and of dihedrals.

A law of a bond is an energy as a function of the distance of two beads; one of an angle, or of a
dihedral, is an energy as a function of its *cosine*: no force is ever divided by a sine, so chains
may be straight. The engine differentiates them. Their numbers are those of the formulas here; what
LAMMPS, HOOMD-blue and GROMACS call them is in ``docs/coming_from``.
"""

import jax
import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.model.declare import bounded, potential, proportional_to


def _of(*kinds: str):
    """A decorator that says what a law may be of: of a distance, or of a cosine."""

    def declare(law):
        law.of_kinds = kinds
        return law

    return declare


@_of("bond")
@potential
@proportional_to("k")
@bounded(k="not negative", r0="not negative")
def harmonic_bond(r: ArrayLike, *, k: ArrayLike, r0: ArrayLike = 0.0) -> jax.Array:
    """A spring, ``k (r - r0)^2 / 2`` [energy] (Groot & Warren 1997, section V, with ``r0 = 0``).

    Distance ``r`` [length], ``k`` [energy / length^2], ``r0`` [length]. LAMMPS has ``K = k/2``,
    HOOMD-blue and GROMACS the same ``k``.

    Example:
        >>> dpd.laws.harmonic_bond(2.0, k=4.0, r0=1.0)
        2.0
        >>> spring = dpd.term(dpd.laws.harmonic_bond, k=4.0)
        >>> dpd.fluid([dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)], kT=1.0, bonds=spring)
        Fluid(kT=1, 1 species, 0-0: soft_repulsion; bond: harmonic_bond)
    """
    return 0.5 * k * (r - r0) ** 2


@_of("bond")
@potential
@proportional_to("k")
@bounded(k="not negative", r_max="positive", r0="not negative")
def fene_bond(r: ArrayLike, *, k: ArrayLike, r_max: ArrayLike, r0: ArrayLike = 0.0) -> jax.Array:
    """A spring of finite length, ``-k r_max^2 ln(1 - ((r - r0)/r_max)^2) / 2`` [energy] (Warner
    1972).

    Distance ``r``, ``r_max`` and ``r0`` [length], ``k`` [energy / length^2]. Without the repulsion
    that LAMMPS and HOOMD-blue put into theirs: pairs repel each other anyhow. Infinite from
    ``r0 + r_max`` on, where a run ends.

    Example:
        >>> lengths = (0.0, 0.5, 1.4, 1.5)
        >>> [round(float(dpd.laws.fene_bond(r, k=30.0, r_max=1.5)), 1) for r in lengths]
        [0.0, 4.0, 69.1, inf]
    """
    stretch = ((r - r0) / r_max) ** 2
    within = stretch < 1.0
    inside = -0.5 * k * r_max**2 * jnp.log1p(-jnp.where(within, stretch, 0.0))
    return jnp.where(within, inside, jnp.inf * stretch)


@_of("angle", "dihedral")
@potential
@proportional_to("k")
@bounded(k="not negative", theta0="angle")
def cosine_angle(c: ArrayLike, *, k: ArrayLike, theta0: ArrayLike = jnp.pi) -> jax.Array:
    """Bending, ``k (1 - cos(theta - theta0))`` [energy], theta between 0 and pi.

    ``c = cos(theta)``, ``k`` [energy], ``theta0`` [radian], by default straight, for which it is
    ``k (1 + c)`` (Shillcock & Lipowsky 2002, eq. 4, whose angle is pi less). For any other
    ``theta0`` the force ends with a kink at 0 and at pi.

    Example:
        >>> straight, right = -1.0, 0.0
        >>> [round(float(dpd.laws.cosine_angle(c, k=20.0)), 2) for c in (straight, right)]
        [0.0, 20.0]
        >>> stiff = {"TTT": dpd.term(dpd.laws.cosine_angle, k=20.0)}  # angles= of dpd.molecules
    """
    sine = _sine(c)
    return k * (1.0 - (c * jnp.cos(theta0) + jnp.sin(theta0) * sine))


@_of("angle", "dihedral")
@potential
@proportional_to("k")
@bounded(k="not negative", theta0="angle")
def harmonic_cosine(c: ArrayLike, *, k: ArrayLike, theta0: ArrayLike = jnp.pi) -> jax.Array:
    """Bending, ``k (cos(theta) - cos(theta0))^2 / 2`` [energy] (``k`` as in GROMACS and MARTINI).

    ``c = cos(theta)``, ``k`` [energy], ``theta0`` [radian], by default straight.

    Example:
        >>> at = dict(k=20.0, theta0=2 * np.pi / 3)
        >>> [round(float(dpd.laws.harmonic_cosine(c, **at)), 2) for c in (-0.5, -1.0)]
        [0.0, 2.5]
    """
    return 0.5 * k * (c - jnp.cos(theta0)) ** 2


@_of("angle", "dihedral")
@potential
@proportional_to("k")
def cosine_dihedral(
    c: ArrayLike, *, k: ArrayLike, n: ArrayLike = 1, d: ArrayLike = 1.0
) -> jax.Array:
    """Torsion, ``k (1 + d cos(n phi)) / 2`` [energy]; ``phi = 180`` degrees is trans.

    ``c = cos(phi)``, ``k`` [energy], ``n`` 1 to 6, ``d`` 1 or -1. As in HOOMD-blue with
    ``phi0 = 0``; LAMMPS's ``K`` is ``k/2``.

    Example:
        >>> angles = np.radians([180.0, 120.0, 60.0, 0.0])
        >>> [round(float(dpd.laws.cosine_dihedral(np.cos(phi), k=2.0, n=3)), 2) for phi in angles]
        [0.0, 2.0, 0.0, 2.0]
    """
    return 0.5 * k * (1.0 + d * _chebyshev(c, n))


@_of("angle", "dihedral")
@potential
def ryckaert_bellemans(
    c: ArrayLike,
    *,
    c0: ArrayLike = 0.0,
    c1: ArrayLike = 0.0,
    c2: ArrayLike = 0.0,
    c3: ArrayLike = 0.0,
    c4: ArrayLike = 0.0,
    c5: ArrayLike = 0.0,
) -> jax.Array:
    """Torsion, ``sum c_n cos(psi)^n`` [energy] with ``psi = phi - 180`` degrees, 0 in trans
    (Ryckaert & Bellemans 1975; as in GROMACS).

    ``c = cos(phi)``, so that ``cos(psi) = -c``; ``c0`` to ``c5`` [energy].

    Example:
        >>> butane = dict(c0=9.28, c1=12.16, c2=-13.12, c3=-3.06, c4=26.24, c5=-31.5)  # kJ/mol
        >>> round(dpd.laws.ryckaert_bellemans(1.0, **butane), 2)  # cis
        44.8
        >>> abs(dpd.laws.ryckaert_bellemans(-1.0, **butane)) < 1e-6  # trans
        True
    """
    x = -c
    return c0 + x * (c1 + x * (c2 + x * (c3 + x * (c4 + x * c5))))


def _sine(c):
    """``sqrt(1 - c^2)`` with derivative 0 where it is 0, in place of an infinite one."""
    square = jnp.maximum(1.0 - c * c, 0.0)
    is_zero = square == 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def _chebyshev(c, n):
    """``cos(n phi)`` from ``cos(phi)`` for n 0 to 6; NaN for any other."""
    c2 = c * c
    polynomials = (
        jnp.ones_like(c),
        c,
        2 * c2 - 1,
        c * (4 * c2 - 3),
        8 * c2 * (c2 - 1) + 1,
        c * (16 * c2 * c2 - 20 * c2 + 5),
        c2 * (32 * c2 * c2 - 48 * c2 + 18) - 1,
    )
    found = jnp.full_like(c, jnp.nan)
    for degree, value in enumerate(polynomials):
        found = jnp.where(n == degree, value, found)
    return found
