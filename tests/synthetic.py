"""A viscosity known in closed form, measured with noise: it takes the place of runs."""

import dataclasses
import math
from types import SimpleNamespace

import jax
import numpy as np

from dpdjax.calibration import experiment
from dpdjax.calibration.curve import Point
from dpdjax.measure.statistics import Estimate
from dpdjax.surrogate import foresight


@dataclasses.dataclass(frozen=True)
class Fluid:
    """``A / gamma + B gamma + C``, a kinetic and a drag part, in ``x = ln gamma``."""

    A: float = 1.0
    B: float = 0.03
    C: float = 0.6

    def value(self, x):
        return self.A * np.exp(-x) + self.B * np.exp(x) + self.C

    def slope(self, x):
        return self.B * np.exp(x) - self.A * np.exp(-x)

    @property
    def lowest(self):
        """Where the minimum is."""
        return 0.5 * math.log(self.A / self.B)

    def root(self, target, sign):
        """Where the viscosity is ``target`` with a slope of this sign."""
        high = target - self.C
        return math.log((high + sign * math.sqrt(high**2 - 4 * self.A * self.B)) / (2 * self.B))


FLUID = Fluid()


def sample(rng, x, error, bias=1.0) -> Point:
    """A value with the given error, and a slope with one of 10 %, off by the factor ``bias``."""
    slope = bias * FLUID.slope(x)
    slope_error = 0.1 * max(abs(FLUID.slope(x)), 0.02)
    value = FLUID.value(x) + error * rng.normal()
    return Point(
        x, Estimate(value, error), Estimate(slope + slope_error * rng.normal(), slope_error)
    )


def replace_runs(monkeypatch, seed=0, bias=1.0):
    """Let calibrations measure :data:`FLUID`, slopes off by ``bias``; returns a list that fills
    with the errors asked for."""
    rng, asked = np.random.default_rng(seed), []
    ln_gamma = lambda fluid: math.log(float(fluid.value("gamma")))

    def prepare(fluid, goal, key, *, density, side, boxes, dt=None, integrator=None, report=None):
        state = SimpleNamespace(position=np.zeros((boxes, 10, 3)))
        keys = jax.random.split(key, boxes)
        return SimpleNamespace(
            goal=goal, state=state, keys=keys, steps=0, step_for=lambda fluid: 0.01
        )

    def measure(ensemble, fluid, error, settle, most, report, far=math.inf):
        exact = FLUID.value(ln_gamma(fluid))
        error = max(error, abs(exact - ensemble.goal.target) / far)
        asked.append(error)
        ensemble.steps += 1000
        series = exact + 10 * error * rng.normal(size=(4, 100))
        estimate = Estimate(exact + error * rng.normal(), error)
        return experiment.Measurement(
            estimate,
            series,
            0.1 * np.arange(100),
            0.01,
            float(ensemble.goal.flow.rate),
            ensemble.steps,
            temperature=float(fluid.kT),
        )

    def measure_slopes(ensemble, fluid, names, windows):
        return [sample(rng, ln_gamma(fluid), 1.0, bias).slope for _ in names]

    without_atlas(monkeypatch)
    for name, function in (
        ("prepare", prepare),
        ("measure", measure),
        ("measure_slopes", measure_slopes),
    ):
        monkeypatch.setattr(experiment, name, function)
    return asked


def without_atlas(monkeypatch):
    """Let calibrations know nothing before they run."""
    monkeypatch.setattr(foresight, "_covered", lambda fluid, density: None)
    monkeypatch.setattr(foresight, "is_of_atlas", lambda fluid, density: False)
