"""The geometry of pairs of beads: distances, directions, velocities of surfaces past each other."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.model.beads import radii
from dpdjax.pairs import box as boxes


class Pairs(NamedTuple):
    """The geometry of a list of pairs, by component; every entry has shape (pairs,).

    ``v`` is the approach along ``e``, ``across`` the velocity of the two surfaces past each other,
    perpendicular to ``e``; None where nothing asks for it.
    """

    i: jax.Array
    j: jax.Array
    real: jax.Array
    r: jax.Array
    h: jax.Array
    e: tuple
    v: jax.Array
    across: tuple | None
    si: jax.Array
    sj: jax.Array
    R_i: jax.Array
    R_j: jax.Array


class Columns(NamedTuple):
    """What the pairs read of the beads, in columns of shape (n,); no radii where all are points.

    ``spin``: angular velocities of the beads that rotate, from the slot ``rotating_from`` on, in
    columns; or None.
    """

    position: tuple
    velocity: tuple
    species: jax.Array
    id: jax.Array
    radius: jax.Array | None
    spin: tuple | None = None
    rotating_from: int = 0

    @classmethod
    def of(cls, fluid, state, velocity) -> "Columns":
        # Whole columns first: XLA would fold what makes them into every single read.
        columns = lambda rows: tuple(rows[:, k] for k in range(3))
        x, v = jax.lax.optimization_barrier((columns(state.position), columns(velocity)))
        radius = radii(fluid, state) if fluid.has_radii else None
        rotation = state.rotation
        spin, begin = (
            (None, 0) if rotation is None else (columns(rotation.velocity), rotation.begin)
        )
        return cls(x, v, state.species, state.id, radius, spin, begin)


class Moment(NamedTuple):
    """What all pairs of a list share at one moment: the box, the shear rate, the time step and what
    keys the noise."""

    box: boxes.Box
    rate: Any = 0.0
    dt: Any = None
    words: Any = None


def geometry(fluid, interaction, beads: Columns, idx, moment: Moment) -> Pairs:
    """:func:`pair_geometry` of pairs of one interaction."""
    spheres = tuple(any(fluid.radius[k] is not None for k in group) for group in interaction.groups)
    words = None if moment.words is None else moment.words.step
    return pair_geometry(
        moment.box, beads, idx, moment.rate, spheres, not interaction.is_central, words
    )


def pair_geometry(
    box, beads: Columns, idx, rate, spheres=(False, False), across: bool = False, words=None
) -> Pairs:
    """Distance, gap, direction and relative velocity of each pair of ``idx`` (2, pairs).

    ``spheres``: whether the first and the second beads have radii at all; ``across``: whether the
    velocity perpendicular to the line of centres is wanted (static). ``words``: of the step, which
    key the direction of beads at one place.

    The lab velocities of two beads differ by their peculiar velocities and by
    ``rate y_ij`` of the nearest image, which is the jump across the y-boundary too.
    """
    n = beads.id.shape[0]
    # Padded slots are pairs of a bead with itself.
    real = idx[0] < n
    i, j = jnp.minimum(idx[0], n - 1), jnp.minimum(idx[1], n - 1)
    dx, dy, dz = boxes.minimum_image(box, *(take(c, i) - take(c, j) for c in beads.position))
    square = dx * dx + dy * dy + dz * dz
    # Beads at one place are a pair too. Zero is kept out of the root and its derivative.
    apart = square > 0
    inverse = jax.lax.rsqrt(jnp.where(apart, square, 1.0))
    somewhere = diagonal_of(words, square.dtype)
    e = tuple(jnp.where(apart, d * inverse, s) for d, s in zip((dx, dy, dz), somewhere))
    vx, vy, vz = (take(c, i) - take(c, j) for c in beads.velocity)
    vx = vx + rate * dy
    approach = e[0] * vx + e[1] * vy + e[2] * vz
    r = jnp.where(real, square * inverse, jnp.inf)
    R_i, R_j = (
        take(beads.radius, k) if has else jnp.zeros((), r.dtype) for k, has in zip((i, j), spheres)
    )
    h = r - (R_i + R_j) if any(spheres) else r
    past = past_each_other(beads, i, j, e, (vx, vy, vz), approach, R_i, R_j) if across else None
    return Pairs(
        idx[0],
        idx[1],
        real,
        r,
        h,
        e,
        approach,
        past,
        take(beads.species, i),
        take(beads.species, j),
        R_i,
        R_j,
    )


def past_each_other(beads: Columns, i, j, e: tuple, v: tuple, approach, R_i, R_j) -> tuple:
    """Velocity of the surfaces of pairs past each other, by component, from that of their centres
    ``v`` and its part along ``e``."""
    past = tuple(u - approach * c for u, c in zip(v, e))
    if beads.spin is None:
        return past
    # Surface points lie at -R_i e and R_j e from the centres, and move as omega x arm.
    both = tuple(R_i * a + R_j * b for a, b in zip(spin_of(beads, i), spin_of(beads, j)))
    return tuple(p - c for p, c in zip(past, cross(both, e)))


def diagonal_of(words, dtype) -> tuple:
    """A diagonal of a cube by the words (2,) of a step, or a fixed one: from the second to the
    first of two beads at one place.

    The same for all pairs. One for each would make every pair read the words of its beads here too:
    a tenth of the pass.
    """
    side = jnp.asarray(3.0**-0.5, dtype)
    if words is None:
        return side, side, side
    return tuple(jnp.where(words[0] & jnp.uint32(1 << k) == 0, side, -side) for k in (31, 30, 29))


def spin_of(beads: Columns, slots) -> tuple:
    """Angular velocity, by component, of the beads in ``slots`` (pairs,); 0 for those that do not
    rotate."""
    row, rows = slots - beads.rotating_from, beads.spin[0].shape[0]
    rotates = (row >= 0) & (row < rows)
    return tuple(jnp.where(rotates, take(c, jnp.clip(row, 0, rows - 1)), 0.0) for c in beads.spin)


def cross(a: tuple, b: tuple) -> tuple:
    """Vector product of two vectors by component."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def take(x, i):
    """``x[i]`` for indices known to be within bounds."""
    return x.at[i].get(mode="promise_in_bounds", wrap_negative_indices=False)
