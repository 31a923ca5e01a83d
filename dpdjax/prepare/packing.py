"""Where a suspension starts: spheres that do not overlap, and points in the room between them.

The spheres are random points pushed apart until every gap is as wide as wanted. Pushes are added up
as integers, so the outcome does not depend on the order of a list, nor on the device's order of
sums.
"""

import functools
import operator

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import is_concrete, not_negative, number, positive, prng_key
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.noise import Domain

DENSEST = 0.6
"""Volume fraction up to which spheres, each with half a gap around it, are packed: they jam at 0.64
at random."""
WIDEST = 0.62
"""The same for the distance they are pushed to, which is above the gap so that the pushing ends."""
GAP = 0.02
"""Default gap, and how far above any gap spheres are pushed, over the smallest radius."""
SKIN = 0.4
"""Skin of the list of spheres over the mean radius."""
ROOM = 1.6
"""Room for pairs of spheres: those pushed apart have more close neighbours than points have."""
STEP, MEMORY = 0.4, 0.9
"""Share of an overlap that a sweep takes away, and share of the last move that it goes on with."""
UNIT = 2.0**-24
"""The smallest push over the largest diameter."""
MOST_SWEEPS = 5000
"""Thirty times what a volume fraction of 0.6 takes."""
MOST_ROUNDS = 1000
"""Rounds of new points before the room is taken to be none."""


def pack(key, box: boxes.Box, radius, *, gap: float | None = None):
    """Spheres at random in a periodic box, none closer to another than a gap.

    Random points are pushed apart until no gap ``r_ij - R_i - R_j`` is below ``gap``. Their order
    is about that of hard spheres in equilibrium, but that the narrowest gaps are missing.

    Args:
        key: a PRNG key; the same one may drive the run.
        box: an unstrained :class:`Box`.
        radius: one for each sphere, shape (n,), of any sizes [length].
        gap: the narrowest gap [length]; by default 0.02 of the smallest radius, or above a volume
            fraction of about 0.58 what still leaves spheres grown by half of it a fraction of 0.6.

    Returns the centres, shape (n, 3) and inside the box [length], of the dtype of the box; the same
    bits for the same key.

    Raises:
        ValueError: a radius that is not positive, a volume fraction of 0.6 or more, a side below
            ``2 (2 R + gap)``, a strained box, numbers that are being traced.
        RuntimeError: spheres that are still too close after 5000 sweeps.
        TypeError: no key.
    """
    key = _one_key(key, Domain.PACK)
    lengths, radius = _sides(box, key, radius, gap), _radii(radius)
    gap = _checked_gap(lengths, radius, gap)
    target = gap + _margin(lengths, radius, gap)
    start = jax.random.uniform(key, (len(radius), 3), dtype=box.lengths.dtype) * box.lengths[None]
    if len(radius) == 1:
        return start
    sizes = jnp.asarray(radius, box.lengths.dtype)
    wanted = gap + _rounding(box, lengths)
    grid = _grid_of_spheres(lengths, radius, target)
    push = lambda grid: _pushed_apart(grid, box, start, sizes, wanted, target, MOST_SWEEPS)
    position, narrowest, sweeps = _with_room(push, grid)
    if not narrowest >= wanted:
        raise RuntimeError(
            f"the narrowest gap of spheres of volume fraction {_fraction(lengths, radius):.3g} is "
            f"still {float(narrowest):.3g} after {int(sweeps)} sweeps, and {gap:.3g} is wanted; "
            "use fewer spheres or a larger box, a smaller gap, or another key"
        )
    return position


def arrange(key, box: boxes.Box, radius, *, clearance: float = 0.0):
    """Positions (n, 3) of beads of radii (n,), 0 for points: :func:`pack` of the spheres, and
    :func:`fill` for the points."""
    radius = np.asarray(radius, float)
    is_sphere = radius > 0
    position = np.zeros((len(radius), 3), box.lengths.dtype)
    position[is_sphere] = pack(key, box, radius[is_sphere])
    if not np.all(is_sphere):
        count = int(np.sum(~is_sphere))
        position[~is_sphere] = fill(
            key, box, position[is_sphere], radius[is_sphere], count, clearance=clearance
        )
    return position


