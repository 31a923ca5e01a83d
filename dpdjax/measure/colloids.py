"""Suspensions of spheres: pairs by surface gap, contacts, bonds, clusters, the structure factor.

The surface gap of two spheres is ``h = r - R_i - R_j``. Every box may be tilted, each frame by its own strain.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components
from scipy.spatial import cKDTree

from dpdjax.checks import positive
from dpdjax.measure.statistics import Estimate
from dpdjax.measure.structure import PIECES, RadialDistribution, as_frames, draw, pieces_of, standard_error
from dpdjax.measure.transport import _chosen

PAIRS_AT_ONCE = 2**16
"""Pairs looked at together: few enough for their separations to stay in the cache."""
SURVIVAL_PIECES = 4
"""Independent pieces that the lags of the survival of bonds leave unless told otherwise, replicas counted."""
KAPPA_GAP = 3.0
"""Spheres closer than this over ``kappa`` are in contact unless told otherwise: a Morse attraction is at a tenth there."""


@dataclasses.dataclass(frozen=True)
class Spheres:
    """Frames of a suspension, as all measures of this module take them.

    Made from a run by :func:`spheres`, or from arrays; missing axes in front are added.

    Attributes:
        position: (batch, frames, n, 3), wrapped or not [length].
        radius: of each bead, (n,), or (batch, n) where the members differ [length].
        lengths: sides of the box, (3,) [length].
        strain: tilt of the box in each frame, (batch, frames), by default none.
        time: of each frame, (frames,), by default their number [time].

    Raises ValueError for shapes that do not fit, positions that are not finite, radii or sides not above zero.
    """

    position: np.ndarray
    radius: np.ndarray
    lengths: np.ndarray
    strain: np.ndarray = 0.0
    time: np.ndarray | None = None

    def __post_init__(self):
        position = as_frames(self.position, "position")
        batch, frames, n = position.shape[:3]
        time = np.arange(frames) if self.time is None else self.time
        keep = lambda name, value: object.__setattr__(self, name, value)
        keep("position", position)
        keep("radius", _same_or_each(_fitted(_above_zero(self.radius, "radius"), (batch, n), "radius")))
        keep("lengths", _fitted(_above_zero(self.lengths, "lengths"), (3,), "lengths"))
        keep("strain", _fitted(self.strain, (batch, frames), "strain"))
        keep("time", _fitted(time, (frames,), "time"))

    @property
    def n(self) -> int:
        """Spheres in a frame."""
        return self.position.shape[2]


@dataclasses.dataclass(frozen=True)
class PairDistribution:
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
        return draw(ax, self.h, self.g, self.error, "h [length]", "g(h)")


@dataclasses.dataclass(frozen=True)
class ContactNumber:
    """How many others each sphere is in contact with.

    Attributes:
        mean: contacts of a sphere, over spheres and frames.
        z: numbers of contacts, 0 to the largest, (z,).
        share: of the spheres that have ``z`` contacts, (z,).
        error: standard error of ``share``, (z,); NaN where there is a single frame.
        time: of each frame, (frames,) [time].
        series: contacts of a sphere in each frame, (batch, frames).
        gap: surface gap below which two spheres are in contact [length].
    """

    mean: Estimate
    z: np.ndarray
    share: np.ndarray
    error: np.ndarray
    time: np.ndarray
    series: np.ndarray
    gap: float

    def plot(self, ax=None):
        """Draw the shares with their error band; returns the matplotlib axes."""
        return draw(ax, self.z, self.share, self.error, "contacts z", "P(z)")


@dataclasses.dataclass(frozen=True)
class StructureFactor:
    """The structure factor, by shells that hold a wave vector.

    Attributes:
        q: mean length of the wave vectors in each shell, (shells,) [1 / length].
        s: mean of S over them, (shells,).
        error: standard error of ``s``, (shells,); NaN where there is a single frame.
        vectors: wave vectors in each shell, both of each opposite two counted, (shells,).
    """

    q: np.ndarray
    s: np.ndarray
    error: np.ndarray
    vectors: np.ndarray

    def plot(self, ax=None):
        """Draw S with its error band; returns the matplotlib axes."""
        return draw(ax, self.q, self.s, self.error, "q [1 / length]", "S(q)")


@dataclasses.dataclass(frozen=True)
class Bonds:
    """Bonds that form closer than they break.

    Attributes:
        time: of each frame, (frames,) [time].
        number: bonds in each frame, (batch, frames).
        formed, broken: since the frame before, 0 in the first, (batch, frames).
        per_colloid: bonds that a sphere has, over spheres and frames; each bond counts for both of its ends.
        lag: times from 0, (lags,) [time].
        survival: share of the bonds of a frame that were there without a break up to ``lag`` later, (lags,);
            NaN where there was no bond.
        error: standard error of ``survival``, (lags,); NaN where there is a single piece.
    """

    time: np.ndarray
    number: np.ndarray
    formed: np.ndarray
    broken: np.ndarray
    per_colloid: Estimate
    lag: np.ndarray
    survival: np.ndarray
    error: np.ndarray

    def plot(self, ax=None):
        """Draw the survival with its error band; returns the matplotlib axes."""
        return draw(ax, self.lag, self.survival, self.error, "t [time]", "share of bonds that survive")


@dataclasses.dataclass(frozen=True)
class Clusters:
    """Spheres joined by contacts, frame by frame; a sphere without contacts is a cluster of one.

    Attributes:
        time: of each frame, (frames,) [time].
        largest: spheres in the largest cluster, (batch, frames).
        number: clusters, (batch, frames).
        mean_size: size of the cluster of a sphere, averaged over spheres, (batch, frames).
        percolates: whether a cluster is joined to an image of itself along x, y, z, (batch, frames, 3) bool.
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
        """Mean over frames of ``"largest"``, ``"number"`` or ``"mean_size"``; ValueError for another name."""
        if name not in ("largest", "number", "mean_size"):
            raise ValueError(f"name is {name!r}; it is largest, number or mean_size")
        return _average(getattr(self, name))

    def plot(self, ax=None):
        """Draw the largest cluster against time, with the error over replicas; returns the matplotlib axes."""
        return draw(ax, self.time, self.largest.mean(axis=0), standard_error(self.largest), "t [time]", "largest cluster")


