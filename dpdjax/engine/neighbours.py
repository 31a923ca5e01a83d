"""Half lists of neighbours in jax-md's own type, built from sorted cells.

Beads are sorted by cell, x fastest and finest, so the half stencil of a bead is five
contiguous ranges: what follows in its own row, and one range of each of four rows further up.
Each row is stored between periodic images of its own ends, so a range is a stretch of memory: a
window of it is read at once and tested, and the verdicts are packed into 32-bit words. Each slot
of the list finds its word from prefix sums of the popcounts and its bit inside the word by binary
search. Nothing large is scattered, and the shapes are static.

The lists are ``jax_md.partition.NeighborList`` in its ``OrderedSparse`` format, under its
``allocate``/``update`` protocol with the box passed at every update.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import box as boxes
from dpdjax.engine.batching import apart, on_cpu, where_needed

# Rows of the half stencil as (dy, dz); the first is the bead's own row.
ROWS = np.array([[0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]])
BYTE, WORD = 8, 32
FINENESS = 4
"""Cells along x per cut: finer cells fit the ranges closer to what is within the cut."""


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
    """

    reach: float
    skin: float
    cells: tuple[int, int, int] | None
    span: int
    window: int
    capacity: int
    sheared: bool = True

    def grown(self, pairs: bool, windows: bool) -> "Grid":
        """A grid with half as much again of what overflowed."""
        return dataclasses.replace(
            self,
            capacity=_round_up(int(1.5 * self.capacity), 256) if pairs else self.capacity,
            window=_whole_words(int(1.5 * self.window)) if windows else self.window,
        )


