"""What measures need of a run, and the checks that it is so."""

import warnings

import numpy as np
from scipy.stats import kendalltau

from dpdjax.engine.flow import Flow

RARELY = 1e-3
"""How often a stationary series is told to drift."""
PIECES = 10
"""Stretches of a series whose means are looked at for a trend: longer than the series remembers."""


def equilibrium(trajectory, measure: str):
    """Raise ValueError unless nothing drove the run."""
    if trajectory.flow.deforms and np.any(np.asarray(trajectory.flow.rate) != 0):
        raise ValueError(f"{measure} is of a fluid in equilibrium, and this run was sheared; run it without a flow")
    if type(trajectory.flow).force is not Flow.force:
        raise ValueError(f"{measure} is of a fluid in equilibrium, and a force drove this run; run it without a flow")


def warn_of_drift(series: dict):
    """Warns where any of these series, (frames,) or (replicas, frames) each, rises or falls throughout (Kendall's test)."""
    for name, values in series.items():
        mean = np.atleast_2d(np.asarray(values, float)).mean(axis=0)
        pieces = np.array([part.mean() for part in np.array_split(mean, min(PIECES, len(mean)))])
        if np.ptp(pieces) > 0 and kendalltau(np.arange(len(pieces)), pieces).pvalue < RARELY:
            warnings.warn(
                f"the run is not stationary: its {name} goes from {pieces[0]:.4g} to {pieces[-1]:.4g} over the frames used; "
                "leave out more at the start, skip=..., or run longer",
                stacklevel=3,
            )
