"""Sums over pairs onto their beads and over all of them."""

import dataclasses
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from dpdjax.model.fluid import ORIGINS
from dpdjax.pairs.geometry import Columns, Pairs, cross
from dpdjax.xla import on_cpu

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Tally:
    """Sums over pairs from the last force pass that was asked for them.

    Attributes:
        energy: potential energy [energy].
        virial: sum of ``F_ij r_ij`` by origin, (3, 3) each [energy]: the force along the first
            axis, the separation along the second. Symmetric where all forces are central.
        carried: half of ``sum m v v`` before the drag of a step changes velocities at once, less
            that after it (3, 3) [energy]; it belongs to the kinetic stress. 0 where velocities
            change with the forces.
    """

    energy: Any
    virial: dict[str, Any]
    carried: Any

    @classmethod
    def zero(cls, dtype, origins=ORIGINS) -> "Tally":
        nothing = jnp.zeros((3, 3), dtype)
        return cls(jnp.zeros((), dtype), {origin: nothing for origin in origins}, nothing)

    def __add__(self, more: "Tally") -> "Tally":
        both = self.plus(more.energy, more.virial)
        return dataclasses.replace(both, carried=self.carried + more.carried)

    def plus(self, energy, virial: dict) -> "Tally":
        """With the sums of more pairs, whose virials may be of some of the origins only."""
        return Tally(
            self.energy + energy,
            self.virial | {k: self.virial[k] + v for k, v in virial.items()},
            self.carried,
        )


class Forces(NamedTuple):
    """What acts at one moment; forces add up by ``+``, and are multiplied by a number.

    Attributes:
        force: on each bead (n, 3) [force].
        torque: on each bead that rotates (m, 3) [energy], or None where none does.
        tally: sums over pairs, with ``energy`` and ``virial`` by origin, or None where they were
            not asked for.

    Example:
        >>> acts = dpd.forces(water, state, key, 0.01, kinds=("conservative",))
        >>> acts.force.shape, acts.torque is None, sorted(acts.tally.virial)
        ((192, 3), True, ['conservative', 'drag', 'random'])
        >>> bool(jnp.abs((acts + 0.5 * acts).force - 1.5 * acts.force).max() < 1e-3)
        True
    """

    force: Any
    torque: Any
    tally: Tally | None

    def __mul__(self, share) -> "Forces":
        """A share of them."""
        return Forces(*jax.tree.map(lambda x: share * x, tuple(self)))

    __rmul__ = __mul__

    def __add__(self, more: "Forces") -> "Forces":
        """Both together: of other kinds, other pairs, bonds, drivers."""
        both = lambda mine, other: (
            mine if other is None else other if mine is None else mine + other
        )
        return Forces(*(both(mine, other) for mine, other in zip(self, more)))


def over_blocks(add, sums, idx, size: int, pad: int):
    """``sums = add(sums, part)`` over ``idx`` (2, pairs) in blocks of ``size``, the last one filled
    with ``pad``."""

    def block(sums, begin):
        # The last block reaches back into the one before it.
        start = jnp.minimum(begin, idx.shape[1] - size)
        fresh = start + jnp.arange(size, dtype=idx.dtype) >= begin
        part = jax.lax.dynamic_slice_in_dim(idx, start, size, 1)
        return add(sums, jnp.where(fresh[None], part, pad)), None

    return jax.lax.scan(block, sums, jnp.arange(0, idx.shape[1], size, dtype=idx.dtype))[0]


def net_zero(n: int, dtype, paired: bool = False):
    """Empty sums over first and over second beads, each as its parts (n,).

    The parts are x, y, z; or, ``paired``, x + i y and z: a CPU adds a complex number as fast as a
    real one.
    """
    z = jnp.zeros(n, dtype)
    parts = (jax.lax.complex(z, z), z) if paired else (z, z, z)
    return parts, parts