def spheres(trajectory, *, species: int = 1) -> Spheres:
    """The spheres of one species of a run, with the radius ``fluid.radius[species]`` times each bead's size.

    Args:
        trajectory: a run recorded with ``observe=dpd.positions``, or with an observable whose ``position`` holds
            this species only; a sheared one with its ``strain`` too.
        species: index of the species.

    Raises:
        ValueError: no recorded positions, or of other beads; a sheared run without ``strain``; a species that
            is not there or has no radius; members of a batch in different boxes or at different times.
    """
    position, lengths, strain, time = _recorded(trajectory)
    beads = _chosen(trajectory, species)
    radius = trajectory.fluid.radius[species]
    if radius is None:
        raise ValueError(f"species {species} has no radius, its beads are points; name another: spheres(trajectory, species=...)")
    sizes = np.asarray(trajectory.final.size, float)
    sizes = sizes.reshape(-1, sizes.shape[-1])[:, beads]
    return Spheres(_of_beads(position, trajectory, beads), np.reshape(radius, (-1, 1)) * sizes, lengths, strain, time)


def pair_distribution(what, *, bins: int = 100, h_max: float | None = None, h_min: float = -0.05) -> PairDistribution:
    """The pair distribution by surface gap: how many pairs have gap h, over how many an ideal gas would have.

    Every pair is compared with the exact volume of its own shell, ``R_i + R_j + h`` from the centre, so spheres
    thrown at random have g = 1 whatever their radii. For equal radii it is g(r) at ``r = h + 2 R``. The error
    comes from the scatter of blocks of frames (and of replicas).

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        bins: shells between ``h_min`` and ``h_max``.
        h_max: largest gap [length]; by default, and at most, that of the largest spheres half the shortest side apart.
        h_min: smallest gap [length]; negative, to see overlaps.

    Raises ValueError for a single sphere, ``h_max`` too large for the box, ``h_min`` that is not below ``h_max``
    or at which the smallest spheres coincide, and as :func:`spheres` does.
    """
    what = _as_spheres(what)
    edges = _gap_edges(what, bins, h_min, h_max)
    volume = np.prod(what.lengths)
    ideal = [_ideal_pairs(radius, edges) / volume for radius in _radii(what)]
    counts = _by_frame(what, lambda frame: _count_gaps(frame, edges))
    g = counts / np.stack(ideal)[:, None, :]
    return PairDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), standard_error(pieces_of(g)))


