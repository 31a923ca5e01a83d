"""All pairs within a distance, from sorted cells.

Beads are sorted by cell, x fastest and finest, so the half stencil of a bead is five
contiguous ranges: what follows in its own row, and one range of each of four rows further up.
Each row is stored between periodic images of its own ends, so a range is a stretch of memory: a
window of it is read at once and tested, and the verdicts are packed into 32-bit words. Each slot
of the list finds its word from prefix sums of the popcounts and its bit inside the word by binary
search. Nothing large is scattered, and the shapes are static.

Between two groups the beads of the larger one are stored in rows, and those of the smaller one
look through all nine rows around them.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.pairs import box as boxes
from dpdjax.xla import apart, on_cpu

# Rows as (dy, dz): of the half stencil, the first the bead's own row; and all around a bead.
HALF = np.array([[0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]], np.int32)
FULL = np.array([[y, z] for z in (-1, 0, 1) for y in (-1, 0, 1)], np.int32)
BYTE, WORD = 8, 32
BLOCK = 16_384
"""Beads whose pairs a CPU finds at a time (measured: tests/benchmarks)."""
MARGIN = 1.05
"""Room for the pairs of a block over its share of the list."""


def all_pairs(grid, box: boxes.Box, position, ids=None):
    """The list of :func:`cell_pairs` by trying every pair: for boxes of few cells, and for very few
    beads."""
    n = position.shape[0]
    i, j = _every_pair(grid)
    if ids is not None:
        slot = inverse(ids)
        i, j = slot[i], slot[j]
    d = boxes.displacement(box, position[i], position[j])
    near = jnp.sum(d * d, axis=1) < grid.list_radius**2
    words = _packed(jnp.pad(near, (0, -near.size % WORD)).reshape(-1, WORD))
    word, bit, filled, total = _set_bits(words, grid.capacity)
    pair = jnp.minimum(word * WORD + bit, i.size - 1)
    idx = jnp.where(filled, jnp.stack([jnp.asarray(i)[pair], jnp.asarray(j)[pair]]), n)
    return idx.astype(jnp.int32), (total > grid.capacity, jnp.asarray(False))


def _every_pair(grid):
    """Both beads of every pair there is, by id: lower first, or of the first group first."""
    first, second = grid.groups
    if grid.is_one_group:
        i, j = np.triu_indices(first[1] - first[0], 1)
        return i + first[0], j + first[0]
    i, j = np.meshgrid(np.arange(*first), np.arange(*second), indexing="ij")
    return i.ravel(), j.ravel()


def cell_pairs(grid, box: boxes.Box, position, ids=None):
    """All pairs of a list: indices (2, capacity), and (pairs, windows) overflow."""
    n = position.shape[0]
    part = lambda function, *inputs: apart(function, inputs, position[0, 0])
    seekers, rows, overflow = part(functools.partial(_laid_out, grid), box, position, ids)
    seeking = seekers.cell.shape[0]
    size = block_size(seeking)
    room = min(grid.capacity, rounded(MARGIN * grid.capacity * size / seeking))

    def block(carry, begin):
        idx, total, pairs, windows = carry
        ranges = part(functools.partial(_ranges, grid, size), box, seekers, rows, begin)
        words = part(functools.partial(_near, grid), ranges, rows.places)
        word, bit, filled, count = part(functools.partial(_set_bits, capacity=room), words)
        bead, slot = part(functools.partial(_bead_and_slot, grid), ranges, word, bit)
        a, b, swap = part(functools.partial(_ends, grid), seekers, rows, bead, slot)
        ends = jnp.stack(
            [jnp.where(filled, end, n) for end in (jnp.where(swap, b, a), jnp.where(swap, a, b))]
        )
        # The next block goes where this one is not filled.
        idx = jax.lax.dynamic_update_slice_in_dim(idx, ends, total, 1)
        pairs |= (count > room) | (total + room > grid.capacity)
        return (idx, total + count, pairs, windows | jnp.any(ranges.length > grid.window)), None

    empty = jnp.full((2, grid.capacity), n, jnp.int32)
    start = (empty, jnp.zeros((), jnp.int32), jnp.zeros((), bool), overflow)
    (idx, _, pairs, windows), _ = jax.lax.scan(
        block, start, jnp.arange(0, seeking, size, dtype=jnp.int32)
    )
    return idx, (pairs, windows)


def block_size(n: int) -> int:
    """Beads of a block: shares of about ``BLOCK``, or all of them."""
    blocks = max(1, n // BLOCK) if on_cpu() else 1
    return n if blocks == 1 else min(n, rounded(n / blocks, 32))


def stretch(n: int) -> float:
    """Length of a list over its pairs, so that the last block too finds all of its room in it."""
    size = block_size(n)
    before = (-(-n // size) - 1) * size
    return max(1.0, before / (n - MARGIN * size)) if before else 1.0


def rounded(count: float, unit: int = 256) -> int:
    """The next multiple of ``unit``: XLA needs up to six times as long for loops over odd
    counts."""
    return -(-math.ceil(count) // unit) * unit


def cell_order(grid, box: boxes.Box, position, ids):
    """The slots (n,) of the beads sorted by cell, by id within one."""
    return _sorted(_cells(grid, box, position)[0], math.prod(grid.cells), ids)


def inverse(order):
    """Where each number of a permutation stands in it."""
    count = jnp.arange(order.shape[0], dtype=jnp.int32)
    return jnp.zeros_like(count).at[order].set(count, unique_indices=True)


def _cells(grid, box, position):
    """The number of each bead's cell, x fastest, and its image in the tilted box (n, 3)."""
    nx, ny, nz = grid.cells
    fractional, position = boxes.in_lattice(box, position)
    cell = (fractional * np.array(grid.cells)[None]).astype(jnp.int32)
    # Below 0 too, for positions that became NaN: they must not send the sort round for ever.
    x, y, z = (jnp.clip(cell[:, k], 0, grid.cells[k] - 1) for k in range(3))
    return (z * ny + y) * nx + x, position


