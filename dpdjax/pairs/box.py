"""The periodic box, and its Lees-Edwards deformation.

Positions are Cartesian and wrapped; the lattice is ``Lx e_x``, ``strain Ly e_x + Ly e_y``,
``Lz e_z``, with ``strain Ly`` kept within half a side of zero.
"""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import positive


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Box:
    """A periodic box under shear: the lattice ``Lx e_x``, ``strain Ly e_x + Ly e_y``, ``Lz e_z``.

    Attributes:
        lengths: sides, shape (3,) [length].
        strain: shear displacement of the upper y-image over Ly, modulo Lx/Ly.

    Example:
        >>> box = sheared.final.box
        >>> box.lengths.tolist(), float(box.volume), round(float(box.strain), 3)
        ([4.0, 4.0, 4.0], 64.0, 0.4)
        >>> round(float(box.strained(0.2).strain), 3)  # within half a period of zero
        -0.4
    """

    lengths: Any
    strain: Any

    @property
    def volume(self) -> jax.Array:
        """Product of the sides [volume]."""
        return self.lengths[0] * self.lengths[1] * self.lengths[2]

    def strained(self, increment: ArrayLike) -> "Box":
        """The box after a further shear strain."""
        return Box(self.lengths, self.strain + increment).folded()[0]

    def folded(self) -> tuple["Box", jax.Array]:
        """The same lattice, with its strain within half a period ``Lx/Ly`` of zero, and how many
        periods were taken off."""
        period = self.lengths[0] / self.lengths[1]
        periods = jnp.round(self.strain / period)
        return Box(self.lengths, self.strain - period * periods), periods


def box(lengths) -> Box:
    """An unstrained box; ``lengths`` is one side or three [length]."""
    lengths = positive(lengths, "box")
    if lengths.shape not in ((), (3,)):
        raise ValueError(f"box has shape {lengths.shape}; give one side or three")
    return Box(jnp.broadcast_to(lengths, (3,)), jnp.zeros((), lengths.dtype))


def minimum_image(box: Box, dx, dy, dz):
    """The nearest image of separations given by component, each of one shape.

    Right for the separations that matter, those below half the shortest side.
    Rounding instead of a modulus: it vectorises, and its derivative is zero.
    """
    lx, ly, lz = box.lengths
    rows = jnp.round(dy / ly)
    dx = dx - rows * (box.strain * ly)
    return dx - lx * jnp.round(dx / lx), dy - ly * rows, dz - lz * jnp.round(dz / lz)


def displacement(box: Box, ra: jax.Array, rb: jax.Array) -> jax.Array:
    """Nearest-image separation ``ra - rb`` of Cartesian positions (..., 3) [length].

    Example:
        >>> box = rest.final.box  # sides of 4
        >>> a, b = jnp.array([0.5, 1.0, 1.0]), jnp.array([3.5, 1.0, 1.0])
        >>> dpd.observe.displacement(box, a, b).tolist()
        [1.0, 0.0, 0.0]
    """
    d = ra - rb
    return jnp.stack(minimum_image(box, d[..., 0], d[..., 1], d[..., 2]), axis=-1)


def wrap(box: Box, position):
    """Positions inside the box and how many sides each was carried over, (n, 3) int32."""
    wrapped, crossed = wrapped_columns(box, position.T)
    return wrapped.T, crossed.T


def wrapped_columns(box: Box, position):
    """:func:`wrap` of positions given by component, (3, n)."""
    lx, ly, lz = box.lengths
    x, y, z = position
    rows = jnp.floor(y / ly)
    x = x - rows * (box.strain * ly)
    columns, layers = jnp.floor(x / lx), jnp.floor(z / lz)
    wrapped = jnp.stack([x - lx * columns, y - ly * rows, z - lz * layers])
    return wrapped, jnp.stack([columns, rows, layers]).astype(jnp.int32)


def fractional(box: Box, position):
    """Coordinates in [0, 1) along the lattice vectors, shape (n, 3)."""
    return in_lattice(box, position)[0]


def in_lattice(box: Box, position):
    """Coordinates in [0, 1) along the lattice vectors, and the image that has them, (n, 3) each."""
    lx, ly, lz = box.lengths
    x, y, z = position[:, 0], position[:, 1], position[:, 2]
    s = jnp.stack([(x - box.strain * y) / lx, y / ly, z / lz], axis=1)
    crossed = jnp.floor(s)
    columns, rows, layers = crossed[:, 0], crossed[:, 1], crossed[:, 2]
    image = jnp.stack(
        [x - rows * (box.strain * ly) - columns * lx, y - rows * ly, z - layers * lz], axis=1
    )
    return s - crossed, image


def matrix(box: Box):
    """The lattice as columns of an upper triangular matrix, as ``jax_md.space`` takes it."""
    return jnp.diag(box.lengths).at[0, 1].set(box.strain * box.lengths[1])


def narrowest(lengths, sheared: bool) -> np.ndarray:
    """Smallest distances between opposite faces over all strains, shape (3,) [length]."""
    lx, ly, lz = np.asarray(lengths, float)
    tilt = 0.5 * lx / ly if sheared else 0.0
    return np.array([lx / np.hypot(1.0, tilt), ly, lz])