def fill(key, box: boxes.Box, centres, radius, count: int, *, clearance: float = 0.0):
    """Points at random in the room that spheres leave in a periodic box.

    Points inside a sphere are drawn anew until none is, so that they are uniform in the free volume
    and independent of each other.

    Args:
        key: a PRNG key; the same one may drive the run, and place the spheres.
        box: an unstrained :class:`Box`.
        centres: of the spheres, shape (m, 3) [length].
        radius: one for each sphere, shape (m,) [length].
        count: number of points.
        clearance: the least distance between a point and a surface [length].

    Returns the points, shape (count, 3) and inside the box [length], of the dtype of the box; the
    same bits for the same key.

    Raises:
        ValueError: a radius that is not positive, centres of another shape, a count below 1, a
            clearance below zero, a side below ``2 (R + clearance)``, a strained box, numbers that
            are being traced.
        RuntimeError: no free volume, or next to none.
        TypeError: no key.
    """
    key = _one_key(key, Domain.FILL)
    lengths, radius = _sides(box, key, radius, centres, clearance), _radii(radius)
    clearance, count = float(not_negative(clearance, "clearance")), operator.index(count)
    centres = number(centres, "centres").astype(box.lengths.dtype)
    if centres.shape != (len(radius), 3):
        raise ValueError(
            f"centres have shape {centres.shape}; {len(radius)} radii need ({len(radius)}, 3)"
        )
    if count < 1:
        raise ValueError(f"count is {count}; give at least 1 point")
    largest = radius.max() + clearance
    if lengths.min() < 2 * largest:
        raise ValueError(
            f"box side {lengths.min():.4g} is below 2 (radius + clearance) = {2 * largest:.4g}; "
            "use a larger box or a smaller clearance"
        )
    limit = jnp.asarray(radius + clearance + _rounding(box, lengths), box.lengths.dtype)
    grid = _grid_between(lengths, limit, count)
    draw = lambda grid: _drawn_outside(grid, count, box, centres, limit, key, MOST_ROUNDS)
    position, inside, rounds = _with_room(draw, grid)
    if inside:
        raise RuntimeError(
            f"{int(inside)} of {count} points are still inside spheres after {int(rounds)} rounds: "
            f"there is next to no free volume; use a clearance below {clearance:.4g}, fewer "
            "spheres or a larger box"
        )
    return position


def _one_key(key, domain: Domain):
    """The key for one purpose."""
    key = prng_key(key)
    if key.ndim:
        raise ValueError(f"{key.size} keys where one is wanted; call once for each")
    return jax.random.fold_in(key, domain)


def _sides(box, *others) -> np.ndarray:
    """The sides (3,) of a box that is not strained, all numbers being known."""
    if not is_concrete(box, *others):
        raise ValueError(
            "key, box, spheres and gaps must be known when tracing: place them outside jit, vmap "
            "and grad"
        )
    if box.strain != 0:
        raise ValueError(
            f"the box has a strain of {float(box.strain):.4g}; give an unstrained one, "
            "dpdjax.pairs.box.box(lengths)"
        )
    return np.asarray(box.lengths, float)


def _radii(radius) -> np.ndarray:
    radius = np.asarray(positive(radius, "radius"), float)
    if radius.ndim != 1 or not radius.size:
        raise ValueError(
            f"radius has shape {radius.shape}; give one for each sphere, such as np.full(100, 1.0)"
        )
    return radius


def _fraction(lengths, radius) -> float:
    return float(4 / 3 * np.pi * np.sum(radius**3) / lengths.prod())


def _slack(lengths, radius, fraction: float) -> float:
    """A gap that, half on every sphere, makes their volume fraction at most ``fraction``."""
    return 2 * float(radius.min()) * (np.cbrt(fraction / _fraction(lengths, radius)) - 1)


