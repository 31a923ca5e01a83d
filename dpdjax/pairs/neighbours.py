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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.pairs import box as boxes
from dpdjax.pairs import cells, kernels
from dpdjax.xla import where_needed

FINENESS = 4
"""Cells along x per list radius: finer cells fit the ranges closer to what is within it."""
ROUNDING = 1e-5
"""By which a box may seem smaller than it is."""
IN_CELLS = 200
"""Beads of the larger group from which cells are worth it."""
PAIRS, WINDOWS, NARROW, SHORT = 1, 2, (4, 16, 32), 8
"""What is wrong with a list, as bits of its error code: more pairs than it holds, more beads in a
range than a window does; cells that no longer cover the radius along x, y or z of a box that has
become smaller; a side of that below twice the radius."""
OVERFLOWS = PAIRS | WINDOWS | sum(NARROW)
"""What a larger grid is the cure for."""
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
        excludes: whether pairs are left out that a :class:`Excluded` names.
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
    excludes: bool = False
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
        """A grid with a quarter more of what overflowed, for every step pays for room that is not
        used; and with wider cells where those are too narrow.

        ``code``: of the list's error, ``PAIRS``, ``WINDOWS`` or one of ``NARROW`` by axis.
        """
        return dataclasses.replace(
            self._widened(code),
            capacity=cells.rounded(1.25 * self.capacity) if code & PAIRS else self.capacity,
        )._with_windows(1.25 if code & WINDOWS else 1.0)

    def _with_windows(self, factor: float) -> "Grid":
        """With windows for so many times as many beads."""
        if factor == 1.0 or not self.window:
            return self
        return dataclasses.replace(self, window=_whole_words(int(factor * self.window)))

    def _widened(self, code: int) -> "Grid":
        """With cells that cover the list radius in a box that is shorter along some axes: those
        along x one more of them, along y and z by fewer of them; none where too few are left."""
        is_narrow = [bool(code & bit) for bit in NARROW]
        if self.cells is None or not any(is_narrow):
            return self
        nx, *across = self.cells
        span = self.span + is_narrow[0]
        fewer = [min(c - 1, int(0.95 * c)) if yes else c for c, yes in zip(across, is_narrow[1:])]
        if min(fewer) < 3 or 2 * span + 1 > nx:
            return dataclasses.replace(self, cells=None, span=0, window=0)
        wider = math.prod(across) / math.prod(fewer) * (2 * span + 1) / (2 * self.span + 1)
        wide = dataclasses.replace(self, cells=(nx, *fewer), span=span)
        return wide._with_windows(wider)

    def misfit(self, box: boxes.Box):
        """What of ``NARROW`` and ``SHORT`` a box is for this grid, as a code; uint8."""
        bit = lambda is_so, bit: jnp.where(is_so, jnp.uint8(bit), jnp.uint8(0))
        short = jnp.any(box.lengths < 2 * self.list_radius * (1 - ROUNDING))
        code = bit(short, SHORT)
        if self.cells is None:
            return code
        lx, ly, lz = box.lengths
        faces = lx / jnp.sqrt(1.0 + box.strain**2), ly, lz
        for face, count, bit_of in zip(faces, self._across, NARROW):
            code |= bit(face < count * self.list_radius * (1 - ROUNDING), bit_of)
        return code

    @property
    def _across(self) -> tuple[float, float, float]:
        """How many times the list radius is to fit into the box along each axis."""
        nx, ny, nz = self.cells
        return nx / self.span, ny, nz


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


def room_for(grid: Grid, room: float) -> int:
    """A capacity so many times that of a grid."""
    return cells.rounded(room * grid.capacity)