def partial_distribution(
    trajectory, species_a: int, species_b: int, *, bins: int = 100, r_max: float | None = None
) -> RadialDistribution:
    """The radial distribution function between two species, or within one, by the distance of the centres.

    Normalised so that beads thrown at random have g = 1 for any numbers of them.

    Args:
        trajectory: a run recorded with ``observe=dpd.positions``; a sheared one with its ``strain`` too.
        species_a, species_b: indices of the species, the same one for the pairs within it.
        bins: shells between 0 and ``r_max``.
        r_max: largest distance [length], by default and at most half the shortest side.

    Returns a :class:`RadialDistribution`. Raises ValueError for positions of some beads only, a species that is
    not there or has a single bead, ``r_max`` above half the shortest side, and as :func:`spheres` does.
    """
    position, lengths, strain, _ = _recorded(trajectory)
    groups = [_chosen(trajectory, species) for species in (species_a, species_b)]
    _check_all_beads(position, trajectory)
    same = species_a == species_b
    if same and len(groups[0]) < 2:
        raise ValueError(f"one bead of species {species_a} has no pairs; at least 2 are needed")
    edges = _distance_edges(lengths, bins, r_max)
    # Points: the gap of two beads without radii is their distance.
    what = Spheres(position, np.ones(position.shape[2]), lengths, strain)
    counts = _by_frame(what, lambda frame: _count_between(frame, groups[0], None if same else groups[1], edges))
    pairs = len(groups[0]) * (len(groups[1]) - same) / (1 + same)
    g = counts / (pairs * 4.0 / 3.0 * np.pi * np.diff(edges**3) / np.prod(lengths))[None, None, :]
    return RadialDistribution(0.5 * (edges[1:] + edges[:-1]), g.mean((0, 1)), standard_error(pieces_of(g)))


def contact_number(what, *, gap: float | None = None) -> ContactNumber:
    """The number of others closer than ``gap``, its distribution, and its mean in each frame.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap below which two spheres are in contact [length]; 3 / kappa for a run whose fluid has a
            ``kappa``.

    Raises ValueError for a gap that is missing, not above zero or too large for the box (``2 R + gap`` above half
    the shortest side), and as :func:`spheres` does.
    """
    gap, what = _checked_gap(what, gap)
    contacts = _by_frame(what, lambda frame: _contacts_of_each(what.n, _close_pairs(frame, gap)))
    z = np.arange(contacts.max() + 1)
    shares = np.mean(contacts[..., None, :] == z[:, None], axis=-1)
    series = contacts.mean(axis=-1)
    error = standard_error(pieces_of(shares))
    return ContactNumber(_average(series), z, shares.mean((0, 1)), error, what.time, series, gap)


def structure_factor(what, *, q_max: float | None = None, bins: int = 60) -> StructureFactor:
    """The structure factor ``S(q) = |sum exp(-i q . r)|^2 / n``, at the wave vectors ``2 pi m / L`` of the box.

    All spheres count alike, whatever their radii. Averages run over the wave vectors of a shell and over frames;
    shells without any are left out.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        q_max: largest wave vector [1 / length], by default 2 pi over the mean radius. The work grows as its cube.
        bins: shells of equal width between 0 and ``q_max``.

    Raises ValueError for tilted frames, ``q_max`` below the smallest wave vector, and as :func:`spheres` does.
    """
    what = _as_spheres(what)
    if np.any(_shift(what.strain, what.lengths) != 0):
        raise ValueError("the box is tilted and its wave vectors change from frame to frame; measure this without shear")
    q_max = 2 * np.pi / np.mean(what.radius) if q_max is None else float(q_max)
    lowest = 2 * np.pi / np.max(what.lengths)
    if not q_max >= lowest * (1 - 1e-9):
        raise ValueError(f"q_max is {q_max:.6g}; it must reach the smallest wave vector of the box, {lowest:.6g}")
    bins = _checked_bins(bins)
    planes = _wave_planes(what.lengths, q_max, bins)
    vectors = sum(np.bincount(p.shell.ravel(), minlength=bins + 1)[:bins] for p in planes)
    full = vectors > 0
    q = sum(np.bincount(p.shell.ravel(), p.q.ravel(), bins + 1)[:bins] for p in planes)[full] / vectors[full]
    s = _by_frame(what, lambda frame: _spectrum(frame, planes, bins)[full] / vectors[full])
    return StructureFactor(q, s.mean((0, 1)), standard_error(pieces_of(s)), 2 * vectors[full])


def bonds(
    what, *, gap: float | None = None, forms: float = 0.8, breaks: float = 1.0, t_max: float | None = None
) -> Bonds:
    """Bonds with hysteresis: one forms at ``h < forms gap`` and breaks at ``h > breaks gap``.

    The band between keeps a pair that trembles at the limit from counting as many bonds. In the first frame the
    pairs below ``forms gap`` are bonded. What happens between two frames goes unseen: record them closer than
    bonds live.

    Survival looks at the bonds of every frame that the longest lag still finds an end for. Its error comes from
    replicas, and stretches of time at least twice the longest lag.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap [length], as in :func:`contact_number`.
        forms, breaks: fractions of the gap, ``0 < forms <= breaks``.
        t_max: longest lag of the survival [time]; by default as long as leaves 4 independent pieces.

    Raises ValueError for fractions out of order, a ``t_max`` outside the run, and as :func:`contact_number` does.
    """
    gap, what = _checked_bonds(what, gap, forms, breaks)
    # Entry [member, a, b]: bonds that were there from frame a or before to frame b or after.
    lasting = np.stack([_lasting(keys) for keys in _bond_keys(what, gap, forms, breaks)])
    number = np.einsum("baa->ba", lasting)
    kept = np.einsum("baa->ba", lasting[:, :-1, 1:])
    none = np.zeros((len(lasting), 1), int)
    formed = np.concatenate([none, number[:, 1:] - kept], axis=1)
    broken = np.concatenate([none, number[:, :-1] - kept], axis=1)
    lag, survival, error = _survival(what.time, lasting, t_max)
    return Bonds(what.time, number, formed, broken, _average(2 * number / what.n), lag, survival, error)


