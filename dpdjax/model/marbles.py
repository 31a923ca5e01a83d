"""Marbles: large rotating spheres with tunable slip in a DPD solvent (Zhou & Schmid 2015)."""

from collections.abc import Sequence

import jax.numpy as jnp
from jax.typing import ArrayLike

from dpdjax.checks import not_negative, positive
from dpdjax.model import laws
from dpdjax.model.colloids import COLLOID, SOLVENT, sphere_volume
from dpdjax.model.declare import FULL, PROJECTORS
from dpdjax.model.fluid import Fluid, fluid, interaction
from dpdjax.model.marble_laws import shifted_repulsion, surface_drag
from dpdjax.model.term import Term, several, term


def marble_fluid(
    *,
    kT: ArrayLike = 1.0,
    gamma=5.0,
    gamma_cs=5.0,
    coupling: str = FULL,
    a=None,
    gamma_t=None,
    radius=None,
    density=None,
    r_c=1.0,
    solvent_mass=1.0,
    epsilon=None,
    sigma=None,
    r_0=None,
    mass=None,
    inertia=None,
    is_several: bool = False,
    attraction: Term | Sequence[Term] = (),
    friction: Term | Sequence[Term] = (),
) -> Fluid:
    """Solvent beads (species 0) and large spheres (species 1) that rotate, and whose surface drags
    the solvent (Zhou & Schmid 2015).

    ===============  =====================================  ====================================
    pair             conservative                           drag
    ===============  =====================================  ====================================
    solvent-solvent  ``soft_repulsion``, given ``a``        ``central_drag``, and
                                                            ``transverse_drag`` by ``gamma_t``
    marble-solvent   ``shifted_repulsion``                  ``surface_drag``, with the projector
                                                            ``coupling``
    marble-marble    ``shifted_repulsion``, ``attraction``  ``friction``
    ===============  =====================================  ====================================

    Full coupling acts at the point of the surface next to the bead, which moves with the sphere and
    turns with it; it goes from full slip at ``gamma_cs = 0`` towards none. Momentum is conserved,
    angular momentum is not: force and reaction have different arms.

    Args:
        kT: thermal energy [energy].
        gamma, gamma_cs: friction of the solvent and of the surface [mass / time].
        coupling: ``"full"``, ``"transverse"``, or ``"central"``, which exerts no torque: the marble
            spins as it started.
        a: soft repulsion of the solvent [energy / length]; none by default.
        gamma_t: transverse friction of the solvent [mass / time]; none by default.
        radius: of a marble [length]; 3 r_c by default.
        density: solvent beads per volume, 3/r_c^3 by default; a marble is as heavy as what it
            displaces.
        r_c: reach of the solvent's forces and of the surface's drag [length].
        solvent_mass: of a solvent bead [mass].
        epsilon, sigma, r_0: of the repulsion of a marble and solvent [energy, length, length];
            ``kT``, ``r_c`` and ``radius - sigma`` by default. Two marbles repel alike, from
            ``2 radius - sigma`` on.
        mass, inertia: of a marble [mass, mass length^2]; ``4 pi radius^3 density solvent_mass/3``
            and ``2/5 mass radius^2`` by default.
        is_several: whether there is more than one, so that they need a list of their own.
        attraction, friction: further potentials and frictions between marbles, such as those of
            :func:`dpdjax.colloid_fluid`.

    Returns a :class:`dpdjax.Fluid`. Raises ValueError for numbers no fluid can have, an unknown
    coupling, forces between marbles of which there is one.

    Example:
        >>> slipping = dpd.marble_fluid(radius=3.0, gamma_cs=0.5, a=25.0)
        >>> slipping
        Fluid(kT=1, 2 species, 0-0: soft_repulsion, central_drag;
              0-1: shifted_repulsion, surface_drag)
        >>> slipping.rotating
        (1,)
    """
    kT, r_c, solvent_mass = (
        not_negative(kT, "kT"),
        positive(r_c, "r_c"),
        positive(solvent_mass, "solvent_mass"),
    )
    radius = positive(3.0 * r_c if radius is None else radius, "radius")
    if coupling not in PROJECTORS:
        raise ValueError(f"coupling is {coupling!r}; it is one of {', '.join(PROJECTORS)}")
    density = positive(3.0 / r_c**3 if density is None else density, "density")
    sigma = positive(r_c if sigma is None else sigma, "sigma")
    epsilon = (
        positive(kT, "kT", "or give epsilon=, which is kT by default")
        if epsilon is None
        else epsilon
    )
    attraction = several(attraction, "attraction")
    friction = several(friction, "friction")
    if (attraction or friction) and not is_several:
        raise ValueError("attraction and friction act between marbles: give is_several=True")
    mass = (
        solvent_mass * density * sphere_volume(radius) if mass is None else positive(mass, "mass")
    )
    inertia = 0.4 * mass * radius**2 if inertia is None else inertia
    wall = {"epsilon": epsilon, "sigma": sigma}
    among = [
        _solvent(gamma, gamma_t, a, r_c),
        interaction(
            (SOLVENT, COLLOID),
            term(shifted_repulsion, r_0=radius - sigma if r_0 is None else r_0, **wall),
            term(surface_drag, gamma_cs=gamma_cs, r_c=r_c, origin="surface", projector=coupling),
        ),
    ]
    if is_several:
        steric = term(shifted_repulsion, r_0=2.0 * radius - sigma, **wall, origin="contact")
        among.append(interaction((COLLOID, COLLOID), [steric, *attraction], friction))
    masses = jnp.stack(jnp.broadcast_arrays(solvent_mass, mass))
    return fluid(
        interactions=among, kT=kT, mass=masses, radius=(None, radius), inertia=(None, inertia)
    )


def _solvent(gamma, gamma_t, a, r_c):
    repulsion = [] if a is None else term(laws.soft_repulsion, a=a, r_c=r_c)
    drag = [term(laws.central_drag, gamma=gamma, r_c=r_c)]
    if gamma_t is not None:
        drag.append(term(laws.transverse_drag, gamma_t=gamma_t, r_c=r_c))
    return interaction((SOLVENT, SOLVENT), repulsion, drag)
