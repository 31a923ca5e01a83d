"""Structure: the radial distribution function."""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.drawing import curve
from dpdjax.engine.trajectory import Trajectory
from dpdjax.errors import warn
from dpdjax.measure import needs
from dpdjax.measure.blocks import error_of
from dpdjax.measure.reading import as_frames, frame_lengths, recorded, strains
from dpdjax.measure.results import Result
from dpdjax.pairs import box as boxes

PAIRS_AT_ONCE = 2**20
"""Distances held in memory at a time."""
EMPTY = 0.75
"""Share of a side below which what beads span of it is not all of it."""


@dataclasses.dataclass(frozen=True, repr=False)
class RadialDistribution(Result):
    """The radial distribution function, by shells.

    Attributes:
        r: middle of each shell, (bins,) [length].
        g: density around a bead over the mean density, (bins,).
        error: standard error of ``g``, (bins,); NaN where there is a single frame.

    Example:
        >>> g = dpd.measure.radial_distribution(rest, bins=20)
        >>> round(float(g.r[0]), 3)  # half a shell of 2 / 20
        0.05
        >>> g.plot()
        <Axes: ...>
    """

    r: np.ndarray
    g: np.ndarray
    error: np.ndarray

    def plot(self, ax: Any = None) -> Any:
        """Draw g with its error band; returns the matplotlib axes."""
        return curve(ax, self.r, self.g, self.error, "r [length]", "g(r)")


def radial_distribution(
    trajectory: Trajectory | ArrayLike,
    *,
    box: boxes.Box | ArrayLike | None = None,
    bins: int = 100,
    r_max: float | None = None,
) -> RadialDistribution:
    """The radial distribution function of all recorded beads, whatever their species.

    Every pair is counted, ``n (n - 1) / 2`` to a frame, and compared with the exact volume of its
    shell: beads thrown at random have g = 1 for any n. The error comes from the scatter of blocks
    of frames (and of replicas): record frames further apart than the structure lives, about one
    time unit.

    Under shear it is the mean over all directions, each frame in its own tilted box; of a run at
    constant pressure each frame is in its own box and compared with its own density.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``, sheared or not; or
            positions (n, 3), (frames, n, 3) or (batch, frames, n, 3) [length], wrapped or not.
        box: a ``Box``, one side or three [length]; only with bare positions.
        bins: shells between 0 and ``r_max``.
        r_max: largest distance [length], by default and at most half the shortest side.

    Raises:
        ValueError: no recorded positions, or means of them, a sheared run without its ``strain``,
            positions that are not finite, no box or two, ``r_max`` above half the shortest side.

    Example:
        >>> g = dpd.measure.radial_distribution(rest, bins=40)
        >>> bool(g.g[0] < 0.5), bool(abs(g.g[-10:].mean() - 1) < 0.1)  # repulsion; no order far off
        (True, True)
        >>> random = np.random.default_rng(0).random((5, 200, 3)) * 4.0
        >>> far = dpd.measure.radial_distribution(random, box=4.0, bins=10).g[2:]
        >>> bool(np.all(abs(far - 1) < 0.2))
        True
    """
    needs.warn_of_ages(trajectory, "g(r)")
    position, lengths, strain = _configurations(trajectory, box)
    edges = distance_edges(lengths, bins, r_max)
    counts = np.stack([count_pairs(*member, edges) for member in zip(lengths, strain, position)])
    volume = np.prod(lengths, axis=-1)
    expected = expected_pairs(edges, position.shape[2], volume.ravel())
    g = counts / expected.reshape(*volume.shape, -1)
    return RadialDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), error_of(g))


def distance_edges(lengths, bins, r_max):
    """Edges (bins + 1,) of shells from 0 to ``r_max``, by default half the shortest side;
    ValueError for more."""
    half = 0.5 * float(np.min(lengths))
    r_max = half if r_max is None else float(r_max)
    if not 0 < r_max <= half * (1 + 1e-6):
        raise ValueError(
            f"r_max is {r_max:.6g}; it must be above zero and at most half the shortest side, "
            f"{half:.6g}"
        )
    return np.linspace(0.0, r_max, whole_bins(bins) + 1)