def plan_grid(n: int, lengths, reach: float, skin: float, sheared: bool = True) -> Grid:
    """A grid for ``n`` beads spread evenly; clustered beads make it grow later.

    Raises ValueError where a side is below ``2 (reach + skin)``: the nearest image
    would not be the only one.
    """
    lengths = np.asarray(lengths, float)
    cut = reach + skin
    if np.any(boxes.narrowest(lengths, sheared) < 2 * cut * (1 - 1e-6)) :
        raise ValueError(
            f"box side {lengths.min():.4g} is below 2 (reach + skin) = {2 * cut:.4g}"
            f"{' (a tilted side counts 0.89)' if sheared else ''}; use a side of at least "
            f"{2 * cut * (np.hypot(1, 0.5) if sheared else 1):.4g} or a smaller skin"
        )
    density = n / lengths.prod()
    pairs = 0.5 * n * density * (4 / 3) * math.pi * cut**3
    capacity = min(_round_up(int(1.1 * pairs + 6 * math.sqrt(pairs)) + 64, 256), max(n * (n - 1) // 2, 1))
    cells = np.floor(boxes.narrowest(lengths, sheared) / cut * (1 + 1e-6)).astype(int)
    if np.any(cells < 3) or n < 200:
        return Grid(reach, skin, None, 0, 0, capacity, sheared)
    # More rows than the beads fill cost more to index than they save.
    most = max(3, int(np.cbrt(n / 2)) + 1)
    cells = np.minimum(cells, np.maximum(3, np.ceil(most * lengths / np.cbrt(lengths.prod())))).astype(int)
    cells[0] *= FINENESS
    span = math.ceil(cells[0] * cut / boxes.narrowest(lengths, sheared)[0] * (1 - 1e-6))
    per_range = (2 * span + 1) * n / cells.prod()
    window = _whole_words(int(per_range + 4 * math.sqrt(per_range)))
    return Grid(reach, skin, tuple(int(c) for c in cells), span, window, capacity, sheared)


def _whole_words(slots: int) -> int:
    """A window of at least ``slots``: words of equal width, in whole bytes."""
    words = -(-slots // WORD)
    return words * _round_up(-(-slots // words), BYTE)


def _round_up(value: int, unit: int) -> int:
    return -(-value // unit) * unit


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

    ``ids`` (n,), a permutation: the pairs come in the order, and each with its beads the way round,
    that beads stored by id would give. By default the beads are.
    """
    idx, (pairs, windows) = build_pairs(grid, box, position, ids)
    code = pairs.astype(jnp.uint8) + 2 * windows.astype(jnp.uint8)
    return restore(grid, idx, position, code, box.strain)


def restore(grid: Grid, idx, reference_position, code, strain) -> Neighbours:
    """A list from its arrays; ``code`` has jax-md's bits, 1 pair and 2 cell overflow."""
    from jax_md import partition

    neighbour_list = partition.NeighborList(
        idx=idx,
        reference_position=reference_position,
        error=partition.PartitionError(code),
        cell_list_capacity=grid.window,
        max_occupancy=grid.capacity,
        format=partition.OrderedSparse,
        cell_size=grid.reach + grid.skin,
        cell_list_fn=None,
        update_fn=updater(grid),
    )
    return Neighbours(neighbour_list, strain, grid)


@functools.cache
def updater(grid: Grid):
    """The list's ``update_fn``; one object per grid, so that jit does not recompile."""

    def update_fn(position, neighbour_list, box):
        return update(Neighbours(neighbour_list, box.strain, grid), box, position).list

    return update_fn


def is_stale(neighbours: Neighbours, box: boxes.Box, position):
    """Whether a pair inside the reach may be missing from the list.

    Twice the largest non-affine displacement since the build, plus what the strain
    since then adds to a pair at the reach, against the skin.
    """
    grid, reference = neighbours.grid, neighbours.list.reference_position
    period = box.lengths[0] / box.lengths[1]
    strain = box.strain - neighbours.strain
    strain = strain - period * jnp.round(strain / period)
    affine = strain * reference[:, 1]
    d = position - reference
    dx, dy, dz = boxes.minimum_image(box, d[:, 0] - affine, d[:, 1], d[:, 2])
    moved = jnp.sqrt(jnp.max(dx * dx + dy * dy + dz * dz))
    return 2.0 * moved + jnp.abs(strain) * (grid.reach + grid.skin) > grid.skin


def update(neighbours: Neighbours, box: boxes.Box, position, ids=None) -> Neighbours:
    """The list, rebuilt if it is stale; in a batch, the lists of the members that are."""
    neighbours, position, box = jax.lax.stop_gradient((neighbours, position, box))
    return _rebuild_where(neighbours.grid)(is_stale(neighbours, box, position), neighbours, box, position, ids)


@functools.cache
def _rebuild_where(grid: Grid):
    """One object per grid, so that ``custom_vmap`` is set up once."""

    def rebuild(old, box, position, ids):
        new = allocate(grid, box, position, ids)
        return dataclasses.replace(new, list=_with_error(new.list, old.list.error.code | new.list.error.code))

    return where_needed(rebuild)


def _with_error(neighbour_list, code):
    return dataclasses.replace(neighbour_list, error=dataclasses.replace(neighbour_list.error, code=code))


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
        return _all_pairs(grid, box, position)
    return _cell_pairs(grid, box, position, ids)


def _all_pairs(grid, box, position):
    n = position.shape[0]
    i, j = np.triu_indices(n, 1)
    d = boxes.displacement(box, position[i], position[j])
    near = jnp.sum(d * d, axis=1) < (grid.reach + grid.skin) ** 2
    words = _packed(jnp.pad(near, (0, -near.size % WORD)).reshape(-1, WORD))
    word, bit, filled, total = _set_bits(grid, words)
    pair = jnp.minimum(word * WORD + bit, i.size - 1)
    idx = jnp.where(filled, jnp.stack([jnp.asarray(i)[pair], jnp.asarray(j)[pair]]), n)
    return idx.astype(jnp.int32), (total > grid.capacity, jnp.asarray(False))


def _cell_pairs(grid, box, position, ids):
    part = lambda function, *inputs: apart(functools.partial(function, grid), inputs, position[0, 0])
    windows, overflow = part(_windows, box, position, ids)
    words = part(_near, windows)
    word, bit, filled, total = part(_set_bits, words)
    bead, slot = part(_bead_and_slot, windows.start, word, bit)
    a, b, swap = part(_ends, windows, bead, slot)
    idx = jnp.stack([jnp.where(filled, end, position.shape[0]) for end in (jnp.where(swap, b, a), jnp.where(swap, a, b))])
    return idx, (total > grid.capacity, overflow)


def cell_order(grid: Grid, box: boxes.Box, position, ids):
    """The slots (n,) of the beads sorted by cell, by id within one."""
    return _sorted(_cells(grid, box, position)[0], math.prod(grid.cells), ids)


def _cells(grid, box, position):
    """The number of each bead's cell, x fastest, and its image in the tilted box (n, 3)."""
    nx, ny, nz = grid.cells
    fractional, position = boxes.in_lattice(box, position)
    cell = (fractional * np.array(grid.cells)[None]).astype(jnp.int32)
    x, y, z = (jnp.minimum(cell[:, k], grid.cells[k] - 1) for k in range(3))
    return (z * ny + y) * nx + x, position


def _sorted(cell, cells: int, ids=None):
    """The slots (n,) sorted by cell, and by id (by slot without ids) within one."""
    ids = jnp.arange(cell.shape[0], dtype=jnp.int32) if ids is None else ids
    if not on_cpu():
        return jnp.lexsort((ids, cell))
    counts = jnp.zeros(cells, jnp.int32).at[cell].add(1)
    return inverse((jnp.cumsum(counts) - counts)[cell] + _rank(cell, cells, ids))


def _rank(cell, cells: int, ids):
    """How many beads of the same cell have a lower id (n,).

    Each turn takes the lowest of every cell: as many turns as the fullest cell has beads, and still
    a third of the time of a sort.
    """
    n = cell.shape[0]

    def turn(carry):
        turns, left, rank = carry
        lowest = jnp.full(cells, n, jnp.int32).at[cell].min(left)
        taken = lowest[cell] == left
        # Those taken are left as n, which is lower than none.
        taken &= left < n
        return turns + 1, jnp.where(taken, n, left), jnp.where(taken, turns, rank)

    zero = jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(lambda carry: jnp.any(carry[1] < n), turn, (zero, ids, jnp.zeros_like(ids)))[2]


def inverse(order):
    """Where each number of a permutation stands in it."""
    count = jnp.arange(order.shape[0], dtype=jnp.int32)
    return jnp.zeros_like(count).at[order].set(count, unique_indices=True)


class Rows(NamedTuple):
    """Sorted beads in slots, row after row of cells, each row between images of its own ends.

    A range of cells is then a range of slots, at the ends of the rows too.

    Attributes:
        first: first slot of each cell, images included, and the end of all.
        home: slot of each bead itself (n,).
        bead, turn: the bead in each slot, and the sides along x by which it is an image (-1, 0, 1).
        overflow: whether there are more images than room for them.
    """

    first: Any
    home: Any
    bead: Any
    turn: Any
    overflow: Any


def _rows(grid, cell) -> Rows:
    n, (nx, ny, nz), span = cell.shape[0], grid.cells, grid.span
    counts = jnp.zeros(nx * ny * nz, jnp.int32).at[cell].add(1, indices_are_sorted=True)
    before = (jnp.cumsum(counts) - counts).reshape(-1, nx)
    counts = counts.reshape(-1, nx)
    counts = jnp.concatenate([counts[:, nx - span :], counts, counts[:, :span]], axis=1)
    first = jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(counts.ravel())])
    # Each row has three runs of consecutive beads: images, the row itself, images.
    begin = first[:-1].reshape(counts.shape)[:, np.array([0, span, span + nx])]
    ahead = before[:, np.array([nx - span, 0, 0])] - begin
    images = min(n, math.ceil(ny * nz * grid.window * 2 * span / (2 * span + 1)))
    # The last window too ends inside.
    slots = jnp.arange(n + images + grid.window, dtype=jnp.int32)
    run = jnp.cumsum(jnp.zeros_like(slots).at[begin.ravel()].add(1, mode="drop", indices_are_sorted=True)) - 1
    bead = jnp.clip(slots + ahead.ravel()[run], 0, n - 1)
    home = jnp.arange(n, dtype=jnp.int32) - ahead[:, 1][cell // nx]
    return Rows(first, home, bead, run % 3 - 1, first[-1] > n + images)


class Windows(NamedTuple):
    """The five ranges of slots in which a sorted bead finds its partners.

    Attributes:
        start, length: of each range (n, 5).
        origin: where the bead is as seen from the range, by component (n, 5).
        places: position in each slot, by component.
        here, there: slot in memory of each sorted bead, and of the bead in each slot; with ids, their ids too.
    """

    start: Any
    length: Any
    origin: tuple
    places: tuple
    here: tuple
    there: tuple


def _windows(grid, box, position, ids):
    """The windows, and whether a range is longer than one or there are too many images."""
    cell, position = _cells(grid, box, position)
    order = _sorted(cell, math.prod(grid.cells), ids)
    cell, bead = cell[order], tuple(position[order, k] for k in range(3))
    rows = _rows(grid, cell)
    start, length, origin = _ranges(grid, box, cell, bead, rows)
    x, y, z = (c[rows.bead] for c in bead)
    here = (order,) if ids is None else (order, ids[order])
    there = tuple(name[rows.bead] for name in here)
    windows = Windows(start, length, origin, (x + rows.turn * box.lengths[0], y, z), here, there)
    return windows, rows.overflow | jnp.any(length > grid.window)


def _ranges(grid, box, cell, bead, rows: Rows):
    """The five ranges of slots of each bead: first slot, length, and where the bead is as seen from there; (n, 5) each.

    Four ranges span the cells x - span to x + span of a row above; the first, in the bead's own
    row, runs from the next slot to the end of x + span.
    """
    nx, ny, nz = grid.cells
    x, row = cell % nx, cell // nx
    y, z = (row % ny)[:, None] + ROWS[None, :, 0], (row // ny)[:, None] + ROWS[None, :, 1]
    turn_y, turn_z = y // ny, z // nz
    at = ((z - turn_z * nz) * ny + y - turn_y * ny) * (nx + 2 * grid.span) + x[:, None]
    own = np.arange(len(ROWS))[None] == 0
    start = jnp.where(own, rows.home[:, None] + 1, rows.first[at])
    length = rows.first[at + 2 * grid.span + 1] - start
    lx, ly, lz = box.lengths
    rx, ry, rz = (c[:, None] for c in bead)
    return start, length, (rx - turn_y * (box.strain * ly), ry - turn_y * ly, rz - turn_z * lz)


def _near(grid, windows: Windows):
    """Which beads of each window are within reach and skin, packed into words."""
    width = _width(grid)
    begin = np.arange(0, grid.window, width, dtype=np.int32)[None, None]
    offset = begin[..., None] + np.arange(width, dtype=np.int32)[None, None, None]
    # Consecutive slots are read at once; as an index for each they would take eight times as long.
    numbers = jax.lax.GatherDimensionNumbers(offset_dims=(3,), collapsed_slice_dims=(), start_index_map=(0,))
    first = (windows.start[..., None] + begin)[..., None]
    part = lambda c: jax.lax.gather(c, first, numbers, (width,), mode="promise_in_bounds")
    dx, dy, dz = (part(c) - o[..., None, None] for c, o in zip(windows.places, windows.origin))
    near = dx * dx + dy * dy + dz * dz < (grid.reach + grid.skin) ** 2
    return _packed(near & (offset < windows.length[..., None, None])).ravel()


def _width(grid) -> int:
    """Bits used of a word: the widest that divides the window."""
    return next(width for width in range(WORD, 0, -BYTE) if grid.window % width == 0)


def _bead_and_slot(grid, start, word, bit):
    """The sorted bead, and the slot of its partner, that a bit of a word stands for."""
    width = _width(grid)
    parts = grid.window // width
    entry = jnp.minimum(word // parts, start.size - 1)
    return entry // len(ROWS), start.ravel()[entry] + word % parts * width + bit


def _ends(grid, windows: Windows, bead, slot):
    """Both beads of each pair as slots in memory, and whether they are to change places."""
    del grid
    a, b = windows.here[0][bead], windows.there[0][slot]
    # By id where there is one: it is the same wherever the beads are stored.
    return a, b, windows.here[-1][bead] > windows.there[-1][slot]


def _packed(bits):
    """Booleans, at most 32 on the last axis, as words."""
    shift = np.arange(bits.shape[-1], dtype=np.uint32).reshape([1] * (bits.ndim - 1) + [-1])
    return jnp.sum(bits.astype(jnp.uint32) << shift, axis=-1, dtype=jnp.uint32)


def _set_bits(grid, words):
    """Word and bit of each of the first ``capacity`` set bits, whether there is one, and how many in all."""
    counts = jax.lax.population_count(words).astype(jnp.int32)
    ends = jnp.cumsum(counts)
    begins = ends - counts
    # A mark where each word begins in the output; as many marks as words have begun so far.
    marks = jnp.zeros(grid.capacity, jnp.int32).at[begins].add(1, mode="drop")
    word = jnp.cumsum(marks) - 1
    slot = jnp.arange(grid.capacity, dtype=jnp.int32)
    return word, _select_bit(words[word], slot - begins[word]), slot < ends[-1], ends[-1]


def _select_bit(word, rank):
    """Position of the set bit of ``word`` that has ``rank`` set bits below it."""
    position = jnp.zeros_like(rank)
    for width in (16, 8, 4, 2, 1):
        low = (word >> position.astype(jnp.uint32)) & jnp.uint32((1 << width) - 1)
        below = jax.lax.population_count(low).astype(jnp.int32)
        above = rank >= below
        rank = jnp.where(above, rank - below, rank)
        position = jnp.where(above, position + width, position)
    return position