def _sorted(cell, cells: int, ids=None):
    """The slots (n,) sorted by cell, and by id (by slot without ids) within one."""
    ids = jnp.arange(cell.shape[0], dtype=jnp.int32) if ids is None else ids
    if not on_cpu():
        return jnp.lexsort((ids, cell)).astype(jnp.int32)
    counts = jnp.zeros(cells, jnp.int32).at[cell].add(1)
    return inverse((jnp.cumsum(counts) - counts)[cell] + _rank(cell, cells, ids))


def _rank(cell, cells: int, ids):
    """How many beads of the same cell have a lower id (n,).

    Each round takes the lowest of every cell: as many rounds as the fullest cell has beads, and
        still
    a third of the time of a sort.
    """
    nobody = np.iinfo(np.int32).max

    def visit(carry):
        rounds, left, rank = carry
        lowest = jnp.full(cells, nobody, jnp.int32).at[cell].min(left)
        # Beads that had their round are left as nobody.
        taken = (lowest[cell] == left) & (left < nobody)
        return rounds + 1, jnp.where(taken, nobody, left), jnp.where(taken, rounds, rank)

    zero = jnp.zeros((), jnp.int32)
    return jax.lax.while_loop(
        lambda carry: jnp.any(carry[1] < nobody), visit, (zero, ids, jnp.zeros_like(ids))
    )[2]


class SortedBeads(NamedTuple):
    """The beads of a group sorted by cell, by id within one.

    Attributes:
        cell, position: of each its cell and its position by component, (n,).
        name: its slot in memory; with ids, its id too.
    """

    cell: Any
    position: tuple
    name: tuple


class Rows(NamedTuple):
    """Beads in slots, row after row of cells, each row between images of its own ends.

    A range of cells is then a range of slots, at the ends of the rows too.

    Attributes:
        first: first slot of each cell, images included, and the end of all.
        home: slot of each sorted bead itself (n,).
        places: position in each slot, by component.
        name: slot in memory of the bead in each slot; with ids, its id too.
    """

    first: Any
    home: Any
    places: tuple
    name: tuple


def _sorted_group(grid, group, box, position, ids) -> SortedBeads:
    """The beads in the slots from ``group[0]`` to ``group[1]`` of the state."""
    begin, end = group
    ids = None if ids is None else ids[begin:end]
    cell, position = _cells(grid, box, position[begin:end])
    order = _sorted(cell, math.prod(grid.cells), ids)
    name = (begin + order,) if ids is None else (begin + order, ids[order])
    return SortedBeads(cell[order], tuple(position[order, k] for k in range(3)), name)


def _laid_out(grid, box, position, ids):
    """Who seeks partners, the rows to seek them in, and whether these have more images than room
    for them."""
    beads = _sorted_group(grid, grid.many, box, position, ids)
    first, home, bead, image, overflow = _rows(grid, beads.cell)
    x, y, z = (c[bead] for c in beads.position)
    rows = Rows(
        first, home, (x + image * box.lengths[0], y, z), tuple(name[bead] for name in beads.name)
    )
    seekers = beads if grid.is_one_group else _sorted_group(grid, grid.few, box, position, ids)
    return seekers, rows, overflow


def _rows(grid, cell):
    """First slot of each cell, slot of each bead, bead in each slot, its image along x (-1, 0, 1),
    overflow."""
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
    slots = jnp.arange(rounded(n + images + grid.window), dtype=jnp.int32)
    run = (
        jnp.cumsum(
            jnp.zeros_like(slots).at[begin.ravel()].add(1, mode="drop", indices_are_sorted=True)
        )
        - 1
    )
    bead = jnp.clip(slots + ahead.ravel()[run], 0, n - 1)
    home = jnp.arange(n, dtype=jnp.int32) - ahead[:, 1][_divided(cell, nx)[0]]
    return first, home, bead, _divided(run, 3)[1] - 1, first[-1] > n + images