def _whole_words(slots: int) -> int:
    """A window of at least ``slots``: words of equal width, in whole bytes."""
    words = -(-slots // cells.WORD)
    return words * cells.BYTE * -(-slots // (words * cells.BYTE))


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Neighbours:
    """One list, and the box it was built in.

    Attributes:
        list: a ``jax_md.partition.NeighborList``; ``list.idx`` is (2, capacity), padded
            with the number of beads.
        strain, lengths: those of the box at the build.
        grid: static shape of the list.
    """

    list: Any
    strain: jax.Array
    lengths: jax.Array
    grid: Grid = dataclasses.field(metadata={"static": True})


class Excluded(NamedTuple):
    """Pairs that no list holds: of each bead, by id, the ids of its ``partners`` (n, most), and the
    ids (n,) of the beads as they are stored."""

    partners: jax.Array
    id: jax.Array

    def without(self, idx):
        """Pairs (2, capacity), with those left out padded."""
        n = self.id.shape[0]
        a, b = (self.id[jnp.minimum(slots, n - 1)] for slots in idx)
        return jnp.where(jnp.any(self.partners[a] == b[:, None], axis=1), n, idx)


def allocate(
    grid: Grid, box: boxes.Box, position, ids=None, excluded: Excluded | None = None
) -> Neighbours:
    """A fresh list of the pairs within ``reach + skin``. jit and vmap safe.

    ``ids`` (n,), a permutation within each group: the pairs come in the order, and each with its
    beads the way round, that beads stored by id would give. By default the beads are. ``excluded``:
    what a grid that ``excludes`` leaves out.
    """
    idx, (pairs, windows) = build_pairs(grid, box, position, ids)
    if grid.excludes:
        if excluded is None:
            raise ValueError(
                "this list leaves out pairs and was not told which: dpd.run updates it"
            )
        idx = excluded.without(idx)
    code = PAIRS * pairs.astype(jnp.uint8) + WINDOWS * windows.astype(jnp.uint8)
    return restore(grid, idx, position, code | grid.misfit(box), box.strain, box.lengths)


ARRAYS = ("idx", "reference_position", "code", "strain", "lengths")
"""What a list consists of beside its grid."""


def arrays_of(neighbours: Neighbours) -> dict:
    """The arrays of a list by name, as :func:`restore` takes them."""
    held = neighbours.list
    built_in = neighbours.strain, neighbours.lengths
    return dict(zip(ARRAYS, (held.idx, held.reference_position, held.error.code, *built_in)))


def restore(grid: Grid, idx, reference_position, code, strain, lengths) -> Neighbours:
    """A list from its arrays; ``code`` has jax-md's bits, 1 pair and 2 cell overflow, 4 narrow
    cells and 8 a small box, and two more (``NARROW``)."""
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
    return Neighbours(neighbour_list, strain, lengths, grid)


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
        held = Neighbours(neighbour_list, box.strain, box.lengths, grid)
        return update(held, box, position).list

    return update_fn


def is_stale(neighbours: Neighbours, box: boxes.Box, position):
    """Whether a pair inside the reach may be missing from the list.

    The largest non-affine displacements since the build of either group together (of one group
    twice its own), plus what the strain since then adds to a pair at the list radius and what the
    box, where it is shorter than at the build, takes off that, against the skin.
    """
    grid = neighbours.grid
    period = box.lengths[0] / box.lengths[1]
    # Sides over those at the build, 1 to the last bit where they are the same.
    stretch = box.lengths / neighbours.lengths
    strain = box.strain - neighbours.strain * (stretch[0] / stretch[1])
    strain = strain - period * jnp.round(strain / period)

    def farthest(group):
        now, reference = (
            x[group[0] : group[1]] for x in (position, neighbours.list.reference_position)
        )
        reference = reference * stretch[None]
        affine = strain * reference[:, 1]
        d = now - reference
        dx, dy, dz = boxes.minimum_image(box, d[:, 0] - affine, d[:, 1], d[:, 2])
        return jnp.sqrt(jnp.max(dx * dx + dy * dy + dz * dz))

    moved = (
        2.0 * farthest(grid.few) if grid.is_one_group else farthest(grid.few) + farthest(grid.many)
    )
    # What was farther apart than the list radius is now farther than this.
    least = grid.list_radius * jnp.min(stretch)
    return moved + jnp.abs(strain) * least + (grid.list_radius - least) > grid.skin


def update(
    neighbours: Neighbours, box: boxes.Box, position, ids=None, excluded: Excluded | None = None
) -> Neighbours:
    """The list, rebuilt if it is stale; in a batch, the lists of the members that are."""
    neighbours, position, box = jax.lax.stop_gradient((neighbours, position, box))
    return _rebuild_where(neighbours.grid)(
        is_stale(neighbours, box, position), neighbours, box, position, ids, excluded
    )


def excluding(neighbours: Neighbours, excluded: Excluded) -> Neighbours:
    """The same list without pairs; from now on it leaves them out."""
    grid = dataclasses.replace(neighbours.grid, excludes=True)
    held, error = neighbours.list, neighbours.list.error
    idx = excluded.without(held.idx)
    built_in = neighbours.strain, neighbours.lengths
    return restore(grid, idx, held.reference_position, error.code, *built_in)


@functools.cache
def _rebuild_where(grid: Grid):
    """One object per grid, so that ``custom_vmap`` is set up once."""

    def rebuild(old, box, position, ids, excluded):
        new = allocate(grid, box, position, ids, excluded)
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
    code = np.asarray(neighbours.list.error.code)[members]
    return int(np.bitwise_or.reduce(code.ravel(), initial=0)) & OVERFLOWS


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
    return dataclasses.replace(neighbours, list=padded, grid=grid)


def build_pairs(grid: Grid, box: boxes.Box, position, ids=None):
    """All pairs within ``reach + skin``: indices (2, capacity), and (pairs, windows) overflow."""
    if grid.cells is None:
        return cells.all_pairs(grid, box, position, ids)
    return cells.cell_pairs(grid, box, position, ids)
