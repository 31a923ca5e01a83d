"""Measurements state errors that cover: synthetic stresses with the memory of the real one,
hundreds of times over."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.signal import lfilter

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.engine.flow import Flow

EXACT, WHITE, RANDOM, SLOW = 1.1, 0.21, 1.55, ((0.03, 8.0), (0.00077, 150.0))
"""As measured at a 2.5, kT 0.1, gamma 50, a frame of 0.024: variances over a frame of what a box of
375 beads records, in units of (stress/rate)^2, and of the parts that remember, for how many frames;
of the random stress minus 0.35 goes with the value. With it taken off, blocks of 25, 50, 100, 200
and 400 frames give the mean of 6 boxes of 3000 beads over 3600 frames errors of 1.64, 1.67,
1.72(8), 1.84(12) and 2.04(20) thousandths."""
THERMAL = 130
"""Frames of a thermal time."""


class Stress:
    """Values of boxes of 3000 beads and the random stress that goes along with them."""

    def __init__(self, seed, boxes=2):
        self.rng = np.random.default_rng(seed)
        self.last = [self.rng.normal(size=boxes) for _ in SLOW]

    def frames(self, count):
        draw = lambda variance: np.sqrt(variance) * self.rng.normal(size=(len(self.last[0]), count))
        random = draw(RANDOM)
        value = draw(WHITE) - 0.35 * random
        for k, (variance, memory) in enumerate(SLOW):
            kept = np.exp(-1 / memory)
            slow, _ = lfilter(
                [1], [1, -kept], draw(1 - kept**2), axis=1, zi=(kept * self.last[k])[:, None]
            )
            self.last[k] = slow[:, -1]
            value = value + np.sqrt(variance) * slow
        return {"value": EXACT + value / np.sqrt(8.0), "noise": random / np.sqrt(8.0)}


@pytest.fixture
def measure(monkeypatch):
    """``measure(seed, error)`` of synthetic stresses."""

    def extended(ensemble, fluid, dt, plan):
        ensemble.steps += plan.steps * ensemble.beads
        return ensemble.stress.frames(plan.frames)

    def measured(seed, error, fluid=None):
        fluid = fluid or SimpleNamespace(kT=1.0)
        flow = Flow.of(dpd.shear(0.25))
        goal = SimpleNamespace(name="viscosity", target=EXACT, scale=1.0, flow=flow)
        boxes = experiment.Ensemble(
            None, goal, 3.0, SimpleNamespace(position=np.zeros((2, 10, 3))), None, dt=0.01
        )
        boxes.stress = Stress(seed)
        return experiment.measure(boxes, fluid, error, 0.0, 10**12, lambda text: None)

    monkeypatch.setattr(experiment, "_extend", extended)
    monkeypatch.setattr(experiment, "check_dt", lambda *_: None)
    thermal = 0.01 * experiment.PIECE.every * THERMAL
    monkeypatch.setattr(experiment, "remembered", lambda *_: experiment.REMEMBERED * thermal)
    monkeypatch.setattr(experiment, "piece", lambda *_: experiment.PIECE)
    monkeypatch.setattr(experiment, "_check_dt", lambda *_: None)
    return measured


def test_stated_errors_cover(measure):
    """Looked at after every piece, 16 blocks scattered by 1.39 of what they stated."""
    error = 0.0073
    runs = [measure(seed, error) for seed in range(800)]
    deviations = np.array([(run.estimate.value - EXACT) / run.estimate.error for run in runs])
    assert 0.85 < deviations.std() < 1.13
    assert abs(deviations.mean()) < 3 / np.sqrt(800)
    assert all(run.estimate.error <= error for run in runs)
    pieces = np.mean([run.series.shape[1] / experiment.PIECE.frames for run in runs])
    assert pieces < 75, (
        "honest, and not much longer than needed: 43 pieces where the error is known"
    )


def test_length_is_planned():
    assert experiment.planned(10, 1.01) == 12, "grows by a share, not by a piece"
    assert experiment.planned(10, 1.3) == 17
    assert experiment.planned(10, 3.0) == 54, "a long way is planned anew before its end"
    assert experiment.planned(10, 100.0) == 160


def test_warm_flows_are_told(measure, monkeypatch):
    """6 % above kT was an answer without a word."""
    extended = experiment._extend
    warm = lambda ensemble, fluid, dt, plan: (
        extended(ensemble, fluid, dt, plan) | {"temperature": np.full((2, 25), 0.106)}
    )
    monkeypatch.setattr(experiment, "_extend", warm)
    with pytest.warns(
        UserWarning,
        match="viscosity was measured 6 % above kT, with shear rate 0.25 and dt 0.01: give a "
        "smaller",
    ):
        measure(0, 1.0, SimpleNamespace(kT=0.1))
