"""Colloids in a DPD solvent: the fluid of a suspension from a few numbers, and what follows from
them."""

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import choice, is_concrete, not_negative, one, positive
from dpdjax.errors import warn
from dpdjax.model import colloid_laws, laws
from dpdjax.model.fluid import Fluid, fluid, interaction
from dpdjax.model.term import Term, several, term

SOLVENT, COLLOID = 0, 1
"""Species of a suspension."""


def colloid_fluid(
    *,
    kT: ArrayLike = 0.1,
    gamma=4.5,
    eta_0=0.3,
    D0=0.0,
    kappa=None,
    r0=0.0,
    radius=None,
    density=None,
    r_c=1.0,
    solvent_mass=1.0,
    repulsion=25.0,
    modulus=1e4,
    Delta=None,
    delta=None,
    attraction: Term | Sequence[Term] | None = None,
    solvent_repulsion: Callable = colloid_laws.balanced_repulsion,
    contact: Callable = colloid_laws.contact,
    lubrication: Callable = colloid_laws.squeezing_lubrication,
    noise: str = "exact",
) -> Fluid:
    """Solvent beads (species 0) and hard colloids (species 1) that attract, rub and squeeze the
    solvent between them.

    ===============  ==============================  ================================
    pair             conservative                    drag
    ===============  ==============================  ================================
    solvent-solvent  ``soft_repulsion``              ``central_drag``
    colloid-solvent  ``balanced_repulsion``          ``balanced_drag``
    colloid-colloid  ``contact`` and the attraction  ``central_drag`` and lubrication
    ===============  ==============================  ================================

    Stresses of contacts, of the attraction and of lubrication are kept as ``contact``, ``colloid``
    and ``lubrication``. Every number is a leaf, and a traced one will do; ``fluid.set(kT=...)``
    alone leaves repulsion and contact as they are, a new fluid scales them.

    Args:
        kT: thermal energy [energy].
        gamma: friction of every pair [mass / time].
        eta_0: viscosity of the solvent, for lubrication [energy time / volume]: that of this gamma,
            see :func:`dpdjax.calibrate`.
        D0, kappa, r0: depth [energy], inverse range [1 / length], 30/r_c by default, and place
            [length] of a Morse attraction.
        radius: of a colloid [length]; r_c by default.
        density: solvent beads per volume, 3/r_c^3 by default; a colloid is as heavy as what it
            displaces.
        r_c: reach of all forces but the contact's [length].
        solvent_mass: of a solvent bead [mass].
        repulsion: strength of the soft repulsions ``a r_c`` [kT].
        modulus: contact force ``f`` [kT / r_c].
        Delta, delta: roughness for contacts, and gap below which lubrication is constant [length];
            r_c/1000 by default.
        attraction: one or more potentials of the gap in place of Morse, e.g.
            ``dpd.term(dpd.laws.asakura_oosawa, ...)``; without it for a start, set its depth to
            zero, e.g. ``fluid.set(phi_p=0.0)``.
        solvent_repulsion: or :func:`dpdjax.laws.scripts_repulsion`.
        contact: or :func:`dpdjax.laws.scaled_contact`.
        lubrication: or :func:`dpdjax.laws.unequal_lubrication`, exact for unequal radii.
        noise: ``"exact"``, or ``"literal"`` for drag and noise of colloids as first published,
            which cools close pairs.

    Returns a :class:`dpdjax.Fluid`. Raises ValueError for numbers no fluid can have, and an unknown
    noise.

    Example:
        >>> sticky = dpd.colloid_fluid(kT=0.1, gamma=4.5, eta_0=0.3, D0=1.2, kappa=30.0)
        >>> print(sticky)
        kT 0.1, mass [ 1. , 12.566371]
        ...
        1-1  morse, D0 1.2, kappa 30, r0 0, r_c 1: -12 kT at contact, 12 kT deep at h = 0
        ...
        >>> repelling = sticky.set(D0=0.0)
    """
    kT, r_c, solvent_mass = (
        one(kT, "kT", not_negative),
        one(r_c, "r_c", positive),
        one(solvent_mass, "solvent_mass", positive),
    )
    radius, eta_0 = (
        one(r_c if radius is None else radius, "radius", positive),
        not_negative(eta_0, "eta_0"),
    )
    density = one(3.0 / r_c**3 if density is None else density, "density", positive)
    repulsion, modulus = not_negative(repulsion, "repulsion"), not_negative(modulus, "modulus")
    kappa = 30.0 / r_c if kappa is None else kappa
    Delta, delta = (1e-3 * r_c if gap is None else gap for gap in (Delta, delta))
    choice(noise, ("exact", "literal"), "noise")
    if noise == "literal" and lubrication is not colloid_laws.squeezing_lubrication:
        raise ValueError(
            "literal noise belongs to dpd.laws.squeezing_lubrication; leave lubrication= out"
        )
    up_to_r_c = {"reach": colloid_laws.solvent_cut, "r_c": r_c}
    if attraction is None:
        attraction = term(colloid_laws.morse, D0=D0, kappa=kappa, r0=r0, **up_to_r_c)
    elif is_concrete(D0) and np.any(np.asarray(D0) != 0):
        warn(
            f"D0 is {D0}, the depth of the Morse attraction, and not used: attraction= is given "
            "instead",
        )
    attraction = several(attraction, "attraction")
    strength, rub = repulsion * kT, {"gamma": gamma, "r_c": r_c}
    squeeze = {"eta_0": eta_0, "delta": delta}
    soft = term(laws.soft_repulsion, a=strength / r_c, r_c=r_c)
    hard = term(contact, f=modulus * kT / r_c, Delta=Delta, r_c=r_c, origin="contact")
    drag = [
        term(laws.central_drag, **rub),
        term(lubrication, **squeeze, **up_to_r_c, origin="lubrication"),
    ]
    random = None
    if noise == "literal":
        drag = [term(colloid_laws.literal_drag, **rub, **squeeze, origin="lubrication")]
        random = [term(colloid_laws.literal_noise, **rub, **squeeze)]
    push = term(solvent_repulsion, strength=strength, r_c=r_c)
    among = [
        interaction((SOLVENT, SOLVENT), soft, term(laws.central_drag, **rub)),
        interaction((SOLVENT, COLLOID), push, term(colloid_laws.balanced_drag, **rub)),
        interaction((COLLOID, COLLOID), [hard, *map(_of_colloids, attraction)], drag, random),
    ]
    mass = jnp.stack(
        jnp.broadcast_arrays(solvent_mass, solvent_mass * density * sphere_volume(radius))
    )
    return fluid(interactions=among, kT=kT, mass=mass, radius=(None, radius))


