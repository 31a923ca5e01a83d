"""Half lists of neighbours in jax-md's own type: their shape, their life and their protocol.

A list holds the pairs within one group of beads, or those between two; a group is a range of
slots. The lists are ``jax_md.partition.NeighborList`` in its ``OrderedSparse`` format, under its
``allocate``/``update`` protocol with the box passed at every update.
"""

import dataclasses
import functools
import importlib.util
import math
import sys
import types
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.pairs import box as boxes
from dpdjax.pairs import cells, kernels
from dpdjax.xla import where_needed

FINENESS = 4
"""Cells along x per list radius: finer cells fit the ranges closer to what is within it."""
IN_CELLS = 200
"""Beads of the larger group from which cells are worth it."""
FEW = 64
"""Beads of the smaller group up to which all pairs are tried: sorting the larger one costs more
(measured: tests/benchmarks)."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """The static part of a list.

    Attributes:
        reach: largest distance at which the laws act [length].
        skin: added to the reach; a list lasts while beads move less than half of it.
        cells: cells along each side, or None to test all pairs (small boxes).
        span: cells along x that cover ``reach + skin``; along y and z one does.
        window: slots tested in each row of the stencil, a multiple of 8.
        capacity: pairs the list holds.
        sheared: whether the cells are wide enough for a tilted box.
        groups: first slot and end of either group; twice the same for the pairs within one.
        kernel: what does the sums over the pairs (``dpdjax.pairs.kernels``), by default the one
            suited to this machine.
    """

    reach: float
    skin: float
    cells: tuple[int, int, int] | None
    span: int
    window: int
    capacity: int
    sheared: bool
    groups: tuple[tuple[int, int], tuple[int, int]]
    kernel: Callable = dataclasses.field(default_factory=kernels.suited)

    @property
    def is_one_group(self) -> bool:
        return self.groups[0] == self.groups[1]

    @property
    def few(self) -> tuple[int, int]:
        """The smaller group."""
        return min(self.groups, key=_count)

    @property
    def many(self) -> tuple[int, int]:
        """The larger group; of two equal ones the second."""
        return self.groups[0] if self.few != self.groups[0] else self.groups[1]

    @property
    def list_radius(self) -> float:
        """Distance up to which pairs are listed [length]."""
        return self.reach + self.skin

    def grown(self, code: int = 3) -> "Grid":
        """A grid with a quarter more of what overflowed: every step pays for room that is not used.

        ``code``: 1 for the pairs, 2 for the windows, as in the list's error.
        """
        return dataclasses.replace(
            self,
            capacity=cells.rounded(1.25 * self.capacity) if code & 1 else self.capacity,
            window=_whole_words(int(1.25 * self.window))
            if code & 2 and self.window
            else self.window,
        )


def _rounded_up(length: float) -> float:
    """To hundredths of a length of 1 or more, and of a shorter one to three digits."""
    unit = 0.01 * 10.0 ** min(0, math.floor(math.log10(length)))
    return math.ceil(length / unit) * unit


def plan_grid(
    groups, lengths, reach: float, skin: float, sheared: bool = True, room: float = 1.03
) -> Grid:
    """A grid for beads spread evenly; clustered beads make it grow later.

    Args:
        groups: number of beads for the pairs among all of them; or first slot and end of each of
            two groups.
        lengths: sides of the box (3,) [length].
        reach, skin, sheared: see :class:`Grid`.
        room: pairs there is room for, over those of beads without structure.

    Raises ValueError where a side is below ``2 (reach + skin)``: the nearest image
    would not be the only one.
    """
    groups = (
        ((0, groups), (0, groups))
        if np.ndim(groups) == 0
        else tuple((int(a), int(b)) for a, b in groups)
    )
    lengths = np.asarray(lengths, float)
    list_radius = reach + skin
    if np.any(boxes.narrowest(lengths, sheared) < 2 * list_radius * (1 - 1e-6)):
        raise ValueError(
            f"box side {lengths.min():.4g} is below 2 (reach + skin) = {2 * list_radius:.4g}"
            f"{', or 1.118 times that in a box that can tilt' if sheared else ''}; use a side of "
            f"at least {_rounded_up(2 * list_radius * (np.hypot(1, 0.5) if sheared else 1)):g} or "
            "a smaller skin"
        )
    all_pairs = Grid(reach, skin, None, 0, 0, 0, sheared, groups)
    few, many = _count(all_pairs.few), _count(all_pairs.many)
    capacity = _capacity(
        all_pairs.is_one_group, few, many, (4 / 3) * math.pi * list_radius**3 / lengths.prod(), room
    )
    all_pairs = dataclasses.replace(all_pairs, capacity=capacity)
    shape = np.floor(boxes.narrowest(lengths, sheared) / list_radius * (1 + 1e-6)).astype(int)
    if np.any(shape < 3) or many < IN_CELLS or few <= FEW:
        return all_pairs
    # More rows than the beads fill cost more to index than they save.
    most = max(3, int(np.cbrt(many / 2)) + 1)
    shape = np.minimum(
        shape, np.maximum(3, np.ceil(most * lengths / np.cbrt(lengths.prod())))
    ).astype(int)
    shape[0] *= FINENESS
    span = math.ceil(shape[0] * list_radius / boxes.narrowest(lengths, sheared)[0] * (1 - 1e-6))
    per_range = (2 * span + 1) * many / shape.prod()
    window = _whole_words(int(per_range + 5 * math.sqrt(per_range)))
    return dataclasses.replace(
        all_pairs, cells=tuple(int(c) for c in shape), span=span, window=window
    )


def _count(group) -> int:
    return group[1] - group[0]


def _capacity(one_group: bool, few: int, many: int, share: float, room: float) -> int:
    """``room`` times the pairs of beads without structure and six standard deviations more, but no
    more than there are.

    ``share``: of all beads, those within the radius of one.
    """
    there = few * (few - 1) // 2 if one_group else few * many
    pairs = share * (0.5 * few * many if one_group else there)
    wanted = cells.stretch(few) * (room * pairs + 6 * math.sqrt(pairs)) + 64
    return min(cells.rounded(wanted), max(there, 1))


def _whole_words(slots: int) -> int:
    """A window of at least ``slots``: words of equal width, in whole bytes."""
    words = -(-slots // cells.WORD)
    return words * cells.BYTE * -(-slots // (words * cells.BYTE))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Neighbours:
    """One list, and the strain it was built at.

    Attributes:
        list: a ``jax_md.partition.NeighborList``; ``list.idx`` is (2, capacity), padded
            with the number of beads.
        strain: box strain at the build.
        grid: static shape of the list.
    """

    list: object
    strain: object
    grid: Grid = dataclasses.field(metadata={"static": True})


def allocate(grid: Grid, box: boxes.Box, position, ids=None) -> Neighbours:
    """A fresh list of the pairs within ``reach + skin``. jit and vmap safe.

    ``ids`` (n,), a permutation within each group: the pairs come in the order, and each with its
    beads the way round, that beads stored by id would give. By default the beads are.
    """
    idx, (pairs, windows) = build_pairs(grid, box, position, ids)
    code = pairs.astype(jnp.uint8) + 2 * windows.astype(jnp.uint8)
    return restore(grid, idx, position, code, box.strain)


ARRAYS = ("idx", "reference_position", "code", "strain")
"""What a list consists of beside its grid."""


def arrays_of(neighbours: Neighbours) -> dict:
    """The arrays of a list by name, as :func:`restore` takes them."""
    held = neighbours.list
    arrays = (held.idx, held.reference_position, held.error.code, neighbours.strain)
    return dict(zip(ARRAYS, arrays))


def restore(grid: Grid, idx, reference_position, code, strain) -> Neighbours:
    """A list from its arrays; ``code`` has jax-md's bits, 1 pair and 2 cell overflow."""
    partition = jax_md_partition()
    neighbour_list = partition.NeighborList(
        idx=idx,
        reference_position=reference_position,
        error=partition.PartitionError(code),
        cell_list_capacity=grid.window,
        max_occupancy=grid.capacity,
        format=partition.OrderedSparse,
        cell_size=grid.list_radius,
        cell_list_fn=None,
        update_fn=updater(grid),
    )
    return Neighbours(neighbour_list, strain, grid)