def bonded_pairs(what, *, gap: float | None = None, forms: float = 0.8, breaks: float = 1.0) -> list[list[np.ndarray]]:
    """The bonds of :func:`bonds` as pairs of indices ``i < j``, (bonds, 2), by member and frame: ``pairs[member][frame]``.

    Arguments and errors as in :func:`bonds`.
    """
    gap, what = _checked_bonds(what, gap, forms, breaks)
    members = _bond_keys(what, gap, forms, breaks)
    return [[np.stack(np.divmod(keys, what.n), axis=1) for keys in frames] for frames in members]


def clusters(what, *, gap: float | None = None) -> Clusters:
    """Clusters of spheres joined by gaps below ``gap``, and whether they percolate.

    A cluster percolates where a way along its contacts leads from a sphere to an image of the same sphere. Along
    which directions is counted in vectors of the lattice, ``Lx e_x``, ``strain Ly e_x + Ly e_y`` and ``Lz e_z``,
    the strain folded so that ``strain Ly`` is within half a side: in a tilted box a way up by Ly goes along x too
    where it ends more than half a side off.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap [length], as in :func:`contact_number`.

    Raises ValueError as :func:`contact_number` does.
    """
    gap, what = _checked_gap(what, gap)
    values = _by_frame(what, lambda frame: _cluster_numbers(what.n, _close_pairs(frame, gap)))
    percolates = values[..., 3:] > 0
    largest, number = (values[..., k].astype(int) for k in (0, 1))
    percolation = percolates.mean((0, 1)), standard_error(pieces_of(percolates))
    return Clusters(what.time, largest, number, values[..., 2], percolates, *percolation)


# Reading and checking.


def _as_spheres(what) -> Spheres:
    return what if isinstance(what, Spheres) else spheres(what)


def _recorded(trajectory):
    """Positions (batch, frames, beads, 3), sides (3,), strains that broadcast to (batch, frames), times (frames,)."""
    if "position" not in trajectory.frames:
        raise ValueError(f"the run recorded no 'position' but {', '.join(trajectory.frames)}; use observe=dpd.positions")
    position = as_frames(trajectory.frames["position"], "position")
    lengths = _common(trajectory.final.box.lengths, 1, "in different boxes")
    time = _common(trajectory.frames["time"], 1, "recorded at different times")
    return position, lengths, _strains(trajectory), time


def _strains(trajectory):
    """The strain of each frame, or of all: (batch, frames) or (batch, 1)."""
    if "strain" in trajectory.frames:
        return np.atleast_2d(np.asarray(trajectory.frames["strain"], float))
    if np.any(np.asarray(trajectory.flow.rate) != 0):
        raise ValueError(
            "the run was sheared and recorded no 'strain', so the box of each frame is unknown; "
            "record it too: observe=[dpd.positions, lambda fluid, state: {'strain': state.box.strain}]"
        )
    return np.reshape(np.asarray(trajectory.final.box.strain, float), (-1, 1))


def _common(values, axes: int, what: str):
    """The values of the first member; ValueError unless all members have the same."""
    values = np.asarray(values, float)
    members = values.reshape(-1, *values.shape[values.ndim - axes :])
    if not np.allclose(members, members[:1], rtol=1e-6, atol=0):
        raise ValueError(f"members of the batch are {what}; measure them one by one: trajectory.members()")
    return members[0]


def _of_beads(position, trajectory, beads):
    """Positions of some beads, which may be the only ones recorded."""
    recorded, everything = position.shape[2], np.shape(trajectory.final.species)[-1]
    if recorded == everything:
        return position[:, :, beads]
    if recorded == len(beads):
        return position
    raise ValueError(
        f"the run recorded positions of {recorded} beads, neither all {everything} nor the {len(beads)} of this species; "
        "use observe=dpd.positions"
    )


def _check_all_beads(position, trajectory):
    everything = np.shape(trajectory.final.species)[-1]
    if position.shape[2] != everything:
        raise ValueError(
            f"the run recorded positions of {position.shape[2]} of its {everything} beads; use observe=dpd.positions"
        )