def pure_solvent(fluid: Fluid) -> Fluid:
    """The solvent of a suspension alone: what its viscosity is to be measured of.

    Raises ValueError for a fluid whose first species does not interact with itself, or with bonds.

    Example:
        >>> dpd.pure_solvent(made.fluid)
        Fluid(kT=0.1, 1 species, 0-0: soft_repulsion, central_drag)
    """
    if fluid.bonded:
        raise ValueError(
            "this fluid has bonds, its solvent too perhaps: measure a state, state=..."
        )
    for among in fluid.interactions:
        if among.groups == ((SOLVENT,), (SOLVENT,)):
            return Fluid(
                (among,), fluid.kT, fluid.mass[..., :1], fluid.radius[:1], fluid.inertia[:1]
            )
    raise ValueError("no interaction of the first species with itself; it is no solvent")


def solvent_reach(fluid: Fluid) -> float:
    """How far points of the first species see each other [length]; where they do not, the shortest
    reach there is."""
    for among in fluid.interactions:
        if all(SOLVENT in group for group in among.groups):
            return max(float(np.max(reach)) for reach in among.reaches(0.0, 0.0, fluid.kT))
    return min(fluid.reaches())


def sphere_volume(radius):
    """``4 pi R^3 / 3``."""
    return 4.0 / 3.0 * math.pi * radius**3


def diffusion_time(fluid: Fluid) -> jax.Array:
    """The bare diffusion time of a colloid, ``tau = R^2/D`` with ``D = kT/(6 pi eta_0 R)`` [time].

    Results of suspensions are told in ``t/tau``. It supposes stick, and that ``eta_0`` is the
    viscosity of the solvent. Raises TypeError for a fluid without a viscosity or radius, ValueError
    for one with two viscosities.

    Example:
        >>> round(float(dpd.theory.diffusion_time(made.fluid)), 2)  # 6 pi eta_0 R^3 / kT
        56.55
        >>> round(gel.tau, 2)
        56.55
    """
    radius = fluid.radius[-1]
    if radius is None:
        raise TypeError("the last species has no radius; a diffusion time is that of a colloid")
    return 6.0 * math.pi * solvent_viscosity(fluid) * radius**3 / fluid.kT


def solvent_viscosity(fluid: Fluid):
    """The viscosity of the solvent that lubrication is given, as its laws declare with
    ``dpd.laws.of_viscosity`` [energy time/volume].

    Raises TypeError where no law has it, ValueError where two disagree.
    """
    names = {
        t.law.viscosity for i in fluid.interactions for t in i.drag if hasattr(t.law, "viscosity")
    }
    if not names:
        raise TypeError(
            "no friction of this fluid declares the viscosity of the solvent, as the 'eta_0' of "
            "lubrication; "
            'mark your law with @dpd.laws.of_viscosity("eta_0")'
        )
    if len(names) > 1:
        raise ValueError(
            f"the viscosity of the solvent is {', '.join(sorted(names))} in different laws: give "
            "it one name"
        )
    return fluid.value(names.pop())


def attraction_range(fluid: Fluid) -> float:
    """The gap over which spheres attract, as their laws declare with ``dpd.laws.attracts``, up to
    where they are cut [length].

    The widest where there are several. Raises ValueError without one, and for a scan or a table of
    different ranges.
    """
    between_spheres = [
        i
        for i in fluid.interactions
        if all(fluid.radius[k] is not None for group in i.groups for k in group)
    ]
    found = [
        _range_of(fluid, i, t)
        for i in between_spheres
        for t in i.conservative
        if hasattr(t.law, "attraction")
    ]
    if not found:
        raise ValueError(
            "no law between the spheres of this fluid declares how far it attracts, as "
            "dpd.laws.morse does"
        )
    widest = np.unique(functools.reduce(np.maximum, found))
    if len(widest) > 1:
        raise ValueError(
            f"the attractions of this fluid have the ranges {', '.join(f'{r:.4g}' for r in widest)}"
        )
    return float(widest[0])


def _range_of(fluid, interaction, attraction: Term):
    """How far one term attracts, at most up to its reach."""
    R_i, R_j = (
        max(np.max(np.asarray(fluid.radius[k])) for k in group) for group in interaction.groups
    )
    given = {"R_i": R_i, "R_j": R_j, "kT": np.asarray(fluid.kT)}
    wide = dataclasses.replace(attraction, law=attraction.law.attraction).between(**given)
    return np.minimum(np.asarray(wide[0](), float), np.asarray(wide[1], float))


def _of_colloids(attraction: Term) -> Term:
    """The term with its stress under a name of its own."""
    return dataclasses.replace(attraction, origin=attraction.origin or "colloid")