def net_add(net, pairs: Pairs, along, across=None):
    """Add ``along`` e, and ``across``, of every pair to the sums of its first and of its second
    bead."""
    f = tuple(along * e for e in pairs.e)
    f = f if across is None else tuple(a + b for a, b in zip(f, across))
    # The laws before the sums: XLA would evaluate them again for every scatter.
    f = jax.lax.optimization_barrier(f)
    parts = (jax.lax.complex(f[0], f[1]), f[2]) if len(net[0]) == 2 else f
    add = lambda total, i, part: total.at[i].add(part, mode="drop", wrap_negative_indices=False)
    return tuple(
        tuple(add(t, i, p) for t, p in zip(totals, parts))
        for totals, i in zip(net, (pairs.i, pairs.j))
    )


def net_force(net):
    """What the pairs push each bead by (n, 3): first beads one way, second beads the other."""
    parts = [first - second for first, second in zip(*net)]
    x, y, z = (parts[0].real, parts[0].imag, parts[1]) if len(parts) == 2 else parts
    return jnp.stack([x, y, z], axis=1)


def sum_onto_beads(pairs: Pairs, along, n: int):
    """``along`` e on the first and its opposite on the second bead of every pair; (n, 3)."""
    return net_force(net_add(net_zero(n, along.dtype, on_cpu()), pairs, along))


def onto_beads(slots, f, n: int):
    """Vectors ``f`` (3, rows) added onto the beads in ``slots`` (rows,); (n, 3)."""
    # The laws before the sums: XLA would evaluate them again for every scatter.
    f = jax.lax.optimization_barrier(f)
    add = lambda part: (
        jnp.zeros(n, part.dtype)
        .at[slots]
        .add(part, mode="promise_in_bounds", wrap_negative_indices=False)
    )
    if not on_cpu():
        return jnp.stack([add(part) for part in f], axis=1)
    xy, z = add(jax.lax.complex(f[0], f[1])), add(f[2])
    return jnp.stack([xy.real, xy.imag, z], axis=1)


def torque_add(torque, beads: Columns, pairs: Pairs, across):
    """Add ``arm x force`` of every pair to what turns its beads (m, 3).

    The arms ``-R_i e`` and ``R_j e`` are those of the surface velocities, and the second bead feels
    the opposite force: both get ``-R e x across``.
    """
    lever = jnp.stack(cross(pairs.e, across), axis=1)
    m = torque.shape[0]
    for slots, R in ((pairs.i, pairs.R_i), (pairs.j, pairs.R_j)):
        row = slots - beads.rotating_from
        row = jnp.where((row >= 0) & (row < m), row, m)
        torque = torque.at[row].add(
            -jnp.reshape(R, (-1, 1)) * lever, mode="drop", wrap_negative_indices=False
        )
    return torque


def sum_across(pairs: Pairs, across: dict) -> dict:
    """The virials ``sum F_ij r_ij`` of forces perpendicular to ``e``, by origin."""
    r = jnp.where(pairs.real, pairs.r, 0.0)
    separation = jnp.stack([r * e for e in pairs.e])
    product = lambda f: jnp.einsum(
        "ap,bp->ab", jnp.stack(f), separation, precision=jax.lax.Precision.HIGHEST
    )
    return {origin: product(f) for origin, f in across.items()}


def sum_pairs(pairs: Pairs, energy, forces: dict):
    """Energy and the virials ``sum r_ij F_ij`` by origin of a list, all in one matrix product."""
    r = jnp.where(pairs.real, pairs.r, 0.0)
    energy, along, r, e = jax.lax.optimization_barrier((energy, tuple(forces.values()), r, pairs.e))
    upper = jnp.stack([r * e[a] * e[b] for a, b in UPPER])
    sums = jnp.einsum("fp,vp->fv", jnp.stack(along), upper, precision=jax.lax.Precision.HIGHEST)
    return jnp.sum(energy), {origin: symmetric(sums[k]) for k, origin in enumerate(forces)}


def symmetric(upper):
    """The six numbers of ``UPPER`` as a (3, 3) matrix."""
    xx, xy, xz, yy, yz, zz = upper
    return jnp.stack([jnp.stack([xx, xy, xz]), jnp.stack([xy, yy, yz]), jnp.stack([xz, yz, zz])])
