"""Pair distributions of suspensions: by the surface gap of spheres, and between two species."""

import dataclasses

import numpy as np

from dpdjax.checks import choice
from dpdjax.drawing import curve
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure.blocks import error_of
from dpdjax.measure.molecules import labels_of, shared_rows
from dpdjax.measure.reading import chosen_beads
from dpdjax.measure.results import Result
from dpdjax.measure.spheres import Spheres, as_spheres, by_frame, nearest, of_run
from dpdjax.measure.structure import RadialDistribution, distance_edges, whole_bins

PAIRS_AT_ONCE = 2**14
"""Pairs looked at together: few enough for their separations to stay in the cache."""


@dataclasses.dataclass(frozen=True, repr=False)
class PairDistribution(Result):
    """The pair distribution by surface gap, in shells.

    Attributes:
        h: middle of each shell, (bins,) [length].
        g: pairs over those of an ideal gas, (bins,).
        error: standard error of ``g``, (bins,); NaN where there is a single frame.
    """

    h: np.ndarray
    g: np.ndarray
    error: np.ndarray

    def plot(self, ax=None):
        """Draw g with its error band; returns the matplotlib axes."""
        return curve(ax, self.h, self.g, self.error, "h [length]", "g(h)")


def pair_distribution(
    what: Trajectory | Spheres, *, bins: int = 100, h_max: float | None = None, h_min: float = -0.05
) -> PairDistribution:
    """The pair distribution by surface gap: how many pairs have gap h, over how many an ideal gas
    would have.

    Every pair is compared with the exact volume of its own shell, ``R_i + R_j + h`` from the
    centre, so spheres thrown at random have g = 1 whatever their radii. For equal radii it is g(r)
    at ``r = h + 2 R``. The error comes from the scatter of blocks of frames (and of replicas).

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        bins: shells between ``h_min`` and ``h_max``.
        h_max: largest gap [length]; by default, and at most, that of the largest spheres half the
            shortest side apart.
        h_min: smallest gap [length]; negative, to see overlaps.

    Raises ValueError for a single sphere, ``h_max`` too large for the box, ``h_min`` that is not
    below ``h_max`` or at which the smallest spheres coincide, and as :func:`spheres` does.

    Example:
        >>> found = dpd.measure.pair_distribution(gel, bins=20, h_max=1.0)
        >>> found.g.shape
        (20,)
        >>> round(float(found.h[-1]), 3)
        0.974
    """
    what = as_spheres(what)
    edges, everyone = _gap_edges(what, bins, h_min, h_max), np.arange(what.n)
    counts = by_frame(what, lambda frame: _count(frame, everyone, everyone, edges, frame.radius))
    ideal = np.stack([_ideal_pairs(radius, edges) for radius in what.radius]) / np.prod(
        what.lengths
    )
    g = counts / ideal[:, None, :]
    return PairDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), error_of(g))


