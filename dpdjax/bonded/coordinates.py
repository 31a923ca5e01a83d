"""The one coordinate that a bonded law is of: a distance, or the cosine of an angle.

Each is a function of the vectors from each bead to the one before it (3, beads - 1, count), from
which the engine differentiates; by cosines alone, whose slope is finite in a straight chain.
"""

import jax
import jax.numpy as jnp

from dpdjax.pairs.geometry import cross


def distance(v):
    """The length of a bond (count,); its slope is 0 where it has no direction."""
    square = jnp.sum(v[:, 0] * v[:, 0], axis=0)
    is_zero = square == 0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))


def cosine(v):
    """``cos(theta)`` at the middle bead of three (count,), -1 where they are in line."""
    return -jnp.sum(v[:, 0] * v[:, 1], axis=0) * _inverse(v[:, 0]) * _inverse(v[:, 1])


def dihedral_cosine(v):
    """``cos(phi)`` between the planes of four beads in a chain (count,), -1 in trans."""
    # Of unit vectors: squares of products of lengths leave the range of float32 in small units.
    a, b, c = (v[:, k] * _inverse(v[:, k])[None] for k in range(3))
    first, second = jnp.stack(cross(a, b)), jnp.stack(cross(b, c))
    return jnp.sum(first * second, axis=0) * _inverse(first) * _inverse(second)


COORDINATES = {"bond": distance, "angle": cosine, "dihedral": dihedral_cosine}
"""The coordinate of each kind."""


def _inverse(v):
    """One over the length of vectors (3, count), 0 of none."""
    square = jnp.sum(v * v, axis=0)
    is_zero = square == 0
    return jnp.where(is_zero, 0.0, jax.lax.rsqrt(jnp.where(is_zero, 1.0, square)))