def _checked_gap(lengths, radius, gap) -> float:
    """The gap or its default; raises ValueError where the spheres do not fit with it."""
    reached = _fraction(lengths, radius)
    if reached >= DENSEST:
        raise ValueError(
            f"volume fraction {reached:.4g} of the spheres is not below {DENSEST}, and random "
            f"spheres jam at 0.64: use at most {int(len(radius) * DENSEST / reached)} such "
            f"spheres, or sides over {np.cbrt(reached / DENSEST):.4g} times as long"
        )
    slack = _slack(lengths, radius, DENSEST)
    gap = min(GAP * radius.min(), slack) if gap is None else float(not_negative(gap, "gap"))
    if _fraction(lengths, radius + gap / 2) > DENSEST * (1 + 1e-9):
        raise ValueError(
            f"spheres of volume fraction {reached:.4g} with gaps of {gap:.4g} fill more than "
            f"{DENSEST} of the box; use a gap below {slack:.4g}, fewer spheres or a larger box"
        )
    contact = 2 * radius.max() + gap
    if len(radius) == 1 and lengths.min() < contact:
        raise ValueError(
            f"box side {lengths.min():.4g} is below {contact:.4g}: a sphere would meet its image; "
            "use a larger box"
        )
    if len(radius) > 1 and lengths.min() < 2 * contact:
        raise ValueError(
            f"box side {lengths.min():.4g} is below 2 (2 radius + gap) = {2 * contact:.4g}: a "
            "sphere would meet another and its image; use a larger box or smaller spheres"
        )
    return float(gap)


def _margin(lengths, radius, gap: float) -> float:
    """How much further than the gap spheres are pushed, so that the last overlaps go in few
    sweeps."""
    fits = lengths.min() / 2 - (2 * radius.max() + gap)
    return float(min(GAP * radius.min(), _slack(lengths, radius + gap / 2, WIDEST), fits))


def _rounding(box, lengths) -> float:
    """What rounding may take from a distance between two positions."""
    return 4 * float(np.finfo(box.lengths.dtype).eps) * lengths.max()


def _grid_of_spheres(lengths, radius, target: float) -> lists.Grid:
    reach = 2 * radius.max() + target
    skin = min(SKIN * radius.mean(), lengths.min() / 2 - reach)
    return _roomy(
        lists.plan_grid(
            len(radius), lengths, float(reach), float(max(skin, 0)), sheared=False, room=ROOM
        )
    )


def _grid_between(lengths, limit, count: int) -> lists.Grid:
    """Pairs of a sphere and a point inside it; the skin is for rounding alone."""
    groups, reach = ((0, len(limit)), (len(limit), len(limit) + count)), float(limit.max())
    skin = min(0.01 * reach, lengths.min() / 2 - reach)
    return _roomy(lists.plan_grid(groups, lengths, reach, float(max(skin, 0)), sheared=False))


def _roomy(grid: lists.Grid) -> lists.Grid:
    """A grid with wider windows: a list that overflows costs seconds to compile anew, and these
    live short."""
    return grid.grown(2)


def _with_room(work, grid: lists.Grid):
    """The outcome of ``work(grid)``, less its list's error code, with a grid that nothing
    overflows."""
    while True:
        *outcome, code = work(grid)
        if not code:
            return outcome
        grid = grid.grown(int(code))