def partial_distribution(
    trajectory: Trajectory,
    species_a: int,
    species_b: int,
    *,
    bins: int = 100,
    r_max: float | None = None,
    pairs: str = "all",
) -> RadialDistribution:
    """The radial distribution function between two species, or within one, by the distance of the
    centres.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``; a sheared one with its
            ``strain`` too.
        species_a, species_b: indices of the species, the same one for the pairs within it.
        bins: shells between 0 and ``r_max``.
        r_max: largest distance [length], by default and at most half the shortest side.
        pairs: ``"all"``, or those ``"within"`` molecules or ``"between"`` two, which add up to all:
            each is compared with all pairs of an ideal gas.

    Returns a :class:`RadialDistribution`. Raises ValueError for positions of some beads only, a
    species that is not there or has a single bead, ``r_max`` above half the shortest side, other
    ``pairs``, or no bonds that tell molecules, and as :func:`spheres` does.

    Example:
        >>> within = dpd.measure.partial_distribution(chains, 0, 0, bins=20, pairs="within")
        >>> between = dpd.measure.partial_distribution(chains, 0, 0, bins=20, pairs="between")
        >>> every = dpd.measure.partial_distribution(chains, 0, 0, bins=20)
        >>> np.allclose(within.g + between.g, every.g)
        True
    """
    choice(pairs, ("all", "within", "between"), "pairs")
    a, b = (chosen_beads(trajectory, species) for species in (species_a, species_b))
    same = species_a == species_b
    if same and len(a) < 2:
        raise ValueError(f"one bead of species {species_a} has no pairs; at least 2 are needed")
    what = of_run(trajectory, chosen_beads(trajectory, None), 1.0)
    edges, points = distance_edges(what.lengths, bins, r_max), np.zeros(what.n)
    wanted = None if pairs == "all" else _of_molecules(trajectory, pairs == "within")
    counts = by_frame(what, lambda frame: _count(frame, a, a if same else b, edges, points, wanted))
    number = len(a) * (len(b) - same) / (1 + same)
    g = counts / (number * 4.0 / 3.0 * np.pi * np.diff(edges**3) / np.prod(what.lengths))
    return RadialDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), error_of(g))


def _gap_edges(what, bins, h_min, h_max):
    if what.n < 2:
        raise ValueError("one sphere has no pairs; at least 2 are needed")
    most, least = 0.5 * np.min(what.lengths) - 2 * np.max(what.radius), -2 * np.min(what.radius)
    h_max = most if h_max is None else h_max
    if not h_min >= least:
        raise ValueError(
            f"h_min is {h_min:.6g}; it must be at least {least:.6g}, where the smallest spheres "
            "coincide"
        )
    if not h_min < h_max <= most + 1e-6 * np.min(what.lengths):
        raise ValueError(
            f"h_max is {h_max:.6g}; it must be above h_min, {h_min:.6g}, and at most {most:.6g}, "
            "where the largest spheres are half the shortest side apart"
        )
    return np.linspace(h_min, h_max, whole_bins(bins) + 1)


def _of_molecules(trajectory, within: bool):
    """A function that tells which pairs of rows are of one molecule, or of two."""
    label, ids = labels_of(trajectory.final), np.asarray(trajectory.final.id)
    members = label[ids.reshape(-1, ids.shape[-1])]
    label = shared_rows(members[..., None], "molecules by row")[:, 0]
    return lambda a, b: (label[a][:, None] == label[b][None, :]) == within


def _count(frame, a, b, edges, radius, wanted=None):
    """Pairs of beads ``a`` with beads ``b``, the same or others, in equal shells of the gap,
    (bins,); those that are ``wanted(rows, columns)``."""
    bins, counts = len(edges) - 1, 0
    size = max(1, PAIRS_AT_ONCE // len(b))
    x, width = frame.position.T, (edges[-1] - edges[0]) / bins
    for start in range(0, len(a), size):
        rows, columns = a[start : start + size], b[start:] if a is b else b
        d = nearest(frame, x[:, rows, None] - x[:, None, columns])[0]
        h = np.sqrt(np.sum(d * d, axis=0)) - radius[rows][:, None] - radius[columns][None, :]
        shell = (h - edges[0]) / width
        if wanted is not None:
            shell[~wanted(rows, columns)] = -1.0
        if a is b:
            shell[np.tri(*h.shape, dtype=bool)] = -1.0
        counts = counts + np.bincount(
            shell[(shell >= 0) & (shell < bins)].astype(int), minlength=bins
        )
    return counts


def _ideal_pairs(radius, edges):
    """Pairs of an ideal gas at one sphere set per unit volume in shells of the surface gap,
    (bins,)."""
    half = radius[:, None] + 0.5 * edges[None, :]
    first, second, third = (np.sum(half**k, axis=0) for k in (1, 2, 3))
    # The sum of (half_i + half_j)^3 over i < j.
    return 4.0 / 3.0 * np.pi * np.diff((len(radius) - 4) * third + 3 * first * second)
