"""Structure: the radial distribution function, and what measurements over frames share."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import box as boxes
from dpdjax.measure import needs
from dpdjax.measure.replicas import refuse_scan
from dpdjax.measure.statistics import Estimate

PAIRS_AT_ONCE = 2**20
"""Distances held in memory at a time."""
PIECES = 12
"""Independent pieces an error bar is read off, replicas counted."""


@dataclasses.dataclass(frozen=True)
class RadialDistribution:
    """The radial distribution function, by shells.

    Attributes:
        r: middle of each shell, (bins,) [length].
        g: density around a bead over the mean density, (bins,).
        error: standard error of ``g``, (bins,); NaN where there is a single frame.
    """

    r: np.ndarray
    g: np.ndarray
    error: np.ndarray

    def plot(self, ax=None):
        """Draw g with its error band; returns the matplotlib axes."""
        return draw(ax, self.r, self.g, self.error, "r [length]", "g(r)")


def radial_distribution(trajectory, *, box=None, bins: int = 100, r_max: float | None = None) -> RadialDistribution:
    """The radial distribution function of all recorded beads, whatever their species.

    Every pair is counted, ``n (n - 1) / 2`` to a frame, and compared with the exact volume of its shell:
    beads thrown at random have g = 1 for any n. The error comes from the scatter of blocks of frames (and
    of replicas): record frames further apart than the structure lives, about one time unit.

    Args:
        trajectory: a run recorded with ``observe=dpd.positions``; or positions (n, 3), (frames, n, 3) or
            (batch, frames, n, 3) [length], wrapped or not.
        box: a ``Box``, one side or three [length]; only with bare positions.
        bins: shells between 0 and ``r_max``.
        r_max: largest distance [length], by default and at most half the shortest side.

    Raises:
        ValueError: a sheared run, no recorded positions, positions that are not finite, no box or two,
            ``r_max`` above half the shortest side.
    """
    position, box = _configurations(trajectory, box)
    edges = distance_edges(box.lengths, bins, r_max)
    counts = np.stack([count_pairs(boxes.Box(*b), x, edges) for *b, x in zip(box.lengths, box.strain, position)])
    g = counts / expected_pairs(edges, position.shape[2], np.prod(box.lengths, axis=1))[:, None, :]
    return RadialDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), standard_error(pieces_of(g)))


def distance_edges(lengths, bins, r_max):
    """Edges (bins + 1,) of shells from 0 to ``r_max``, by default half the shortest side; ValueError for more."""
    half = 0.5 * float(np.min(lengths))
    r_max = half if r_max is None else float(r_max)
    if not 0 < r_max <= half * (1 + 1e-6):
        raise ValueError(f"r_max is {r_max:.6g}; it must be above zero and at most half the shortest side, {half:.6g}")
    return np.linspace(0.0, r_max, whole_bins(bins) + 1)


def whole_bins(bins) -> int:
    """A number of bins; ValueError unless it is whole and at least 1."""
    if int(bins) != bins or bins < 1:
        raise ValueError(f"bins is {bins!r}; it must be a whole number of at least 1")
    return int(bins)


def count_pairs(box, position, edges):
    """Ordered pairs in equal shells between ``edges``, (frames, bins), of positions (frames, n, 3)."""
    n = position.shape[1]
    size = max(1, min(n, PAIRS_AT_ONCE // n))
    counts = _counts_by_block(box, position, edges[-1], len(edges) - 1, size)
    # Added up on the host: a frame of a large system can have more pairs than 32 bits count.
    return np.sum(np.asarray(counts), axis=1, dtype=float)


def expected_pairs(edges, n: int, volume):
    """Ordered pairs of an ideal gas in shells between ``edges``: (batch, bins) for ``volume`` (batch,)."""
    shells = 4.0 / 3.0 * np.pi * np.diff(edges**3)
    return n * (n - 1) * shells[None, :] / np.asarray(volume, float)[:, None]


@functools.partial(jax.jit, static_argnames=("bins", "size"))
def _counts_by_block(box, position, r_max, bins: int, size: int):
    """Ordered pairs by frame, block of ``size`` beads and shell, (frames, blocks, bins) int32."""
    n = position.shape[1]
    others = jnp.arange(n)[None, :]

    def of_block(frame, start):
        beads = (start + jnp.arange(size))[:, None]
        d = boxes.displacement(box, frame[jnp.minimum(beads, n - 1)], frame[None, :, :])
        shell = jnp.sqrt(jnp.sum(d * d, axis=-1)) * (bins / r_max)
        shell = jnp.where((beads < n) & (beads != others), jnp.minimum(shell, bins), bins)
        return jnp.bincount(shell.astype(jnp.int32).ravel(), length=bins + 1)[:bins]

    starts = jnp.arange(0, n, size)
    return jax.lax.map(lambda frame: jax.lax.map(lambda start: of_block(frame, start), starts), position)


def _configurations(trajectory, box):
    """Positions (batch, frames, n, 3) and a box with ``lengths`` (batch, 3), ``strain`` (batch,)."""
    if hasattr(trajectory, "frames"):
        if box is not None:
            raise ValueError("a trajectory knows its box; give box=... only with bare positions")
        position, box = recorded(trajectory, "position"), trajectory.final.box
    else:
        if box is None:
            raise ValueError("positions alone do not tell the box; give box=...")
        position = as_frames(trajectory, "positions")
        box = box if isinstance(box, boxes.Box) else boxes.box(box)
    if position.shape[2] < 2:
        raise ValueError("one bead has no pairs; at least 2 are needed")
    batch = position.shape[0]
    lengths = np.broadcast_to(np.reshape(box.lengths, (-1, 3)), (batch, 3))
    return position, boxes.Box(lengths, np.broadcast_to(np.ravel(box.strain), (batch,)))


def recorded(trajectory, name: str, *, sheared: bool = False, observe: str = "dpd.positions", components: int = 3) -> np.ndarray:
    """A vector of every bead that was recorded, (batch, frames, beads, 3); the batch is 1 where there is none.

    ``observe``: what records it, for the message; ``components``: of the vector.

    Raises ValueError where the run did not record ``name``, failed, scans over numbers, or was sheared, unless such a one will do.
    """
    needs.finished(trajectory)
    if not sheared and np.any(np.asarray(trajectory.flow.rate) != 0):
        raise ValueError("the run was sheared: its box changes from frame to frame; measure this without shear")
    if name not in trajectory.frames:
        raise ValueError(f"the run recorded no {name!r} but {', '.join(trajectory.frames)}; use observe={observe}")
    refuse_scan(trajectory)
    values = _followed(trajectory) if name == "unwrapped" and "image" in trajectory.frames else trajectory.frames[name]
    return as_frames(values, name, components)


def _followed(trajectory) -> np.ndarray:
    """Positions followed through the images since the first frame, (..., frames, n, 3), in double precision."""
    position, image, strain = (np.asarray(trajectory.frames[name]) for name in ("position", "image", "strain"))
    turns = (image - image[..., :1, :, :]).astype(float)
    lengths = np.asarray(trajectory.final.box.lengths, float)[..., None, None, :]
    moved = position + turns * lengths
    moved[..., 0] += strain[..., None] * lengths[..., 1] * turns[..., 1]
    return moved


def as_frames(values, name: str, components: int = 3) -> np.ndarray:
    """(n, 3), (frames, n, 3) or (..., frames, n, 3) as (batch, frames, n, 3), 3 the components; ValueError unless finite."""
    values = np.asarray(values)
    if values.ndim < 2 or values.shape[-1] != components or values.size == 0:
        wanted = f"(n, {components}), (frames, n, {components}) or (batch, frames, n, {components})"
        raise ValueError(f"{name} has shape {values.shape}; {wanted} is wanted")
    if not np.all(np.isfinite(values)):
        raise ValueError(f"{name} holds NaN or infinity: the run failed, see trajectory.final.status")
    values = values[None] if values.ndim == 2 else values
    return values.reshape(-1, *values.shape[-3:])


def species_of(trajectory) -> np.ndarray:
    """The species of each bead (n,), the same in every member of a batch."""
    species = np.asarray(trajectory.final.species)
    return species.reshape(-1, species.shape[-1])[0]


def chosen_beads(trajectory, species: int | None) -> np.ndarray:
    """Indices of the beads of one species, or of all; ValueError where there is none."""
    of_bead = species_of(trajectory)
    if species is not None and species not in of_bead:
        raise ValueError(f"no bead is of species {species}; there are {', '.join(map(str, np.unique(of_bead)))}")
    return np.flatnonzero(of_bead == species) if species is not None else np.arange(len(of_bead))


def of_beads(values, trajectory, beads) -> np.ndarray:
    """Recorded values (batch, frames, n, 3) of some beads, which may be the only ones recorded; else ValueError."""
    there, everything = values.shape[2], len(species_of(trajectory))
    if there not in (everything, len(beads)):
        raise ValueError(
            f"the run recorded {there} of its {everything} beads, not the {len(beads)} to be measured; "
            "name their species, or use observe=dpd.positions"
        )
    return values[:, :, beads] if there == everything else values


def average(series) -> Estimate:
    """Mean of values (batch, frames), its error over blocks of frames; NaN for a single one."""
    pieces = pieces_of(series)
    return Estimate(float(np.mean(series)), float(standard_error(pieces)), len(pieces))


def pieces_of(values) -> np.ndarray:
    """Means over blocks of frames, (pieces, ...), of values (batch, frames, ...)."""
    batch, frames = values.shape[:2]
    each = min(frames, -(-PIECES // batch))
    length = frames // each
    blocks = values[:, : each * length].reshape(batch, each, length, *values.shape[2:])
    return blocks.mean(axis=2).reshape(-1, *values.shape[2:])


def pieces_of_member(batch: int, frames: int, longest: int) -> int:
    """Into how many pieces to cut each member, each twice as long as the longest lag."""
    return max(1, min(-(-PIECES // batch), frames // (2 * max(1, longest))))


def standard_error(pieces) -> np.ndarray:
    """Standard error of the mean over the first axis; NaN for a single piece."""
    count = len(pieces)
    if count < 2:
        return np.full(pieces.shape[1:], np.nan)
    return pieces.std(axis=0, ddof=1) / np.sqrt(count)


def draw(ax, x, y, error, xlabel: str, ylabel: str):
    """A line in a band of one standard error; returns the matplotlib axes, new ones for None."""
    ax = _new_axes() if ax is None else ax
    (line,) = ax.plot(x, y)
    ax.fill_between(x, y - error, y + error, color=line.get_color(), alpha=0.3, linewidth=0)
    ax.set(xlabel=xlabel, ylabel=ylabel)
    return ax


def _new_axes():
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ImportError("drawing needs matplotlib: pip install 'dpdjax[plot]'") from error
    return plt.subplots()[1]
