"""Clusters: spheres joined by contacts, how large they are and whether they percolate."""

import dataclasses

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from dpdjax.drawing import curve, time_scale
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure.blocks import average, error_of, standard_error
from dpdjax.measure.contacts import spheres_and_gap
from dpdjax.measure.results import Result
from dpdjax.measure.spheres import Spheres, by_frame, close_pairs, nearest
from dpdjax.measure.statistics import Estimate


@dataclasses.dataclass(frozen=True, repr=False)
class Clusters(Result):
    """Spheres joined by contacts, frame by frame; a sphere without contacts is a cluster of one.

    Attributes:
        time: of each frame, (frames,) [time].
        largest: spheres in the largest cluster, (batch, frames).
        number: clusters, (batch, frames).
        mean_size: size of the cluster of a sphere, averaged over spheres, (batch, frames).
        percolates: whether a cluster is joined to an image of itself along x, y, z, (batch, frames,
            3) bool.
        percolation: share of the frames that percolate along x, y, z, (3,).
        error: standard error of ``percolation``, (3,); NaN where there is a single frame.
    """

    time: np.ndarray
    largest: np.ndarray
    number: np.ndarray
    mean_size: np.ndarray
    percolates: np.ndarray
    percolation: np.ndarray
    error: np.ndarray

    def average(self, name: str) -> Estimate:
        """Mean over frames of ``"largest"``, ``"number"`` or ``"mean_size"``; ValueError for
        another name."""
        if name not in ("largest", "number", "mean_size"):
            raise ValueError(f"name is {name!r}; it is largest, number or mean_size")
        return average(getattr(self, name))

    def plot(self, ax=None):
        """Draw the largest cluster against time, with the error over replicas; returns the
        matplotlib axes."""
        mean, error = self.largest.mean(axis=0), standard_error(self.largest)
        ax = curve(ax, self.time, mean, error, "t [time]", "largest cluster")
        ax.set_xscale(time_scale(self.time))
        return ax


def clusters(what: Trajectory | Spheres, *, gap: float | None = None) -> Clusters:
    """Clusters of spheres joined by gaps below ``gap``, and whether they percolate.

    A cluster percolates where a way along its contacts leads from a sphere to an image of the same
    sphere. Along which directions is counted in vectors of the lattice, ``Lx e_x``,
    ``strain Ly e_x + Ly e_y`` and ``Lz e_z``, the strain folded so that ``strain Ly`` is within
    half a side: in a tilted box a way up by Ly goes along x too where it ends more than half a side
    off.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap [length], as in :func:`contact_number`.

    Raises ValueError as :func:`contact_number` does.

    Example:
        >>> found = dpd.measure.clusters(gel, gap=0.2)
        >>> found.largest.shape, found.percolation.shape
        ((1, 24), (3,))
        >>> found.plot()
        <Axes: ...>
    """
    what, gap = spheres_and_gap(what, gap)
    values = by_frame(what, lambda frame: _cluster_numbers(frame, gap))
    largest, number = (values[..., k].astype(int) for k in (0, 1))
    percolates = values[..., 3:] > 0
    error = error_of(percolates)
    return Clusters(
        what.time, largest, number, values[..., 2], percolates, percolates.mean((0, 1)), error
    )


def cluster_of_each(what: Trajectory | Spheres, *, gap: float | None = None) -> np.ndarray:
    """The number of the cluster that each sphere is in, (batch, frames, n) int, from 0 for the
    largest of a frame.

    Arguments and errors as in :func:`clusters`.

    Example:
        >>> number = dpd.measure.cluster_of_each(gel, gap=0.2)
        >>> members = np.sum(number[0, -1] == 0)
        >>> bool(members == dpd.measure.clusters(gel, gap=0.2).largest[0, -1])
        True
    """
    what, gap = spheres_and_gap(what, gap)
    return by_frame(what, lambda frame: _by_size(_labels(frame, close_pairs(frame, gap))))


def _by_size(label):
    """Labels (n,) numbered by the size of what has them, the largest first."""
    rank = np.argsort(np.argsort(-np.bincount(label), kind="stable"))
    return rank[label]


def _labels(frame, pairs):
    """The cluster of each sphere, (n,)."""
    graph = _graph(len(frame.position), pairs.first, pairs.second)
    return connected_components(graph, directed=False)[1]


def _cluster_numbers(frame, gap):
    """Largest cluster, number of clusters, mean size over spheres, percolation along x, y, z:
    (6,)."""
    n, pairs = len(frame.position), close_pairs(frame, gap)
    label = _labels(frame, pairs)
    sizes = np.bincount(label)
    return np.array(
        [sizes.max(), len(sizes), np.sum(sizes**2) / n, *_winds(frame, pairs, label)], float
    )


def _graph(n: int, first, second):
    return coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n)).tocsr()


def _winds(frame, pairs, label):
    """Whether some way along the pairs leads to an image of its start, along each lattice vector,
    (3,) bool."""
    x = frame.position.T
    step = lambda a, b: -nearest(frame, x[:, b] - x[:, a])[1]
    parent = _parents(pairs, label)
    # The cell of each sphere once its cluster is laid out along a tree; each round doubles the
    # stretch of the way to the root that is added up.
    cell = step(parent, np.arange(len(label)))
    for _ in range(len(label).bit_length()):
        cell, parent = cell + cell[:, parent], parent[parent]
    # Each pair closes a way through the tree; it winds unless it ends in the cell the tree says.
    return np.any(
        cell[:, pairs.first] + step(pairs.first, pairs.second) != cell[:, pairs.second], axis=1
    )


def _parents(pairs, label):
    """Of each sphere the one before it in a tree of its cluster, (n,); the root of a tree is its
    own."""
    n, heads = len(label), np.unique(label, return_index=True)[1]
    # One more node, joined to a sphere of each cluster, makes all trees one.
    first, second = np.append(pairs.first, heads), np.append(pairs.second, np.full(len(heads), n))
    parent = breadth_first_order(_graph(n + 1, first, second), n, directed=False)[1][:n]
    return np.where(parent == n, np.arange(n), parent)
