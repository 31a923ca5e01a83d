"""Calibrations: the whole loop on a known fluid, refusals that say why, and two real ones on small
boxes."""

import math
from types import SimpleNamespace
from typing import NamedTuple

import jax
import numpy as np
import pytest
from synthetic import FLUID, replace_runs

import dpdjax as dpd
from dpdjax.calibration import experiment
from dpdjax.calibration.calibrate import (
    TargetError,
    calibrate,
    drag_guess,
    measure_viscosity,
    rough_viscosity,
)
from dpdjax.calibration.goal import (
    pressure_goal,
    suggest_rate,
    thinning_time,
    viscosity_goal_at,
)
from dpdjax.engine.flow import Flow

UPPER, LOWER = 1, -1


@pytest.fixture
def asked(monkeypatch):
    return replace_runs(monkeypatch)


@pytest.mark.parametrize(
    "target, sign, guess",
    [(1.5, UPPER, None), (1.2, UPPER, 1.0), (1.5, LOWER, 0.5), (1.2, LOWER, 40.0)],
)
def test_answer_is_the_root(water, key, asked, target, sign, guess):
    branch = "upper" if sign == UPPER else "lower"
    fit = calibrate(water, viscosity=target, branch=branch, guess=guess, key=key)
    exact = math.exp(FLUID.root(target, sign))
    assert fit.estimate.deviation(exact) < 4
    slope = abs(FLUID.slope(FLUID.root(target, sign))) / exact
    assert fit.error * slope < 1.2 * 0.01 * target
    assert fit.measured.deviation(target) < 4 and fit.measured.error <= 0.01 * target
    assert fit.fluid.value("gamma") == fit.value and fit.fluid.value("a") == 25.0
    assert (fit.parameter, fit.name, fit.target) == ("gamma", "viscosity", target)
    assert (
        str(fit)
        == f"gamma = {fit.estimate} gives viscosity {target:g}: a fresh run measured {fit.measured}"
    )


def test_errors_asked_for(water, key, asked):
    """Coarse first, then fine, and the fresh run at a third of the tolerance."""
    fit = calibrate(water, viscosity=1.5, guess=20.0, tolerance=0.04, key=key)
    wanted = 0.04 * 1.5 / 3
    assert asked[0] == pytest.approx(3 * wanted) and asked[-1] == pytest.approx(wanted)
    assert np.allclose(asked[1:-1], 0.9 * wanted)
    assert len(asked) == len(fit.history) + 1
    assert fit.particle_steps == 1000 * len(asked)


def test_error_bars_cover_the_root(water, key, monkeypatch):
    deviations = []
    for seed in range(60):
        replace_runs(monkeypatch, seed)
        deviations.append(
            calibrate(water, viscosity=1.5, guess=20.0, key=key).estimate.deviation(
                math.exp(FLUID.root(1.5, UPPER))
            )
        )
    assert 0.5 < np.mean(np.array(deviations) < 1) < 0.85


@pytest.mark.parametrize("bias", [0.7, 1.3])
@pytest.mark.parametrize(
    "branch, guess", [("upper", 3.0), ("upper", 50.0), ("lower", 0.5), ("lower", 20.0)]
)
def test_biased_slopes_neither_hide_nor_shift_the_answer(
    water, key, monkeypatch, bias, branch, guess
):
    """Slopes 30 % off, and a target little above the minimum: nothing is believed that was not
    measured."""
    target = FLUID.value(FLUID.lowest) + 0.1
    for seed in range(10):
        replace_runs(monkeypatch, seed, bias)
        fit = calibrate(water, viscosity=target, branch=branch, guess=guess, key=key)
        assert abs(FLUID.value(math.log(fit.value)) - target) < 4 * 0.01 * target


def test_progress_is_reported(water, key, asked):
    told = []
    calibrate(water, viscosity=1.5, key=key, report=told.append)
    assert told[0] == "equilibrating 2 boxes"
    assert told[1].startswith("gamma ") and told[1].endswith("measuring")
    assert told[2].startswith("gamma ") and "viscosity" in told[2] and "slope" in told[2]