@functools.partial(jax.jit, static_argnums=0)
def _pushed_apart(grid, box, start, radius, wanted, target, most):
    """Centres (n, 3) with gaps of ``wanted``, the narrowest gap, the sweeps it took, and the list's
    error code.

    Every sweep moves spheres closer than ``target`` apart, and on in the direction of the last
    sweep.
    """

    def is_open(neighbours, narrowest):
        return (neighbours.list.error.code == 0) & (narrowest < wanted)

    def sweep(carry):
        neighbours, position, velocity, _, sweeps = carry
        neighbours = lists.update(neighbours, box, position)
        push, narrowest = _pushes(neighbours.list.idx, box, position, radius, target)
        velocity = MEMORY * velocity + STEP * push
        moved = _wrapped(box, position + velocity)
        position = jnp.where(is_open(neighbours, narrowest), moved, position)
        return neighbours, position, velocity, narrowest, sweeps + 1

    goes_on = lambda carry: is_open(carry[0], carry[3]) & (carry[4] < most)
    unknown = jnp.full((), -jnp.inf, start.dtype)
    carry = (
        lists.allocate(grid, box, start),
        start,
        jnp.zeros_like(start),
        unknown,
        jnp.zeros((), jnp.int32),
    )
    neighbours, position, _, narrowest, sweeps = jax.lax.while_loop(goes_on, sweep, carry)
    return position, narrowest, sweeps, neighbours.list.error.code


def _pushes(idx, box, position, radius, target):
    """The moves (n, 3) that would part each pair alone, added up, and the narrowest gap of all."""
    n = position.shape[0]
    i, j = jnp.minimum(idx, n - 1)
    d = boxes.displacement(box, position[i], position[j])
    r = jnp.sqrt(jnp.sum(d * d, axis=1))
    gap = jnp.where(idx[0] < n, r - radius[i] - radius[j], jnp.inf)
    unit = UNIT * 2 * jnp.max(radius)
    apart = jnp.maximum(target - gap, 0.0) / (jnp.maximum(r, unit) * unit)
    # A large sphere, which touches many small ones, gives way less.
    share = radius[j] ** 3 / (radius[i] ** 3 + radius[j] ** 3)
    whole = lambda part: jnp.round((part * apart)[:, None] * d).astype(jnp.int32)
    total = jnp.zeros(position.shape, jnp.int32)
    total = (
        total.at[idx[0]]
        .add(whole(share), mode="drop")
        .at[idx[1]]
        .add(-whole(1.0 - share), mode="drop")
    )
    return total * unit, jnp.min(gap)


def _wrapped(box, position):
    """Positions inside the box: what is just below zero rounds to the side itself, and is wrapped
    once more."""
    return boxes.wrap(box, boxes.wrap(box, position)[0])[0]


@functools.partial(jax.jit, static_argnums=(0, 1))
def _drawn_outside(grid, count, box, centres, limit, key, most):
    """Points (count, 3) further than ``limit`` from the centres, how many are not, the rounds, and
    the list's error code."""

    def draw(carry):
        position, inside, rounds, _ = carry
        # New points for all: those found already crowd the free volume, and would overflow the
        # list.
        fresh = (
            jax.random.uniform(jax.random.fold_in(key, rounds), (count, 3), dtype=limit.dtype)
            * box.lengths[None]
        )
        found = lists.allocate(grid, box, jnp.concatenate([centres, fresh])).list
        position = jnp.where(inside[:, None], fresh, position)
        return (
            position,
            inside & _inside(found.idx, box, centres, limit, fresh),
            rounds + 1,
            found.error.code,
        )

    goes_on = lambda carry: jnp.any(carry[1]) & (carry[2] < most) & (carry[3] == 0)
    nowhere = jnp.zeros((count, 3), limit.dtype)
    carry = (nowhere, jnp.ones(count, bool), jnp.zeros((), jnp.int32), jnp.zeros((), jnp.uint8))
    position, inside, rounds, code = jax.lax.while_loop(goes_on, draw, carry)
    return position, jnp.sum(inside), rounds, code


def _inside(idx, box, centres, limit, position):
    """Which points (count,) are within the limit of a sphere, from the pairs of spheres and
    points."""
    spheres, count = centres.shape[0], position.shape[0]
    i, j = jnp.minimum(idx[0], spheres - 1), jnp.minimum(idx[1] - spheres, count - 1)
    d = boxes.displacement(box, centres[i], position[j])
    within = (idx[0] < spheres) & (jnp.sum(d * d, axis=1) < limit[i] ** 2)
    return jnp.zeros(count, bool).at[j].max(within)
