"""What a fluid says of each bead, by its species and its relative size.

``beads`` is a state, or anything with their ``species`` (n,) and ``size`` (n,).
"""

from typing import Any

import jax
import jax.numpy as jnp

from dpdjax.model.fluid import Fluid


def masses(fluid: Fluid, beads: Any) -> jax.Array:
    """Mass of each bead (n,).

    Example:
        >>> m = dpd.integrators.masses(marble.fluid, marble.state)
        >>> m.shape, round(float(m.max()), 2)
        ((636,), 12.57)
    """
    return fluid.mass[beads.species] * beads.size**3


def radii(fluid: Fluid, beads):
    """Radius of each bead (n,), 0 for points [length]."""
    of_species = jnp.stack(
        [jnp.zeros((), beads.size.dtype) if r is None else r for r in fluid.radius]
    )
    return of_species[beads.species] * beads.size


def inertias(fluid: Fluid, beads: Any) -> jax.Array:
    """Moment of inertia of each bead that rotates (m,) [mass length^2].

    Example:
        >>> round(float(dpd.integrators.inertias(marble.fluid, marble.state)[0]), 2)  # 2/5 M R^2
        5.03
    """
    slots = beads.rotation.slots
    return inertia_of(fluid, beads.species[slots], beads.size[slots])


def inertia_of(fluid: Fluid, species, size):
    """Moment of inertia of beads of these species and relative sizes (m,); goes as the fifth power
    of the size."""
    of_species = jnp.stack([jnp.ones((), size.dtype) if x is None else x for x in fluid.inertia])
    return of_species[species] * size**5