def whole_bins(bins) -> int:
    """A number of bins; ValueError unless it is whole and at least 1."""
    if int(bins) != bins or bins < 1:
        raise ValueError(f"bins is {bins!r}; it must be a whole number of at least 1")
    return int(bins)


def count_pairs(lengths, strain, position, edges):
    """Ordered pairs in equal shells between ``edges``, (frames, bins), of positions (frames, n, 3)
    in boxes with these ``lengths``, (3,) or (frames, 3), and strains (frames,)."""
    n = position.shape[1]
    size = max(1, min(n, PAIRS_AT_ONCE // n))
    box = boxes.Box(np.broadcast_to(lengths, (len(position), 3)), strain)
    counts = _counts_by_block(box, position, edges[-1], len(edges) - 1, size)
    # Added up on the host: a frame of a large system can have more pairs than 32 bits count.
    return np.sum(np.asarray(counts), axis=1, dtype=float)


def expected_pairs(edges, n: int, volume):
    """Ordered pairs of an ideal gas in shells between ``edges``: (batch, bins) for ``volume``
    (batch,)."""
    shells = 4.0 / 3.0 * np.pi * np.diff(edges**3)
    return n * (n - 1) * shells[None, :] / np.asarray(volume, float)[:, None]


@functools.partial(jax.jit, static_argnames=("bins", "size"))
def _counts_by_block(box, position, r_max, bins: int, size: int):
    """Ordered pairs by frame, block of ``size`` beads and shell, (frames, blocks, bins) int32; the
    box is one of each frame."""
    n = position.shape[1]
    others = jnp.arange(n)[None, :]

    def of_block(box, frame, start):
        beads = (start + jnp.arange(size))[:, None]
        d = boxes.displacement(box, frame[jnp.minimum(beads, n - 1)], frame[None, :, :])
        shell = jnp.sqrt(jnp.sum(d * d, axis=-1)) * (bins / r_max)
        shell = jnp.where((beads < n) & (beads != others), jnp.minimum(shell, bins), bins)
        return jnp.bincount(shell.astype(jnp.int32).ravel(), length=bins + 1)[:bins]

    starts = jnp.arange(0, n, size)
    return jax.lax.map(
        lambda of: jax.lax.map(lambda start: of_block(*of, start), starts), (box, position)
    )


def _configurations(trajectory, box):
    """Positions (batch, frames, n, 3), and the sides (batch, frames, 3) and strains (batch, frames)
    of their boxes."""
    if hasattr(trajectory, "frames"):
        if box is not None:
            raise ValueError("a trajectory knows its box; give box=... only with bare positions")
        position = recorded(trajectory, "position")
        lengths, strain = frame_lengths(trajectory), strains(trajectory)
    else:
        if box is None:
            raise ValueError("positions alone do not tell the box; give box=...")
        position = as_frames(trajectory, "positions")
        box = box if isinstance(box, boxes.Box) else boxes.box(box)
        sides = np.reshape(box.lengths, (-1, 1, 3))
        lengths = np.broadcast_to(sides, (*position.shape[:2], 3))
        strain = np.broadcast_to(np.reshape(box.strain, (-1, 1)), position.shape[:2])
        _warn_of_room(position, lengths)
    if position.shape[2] < 2:
        raise ValueError("one bead has no pairs; at least 2 are needed")
    return position, lengths, strain


def _warn_of_room(position, lengths):
    """Warn where many bare positions leave a good part of every side of the box empty: it may be
    another box."""
    span = np.ptp(position, axis=(0, 1, 2))
    if position.shape[2] >= 100 and np.all(span < EMPTY * lengths.min(axis=(0, 1))):
        warn(
            f"the positions span {np.round(span, 3).tolist()} of a box of "
            f"{np.round(lengths[0, 0], 3).tolist()}, which scales every density and distance: give "
            "the box they are in",
        )
