"""Which beads are bonded: integers that go with a state, by the ids of its beads."""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.pairs import box as boxes
from dpdjax.pairs import cells
from dpdjax.pairs.geometry import take

NOBODY = -1
"""What fills the rows of those with fewer partners than others."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, repr=False)
class Topology:
    """The bonds, angles and dihedrals of a state, by the names of their types in the fluid.

    Attributes:
        beads: of each type the ids of its beads, (count, 2) of bonds, 3 of angles, 4 of dihedrals,
            int32. Neighbours in a row are the nearest images of each other.
        sides: of each type, how many vectors of the lattice lie between the unwrapped positions of
            neighbours in a row beyond those of nearest images, (count, 1 to 3, 3) int32: 0 for
            molecules that are whole. It stays what it is for as long as no bond is longer than
            half a box.
        partners: of each bead, by id, the ids of those that it has no pair with, (n, most) int32;
            or None where all beads are pairs.
    """

    beads: dict[str, Any]
    sides: dict[str, Any]
    partners: Any = None

    def __repr__(self):
        return f"Topology({', '.join(f'{v} {k}' for k, v in self.counts.items())})"

    @property
    def counts(self) -> dict[str, int]:
        """How many there are of each type."""
        return {name: rows.shape[-2] for name, rows in self.beads.items()}

    def folded(self, periods) -> "Topology":
        """The same bonds in a box whose strain is so many periods less."""
        shift = lambda s: s.at[..., 0].add(periods.astype(s.dtype) * s[..., 1])
        return dataclasses.replace(self, sides={k: shift(s) for k, s in self.sides.items()})


def topology(
    box, position, image, ids, groups: Mapping[str, ArrayLike], apart: int = 0
) -> Topology:
    """The topology of beads where they are.

    Args:
        box, position, image, ids: those of a state, of known numbers.
        groups: of each type the ids of its beads, (count, 2), (count, 3) or (count, 4).
        apart: beads up to so many bonds apart are no pairs.
    """
    n = position.shape[0]
    beads = {name: _rows(name, rows, n) for name, rows in groups.items()}
    slot = cells.inverse(ids)
    sides = {name: _told_sides(box, position, image, slot[rows]) for name, rows in beads.items()}
    partners = None if not apart else jnp.asarray(_partners(bonds_among(beads), n, apart))
    return Topology(beads, sides, partners)


def bonds_among(beads: Mapping[str, ArrayLike]) -> np.ndarray:
    """All bonds (bonds, 2) of a topology, as ids."""
    pairs = [np.asarray(rows) for rows in beads.values() if np.shape(rows)[-1] == 2]
    return np.concatenate([np.zeros((0, 2), np.int32), *pairs])


def vectors(box, position: tuple, slots):
    """From each bead of a row to the one before it, nearest images, (3, beads - 1, count).

    ``position`` by component (n,) each; ``slots`` (beads, count).
    """
    ahead = (take(c, slots[:-1]) - take(c, slots[1:]) for c in position)
    return jnp.stack(boxes.minimum_image(box, *ahead))


def each_type(types, state):
    """Each of these types of bonds with the slots of its beads (beads, count), and its vectors."""
    slot, position = cells.inverse(state.id), tuple(state.position[:, k] for k in range(3))
    for b in types:
        slots = slot[state.topology.beads[b.name].T]
        yield b, slots, vectors(state.box, position, slots)


def is_torn(topology: Topology, box, position, image, ids):
    """Whether a bond has become longer than half a box, so that its nearest image is another."""
    slot = cells.inverse(ids)
    now = {k: _sides(box, position, image, slot[rows]) for k, rows in topology.beads.items()}
    torn = [jnp.any(now[k] != topology.sides[k]) for k in now]
    return functools.reduce(jnp.logical_or, torn, jnp.zeros((), bool))


def _rows(name: str, rows, n: int):
    """The ids of one type as int32; ValueError for what is none, or says a bead twice."""
    rows = np.asarray(rows)
    if rows.ndim != 2 or rows.shape[1] not in (2, 3, 4) or rows.dtype.kind not in "iu":
        raise ValueError(
            f"{name!r} has {rows.dtype} of shape {rows.shape}; give integers, (bonds, 2), (angles, "
            "3) or (dihedrals, 4)"
        )
    if rows.size and not (0 <= rows.min() and rows.max() < n):
        raise ValueError(
            f"{name!r} names beads {rows.min()} to {rows.max()}; the state has 0 to {n - 1}"
        )
    ordered = np.sort(rows, axis=1)
    twice = np.flatnonzero(np.any(ordered[:, 1:] == ordered[:, :-1], axis=1))
    if twice.size:
        raise ValueError(f"{name!r} {twice[0]} is {rows[twice[0]].tolist()}, one bead twice")
    _refuse_twins(name, rows)
    return jnp.asarray(rows, jnp.int32)


def _refuse_twins(name: str, rows):
    """Raise ValueError for the same beads said again, either way round: they would act twice."""
    either = np.where(rows[:, :1] > rows[:, -1:], rows[:, ::-1], rows)
    _, first = np.unique(either, axis=0, return_index=True)
    again = np.setdiff1d(np.arange(len(rows)), first)
    if again.size:
        raise ValueError(
            f"{name!r} {again[0]} is {rows[again[0]].tolist()}, which is there before: give each "
            "once, one way round"
        )


def _sides(box, position, image, slots):
    """:attr:`Topology.sides` of beads in ``slots`` (count, beads)."""
    lx, ly, lz = box.lengths
    d = position[slots[:, :-1]] - position[slots[:, 1:]]
    rows = jnp.round(d[..., 1] / ly)
    columns = jnp.round((d[..., 0] - rows * (box.strain * ly)) / lx)
    nearest = jnp.stack([columns, rows, jnp.round(d[..., 2] / lz)], axis=-1)
    return image[slots[:, :-1]] - image[slots[:, 1:]] + nearest.astype(image.dtype)


_told_sides = jax.jit(_sides)
"""On the host: operation by operation it takes seconds to compile."""


def _partners(bonds: np.ndarray, n: int, apart: int) -> np.ndarray:
    """Of each bead those up to so many bonds away, (n, most), filled with ``NOBODY``."""
    near = [set() for _ in range(n)]
    for a, b in bonds:
        near[a].add(int(b))
        near[b].add(int(a))
    within = near
    for _ in range(apart - 1):
        within = [mine.union(*(near[k] for k in mine)) - {bead} for bead, mine in enumerate(within)]
    most = max(map(len, within), default=0)
    table = np.full((n, max(most, 1)), NOBODY, np.int32)
    for bead, mine in enumerate(within):
        table[bead, : len(mine)] = sorted(mine)
    return table
