"""Several parameters for several numbers: the descent finds the crossing, with an honest error
bar."""

import math
from types import SimpleNamespace

import jax
import numpy as np
import optax
import pytest
from synthetic import without_atlas

import dpdjax as dpd
from dpdjax.calibration import experiment, joint
from dpdjax.measure.statistics import Estimate

GAMMA, A = 7.0, 18.0
"""Where the synthetic viscosity is 1.2 and the synthetic pressure 20."""


POWERS = (("viscosity", (0.6, 0.2)), ("pressure", (0.05, 0.9)))
"""Of both numbers those of gamma and of a."""


def exact(fluid, powers):
    gamma, a = (float(fluid.value(name)) for name in ("gamma", "a"))
    at = {"viscosity": 1.2, "pressure": 20.0}
    return {n: at[n] * (gamma / GAMMA) ** p * (a / A) ** q for n, (p, q) in powers}


def synthetic(monkeypatch, seed=0, powers=POWERS):
    rng = np.random.default_rng(seed)
    slopes_of = {n: dict(zip(("gamma", "a"), each)) for n, each in powers}

    def prepare(fluid, goal, key, *, density, side, boxes, dt=None, integrator=None, report=None):
        keys = jax.random.split(key, boxes)
        return SimpleNamespace(
            goal=goal, keys=keys, steps=0, state=SimpleNamespace(position=np.zeros((boxes, 10, 3)))
        )

    def measure(ensemble, fluid, error, settle, most, report, far=math.inf):
        ensemble.steps += 1
        value = exact(fluid, powers)[ensemble.goal.name] + error * rng.normal()
        return SimpleNamespace(estimate=Estimate(value, error), dt=0.01, rate=0.1, temperature=1.0)

    def measure_slopes(ensemble, fluid, names, windows):
        value = exact(fluid, powers)[ensemble.goal.name]
        return [
            Estimate(value * power * (1 + 0.1 * rng.normal()), 0.1 * abs(value * power))
            for power in (slopes_of[ensemble.goal.name][n] for n in names)
        ]

    without_atlas(monkeypatch)
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
    monkeypatch.setattr("dpdjax.calibration.joint.MAX_POINTS", 60)
    fit = dpd.calibrate(
        water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key, optimiser=optax.adam(0.1)
    )
    assert fit.estimates["gamma"].deviation(GAMMA) < 4


def test_numbers_and_parameters_must_match(water, key):
    with pytest.raises(ValueError, match="2 parameters for 1 wanted numbers"):
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


def test_what_no_number_sees_is_told_by_name(water, key, monkeypatch):
    synthetic(monkeypatch, powers=(("viscosity", (0.6, 0.0)), ("pressure", (0.4, 0.0))))
    with pytest.raises(ValueError, match="viscosity and pressure do not change with a,"):
        dpd.calibrate(water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key)


def test_numbers_that_pull_in_one_direction_contradict(water, key, monkeypatch):
    synthetic(monkeypatch, powers=(("viscosity", (0.6, 0.3)), ("pressure", (0.6, 0.3))))
    with pytest.raises(dpd.TargetError, match="viscosity 1.5 and pressure 20 contradict") as raised:
        dpd.calibrate(water, ("gamma", "a"), viscosity=1.5, pressure=20.0, key=key)
    assert "they stay along gamma^-0.5" in str(raised.value)
    assert raised.value.history


def test_bounds_are_kept(water, key, monkeypatch):
    synthetic(monkeypatch)
    with pytest.raises(dpd.TargetError, match="at an end of their bounds") as raised:
        dpd.calibrate(
            water,
            ("gamma", "a"),
            viscosity=1.2,
            pressure=20.0,
            key=key,
            bounds={"gamma": (3.0, 5.0)},
        )
    assert all(p.x[0] <= math.log(5.0) + 1e-9 for p in raised.value.history)
    fit = dpd.calibrate(
        water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key, bounds={"gamma": (3.0, 9.0)}
    )
    assert fit.estimates["gamma"].deviation(GAMMA) < 4


@pytest.mark.parametrize(
    "odd, told",
    [
        ({"bounds": {"s": (1.0, 2.0)}}, "bounds has s"),
        ({"bounds": {"gamma": (8.0, 9.0)}}, "bounds of gamma are"),
        ({"branch": "upper"}, "branch= is of one parameter"),
        ({"guess": 3.0}, "guess= is of one parameter"),
    ],
)
def test_odd_arguments(water, key, monkeypatch, odd, told):
    synthetic(monkeypatch)
    with pytest.raises(ValueError, match=told):
        dpd.calibrate(water, ("gamma", "a"), viscosity=1.2, pressure=20.0, key=key, **odd)
