"""Contacts of spheres: how many others are closer to each than a surface gap."""

import dataclasses

import numpy as np

from dpdjax.checks import positive
from dpdjax.drawing import axes, curve, time_scale
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure.blocks import average, error_of, standard_error
from dpdjax.measure.results import Result
from dpdjax.measure.spheres import Spheres, as_spheres, by_frame, close_pairs
from dpdjax.measure.statistics import Estimate
from dpdjax.model.colloids import attraction_range


@dataclasses.dataclass(frozen=True, repr=False)
class ContactNumber(Result):
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
        """Draw the shares as bars with their errors; returns the matplotlib axes."""
        ax = axes(ax)
        bars = {"yerr": np.nan_to_num(self.error), "capsize": 2, "alpha": 0.7}
        ax.bar(self.z, self.share, width=0.8, **bars)
        ax.set(xlabel="contacts z", ylabel="P(z)")
        ax.xaxis.get_major_locator().set_params(integer=True)
        return ax

    def plot_series(self, ax=None, *, tau: float | None = None):
        """Draw the contacts of a sphere against the time of the run's clock, with the error over
        replicas, logarithmic where frames are further and further apart; returns the matplotlib
        axes.

        The clock counts from where the state was made or ``state.restarted()``, as a quench is.

        Args:
            ax: matplotlib axes, or None for new ones.
            tau: unit of time, ``trajectory.tau`` for diffusion times; [time] by default.
        """
        if tau is not None:
            positive(tau, "tau")
        time, label = (self.time, "t [time]") if tau is None else (self.time / tau, "t/tau")
        mean, error = self.series.mean(axis=0), standard_error(self.series)
        ax = curve(ax, time, mean, error, label, f"contact number, gaps below {self.gap:.3g}")
        ax.set_xscale(time_scale(time))
        return ax


def contact_number(what: Trajectory | Spheres, *, gap: float | None = None) -> ContactNumber:
    """The number of others closer than ``gap``, its distribution, and its mean in each frame.

    Args:
        what: :class:`Spheres`, or a run as :func:`spheres` takes it.
        gap: surface gap below which two spheres are in contact [length]; by default, for a run, the
            range of the attraction between its spheres, ``r0 + 3/kappa`` of a Morse potential,
            where a tenth of its depth is left.

    Raises ValueError for a gap that is missing, not above zero or too large for the box
    (``2 R + gap`` above half the shortest side), and as :func:`spheres` does.

    Example:
        >>> found = dpd.measure.contact_number(gel)
        >>> round(found.gap, 3), round(float(found.share.sum()), 3)
        (0.1, 1.0)
    """
    found, gap = spheres_and_gap(what, gap)
    contacts = contacts_of_each(found, gap=gap)
    z = np.arange(contacts.max() + 1)
    shares = np.mean(contacts[..., None, :] == z[:, None], axis=-1)
    series, error = contacts.mean(axis=-1), error_of(shares)
    return ContactNumber(average(series), z, shares.mean((0, 1)), error, found.time, series, gap)


def contacts_of_each(what: Trajectory | Spheres, *, gap: float | None = None) -> np.ndarray:
    """The number of others closer than ``gap`` to each sphere, (batch, frames, n).

    Arguments and errors as in :func:`contact_number`.

    Example:
        >>> of_each = dpd.measure.contacts_of_each(gel, gap=0.2)
        >>> of_each.shape
        (1, 24, 16)
        >>> pairs = dpd.measure.bonded_pairs(gel, gap=0.2, forms=1.0)[0][0]
        >>> 2 * len(pairs) == int(of_each[0, 0].sum())
        True
    """
    what, gap = spheres_and_gap(what, gap)

    def counted(frame):
        pairs = close_pairs(frame, gap)
        return np.bincount(np.concatenate([pairs.first, pairs.second]), minlength=what.n)

    return by_frame(what, counted)


def spheres_and_gap(what, gap) -> tuple[Spheres, float]:
    """The spheres, and the gap or that of the fluid of a run; ValueError for one that will not
    do."""
    found = as_spheres(what)
    gap = gap_of_fluid(getattr(what, "fluid", None)) if gap is None else gap
    positive(gap, "gap")
    gap = float(gap)
    reach, half = 2 * np.max(found.radius) + gap, 0.5 * np.min(found.lengths)
    if reach > half:
        raise ValueError(
            f"gap is {gap:.6g}: the largest spheres would touch {reach:.6g} apart, above half the "
            f"shortest side, {half:.6g}; take a smaller gap or a larger box"
        )
    return found, gap


def gap_of_fluid(fluid) -> float:
    """Over which its spheres attract each other; ValueError where they do not, or it is None."""
    if fluid is None:
        raise ValueError("no gap is given, and no fluid tells it; give gap=... [length]")
    try:
        return attraction_range(fluid)
    except ValueError as error:
        raise ValueError(f"no gap is given, and {error}; give gap=... [length]") from error