class Ranges(NamedTuple):
    """The ranges of slots in which a bead finds its partners, one for each row of the stencil.

    Attributes:
        bead: the first of the block.
        start, length: of each range (beads, rows).
        origin: where the bead is as seen from the range, by component (beads, rows).
    """

    bead: Any
    start: Any
    length: Any
    origin: tuple


def _ranges(grid, size, box, seekers: SortedBeads, rows: Rows, begin) -> Ranges:
    """The ranges of ``size`` seekers from ``begin`` on; the last block reaches back, with empty
    ranges.

    A range spans the cells x - span to x + span of its row; in the own row of the half stencil it
    runs from the next slot to the end of x + span.
    """
    nx, ny, nz = grid.cells
    stencil = HALF if grid.is_one_group else FULL
    at = jnp.minimum(begin, seekers.cell.shape[0] - size)
    here = lambda column: jax.lax.dynamic_slice_in_dim(column, at, size)[:, None]
    row, x = _divided(here(seekers.cell), nx)
    z, y = (c + stencil[None, :, k] for c, k in zip(_divided(row, ny), (1, 0)))
    image_y, image_z = ((c >= m).astype(jnp.int32) - (c < 0) for c, m in ((y, ny), (z, nz)))
    from_cell = ((z - image_z * nz) * ny + y - image_y * ny) * (nx + 2 * grid.span) + x
    start = rows.first[from_cell]
    if grid.is_one_group:
        start = jnp.where(np.arange(len(stencil))[None] == 0, here(rows.home) + 1, start)
    fresh = at + jnp.arange(size, dtype=jnp.int32)[:, None] >= begin
    length = jnp.where(fresh, rows.first[from_cell + 2 * grid.span + 1] - start, 0)
    lx, ly, lz = box.lengths
    rx, ry, rz = (here(c) for c in seekers.position)
    return Ranges(
        at, start, length, (rx - image_y * (box.strain * ly), ry - image_y * ly, rz - image_z * lz)
    )


def _near(grid, ranges: Ranges, places):
    """Which slots of each window are within the list radius of its bead, packed into words."""
    width = _width(grid)
    begin = np.arange(0, grid.window, width, dtype=np.int32)[None, None]
    offset = begin[..., None] + np.arange(width, dtype=np.int32)[None, None, None]
    # Consecutive slots are read at once; an index for each would take several times as long.
    numbers = jax.lax.GatherDimensionNumbers(
        offset_dims=(3,), collapsed_slice_dims=(), start_index_map=(0,)
    )
    first = (ranges.start[..., None] + begin)[..., None]
    part = lambda c: jax.lax.gather(c, first, numbers, (width,), mode="promise_in_bounds")
    dx, dy, dz = (part(c) - o[..., None, None] for c, o in zip(places, ranges.origin))
    near = dx * dx + dy * dy + dz * dz < grid.list_radius**2
    return _packed(near & (offset < ranges.length[..., None, None])).ravel()


def _width(grid) -> int:
    """Bits used of a word: the widest that divides the window."""
    return next(width for width in range(WORD, 0, -BYTE) if grid.window % width == 0)


def _bead_and_slot(grid, ranges: Ranges, word, bit):
    """The sorted bead, and the slot of its partner, that a bit of a word stands for."""
    width = _width(grid)
    entry, part = _divided(word, grid.window // width)
    entry = jnp.minimum(entry, ranges.start.size - 1)
    return ranges.bead + _divided(entry, ranges.start.shape[1])[0], ranges.start.ravel()[
        entry
    ] + part * width + bit


def _ends(grid, seekers: SortedBeads, rows: Rows, bead, slot):
    """Both beads of each pair as slots in memory, and whether they are to change places."""
    a, b = seekers.name[0][bead], rows.name[0][slot]
    if not grid.is_one_group:
        return a, b, jnp.full(a.shape, grid.few != grid.groups[0])
    # By id where there is one: it is the same wherever the beads are stored.
    return a, b, seekers.name[-1][bead] > rows.name[-1][slot]


def _divided(number, by: int):
    """Quotient and remainder of numbers from 0 on; ``//`` and ``%`` look at signs too."""
    by = jnp.full_like(number, by)
    return jax.lax.div(number, by), jax.lax.rem(number, by)


def _packed(bits):
    """Booleans, at most 32 on the last axis, as words."""
    shift = np.arange(bits.shape[-1], dtype=np.uint32).reshape([1] * (bits.ndim - 1) + [-1])
    return jnp.sum(bits.astype(jnp.uint32) << shift, axis=-1, dtype=jnp.uint32)


def _set_bits(words, capacity):
    """Word and bit of each of the first ``capacity`` set bits, whether there is one, and how many
    in all."""
    counts = jax.lax.population_count(words).astype(jnp.int32)
    ends = jnp.cumsum(counts)
    begins = ends - counts
    # A mark where each word begins in the output; as many marks as words have begun so far.
    marks = jnp.zeros(capacity, jnp.int32).at[begins].add(1, mode="drop")
    word = jnp.cumsum(marks) - 1
    slot = jnp.arange(capacity, dtype=jnp.int32)
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
