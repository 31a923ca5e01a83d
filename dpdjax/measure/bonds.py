"""How bond lengths, angles and dihedrals are distributed."""

import dataclasses

import numpy as np

from dpdjax.bonded.coordinates import COORDINATES
from dpdjax.checks import whole
from dpdjax.drawing import curve
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.molecules import by_molecule, labels_of, shared_rows, topology_of
from dpdjax.measure.pools import groups_of, pooled, pooled_error
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate
from dpdjax.model.bonded import BEADS

MOST_BINS = 100_000


@dataclasses.dataclass(frozen=True, repr=False)
class BondedDistribution(Result):
    """How a bond length [length], or an angle or a dihedral [radian], is distributed.

    Attributes:
        x: middle of each bin, (bins,).
        density: share of the bonds in a bin over its width, (bins,); it adds up to 1.
        error: standard error of ``density``, (bins,); NaN where there is a single frame of fewer
            than four molecules.
        mean, mean_square: of the length or the angle itself.
        mean_cosine: of an angle or a dihedral; None of bonds.
        name: what it is of, for drawing.
    """

    x: np.ndarray
    density: np.ndarray
    error: np.ndarray
    mean: Estimate
    mean_square: Estimate
    mean_cosine: Estimate | None
    name: str

    def plot(self, ax=None):
        """Draw the density with its error band; returns the matplotlib axes."""
        return curve(ax, self.x, self.density, self.error, self.name, "density")


def bond_lengths(
    trajectory: Trajectory, name: str | None = None, *, bins: int = 100
) -> BondedDistribution:
    """The lengths of the bonds of one type, of all molecules that have some.

    The density is that of lengths, with the ``r^2`` of a sphere in it: of a spring alone it is as
    ``r^2 exp(-U(r)/kT)``. The error is the larger of those of stretches of the run and of groups of
    molecules.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``, batched or not, sheared
            or not.
        name: of the type in the fluid; by default the only one there is.
        bins: between 0 and the longest that was found.

    Raises ValueError for a type that is not there, none named of several, ``bins`` below 1, and as
    :func:`end_to_end` does.

    Example:
        >>> found = dpd.measure.bond_lengths(chains, bins=50)
        >>> width = found.x[1] - found.x[0]
        >>> round(float(found.density.sum() * width), 3)
        1.0
        >>> abs(found.mean.value - 0.82) < 0.1
        True
    """
    return _distribution(trajectory, "bond", name, bins)


def angles(
    trajectory: Trajectory, name: str | None = None, *, bins: int = 100
) -> BondedDistribution:
    """The angles theta of one type, pi for three beads in line [radian].

    The density is that of angles, with the ``sin(theta)`` of a sphere in it. Arguments and errors
    as in :func:`bond_lengths`; bins are between 0 and pi.

    Example:
        >>> import dataclasses
        >>> ids = dpd.measure.chains(chains).ids
        >>> bent = chains.final.bonded({"angle": ids[:, :3]})  # of a fluid that has none
        >>> found = dpd.measure.angles(dataclasses.replace(chains, final=bent), bins=30)
        >>> found.name, found.x.shape, bool(found.x[-1] < np.pi)
        ('theta [radian]', (30,), True)
    """
    return _distribution(trajectory, "angle", name, bins)


def dihedrals(
    trajectory: Trajectory, name: str | None = None, *, bins: int = 100
) -> BondedDistribution:
    """The dihedrals phi of one type, pi in trans [radian], and 0 to pi: either turn counts as one,
    as in laws of their cosine.

    Arguments and errors as in :func:`bond_lengths`; bins are between 0 and pi.

    Example:
        >>> import dataclasses
        >>> ids = dpd.measure.chains(chains).ids
        >>> turned = chains.final.bonded({"dihedral": ids[:, :4]})
        >>> found = dpd.measure.dihedrals(dataclasses.replace(chains, final=turned), bins=30)
        >>> abs(found.mean_cosine.value) < 0.3  # free to turn
        True
    """
    return _distribution(trajectory, "dihedral", name, bins)


def _distribution(trajectory, kind: str, name, bins) -> BondedDistribution:
    needs.finished(trajectory)
    needs.warn_of_ages(trajectory, f"the distribution of {kind}s")
    bins = whole(bins, "bins", most=MOST_BINS)
    ids = rows_named(trajectory.final, kind, name)
    q = coordinates(trajectory, kind, ids)
    x = q if kind == "bond" else np.arccos(np.clip(q, -1.0, 1.0))
    most = np.pi if kind != "bond" else max(float(x.max()), np.finfo(float).tiny)
    edges = np.linspace(0.0, most, bins + 1)
    groups = _groups(trajectory.final, ids, len(x))
    density = _shares(x, groups, edges) / (edges[1] - edges[0])
    names = {"bond": "r [length]", "angle": "theta [radian]", "dihedral": "phi [radian]"}
    return BondedDistribution(
        0.5 * (edges[1:] + edges[:-1]),
        np.average(density, axis=2, weights=list(map(len, groups))).mean(axis=(0, 1)),
        pooled_error(density),
        pooled(x, groups),
        pooled(x**2, groups),
        None if kind == "bond" else pooled(q, groups),
        names[kind],
    )


def rows_named(state, kind: str, name) -> np.ndarray:
    """The ids of the beads of one type, (count, 2 to 4); ValueError where it is not there, or none
    is named of several."""
    beads = topology_of(state).beads
    own = {k: v for k, v in beads.items() if np.shape(v)[-1] == BEADS[kind] and np.shape(v)[-2]}
    if name is None and len(own) == 1:
        name = next(iter(own))
    if not isinstance(name, str) or name not in own:
        there = ", ".join(repr(k) for k in own) or "none"
        raise ValueError(f"name is {name!r}; the types of {kind} of this run are: {there}")
    return shared_rows(own[name], f"{kind}s")


def coordinates(trajectory, kind: str, ids) -> np.ndarray:
    """The coordinate of bonds, angles or dihedrals (count, beads), as the laws of the fluid have
    it, (batch, frames, count)."""

    def of(x):
        before = np.moveaxis(x[:, :, :-1] - x[:, :, 1:], -1, 0)
        v = np.moveaxis(before, 3, 1).reshape(3, before.shape[3], -1)
        return np.asarray(COORDINATES[kind](v), float).reshape(x.shape[:2])

    return by_molecule(trajectory, ids, [(k + 1, k) for k in range(ids.shape[1] - 1)], of)


def _groups(state, ids, batch: int) -> list[np.ndarray]:
    """The bonds, angles or dihedrals of each group of molecules, by their numbers."""
    found, number = np.unique(labels_of(state)[ids[:, 0]], return_inverse=True)
    return [np.flatnonzero(np.isin(number, own)) for own in groups_of(batch, len(found))]


def _shares(x, groups, edges) -> np.ndarray:
    """The share in each bin of what each group has, (batch, frames, groups, bins)."""
    bins = len(edges) - 1
    place = np.minimum((x * (bins / edges[-1])).astype(int), bins - 1)
    share = lambda row: np.bincount(row, minlength=bins) / len(row)
    return np.stack([np.apply_along_axis(share, 2, place[..., own]) for own in groups], axis=2)