@functools.cache
def jax_md_partition():
    """The module ``jax_md.partition`` alone: the whole package compiles for five seconds when it is
    imported."""
    if "jax_md" in sys.modules:
        return importlib.import_module("jax_md.partition")
    package = types.ModuleType("jax_md")
    package.__path__ = list(importlib.util.find_spec("jax_md").submodule_search_locations)
    sys.modules["jax_md"] = package
    try:
        return importlib.import_module("jax_md.partition")
    finally:
        # A later import of the package is the real one, and finds this module there.
        del sys.modules["jax_md"]


@functools.cache
def updater(grid: Grid):
    """The list's ``update_fn``; one object per grid, so that jit does not recompile."""

    def update_fn(position, neighbour_list, box):
        return update(Neighbours(neighbour_list, box.strain, grid), box, position).list

    return update_fn


def is_stale(neighbours: Neighbours, box: boxes.Box, position):
    """Whether a pair inside the reach may be missing from the list.

    The largest non-affine displacements since the build of either group together (of one group
    twice its own), plus what the strain since then adds to a pair at the reach, against the skin.
    """
    grid = neighbours.grid
    period = box.lengths[0] / box.lengths[1]
    strain = box.strain - neighbours.strain
    strain = strain - period * jnp.round(strain / period)

    def farthest(group):
        now, reference = (
            x[group[0] : group[1]] for x in (position, neighbours.list.reference_position)
        )
        affine = strain * reference[:, 1]
        d = now - reference
        dx, dy, dz = boxes.minimum_image(box, d[:, 0] - affine, d[:, 1], d[:, 2])
        return jnp.sqrt(jnp.max(dx * dx + dy * dy + dz * dz))

    moved = (
        2.0 * farthest(grid.few) if grid.is_one_group else farthest(grid.few) + farthest(grid.many)
    )
    return moved + jnp.abs(strain) * grid.list_radius > grid.skin


