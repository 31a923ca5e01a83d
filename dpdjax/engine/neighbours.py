"""Half lists of neighbours in jax-md's own type, built from sorted cells.

Beads are sorted by cell, x fastest and finest, so the half stencil of a bead is five
contiguous ranges: what follows in its own row, and one range of each of four rows further up.
A window of slots is tested per range; the verdicts are packed into 32-bit words, and each
slot of the list finds its word from prefix sums of the popcounts and its bit inside the word by
binary search. Nothing large is scattered, and the shapes are static.

The lists are ``jax_md.partition.NeighborList`` in its ``OrderedSparse`` format, under its
``allocate``/``update`` protocol with the box passed at every update.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import box as boxes
from dpdjax.engine.batching import where_needed

# Rows of the half stencil as (dy, dz); the first is the bead's own row.
ROWS = np.array([[0, 0], [1, 0], [-1, 1], [0, 1], [1, 1]])
BYTE, WORD = 8, 32
once = jax.lax.optimization_barrier
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
            window=_round_up(int(1.5 * self.window), BYTE) if windows else self.window,
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
    window = _round_up(int(per_range + 4 * math.sqrt(per_range)), BYTE)
    return Grid(reach, skin, tuple(int(c) for c in cells), span, window, capacity, sheared)


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
    word, bit, filled, total = _set_bits(_pack(jnp.pad(near, (0, -near.size % WORD))), grid.capacity)
    pair = jnp.minimum(word * WORD + bit, i.size - 1)
    idx = jnp.where(filled, jnp.stack([jnp.asarray(i)[pair], jnp.asarray(j)[pair]]), n)
    return idx.astype(jnp.int32), (total > grid.capacity, jnp.asarray(False))


def _cell_pairs(grid, box, position, ids):
    n, cells = position.shape[0], math.prod(grid.cells)
    cell, flat = _cells(grid, box, position)
    order = _sorted(flat, cells, ids)
    # Barriers between the stages: XLA would fuse them, and compute each stage again for every use.
    start, length, row_end, row_size = once(_ranges(grid, cell[order], _first(flat, cells)))

    x, y, z = once(tuple(position[order, k] for k in range(3)))
    offset = jnp.arange(grid.window, dtype=jnp.int32)[None, None]
    slot = start[..., None] + offset
    slot = jnp.where(slot >= row_end[..., None], slot - row_size[..., None], slot)
    here = (slice(None), None, None)
    dx, dy, dz = boxes.minimum_image(box, x[slot] - x[here], y[slot] - y[here], z[slot] - z[here])
    near = dx * dx + dy * dy + dz * dz < (grid.reach + grid.skin) ** 2
    near &= offset < length[..., None]

    word, bit, filled, total = once(_set_bits(once(_pack(once(near))), grid.capacity))
    test = word * WORD + bit
    entry, turn = jnp.minimum(test // grid.window, n * len(ROWS) - 1), test % grid.window
    partner = start.ravel()[entry] + turn
    partner = jnp.where(partner >= row_end.ravel()[entry], partner - row_size.ravel()[entry], partner)
    name = order if ids is None else ids[order]
    a, b = name[entry // len(ROWS)], name[jnp.clip(partner, 0, n - 1)]
    idx = jnp.where(filled, jnp.stack([jnp.minimum(a, b), jnp.maximum(a, b)]), n)
    if ids is not None:
        idx = jnp.append(inverse(ids), n)[once(idx)]
    return idx, (total > grid.capacity, jnp.any(length > grid.window))


def cell_order(grid: Grid, box: boxes.Box, position, ids):
    """The slots (n,) of the beads sorted by cell, by id within one."""
    return _sorted(_cells(grid, box, position)[1], math.prod(grid.cells), ids)


def _cells(grid, box, position):
    """The cell of each bead as (x, y, z), and as one number, x fastest."""
    cells = np.array(grid.cells)[None]
    cell = jnp.minimum((boxes.fractional(box, position) * cells).astype(jnp.int32), cells - 1)
    nx, ny, _ = grid.cells
    return cell, (cell[:, 2] * ny + cell[:, 1]) * nx + cell[:, 0]


def _sorted(flat, cells: int, ids=None):
    """The slots (n,) sorted by cell, and by id within one.

    A radix sort whose digits are what fits beside a bead's number in 32 bits: one or two sorts of
    plain integers, each four times faster than a sort of keys with their values.
    """
    n = flat.shape[0]
    number, key = jnp.arange(n, dtype=jnp.uint32), flat.astype(jnp.uint32)
    width = max(1, (n - 1).bit_length())
    order = None if ids is None else inverse(ids)
    for shift in range(0, max(1, (cells - 1).bit_length()), 32 - width):
        digit = (key if order is None else key[order]) >> shift
        turn = (jnp.sort((digit << width) | number) & jnp.uint32((1 << width) - 1)).astype(jnp.int32)
        order = turn if order is None else order[turn]
    return order


def inverse(order):
    """Where each number of a permutation stands in it."""
    count = jnp.arange(order.shape[0], dtype=jnp.int32)
    return jnp.zeros_like(count).at[order].set(count, unique_indices=True)


def _first(flat, cells: int):
    """The first slot of each cell, and the number of beads at the end."""
    counts = jnp.zeros(cells, jnp.int32).at[flat].add(1)
    return jnp.concatenate([jnp.zeros(1, jnp.int32), jnp.cumsum(counts)])


def _ranges(grid, cell, first):
    """Start and length of each bead's five ranges of slots, and the end and size of their rows; (n, 5) each.

    Four ranges span the cells x - span to x + span of a row above; the first, in the bead's own
    row, runs from the next slot to the end of x + span. ``first`` is the first slot of each cell.
    """
    nx, ny, nz = grid.cells
    y = (cell[:, 1, None] + ROWS[None, :, 0]) % ny
    z = (cell[:, 2, None] + ROWS[None, :, 1]) % nz
    row = (z * ny + y) * nx
    row_start, row_end = first[row], first[row + nx]
    size = row_end - row_start

    def edge(x):
        """First slot of cell x of the row, the row repeated periodically."""
        turns = x // nx
        return first[row + x - turns * nx] + turns * size

    x = cell[:, 0, None]
    after = jnp.arange(1, cell.shape[0] + 1, dtype=jnp.int32)[:, None]
    start = jnp.where(np.arange(len(ROWS))[None] == 0, after, edge(x - grid.span))
    length = edge(x + grid.span + 1) - start
    # A range that begins before its row comes in from the other end.
    return start + jnp.where(start < row_start, size, 0), length, row_end, size


def _pack(bits):
    """Booleans, the last axis in whole bytes, as words of 32 bits."""
    bits = bits.reshape(*bits.shape[:-1], -1, BYTE).astype(jnp.uint8)
    shift = jnp.arange(BYTE, dtype=jnp.uint8).reshape(*[1] * (bits.ndim - 1), BYTE)
    octets = jnp.sum(bits << shift, axis=-1, dtype=jnp.uint8).ravel()
    octets = jnp.pad(octets, (0, -octets.size % 4)).reshape(-1, 4).astype(jnp.uint32)
    return octets[:, 0] | octets[:, 1] << 8 | octets[:, 2] << 16 | octets[:, 3] << 24


def _set_bits(words, capacity):
    """Word and bit of each of the first ``capacity`` set bits, whether there is one, and how many in all."""
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
