"""Error bars of what is measured frame by frame, off blocks of frames and off replicas."""

import numpy as np

from dpdjax.measure.statistics import Estimate

PIECES = 12
"""Independent pieces an error bar is read off, replicas counted."""
MOST_ALIKE = 0.9
"""Correlation of neighbouring pieces up to which errors are widened: a run that never forgets its
start tells no error."""


def average(series) -> Estimate:
    """Mean of values (batch, frames), its error over blocks of frames; NaN for a single one."""
    batch, frames = series.shape
    return Estimate(
        float(np.mean(series)), float(error_of(series)), batch * _pieces_of_each(batch, frames)
    )


def error_of(values) -> np.ndarray:
    """Standard error of the mean of values (batch, frames, ...), read off blocks of frames; NaN for
    a single one.

    Blocks that remember the one before, all numbers looked at together, count as fewer: the error
    of a mean of numbers correlated by ``r`` from one to the next is larger by
    ``sqrt((1 + r) / (1 - r))``.
    """
    pieces = pieces_of(values)
    error = standard_error(pieces.reshape(-1, *values.shape[2:]))
    each, off = pieces.shape[1], pieces - pieces.mean(axis=(0, 1))
    spread = np.sum(off**2)
    if each < 3 or spread == 0:
        return error
    # The mean that was taken off is that of these blocks too, and makes neighbours look less alike
    # than they are.
    alike = np.sum(off[:, 1:] * off[:, :-1]) / spread * each / (each - 1) + 1 / each
    alike = min(max(alike, 0.0), MOST_ALIKE)
    return error * np.sqrt((1 + alike) / (1 - alike))


def pieces_of(values) -> np.ndarray:
    """Means over blocks of frames, (batch, pieces, ...), of values (batch, frames, ...)."""
    batch, frames = values.shape[:2]
    each = _pieces_of_each(batch, frames)
    length = frames // each
    return values[:, : each * length].reshape(batch, each, length, *values.shape[2:]).mean(axis=2)


def _pieces_of_each(batch: int, frames: int) -> int:
    """Into how many pieces each member is cut."""
    return min(frames, -(-PIECES // batch))


def pieces_of_member(batch: int, frames: int, longest: int) -> int:
    """Into how many pieces to cut each member, each twice as long as the longest lag."""
    return max(1, min(-(-PIECES // batch), frames // (2 * max(1, longest))))


def standard_error(pieces) -> np.ndarray:
    """Standard error of the mean over the first axis; NaN for a single piece."""
    count = len(pieces)
    if count < 2:
        return np.full(pieces.shape[1:], np.nan)
    return pieces.std(axis=0, ddof=1) / np.sqrt(count)
