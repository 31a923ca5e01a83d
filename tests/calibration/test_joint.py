"""Several parameters for several numbers: the descent finds the crossing, with an honest error
bar."""

import math
from types import SimpleNamespace

import jax
import numpy as np
import optax
import pytest

import dpdjax as dpd
from dpdjax.calibration import experiment, joint
from dpdjax.measure.statistics import Estimate

GAMMA, A = 7.0, 18.0
"""Where the synthetic viscosity is 1.2 and the synthetic pressure 20."""


def exact(fluid):
    gamma, a = (float(fluid.value(name)) for name in ("gamma", "a"))
    return {
        "viscosity": 1.2 * (gamma / GAMMA) ** 0.6 * (a / A) ** 0.2,
        "pressure": 20.0 * (a / A) ** 0.9 * (gamma / GAMMA) ** 0.05,
    }


def synthetic(monkeypatch, seed=0):
    rng = np.random.default_rng(seed)
    powers = {"viscosity": {"gamma": 0.6, "a": 0.2}, "pressure": {"gamma": 0.05, "a": 0.9}}

    def prepare(fluid, goal, key, *, density, side, boxes, dt=None, integrator=None, report=None):
        keys = jax.random.split(key, boxes)
        return SimpleNamespace(
            goal=goal, keys=keys, steps=0, state=SimpleNamespace(position=np.zeros((boxes, 10, 3)))
        )

    def measure(ensemble, fluid, error, settle, most, report):
        ensemble.steps += 1
        return SimpleNamespace(
            estimate=Estimate(exact(fluid)[ensemble.goal.name] + error * rng.normal(), error)
        )

    def measure_slopes(ensemble, fluid, names, windows):
        value = exact(fluid)[ensemble.goal.name]
        return [
            Estimate(value * powers[ensemble.goal.name][n] * (1 + 0.1 * rng.normal()), 0.1 * value)
            for n in names
        ]

    for name, function in (
        ("prepare", prepare),
        ("measure", measure),
        ("measure_slopes", measure_slopes),
    ):
        monkeypatch.setattr(experiment, name, function)


def test_two_parameters_reach_two_targets(water, key, monkeypatch):
    deviations = []
    for seed in range(30):
        synthetic(monkeypatch, seed)
        fit = dpd.calibrate(water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key)
        deviations += [fit.estimates["gamma"].deviation(GAMMA), fit.estimates["a"].deviation(A)]
        assert abs(fit.measured["pressure"].value - 20.0) < 0.04 * 20.0
    assert 0.5 < np.mean(np.array(deviations) < 1) < 0.95
    assert np.max(deviations) < 4.5


def test_any_optax_optimiser_serves(water, key, monkeypatch):
    synthetic(monkeypatch)
    monkeypatch.setattr("dpdjax.calibration.calibrate.MAX_POINTS", 60)
    fit = dpd.calibrate(
        water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key, optimiser=optax.adam(0.1)
    )
    assert fit.estimates["gamma"].deviation(GAMMA) < 4


def test_numbers_and_parameters_must_match(water, key):
    with pytest.raises(ValueError, match="2 parameters .* for 1 wanted numbers"):
        dpd.calibrate(water, ("gamma", "a"), viscosity=1.0, key=key)


def test_preconditioned_gradient_is_the_newton_step():
    goals = [SimpleNamespace(target=2.0), SimpleNamespace(target=1.0)]
    slopes = ((Estimate(2.0, 0.1), Estimate(0.0, 0.1)), (Estimate(0.0, 0.1), Estimate(1.0, 0.1)))
    point = joint.JointPoint(np.zeros(2), (Estimate(2.2, 0.1), Estimate(0.7, 0.1)), slopes)
    assert joint.gradient(point, goals) == pytest.approx([0.1, -0.3], rel=1e-2)


def test_error_is_in_the_parameter_itself(water, key, monkeypatch):
    synthetic(monkeypatch)
    fit = dpd.calibrate(water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key)
    assert 0.002 * GAMMA < fit.estimates["gamma"].error < 0.05 * GAMMA
    assert math.isclose(float(fit.fluid.value("a")), fit.estimates["a"].value, rel_tol=1e-6)
