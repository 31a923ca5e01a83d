"""Rouse modes of linear chains: how large each is, and how long it is remembered."""

import dataclasses
from collections.abc import Sequence

import numpy as np

from dpdjax.drawing import axes, labelled
from dpdjax.engine.trajectory import Trajectory
from dpdjax.measure import needs
from dpdjax.measure.molecules import Molecules, by_molecule, linear_chains
from dpdjax.measure.pools import pooled
from dpdjax.measure.relaxation import Relaxation, can_follow, relaxation, warn_if_short
from dpdjax.measure.results import Result


@dataclasses.dataclass(frozen=True, repr=False)
class RouseModes(Result):
    """Rouse modes 1 to N - 1 of chains of N beads.

    Attributes:
        p: their numbers, (modes,).
        mean_square: ``<X_p^2>`` of one component, (modes,) [length^2].
        error: its standard error, (modes,).
        relaxation_time: tau_p, (modes,) [time], of ``A exp(-t/tau)``; NaN where frames are too far
            apart or too few to tell it, see ``Relaxation``. Modes so stiff that they swing, as
            the higher ones of most DPD chains do, have none: look at ``correlations``.
        relaxation_error: its standard error, (modes,).
        correlations: the autocorrelation of each mode; none where the frames of the run are not
            evenly spaced, or fewer than four.
        chains: whose they are.

    Example:
        >>> modes = dpd.measure.rouse_modes(chains)
        >>> modes.p.tolist(), len(modes.correlations)
        ([1, 2, 3, 4], 4)
    """

    p: np.ndarray
    mean_square: np.ndarray
    error: np.ndarray
    relaxation_time: np.ndarray
    relaxation_error: np.ndarray
    correlations: tuple[Relaxation, ...]
    chains: Molecules

    def plot(self, ax=None, *, spring: float | None = None):
        """Draw the mean squares against p in double logarithmic scale; returns the matplotlib axes.

        Args:
            ax: matplotlib axes, or None for new ones.
            spring: ``kT / k`` [length^2], for the line of a phantom chain, ``kT / (4 k sin^2(p pi /
                2 N))``.
        """
        ax = axes(ax)
        ax.errorbar(self.p, self.mean_square, np.nan_to_num(self.error), fmt="o", ms=3, capsize=2)
        if spring is not None:
            due = spring / (4 * np.sin(0.5 * np.pi * self.p / self.chains.length) ** 2)
            ax.plot(self.p, due, "k--", lw=1.5, label="kT / (4 k sin$^2$(p $\\pi$ / 2 N))")
            ax.legend()
        label = labelled("mean square of a component", "length^2")
        ax.set(xscale="log", yscale="log", xlabel="mode p", ylabel=label)
        return ax

    def plot_correlations(self, ax=None, *, modes: Sequence[int] = (1, 2, 3)):
        """Draw the autocorrelations of some modes, by their p, with error bands; returns the
        matplotlib axes."""
        ax = axes(ax)
        there = [p for p in modes if 1 <= p <= len(self.correlations)]
        for p in there:
            self.correlations[p - 1].plot(ax)
        bands = [line for line in ax.get_lines() if len(line.get_xdata()) > 2]
        ax.legend(bands, [f"p = {p}" for p in there])
        ax.set(ylabel="autocorrelation of Rouse modes")
        return ax


def rouse_modes(
    trajectory: Trajectory,
    *,
    length: int | None = None,
    species: int | Sequence[int] | None = None,
    t_max: float | None = None,
) -> RouseModes:
    """The Rouse modes of linear chains of N beads, orthonormal.

    They are ``X_p = sqrt(2/N) sum_n r_n cos(p pi (n + 1/2) / N)``, n from 0, p from 1 to N - 1: the
    normal modes of springs in a row (Rouse 1953; Doi & Edwards 1986, section 4.1, whose modes of a
    continuous chain are ``X_p / sqrt(2 N)``). In a phantom chain of springs ``k r^2 / 2`` each
    component of each mode has the mean square ``kT / (4 k sin^2(p pi / 2 N))``, and with a friction
    zeta on each bead the relaxation time ``zeta / (4 k sin^2(p pi / 2 N))``.

    Arguments, warnings and errors as in :func:`end_to_end`; the first mode is the one whose memory
    is warned of. Masses do not count.

    Example:
        >>> modes = dpd.measure.rouse_modes(chains)
        >>> bool(np.all(np.diff(modes.mean_square) < 0))
        True
    """
    needs.warn_of_ages(trajectory, "<X_p^2>")
    which = linear_chains(trajectory, length, species)
    cosines = modes_of(which.length)
    modes = by_molecule(trajectory, which.ids, which.tree, lambda x: cosines @ x)
    sizes = [pooled(np.mean(modes[..., k, :] ** 2, axis=-1)) for k in range(len(cosines))]
    p, found = np.arange(1, which.length), ()
    if can_follow(trajectory):
        of_mode = lambda k: relaxation(
            trajectory, modes[..., k - 1, :], t_max, f"autocorrelation of Rouse mode {k}"
        )
        found = tuple(map(of_mode, p.tolist()))
        warn_if_short(found[0], "the first Rouse mode")
    times = [one.relaxation_time for one in found]
    unknown = np.full(len(p), np.nan)
    return RouseModes(
        p,
        np.array([e.value for e in sizes]),
        np.array([e.error for e in sizes]),
        np.array([t.value for t in times]) if times else unknown,
        np.array([t.error for t in times]) if times else unknown,
        found,
        which,
    )


def modes_of(n: int) -> np.ndarray:
    """The orthonormal modes 1 to n - 1 of a chain, as rows (n - 1, n)."""
    phase = np.outer(np.arange(1, n), np.arange(n) + 0.5)
    return np.sqrt(2.0 / n) * np.cos(np.pi / n * phase)
