"""Where the beads of molecules start: random walks, and bilayers already assembled."""

import numpy as np

from dpdjax.prepare.architecture import Architecture

BACK = 0.3
"""Cosine between a step and the one before it below which a walk turns back too sharply, and is
drawn again."""
SPLAY = 0.25
"""How far apart across the normal the branches of a molecule of a bilayer start, in bonds."""


def walks(draw: np.random.Generator, made: Architecture, count: int, lengths, step: float):
    """Positions (count, beads, 3) of random walks with steps of one length, anywhere in a box."""
    x = np.zeros((count, made.n, 3))
    ahead = np.zeros_like(x)
    x[:, 0] = draw.uniform(size=(count, 3)) * lengths
    for bead in range(1, made.n):
        before = made.parent[bead]
        ahead[:, bead] = _directions(draw, ahead[:, before])
        x[:, bead] = x[:, before] + step * ahead[:, bead]
    return closed(x) if made.closes else x


def closed(x):
    """Walks (count, beads, 3) that come back to a step from where they began: each bead is shifted
    by its share of what is missing."""
    n = x.shape[1]
    gap = x[:, -1:] - x[:, :1]
    return x - gap * (np.arange(n) / n)[None, :, None]


def _directions(draw, before):
    """Unit vectors (count, 3) that do not turn back on those ``before``, which may be 0."""
    found = np.zeros_like(before)
    left = np.arange(len(before))
    while left.size:
        v = draw.normal(size=(left.size, 3))
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        found[left] = v
        left = left[np.sum(v * before[left], axis=1) < -BACK]
    return found


def layers(
    draw: np.random.Generator,
    made: Architecture,
    count: int,
    lengths,
    step: float,
    axis: int,
    periods: int,
    thickness: float | None,
):
    """Positions (count, beads, 3) of molecules in bilayers normal to an axis, the first beads
    outside, the others one behind the other towards the middle.

    ``periods``: bilayers, one above the other; ``thickness`` of each, by default all there is room
    for. Molecules go evenly to the leaflets.
    """
    period = lengths[axis] / periods
    thickness = period if thickness is None else thickness
    depth = made.depth()
    leaflet = np.arange(count) % (2 * periods)
    middle = (leaflet // 2 + 0.5) * period
    side = 1.0 - 2.0 * (leaflet % 2)
    along = 0.5 * thickness * (1.0 - (depth + 0.5) / (depth.max() + 1.0))
    x = np.empty((count, made.n, 3))
    for one in range(2 * periods):
        mine = leaflet == one
        places = _in_plane(draw, int(mine.sum()), np.delete(lengths, axis))
        x[mine] = np.insert(places, axis, 0.0, axis=1)[:, None, :]
    x[:, :, axis] = middle[:, None] + side[:, None] * along[None]
    others = [k for k in range(3) if k != axis]
    x[:, :, others] += step * _splay(made)[None]
    return x


def _in_plane(draw, count: int, sides):
    """Places (count, 2) spread evenly over a rectangle, in random order."""
    columns = max(1, round(np.sqrt(count * sides[0] / sides[1])))
    rows = -(-count // columns)
    chosen = np.floor(np.arange(count) * (rows * columns) / max(count, 1)).astype(int)
    places = (np.stack(np.divmod(chosen, rows), axis=1) + 0.5) / [columns, rows] * sides
    return draw.permutation(places)


def _splay(made: Architecture):
    """Shifts (beads, 2), in bonds, that keep the branches of a molecule apart."""
    shift = np.zeros((made.n, 2))
    children = np.bincount([p for p in made.parent if p >= 0], minlength=made.n)
    seen = np.zeros(made.n, int)
    for bead in range(1, made.n):
        before = made.parent[bead]
        shift[bead] = shift[before]
        if children[before] > 1:
            angle = 2 * np.pi * seen[before] / children[before]
            shift[bead] += SPLAY * np.array([np.cos(angle), np.sin(angle)])
            seen[before] += 1
    return shift


def outside(draw: np.random.Generator, count: int, lengths, axis: int, taken):
    """Places (count, 3) of single beads at random outside the slabs ``taken``, (begin, end) along
    the axis each; anywhere where these leave no room."""
    x = draw.uniform(size=(count, 3)) * lengths
    edges = sorted(taken)
    free = [(b, a) for (_, b), (a, _) in zip([(0.0, 0.0), *edges], [*edges, (lengths[axis], 0.0)])]
    free = np.array([(a, b) for a, b in free if b > a]).reshape(-1, 2)
    if not edges or not len(free):
        return x
    room = free[:, 1] - free[:, 0]
    which = draw.choice(len(free), size=count, p=room / room.sum())
    x[:, axis] = free[which, 0] + draw.uniform(size=count) * room[which]
    return x