def _fitted(values, shape, name: str) -> np.ndarray:
    """``values`` broadcast to ``shape``, finite floats; ValueError where they do not fit."""
    values = np.asarray(values, float)
    try:
        fitted = np.broadcast_to(values, shape)
    except ValueError:
        raise ValueError(f"{name} has shape {values.shape}; {shape} is wanted, as the positions have it") from None
    if not np.all(np.isfinite(fitted)):
        raise ValueError(f"{name} holds NaN or infinity; finite numbers are wanted")
    return fitted


def _above_zero(values, name: str):
    positive(values, name)
    return values


def _same_or_each(radius):
    """Radii (batch, n) as (n,) where all members have the same."""
    return radius[0] if np.all(radius == radius[:1]) else radius


def _checked_bins(bins) -> int:
    if int(bins) != bins or bins < 1:
        raise ValueError(f"bins is {bins!r}; it must be a whole number of at least 1")
    return int(bins)


def _distance_edges(lengths, bins, r_max):
    half = 0.5 * float(np.min(lengths))
    r_max = half if r_max is None else float(r_max)
    if not 0 < r_max <= half * (1 + 1e-6):
        raise ValueError(f"r_max is {r_max:.6g}; it must be above zero and at most half the shortest side, {half:.6g}")
    return np.linspace(0.0, r_max, _checked_bins(bins) + 1)


def _gap_edges(what, bins, h_min, h_max):
    if what.n < 2:
        raise ValueError("one sphere has no pairs; at least 2 are needed")
    most = 0.5 * np.min(what.lengths) - 2 * np.max(what.radius)
    h_max, h_min = most if h_max is None else float(h_max), float(h_min)
    least = -2 * np.min(what.radius)
    if not h_min >= least:
        raise ValueError(f"h_min is {h_min:.6g}; it must be at least {least:.6g}, where the smallest spheres coincide")
    if not h_min < h_max <= most + 1e-6 * np.min(what.lengths):
        raise ValueError(
            f"h_max is {h_max:.6g}; it must be above h_min, {h_min:.6g}, and at most {most:.6g}, where the largest "
            "spheres are half the shortest side apart"
        )
    return np.linspace(h_min, h_max, _checked_bins(bins) + 1)


def _checked_gap(what, gap):
    """The gap as a number, and the spheres."""
    if gap is None:
        gap = _gap_of_range(what)
    positive(gap, "gap")
    gap, what = float(gap), _as_spheres(what)
    reach, half = 2 * np.max(what.radius) + gap, 0.5 * np.min(what.lengths)
    if reach > half:
        raise ValueError(
            f"gap is {gap:.6g}: the largest spheres would touch {reach:.6g} apart, above half the shortest side, {half:.6g}; "
            "take a smaller gap or a larger box"
        )
    return gap, what


def _gap_of_range(what) -> float:
    """3 / kappa of the fluid of a run."""
    try:
        kappa = np.unique(np.asarray(what.fluid.value("kappa"), float))
    except (AttributeError, TypeError):
        kappa = np.array([])
    if kappa.size != 1:
        raise ValueError("no gap is given, and no fluid with one kappa tells it; give gap=... [length]")
    positive(kappa, "kappa")
    return KAPPA_GAP / float(kappa[0])


def _checked_bonds(what, gap, forms, breaks):
    if not 0 < forms <= breaks < np.inf:
        raise ValueError(f"forms is {forms!r} and breaks {breaks!r}; they are fractions of the gap, 0 < forms <= breaks")
    gap, what = _checked_gap(what, gap)
    _checked_gap(what, breaks * gap)
    return gap, what


# Frames and pairs.


class _Frame(NamedTuple):
    """One configuration: positions (n, 3) in the box, radii (n,), sides (3,), and how far the upper y-image is shifted."""

    position: np.ndarray
    radius: np.ndarray
    lengths: np.ndarray
    shift: float


class _Pairs(NamedTuple):
    """Close pairs: beads ``first < second`` (m,), surface gap (m,), and the image of the second, in lattice vectors (m, 3)."""

    first: np.ndarray
    second: np.ndarray
    gap: np.ndarray
    image: np.ndarray


def _radii(what):
    return np.broadcast_to(what.radius, (len(what.position), what.n))


def _frames(what):
    """Every frame, member by member."""
    for position, radius, strain in zip(what.position, _radii(what), what.strain):
        for x, tilt in zip(position, strain):
            yield _frame(x, radius, what.lengths, tilt)


def _frame(position, radius, lengths, strain) -> _Frame:
    lx, ly, lz = lengths
    shift = float(_shift(strain, lengths))
    x, y, z = np.asarray(position, float).T
    rows = np.floor(y / ly)
    x = x - rows * shift
    wrapped = np.stack([x - lx * np.floor(x / lx), y - ly * rows, z - lz * np.floor(z / lz)], axis=1)
    return _Frame(wrapped, radius, lengths, shift)


