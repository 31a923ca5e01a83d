"""How vectors of molecules are forgotten: autocorrelations, and their relaxation times."""

import dataclasses
import math

import numpy as np

from dpdjax.drawing import curve
from dpdjax.errors import warn
from dpdjax.measure.blocks import standard_error
from dpdjax.measure.pools import groups_of
from dpdjax.measure.statistics import Estimate
from dpdjax.measure.transport import autocorrelation, correlated

HIGH, LOW = 0.6, math.exp(-1.0)
"""Where an autocorrelation is read off: after what relaxes faster than the rest, and before its
errors count."""
FEWEST = 4
"""Frames whose autocorrelation is looked at."""


@dataclasses.dataclass(frozen=True, repr=False)
class Relaxation:
    """The autocorrelation of a vector, 1 at lag 0, and the time that it takes.

    Attributes:
        time: lags from 0, (lags,) [time].
        value: ``<R(t) . R(0)> / <R^2>``, (lags,).
        error: its standard error, (lags,); NaN where there is a single piece.
        relaxation_time: tau of ``A exp(-t/tau)`` [time], a straight line through the logarithm
            where the value is between 0.6 and 1/e, and one more lag before where there are fewer
            than two in between: of an end-to-end vector, whose higher modes are not all gone there,
            up to 2 % below that of the first mode. NaN where frames are further apart than that.
        name: what it is of, for drawing.
    """

    time: np.ndarray
    value: np.ndarray
    error: np.ndarray
    relaxation_time: Estimate
    name: str

    def __repr__(self):
        lags = f"{len(self.time)} lags up to {self.time[-1]:.4g}"
        return f"Relaxation({self.name}, {lags}, relaxation time {self.relaxation_time})"

    def plot(self, ax=None):
        """Draw it with its error band; returns the matplotlib axes."""
        ax = curve(ax, self.time, self.value, self.error, "t [time]", self.name)
        ax.axhline(0.0, color="0.4", lw=1)
        return ax


def can_follow(trajectory) -> bool:
    """Whether the frames of a run are evenly spaced, and enough to look for a relaxation."""
    frames = np.atleast_2d(trajectory.frames["time"]).shape[1]
    return trajectory.every is not None and frames >= FEWEST


def relaxation(trajectory, vectors, t_max, name: str) -> Relaxation:
    """That of vectors (batch, frames, molecules, 3) whose mean is zero.

    Groups of molecules count as independent, besides replicas and stretches of the run: what is
    within a molecule hardly knows of the others. ``t_max`` [time]: longest lag, by default as long
    as leaves 12 pieces, half of the run where there are as many molecules.

    Raises ValueError for a ``t_max`` outside the run.
    """
    groups = groups_of(len(vectors), vectors.shape[2])
    members = (member[:, group] for member in vectors for group in groups)
    shape = (len(vectors) * len(groups), vectors.shape[1])
    time, curves = correlated(trajectory, members, shape, autocorrelation, t_max)
    start = curves[:, 0].mean()
    if not start > 0:
        nothing = np.full_like(time, np.nan)
        return Relaxation(time, nothing, nothing, Estimate(np.nan, np.nan), name)
    value = curves.mean(axis=0) / start
    # Of a quotient: a piece that is above at lag 0 is so later too.
    error = standard_error((curves - value * curves[:, :1]) / start)
    return Relaxation(time, value, error, _relaxation_time(time, curves), name)


def _relaxation_time(time, curves) -> Estimate:
    """Of ``exp(-t/tau)`` through the mean of curves (pieces, lags), its error by leaving out one
    after the other."""
    value, count = curves.mean(axis=0) / curves[:, 0].mean(), len(curves)
    window = _window(value)
    if len(window) < 2:
        return Estimate(np.nan, np.nan, count)
    read = lambda curve: _decay(time[window], curve[window])
    found = read(value)
    if count < 2 or not np.isfinite(found):
        return Estimate(found, np.nan, count)
    left = np.array([read(one) for one in (curves.sum(axis=0) - curves) / (count - 1)])
    error = np.sqrt((count - 1) / count * np.sum((left - left.mean()) ** 2))
    return Estimate(found, float(error), count)


def _window(value) -> np.ndarray:
    """The lags that a relaxation time is read off at, see :class:`Relaxation`."""
    ends = np.flatnonzero(value < LOW)
    last = ends[0] if ends.size else len(value)
    lags = np.flatnonzero(value[:last] <= HIGH)
    if not lags.size:
        return np.arange(last) if not ends.size else lags
    return lags if len(lags) > 1 else np.array([lags[0] - 1, lags[0]])


def _decay(time, value) -> float:
    """tau of a straight line through ``ln value``; NaN for one that does not fall."""
    if np.any(value <= 0):
        return np.nan
    slope = np.polyfit(time, np.log(value), 1)[0]
    return float(-1.0 / slope) if slope < 0 else np.nan


def warn_if_short(slowest: Relaxation, what: str):
    """Warn where the slowest relaxation has not fallen to 1/e at the longest lag."""
    left = slowest.value[-1]
    if not left > LOW:
        return
    tau, last = slowest.relaxation_time.value, slowest.time[-1]
    time = f"about {tau:.2g}" if np.isfinite(tau) else "unknown"
    warn(
        f"{left:.0%} of {what} is still remembered at the longest lag, {last:.4g}: its relaxation "
        f"time is {time}, and the run is too short to tell it, and has seen each chain in few "
        "shapes; run longer, or give a longer t_max",
    )