@pytest.mark.parametrize("branch, guess", [("upper", None), ("lower", 1.0)])
def test_target_below_the_minimum_states_the_minimum(water, key, asked, branch, guess):
    with pytest.raises(
        TargetError, match="viscosity 0.8 cannot be reached with gamma: the smallest measured is "
    ) as raised:
        calibrate(water, viscosity=0.8, branch=branch, guess=guess, key=key)
    words = str(raised.value).replace(";", "").split()
    value, error = float(words[words.index("+-") - 1]), float(words[words.index("+-") + 1])
    assert abs(value - FLUID.value(FLUID.lowest)) < 4 * error < 0.1
    assert abs(math.log(float(words[words.index("=") + 1])) - FLUID.lowest) < 0.3
    assert len(raised.value.history) >= 3


def test_giving_up_names_the_nearest(water, key, asked):
    with pytest.raises(
        TargetError,
        match="no answer after 2 points and 2e.03 particle-steps: nearest is viscosity .* at gamma",
    ):
        calibrate(water, viscosity=3.0, guess=2.0, key=key, max_particle_steps=1500)


def test_number_of_ones_own(water, key, asked):
    fit = calibrate(water, target=1.5, observe=lambda fluid, state: 1.0, guess=20.0, key=key)
    assert fit.estimate.deviation(math.exp(FLUID.root(1.5, UPPER))) < 4
    assert fit.name == "value" and fit.rate == 0.0


def test_measured_viscosity_is_as_good_as_asked(water, key, asked):
    """The tolerance is relative to what was measured, not to the guess before it."""
    measured = measure_viscosity(water.set(gamma=0.5), tolerance=0.02, key=key)
    assert measured.estimate.deviation(FLUID.value(math.log(0.5))) < 4
    assert measured.estimate.error <= 0.01 * measured.estimate.value
    assert measured.series.shape[1] == len(measured.time)