def _shift(strain, lengths):
    """How far the upper y-image is shifted along x, within half a side of zero."""
    shift = strain * lengths[1]
    return shift - lengths[0] * np.round(shift / lengths[0])


def _by_frame(what, measure) -> np.ndarray:
    """``measure(frame)`` of every frame, (batch, frames, ...)."""
    values = np.stack([measure(frame) for frame in _frames(what)])
    return values.reshape(*what.strain.shape, *values.shape[1:])


def _close_pairs(frame, gap) -> _Pairs:
    """Pairs with a surface gap below ``gap``; right where they are within half the shortest side."""
    n, reach = len(frame.position), 2 * np.max(frame.radius) + gap
    points, owner, image = _with_images(frame, reach)
    first, copy = cKDTree(points).query_pairs(reach, output_type="ndarray").T
    # The beads themselves come first. A pair across a face is found from either side: keep one.
    once = (first < n) & (first < owner[copy])
    first, copy = first[once], copy[once]
    second = owner[copy]
    r = np.sqrt(np.sum((points[copy] - points[first]) ** 2, axis=1))
    h = r - frame.radius[first] - frame.radius[second]
    near = h < gap
    return _Pairs(*(values[near] for values in (first, second, h, image[copy])))


def _with_images(frame, reach):
    """The beads, then their images within ``reach`` of the box: positions, whose they are, and lattice vectors away."""
    n, lx = len(frame.position), frame.lengths[0]
    points, owner, image = frame.position, np.arange(n), np.zeros((n, 3), int)
    # Up and down first: what is shifted along x is wrapped before its images along x are made.
    for axis in (1, 2, 0):
        step = np.zeros(3)
        step[axis] = frame.lengths[axis]
        step[0] += frame.shift if axis == 1 else 0.0
        new = [(points[:, axis] < reach, 1), (points[:, axis] >= frame.lengths[axis] - reach, -1)]
        copies = np.concatenate([points[near] + sign * step for near, sign in new])
        images = np.concatenate([image[near] + sign * np.eye(3, dtype=int)[axis] for near, sign in new])
        if axis == 1:
            columns = np.floor(copies[:, 0] / lx)
            copies[:, 0] -= lx * columns
            images[:, 0] -= columns.astype(int)
        owner = np.concatenate([owner, *(owner[near] for near, _ in new)])
        points, image = np.concatenate([points, copies]), np.concatenate([image, images])
    return points, owner, image


def _count_gaps(frame, edges):
    """Pairs in equal shells of the surface gap, (bins,)."""
    reach = 2 * np.max(frame.radius) + edges[-1]
    # Searching is quicker than trying all pairs where few are near: measured.
    if reach < 0.15 * np.min(frame.lengths):
        return np.histogram(_close_pairs(frame, edges[-1]).gap, edges)[0]
    everyone = np.arange(len(frame.position))
    return _count_between(frame, everyone, None, edges, frame.radius)