def update(neighbours: Neighbours, box: boxes.Box, position, ids=None) -> Neighbours:
    """The list, rebuilt if it is stale; in a batch, the lists of the members that are."""
    neighbours, position, box = jax.lax.stop_gradient((neighbours, position, box))
    return _rebuild_where(neighbours.grid)(
        is_stale(neighbours, box, position), neighbours, box, position, ids
    )


@functools.cache
def _rebuild_where(grid: Grid):
    """One object per grid, so that ``custom_vmap`` is set up once."""

    def rebuild(old, box, position, ids):
        new = allocate(grid, box, position, ids)
        return dataclasses.replace(
            new, list=_with_error(new.list, old.list.error.code | new.list.error.code)
        )

    return where_needed(rebuild)


def _with_error(neighbour_list, code):
    return dataclasses.replace(
        neighbour_list, error=dataclasses.replace(neighbour_list.error, code=code)
    )


def with_overflow(neighbours: Neighbours, code) -> Neighbours:
    """A list that has overflowed as another has besides."""
    error = neighbours.list.error.code | code
    return dataclasses.replace(neighbours, list=_with_error(neighbours.list, error))


def overflow(neighbours: Neighbours, members=...) -> int:
    """What of a list has overflowed, in any of the ``members`` of a batch: 0, or the code of
    :meth:`Grid.grown`."""
    return int(
        np.bitwise_or.reduce(np.asarray(neighbours.list.error.code)[members].ravel(), initial=0)
    )


def pad(neighbours: Neighbours, grid: Grid) -> Neighbours:
    """The same pairs in the same order in a list of larger capacity."""
    n = neighbours.list.reference_position.shape[-2]
    idx = neighbours.list.idx
    width = [(0, 0)] * (idx.ndim - 1) + [(0, grid.capacity - idx.shape[-1])]
    padded = dataclasses.replace(
        neighbours.list,
        idx=jnp.pad(idx, width, constant_values=n),
        error=jax.tree.map(jnp.zeros_like, neighbours.list.error),
        cell_list_capacity=grid.window,
        max_occupancy=grid.capacity,
        update_fn=updater(grid),
    )
    return Neighbours(padded, neighbours.strain, grid)


def build_pairs(grid: Grid, box: boxes.Box, position, ids=None):
    """All pairs within ``reach + skin``: indices (2, capacity), and (pairs, windows) overflow."""
    if grid.cells is None:
        return cells.all_pairs(grid, box, position, ids)
    return cells.cell_pairs(grid, box, position, ids)
