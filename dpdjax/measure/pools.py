"""Error bars of what many molecules have each: off stretches of the run, and off groups of
molecules."""

import numpy as np

from dpdjax.measure.blocks import PIECES, error_of, pieces_of, standard_error
from dpdjax.measure.statistics import Estimate

FEWEST = 4
"""Groups of molecules that tell an error."""


def pooled(values, groups=None) -> Estimate:
    """Mean of values (batch, frames, molecules), with the error of :func:`pooled_error`."""
    groups = groups_of(len(values), values.shape[2]) if groups is None else groups
    of_frames, of_groups = _errors(values, groups)
    if of_groups >= of_frames or np.isnan(of_frames):
        error, count = of_groups, len(values) * len(groups)
    else:
        error, count = of_frames, np.prod(pieces_of(values[..., 0]).shape)
    return Estimate(float(np.mean(values)), float(error), int(count))


def pooled_error(values, groups=None) -> np.ndarray:
    """Standard error of the mean of values (batch, frames, molecules, ...), the larger of two.

    That of stretches of the run counts what all molecules do together; that of groups of molecules
    counts how seldom each changes, which a run of few relaxation times does not tell. ``groups``
    are the numbers in each, by default as :func:`groups_of` has them. NaN where there is one frame
    of fewer than four molecules.
    """
    groups = groups_of(len(values), values.shape[2]) if groups is None else groups
    return np.fmax(*_errors(values, groups))


def _errors(values, groups):
    of_frames = error_of(values.mean(axis=2))
    if len(values) * len(groups) < FEWEST:
        return of_frames, np.full_like(of_frames, np.nan)
    of_each = values.mean(axis=1)
    means = [of_each[:, group].mean(axis=1) for group in groups]
    return of_frames, standard_error(np.concatenate(means))


def groups_of(batch: int, molecules: int) -> list[np.ndarray]:
    """Molecules in so many groups that there are 12 in all members, as far as they go: their
    numbers."""
    return np.array_split(np.arange(molecules), max(1, min(molecules, -(-PIECES // batch))))