def _count_between(frame, a, b, edges, radius=None):
    """Pairs of beads ``a`` with beads ``b`` in equal shells, (bins,); within ``a`` where ``b`` is None.

    Shells of the distance, or of the surface gap where radii are given.
    """
    others = a if b is None else b
    size = max(1, PAIRS_AT_ONCE // len(others))
    bins, counts = len(edges) - 1, 0
    scale = bins / (edges[-1] - edges[0])
    for start in range(0, len(a), size):
        rows, columns = a[start : start + size], others if b is not None else others[start:]
        h = _distances(frame, rows, columns)
        if radius is not None:
            h -= radius[rows][:, None]
            h -= radius[columns][None, :]
        h -= edges[0]
        h *= scale
        if b is None:
            h[np.tri(*h.shape, dtype=bool)] = -1.0
        shell = h[(h >= 0) & (h < bins)].astype(np.int32)
        counts = counts + np.bincount(shell, minlength=bins)
    return counts


def _distances(frame, a, b):
    """Distances of nearest images, (a, b)."""
    lx, ly, lz = frame.lengths
    x, y, z = frame.position.T
    d = y[a][:, None] - y[b][None, :]
    rows = np.rint(d / ly)
    total = np.square(d - ly * rows)
    d = x[a][:, None] - x[b][None, :]
    if frame.shift != 0:
        d -= frame.shift * rows
    total += np.square(_folded(d, lx))
    total += np.square(_folded(z[a][:, None] - z[b][None, :], lz))
    return np.sqrt(total, out=total)


def _folded(d, side):
    """``d`` within half a side of zero, in place."""
    turns = d / side
    np.rint(turns, out=turns)
    turns *= side
    d -= turns
    return d


def _ideal_pairs(radius, edges):
    """Pairs of an ideal gas at one sphere set per unit volume in shells of the surface gap, (bins,)."""
    moments = [np.sum(radius**k) for k in range(4)]
    # Sums of (R_i + R_j)^k over all i and j, without i = j, by the binomial theorem.
    sums = [
        sum(c * moments[j] * moments[k - j] for j, c in enumerate(row)) - np.sum((2 * radius) ** k)
        for k, row in enumerate([(1,), (1, 1), (1, 2, 1), (1, 3, 3, 1)])
    ]
    cubes = sums[3] + 3 * edges * sums[2] + 3 * edges**2 * sums[1] + edges**3 * sums[0]
    return 0.5 * 4.0 / 3.0 * np.pi * np.diff(cubes)


def _average(series) -> Estimate:
    """Mean of values (batch, frames), its error over blocks of frames; NaN for a single one."""
    pieces = pieces_of(series)
    return Estimate(float(np.mean(series)), float(standard_error(pieces)), len(pieces))


def _contacts_of_each(n: int, pairs):
    """Contacts of each sphere, (n,)."""
    return np.bincount(pairs.first, minlength=n) + np.bincount(pairs.second, minlength=n)


# Structure factor.


class _Plane(NamedTuple):
    """Wave vectors of one index along x: the largest indices along y and z, and length and shell of each (y, z)."""

    x: int
    y: int
    z: int
    q: np.ndarray
    shell: np.ndarray


def _wave_planes(lengths, q_max, bins) -> list[_Plane]:
    """Wave vectors up to ``q_max``, one of each opposite two; shell ``bins`` is for those left out."""
    unit = 2 * np.pi / lengths
    # Vectors of one length stay together where it falls on an edge of a shell.
    q_max = q_max * (1 + 1e-9)
    planes = []
    for x in range(int(q_max / unit[0]) + 1):
        across = np.sqrt(max(q_max**2 - (x * unit[0]) ** 2, 0.0))
        my, mz = int(across / unit[1]), int(across / unit[2])
        y, z = np.arange(-my, my + 1)[:, None], np.arange(-mz, mz + 1)[None, :]
        q = np.sqrt((x * unit[0]) ** 2 + (y * unit[1]) ** 2 + (z * unit[2]) ** 2)
        # At x = 0 both of two opposite vectors are in the plane.
        kept = (q < q_max) & ((x > 0) | (y > 0) | ((y == 0) & (z > 0)))
        planes.append(_Plane(x, my, mz, q, np.where(kept, (q * (bins / q_max)).astype(int), bins)))
    return planes


def _spectrum(frame, planes, bins):
    """``|sum exp(-i q . r)|^2 / n`` added up by shell, (bins,)."""
    x, y, z = (_waves(frame, axis, most) for axis, most in enumerate((planes[-1].x, planes[0].y, planes[0].z)))
    z = np.concatenate([z[:, :0:-1].conj(), z], axis=1)
    total = 0.0
    for plane in planes:
        middle, rows = z.shape[1] // 2, plane.y + 1
        xz = x[:, plane.x, None] * z[:, middle - plane.z : middle + plane.z + 1]
        # Real times complex, twice: half the work of the complex product over y of either sign.
        even, odd = (_real_product(part[:, :rows], xz) for part in (y.real, y.imag))
        modes = np.concatenate([(even - 1j * odd)[:0:-1], even + 1j * odd])
        power = modes.real**2 + modes.imag**2
        total = total + np.bincount(plane.shell.ravel(), power.ravel(), bins + 1)[:bins]
    return total / len(frame.position)


def _waves(frame, axis: int, most: int):
    """``exp(-2 pi i m r / L)`` along one axis for m from 0 to ``most``, (n, most + 1)."""
    return np.exp(-2j * np.pi / frame.lengths[axis] * frame.position[:, axis, None] * np.arange(most + 1)[None, :])


def _real_product(a, b):
    """``a^T b`` of real a and complex b as one real product."""
    return (a.T @ b.view(float)).view(complex)


# Bonds.


def _bond_keys(what, gap, forms, breaks) -> list[list[np.ndarray]]:
    """Bonds as sorted numbers ``i n + j``, by member and frame."""
    frames, each = _frames(what), what.strain.shape[1]
    members = []
    for _ in what.position:
        bonded, keys = np.array([], int), []
        for _ in range(each):
            pairs = _close_pairs(next(frames), np.nextafter(breaks * gap, np.inf))
            key = pairs.first * what.n + pairs.second
            bonded = np.sort(key[(pairs.gap < forms * gap) | np.isin(key, bonded)])
            keys.append(bonded)
        members.append(keys)
    return members


def _lasting(keys):
    """Bonds that were there in all of the frames a to b: entry [a, b] for a <= b, (frames, frames)."""
    frames = len(keys)
    spans = np.zeros((frames, frames), int)
    alive, born = np.array([], int), np.array([], int)
    for now, there in enumerate([*keys, np.array([], int)]):
        stays = np.isin(alive, there)
        np.add.at(spans, (born[~stays], now - 1), 1)
        new = np.setdiff1d(there, alive)
        alive = np.concatenate([alive[stays], new])
        born = np.concatenate([born[stays], np.full(len(new), now)])
    # spans[a, b]: from a to b exactly. Add those that began earlier or ended later.
    return np.cumsum(np.cumsum(spans, axis=0)[:, ::-1], axis=1)[:, ::-1]


def _survival(time, lasting, t_max):
    """Lags, the share that survives, and its error, (lags,) each, from counts (batch, frames, frames)."""
    batch, frames = lasting.shape[:2]
    interval = _interval(time)
    longest = _longest_lag(frames, batch, interval, t_max)
    each = max(1, min(-(-PIECES // batch), frames // (2 * max(1, longest))))
    length = frames // each
    origins = [range(start, start + length - longest) for start in range(0, each * length, length)]
    counts = np.array([_survivors(member, o, longest) for member in lasting for o in origins], float)
    with np.errstate(invalid="ignore"):
        shares, total = counts / counts[:, :1], counts.sum(axis=0)
        return interval * np.arange(longest + 1), total / total[0], standard_error(shares)


def _interval(time) -> float:
    """Time between two frames; 0 for a single one."""
    steps = np.diff(time)
    # Times in single precision are off by a part of a step late in a long run.
    if not np.allclose(steps, np.mean(steps) if steps.size else 0.0, rtol=0.05, atol=0):
        raise ValueError(f"frames are between {steps.min():.4g} and {steps.max():.4g} apart; lags need them evenly spaced")
    return float(np.mean(steps)) if steps.size else 0.0


def _longest_lag(frames, batch, interval, t_max) -> int:
    """The longest lag in frames."""
    if t_max is None:
        return min(frames - 1, max(1, frames // (2 * -(-SURVIVAL_PIECES // batch))))
    run = interval * (frames - 1)
    if not 0 < t_max <= run * (1 + 1e-4):
        raise ValueError(f"t_max is {t_max:.6g}; it must be above zero and within the run, {run:.6g}")
    return int(t_max / interval + 1e-4)


def _survivors(lasting, origins, longest: int):
    """Bonds of the frames ``origins`` that were still there each lag later, (longest + 1,)."""
    origins = np.asarray(origins)
    return [np.sum(lasting[origins, origins + lag]) for lag in range(longest + 1)]


# Clusters.


def _cluster_numbers(n: int, pairs):
    """Largest cluster, number of clusters, mean size over spheres, percolation along x, y, z: (6,)."""
    number, label = connected_components(_graph(n, pairs.first, pairs.second), directed=False)
    sizes = np.bincount(label)
    winds = _winds(n, pairs, label)
    return np.array([sizes.max(), number, np.sum(sizes**2) / n, *winds], float)


def _graph(n: int, first, second):
    return coo_array((np.ones(len(first), np.int8), (first, second)), shape=(n, n)).tocsr()


def _winds(n: int, pairs, label):
    """Whether some way along the pairs leads to an image of its start, along each lattice vector, (3,) bool."""
    if not np.any(pairs.image):
        return np.zeros(3, bool)
    cell = _unwrapped_cells(n, pairs, label)
    # Each pair closes a way through the tree; it winds unless it ends in the cell the tree says.
    return np.any(cell[pairs.first] + pairs.image != cell[pairs.second], axis=0)


def _unwrapped_cells(n: int, pairs, label):
    """The cell of each sphere, in lattice vectors, once its cluster is laid out along a tree of pairs, (n, 3)."""
    # One root, joined to a sphere of each cluster, makes all trees one.
    heads = np.unique(label, return_index=True)[1]
    first = np.concatenate([pairs.first, np.full(len(heads), n)])
    second = np.concatenate([pairs.second, heads])
    image = np.concatenate([pairs.image, np.zeros((len(heads), 3), int)])
    parent = breadth_first_order(_graph(n + 1, first, second), n, directed=False)[1].astype(int)
    parent[n] = n
    ways = np.concatenate([first * (n + 1) + second, second * (n + 1) + first])
    order = np.argsort(ways)
    way = order[np.searchsorted(ways, parent[:n] * (n + 1) + np.arange(n), sorter=order)]
    cell = np.zeros((n + 1, 3), int)
    cell[:n] = np.concatenate([image, -image])[way]
    # Each round doubles the stretch of the way to the root that is added up.
    for _ in range(n.bit_length()):
        cell, parent = cell + cell[parent], parent[parent]
    return cell[:n]
