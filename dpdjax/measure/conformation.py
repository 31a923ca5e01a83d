"""The size and the shape of molecules: end-to-end distance, radius of gyration."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dpdjax.drawing import axes
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.molecules import Molecules, by_molecule, chains, linear_chains, rows_of
from dpdjax.measure.pools import pooled
from dpdjax.measure.relaxation import Relaxation, can_follow, relaxation, warn_if_short
from dpdjax.measure.replicas import bead_masses
from dpdjax.measure.results import Result
from dpdjax.measure.statistics import Estimate


@dataclasses.dataclass(frozen=True, repr=False)
class EndToEnd(Result):
    """The vector ``R`` from one end of linear chains to the other.

    Attributes:
        mean_square: ``<R^2>`` [length^2].
        mean: ``<|R|>`` [length].
        correlation: the autocorrelation of R and its relaxation time; None where the frames of the
            run are not evenly spaced, or fewer than four.
        chains: whose it is.
    """

    mean_square: Estimate
    mean: Estimate
    correlation: Relaxation | None
    chains: Molecules

    def plot(self, ax=None):
        """Draw the autocorrelation with its error band; returns the matplotlib axes.

        Raises ValueError where there is none.
        """
        if self.correlation is None:
            raise ValueError(
                "no autocorrelation was measured: run with frames evenly spaced, "
                "dpd.Plan(frames, every)"
            )
        return self.correlation.plot(ax)


@dataclasses.dataclass(frozen=True, repr=False)
class Gyration(Result):
    """How far the beads of molecules are from their centres of mass.

    Attributes:
        mean_square: ``<Rg^2>``, the trace of the gyration tensor [length^2].
        eigenvalues: means of the three eigenvalues of each molecule's tensor, the largest first
            [length^2]; they add up to ``mean_square``.
        molecules: whose it is.
    """

    mean_square: Estimate
    eigenvalues: tuple[Estimate, Estimate, Estimate]
    molecules: Molecules

    def plot(self, ax=None):
        """Draw the eigenvalues as bars with their errors; returns the matplotlib axes."""
        ax = axes(ax)
        bars = {"yerr": np.nan_to_num([e.error for e in self.eigenvalues]), "capsize": 2}
        ax.bar([1, 2, 3], [e.value for e in self.eigenvalues], width=0.8, alpha=0.7, **bars)
        ax.set(xlabel="eigenvalue of the gyration tensor", ylabel="mean [length$^2$]")
        ax.set_xticks([1, 2, 3])
        return ax


def end_to_end(
    trajectory: Trajectory,
    *,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
    t_max: float | None = None,
) -> EndToEnd:
    """The end-to-end vector of linear chains: its mean square, and how long it is remembered.

    Of a phantom chain of N beads and springs ``k r^2 / 2`` the mean square is ``3 (N - 1) kT / k``
    (Doi & Edwards 1986, section 2.1). Under shear it is the vector as it is, not relative to the
    flow. The error is the larger of those of stretches of the run and of groups of chains.

    Args:
        trajectory: a run recorded with ``observe=dpd.observe.positions``, batched or not, sheared
            or not; of chains alone ``dpd.observe.positions_of`` their species.
        length, species: which chains, where there are several kinds; see :func:`chains`.
        t_max: longest lag of the autocorrelation [time]; by default half of the run, less where
            there are fewer than 12 chains.

    Warns where the longest lag does not see the vector forgotten, and of frames further and further
    apart. Raises ValueError for a run without positions, or with means of them, a failed one, a
    sheared one without its ``strain``, no bonds, molecules of several kinds, or branched, a
    ``t_max`` outside the run.

    Example:
        >>> found = dpd.measure.end_to_end(chains)
        >>> found.chains
        Molecules(307 linear of length 5, species 0 x 5)
        >>> found.mean_square.value > found.mean.value**2
        True
    """
    needs.warn_of_ages(trajectory, "<R^2>")
    which = linear_chains(trajectory, length, species)
    vector = by_molecule(trajectory, which.ids, which.tree, lambda x: x[:, :, -1] - x[:, :, 0])
    square = np.sum(vector**2, axis=-1)
    found = None
    if can_follow(trajectory):
        found = relaxation(trajectory, vector, t_max, "autocorrelation of the end-to-end vector")
        warn_if_short(found, "the end-to-end vector")
    return EndToEnd(pooled(square), pooled(np.sqrt(square)), found, which)


def radius_of_gyration(
    trajectory: Trajectory,
    *,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
) -> Gyration:
    """The mean square radius of gyration of molecules, and the shape that they have.

    The gyration tensor is ``sum m (r - r_cm) (r - r_cm) / sum m`` over the beads of a molecule, its
    trace ``Rg^2`` (Theodorou & Suter 1985). Of a phantom chain of N beads of one mass and springs
    ``k r^2 / 2`` that is ``(N^2 - 1) kT / (2 N k)`` on average.

    Arguments as in :func:`end_to_end`, of molecules of any kind; errors too.

    Example:
        >>> found = dpd.measure.radius_of_gyration(chains)
        >>> traces = sum(each.value for each in found.eigenvalues)
        >>> abs(traces - found.mean_square.value) < 1e-5
        True
    """
    needs.warn_of_ages(trajectory, "<Rg^2>")
    which = chains(trajectory, length=length, species=species)
    share = shares(trajectory, which)
    tensor = by_molecule(trajectory, which.ids, which.tree, lambda x: _gyration(x, share))
    values = np.linalg.eigvalsh(tensor)[..., ::-1]
    eigenvalues = tuple(pooled(values[..., k]) for k in range(3))
    return Gyration(pooled(np.trace(tensor, axis1=-2, axis2=-1)), eigenvalues, which)


def shares(trajectory, which: Molecules) -> np.ndarray:
    """The share of each bead in the mass of its molecule, (molecules, beads), the same in all
    members of a batch."""
    mass = bead_masses(trajectory)[0]
    own = mass[rows_of(trajectory, which.ids, len(mass))[0]]
    return own / own.sum(axis=1, keepdims=True)


def _gyration(x, share) -> np.ndarray:
    """Gyration tensors (frames, molecules, 3, 3) of positions (frames, molecules, beads, 3)."""
    off = x - np.einsum("mn,fmnc->fmc", share, x)[:, :, None]
    return np.einsum("mn,fmnc,fmnd->fmcd", share, off, off, optimize=True)