@pytest.mark.parametrize(
    "arguments, message",
    [
        ({}, "give one of viscosity=, .*, compressibility= or target= with observe=; got none"),
        ({"viscosity": 1.0, "pressure": 20.0}, "got viscosity and pressure"),
        ({"target": 1.0}, "target= needs observe="),
        ({"viscosity": 1.0, "branch": "left"}, "branch is 'left'; it is \"upper\""),
        ({"viscosity": -1.0}, "viscosity is -1.0; it must be above zero"),
        ({"viscosity": 0.0}, "viscosity is 0.0; it must be above zero"),
        ({"viscosity": math.nan}, "viscosity is nan; it must be finite"),
        ({"pressure": 0.0}, "pressure is 0, and no error bar"),
        ({"viscosity": 1.0, "tolerance": 0.0}, "tolerance is 0.0; it must be above zero"),
        ({"viscosity": 1.0, "density": -3.0}, "density is -3.0"),
        ({"viscosity": 1.0, "guess": 0.0}, "guess is 0.0; it must be above zero"),
        ({"viscosity": 1.0, "rate": -0.1}, "rate is -0.1; it must be above zero"),
        (
            {"parameter": "mass", "pressure": 20.0},
            r"mass is a table of shape \(1,\); only a scalar",
        ),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_wrong_arguments(water, key, arguments, message):
    with pytest.raises(ValueError, match=message):
        calibrate(water, key=key, **arguments)


def never(*_, **__):
    raise AssertionError("something ran")


def test_what_cannot_run_is_refused_before_it_runs(water, key, fresh, monkeypatch):
    monkeypatch.setattr(experiment, "replayed", never)
    with pytest.raises(ValueError, match="box side 1.5 is below 2"):
        calibrate(water, viscosity=1.0, box=1.5, key=key)
    monkeypatch.setattr(experiment, "initial_state", lambda *_, **__: fresh)
    with pytest.raises(ValueError, match="dt 10 is too large for the drag"):
        calibrate(water, viscosity=1.0, dt=10.0, key=key)


def test_fixed_step_too_long_for_the_next_drag_is_refused(ideal, key, fresh, monkeypatch):
    state = jax.tree.map(lambda leaf: leaf[None], fresh)
    boxes = experiment.Ensemble(
        ideal, pressure_goal(1.0), 3.0, state, jax.random.split(key, 1), dt=0.02
    )
    monkeypatch.setattr(experiment, "replayed", never)
    with pytest.raises(ValueError, match="dt 0.02 is too large for the drag"):
        experiment.measure(boxes, ideal.set(gamma=100.0), 0.1, 0.0, 10**9, lambda text: None)


def test_wrong_names(water, key):
    with pytest.raises(
        TypeError, match="no term of this fluid has 'gama'; it has kT, mass, a, gamma, r_c"
    ):
        calibrate(water, "gama", viscosity=1.0, key=key)
    table = dpd.fluid(
        drag=[dpd.term(dpd.central_drag, gamma=[[4.0, 5.0], [5.0, 6.0]], r_c=1.0)], kT=1.0
    )
    with pytest.raises(
        ValueError, match=r"gamma is a table of shape \(2, 2\); only a scalar can be calibrated"
    ):
        calibrate(table, viscosity=1.0, key=key)
    with pytest.raises(TypeError, match="viscosity is 'thick'; a number"):
        calibrate(water, viscosity="thick", key=key)
    with pytest.raises(TypeError, match=r"key is the integer 0; give jax.random.key\(0\)"):
        calibrate(water, viscosity=1.0, key=0)


@pytest.mark.parametrize(
    "observe, found",
    [
        ({"value": 1.0}, "observe is a dict"),
        (dpd.mean(dpd.observe.standard), "observe is a"),
        (dpd.observe.standard, "observe returns a dict where"),
        (dpd.observe.pressure_tensor, r"observe returns an array of shape \(3, 3\) where"),
        (lambda fluid, state: None, "observe returns a NoneType where"),
    ],
)
def test_what_is_observed_is_one_number(water, key, fresh, monkeypatch, observe, found):
    batch = jax.tree.map(lambda leaf: leaf[None], fresh)
    monkeypatch.setattr(experiment, "replayed", never)
    monkeypatch.setattr(experiment.jax, "vmap", lambda build: lambda keys: batch)
    with pytest.raises(
        TypeError,
        match=f"{found}.*give a function of one number, such as observe=dpd.observe.temperature",
    ):
        calibrate(water, target=1.0, observe=observe, key=key, dt=0.01)


def test_arguments_that_would_be_ignored(water, key):
    with pytest.raises(
        ValueError, match="observe= is used with target= only; give target= or leave observe= out"
    ):
        calibrate(water, viscosity=1.0, observe=lambda fluid, state: 1.0, key=key)
    with pytest.raises(ValueError, match="flow= is used with target= only"):
        calibrate(water, pressure=1.0, flow=dpd.shear(0.1), key=key)
    with pytest.raises(ValueError, match="rate= is used with viscosity= only"):
        calibrate(water, pressure=1.0, rate=0.1, key=key)


def test_fluid_without_drag_has_no_viscosity(water, key):
    frictionless = water.set(gamma=0.0)
    with pytest.raises(ValueError, match="no drag, so no steady viscosity"):
        measure_viscosity(frictionless, key=key)
    with pytest.raises(ValueError, match="no drag, so no steady viscosity"):
        calibrate(frictionless, "a", viscosity=1.0, rate=0.1, key=key)


def test_first_guesses(water):
    """The drag stress of kinetic theory, and a rate that falls with the tolerance."""
    gamma = drag_guess(water, "gamma", 1.3, 3.0)
    assert rough_viscosity(water.set(gamma=1e4 * gamma), 3.0) == pytest.approx(1.3e4, rel=1e-3)
    rates = [suggest_rate(water, 3.0, 0.9, tolerance) for tolerance in (0.005, 0.02)]
    assert rates[1] == pytest.approx(2 * rates[0])
    assert suggest_rate(water, 3.0, 0.9, 10.0) <= 1.5


def noisy_boxes(monkeypatch, seed, memory=0.5):
    """Boxes whose values are noise about 1, each remembering a share of the one before."""
    rng, last = np.random.default_rng(seed), np.zeros(4)

    def replayed(system, state, keys, plan, how, compiling):
        nonlocal last
        values = np.empty((4, plan.frames))
        for k in range(plan.frames):
            last = memory * last + math.sqrt(1 - memory**2) * rng.normal(size=4)
            values[:, k] = 1 + last
        return state, {"value": -values}

    monkeypatch.setattr(experiment, "replayed", replayed)
    monkeypatch.setattr(experiment, "check_dt", lambda system, state: None)
    monkeypatch.setattr(experiment, "remembered", lambda *_: experiment.REMEMBERED)
    monkeypatch.setattr(experiment, "piece", lambda *_: experiment.PIECE)
    flow = Flow.of(dpd.shear(0.3))
    goal = SimpleNamespace(name="number", target=2.0, scale=-1.0, observe=never, flow=flow)
    state = Boxes(np.zeros((4, 10, 3)), np.zeros(4, np.uint32))
    return experiment.Ensemble(None, goal, 3.0, state, None, dt=0.01)


class Boxes(NamedTuple):
    position: np.ndarray
    status: np.ndarray


def test_measurement_goes_on_until_its_error_is_met(monkeypatch):
    deviations = []
    for seed in range(100):
        boxes = noisy_boxes(monkeypatch, seed)
        measured = experiment.measure(boxes, None, 0.06, 30.0, 10**9, lambda text: None)
        assert measured.estimate.error <= 0.06
        settled = 3 * experiment.PIECE.steps * 40
        assert boxes.steps == settled + 40 * measured.series.shape[1] * experiment.PIECE.every
        deviations.append(measured.estimate.deviation(1.0))
    assert 0.55 < np.mean(np.array(deviations) < 1) < 0.8
    assert measured.time[0] == pytest.approx(0.01 * experiment.PIECE.every)
    assert (measured.dt, measured.rate) == (0.01, 0.3)


def test_measurement_ends_where_the_steps_do(monkeypatch):
    measured = experiment.measure(
        noisy_boxes(monkeypatch, 0), None, 1e-4, 0.0, 10**6, lambda text: None
    )
    assert measured.particle_steps == 10**6 and measured.estimate.error > 1e-4


def test_a_measurement_far_off_the_target_ends_early(monkeypatch):
    """The value is 1 and 2 is wanted: an error of an eighth shows the way."""
    boxes = noisy_boxes(monkeypatch, 0)
    measured = experiment.measure(boxes, None, 1e-4, 0.0, 10**9, lambda text: None, far=8.0)
    assert 0.01 < measured.estimate.error < 0.13
    assert measured.series.shape[1] < 500
    assert measured.estimate.deviation(1.0) < 3


def test_run_that_breaks_stops_the_calibration(monkeypatch):
    boxes = noisy_boxes(monkeypatch, 0)
    boxes.state = boxes.state._replace(status=np.array([0, 4, 0, 0], np.uint32))
    with pytest.raises(
        RuntimeError, match="the calibration stopped: positions or velocities became NaN"
    ):
        experiment.measure(boxes, None, 0.01, 0.0, 10**9, lambda text: None)


def test_plateau_is_the_latest_sure_slope():
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(50, 8)) * np.array([0.01, 0.02, 0.05, 0.1, 0.2, 1.0, 5.0, 20.0])
    rising = np.array([0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0, 1.0])
    slope = experiment.plateau(rising + noise)
    assert slope.deviation(1.0) < 4 and slope.error < 0.1
    unsure = experiment.plateau(
        0.01 * rising + np.abs(noise[:, ::-1]) * np.sign(rng.normal(size=(50, 8)))
    )
    assert unsure.error < 0.03, "where no slope is sure, the least noisy"


BOX = {"box": 3.0, "dt": 0.01}


@pytest.fixture
def short_pieces(monkeypatch):
    monkeypatch.setattr(experiment, "PIECE", dpd.Plan(20, 20))


def test_repulsion_of_a_pressure(water, key, short_pieces):
    """The pressure of a = 25, measured directly, leads back to a = 25."""
    boxes = experiment.prepare(
        water, pressure_goal(1.0), key, density=3.0, side=3.0, boxes=4, dt=0.01
    )
    pressure = experiment.measure(boxes, water, 0.05, 1.0, 10**9, lambda text: None).estimate
    assert pressure.value == pytest.approx(23.65, rel=0.02)
    fit = calibrate(water, "a", pressure=pressure.value, guess=20.0, key=jax.random.key(1), **BOX)
    slope = fit.curve.slope(math.log(fit.value)) / fit.value
    assert slope == pytest.approx(0.85, rel=0.15)
    assert abs(fit.value - 25.0) < 4 * math.hypot(fit.error, pressure.error / slope) < 0.6
    assert fit.measured.deviation(pressure) < 4
    assert fit.fluid.value("gamma") == 4.5


def test_friction_of_a_viscosity(water, key, short_pieces):
    """At a = 0 the viscosity 1.26 belongs to gamma 5, on the falling branch."""
    fit = calibrate(
        water.set(a=0.0), viscosity=1.26, branch="lower", guess=4.0, tolerance=0.1, key=key, **BOX
    )
    slope = fit.curve.slope(math.log(fit.value)) / fit.value
    assert fit.estimate.deviation(5.0) < 4 and fit.error < 1.0 and slope < 0
    assert fit.error * -slope <= 0.1 / 3 * 1.26, "a third of the tolerance"
    assert fit.measured.deviation(1.26) < 4 and fit.measured.error <= 0.05 * 1.26


def test_rate_falls_where_kinetic_stress_heats(water):
    rates = [
        viscosity_goal_at(water.set(gamma=gamma), 3.0, 0.9, 0.2).flow.rate
        for gamma in (0.5, 2.0, 8.0)
    ]
    assert 0.02 < rates[0] < 0.1 < rates[1] < rates[2]


def test_heat_is_refused(water):
    """A hundred times the rate that calibrate would choose."""
    with pytest.raises(
        RuntimeError, match="instead of kT = 1, with shear rate 10 .*give a smaller rate="
    ):
        measure_viscosity(water, key=jax.random.key(0), rate=10.0, box=4.0, tolerance=0.2)


@pytest.mark.parametrize(
    "density, a, gamma, rate, ratio, off",
    [(2.5, 100.0, 7.389, 0.4, 0.871, 0.004), (2.5, 100.0, 7.389, 0.2, 0.946, 0.006),
     (2.5, 50.0, 7.389, 0.4, 0.969, 0.020), (8.0, 100.0, 400.0, 0.4, 0.951, 0.006)],
)  # fmt: skip
def test_stiff_fluids_are_sheared_slowly(density, a, gamma, rate, ratio, off):
    """Viscosities at twice a rate over once, measured by tests/atlas/survey.py and by hand: what
    the time that stiff beads remember says of them, and what is left at the rate suggested."""
    fluid = dpd.fluid(
        [dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)],
        [dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)],
        kT=1.0,
    )
    thinned = lambda rate: np.arcsinh(x := rate * thinning_time(fluid, density)) / x
    assert thinned(2 * rate) / thinned(rate) == pytest.approx(ratio, abs=3 * off)
    suggested = suggest_rate(fluid, density, rough_viscosity(fluid, density), 0.02)
    assert 0.985 < thinned(suggested) and suggested < 0.35
