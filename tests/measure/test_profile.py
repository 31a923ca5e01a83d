"""The profile of a sheared box is a line, that of a sinusoidal force a sine, and both are at the
temperature of the bath."""

import jax
import numpy as np
import pytest
from small import SIDE

import dpdjax as dpd
from dpdjax.measure import velocity_profile
from dpdjax.measure.statistics import from_replicas

RATE, MEMBERS = 0.5, 6
ERRORS = 4.5
pytestmark = pytest.mark.filterwarnings("ignore:member", "ignore:the later half")


@pytest.fixture(scope="module")
def run(water, quiet_water, key):
    """``run(flow)``: replicas of water."""

    def of(flow, **how):
        keys, plan = jax.random.split(key, MEMBERS), dpd.Plan(150, 15)
        observe = [dpd.observe.standard, dpd.observe.positions]
        return dpd.run(
            water, quiet_water, keys, 0.02, plan, flow, observe=observe, progress=False, **how
        )

    return of


@pytest.fixture(scope="module")
def sheared(run):
    return run(dpd.shear(RATE))


def test_shear_is_a_line_at_one_temperature(sheared):
    found = velocity_profile(sheared, bins=8)
    np.testing.assert_allclose(found.imposed, RATE * (found.y - SIDE / 2), rtol=1e-6)
    assert np.all(np.abs(found.velocity - found.imposed) < ERRORS * found.velocity_error)
    slopes = [
        np.polyfit(found.y, velocity_profile(member, bins=8).velocity, 1)[0]
        for member in sheared.members()
    ]
    slope = from_replicas(slopes)
    assert slope.deviation(RATE) < ERRORS and slope.error < 0.05 * RATE
    hot = np.asarray(sheared.frames["temperature"])[:, 15:].mean()
    assert np.all(np.abs(found.temperature - hot) < ERRORS * found.temperature_error)
    assert abs(found.temperature.mean() / hot - 1) < 0.005


def test_a_sinusoidal_force_makes_a_sine(run):
    pushed = run(dpd.flows.sinusoidal_force(0.4, SIDE))
    found = velocity_profile(pushed, bins=12)
    k = 2 * np.pi / SIDE
    sine, cosine = (2 * np.mean(found.velocity * wave(k * found.y)) for wave in (np.sin, np.cos))
    left = found.velocity - sine * np.sin(k * found.y)
    assert sine > 0.3 and abs(cosine) < 0.1 * sine and np.std(left) < 0.1 * sine
    assert np.all(np.abs(left) < ERRORS * found.velocity_error) and not np.any(found.imposed)
    # The wave is no heat: without it the temperature is below that of all velocities.
    kinetic = np.asarray(pushed.frames["temperature"])[:, 15:].mean()
    assert abs(kinetic - sine**2 / 6 - found.temperature.mean()) < 0.02


def test_a_file_has_the_same_profile(water, quiet_water, key, tmp_path):
    plan, flow = dpd.Plan(20, 15), dpd.shear(RATE)
    how = {"observe": [dpd.observe.standard, dpd.observe.positions], "progress": False}
    kept = dpd.run(water, quiet_water, key, 0.02, plan, flow, **how)
    how = {"progress": False, "out": tmp_path / "run.gsd"}
    stored = dpd.run(water, quiet_water, key, 0.02, plan, flow, **how)
    for name in ("y", "velocity", "temperature"):
        a, b = (getattr(velocity_profile(run, bins=6), name) for run in (kept, stored))
        np.testing.assert_allclose(a, b, atol=2e-3)


def test_it_draws_itself(sheared):
    pytest.importorskip("matplotlib").use("Agg")
    found = velocity_profile(sheared, bins=8)
    ax = dpd.plot_profile(sheared, bins=8)
    np.testing.assert_allclose(ax.lines[0].get_ydata(), found.velocity)
    np.testing.assert_allclose(ax.lines[-1].get_ydata(), found.imposed)
    right = ax.figure.axes[1]
    np.testing.assert_allclose(right.lines[0].get_ydata(), found.temperature)
    assert right.get_ylabel() == "temperature [energy]" and ax.get_xlabel() == "y [length]"
    assert found.plot(ax) is ax


def test_wrong_runs_and_arguments(sheared, water, quiet_water, key):
    with pytest.raises(ValueError, match="skip is 1.0; it is a share"):
        velocity_profile(sheared, skip=1.0)
    with pytest.raises(ValueError, match="bins"):
        velocity_profile(sheared, bins=0)
    with pytest.raises(ValueError, match="no bead is of species 3"):
        velocity_profile(sheared, species=3)
    with pytest.raises(TypeError, match="measures a run"):
        velocity_profile(quiet_water)
    bare = dpd.run(water, quiet_water, key, 0.02, dpd.Plan(2, 2), progress=False)
    with pytest.raises(ValueError, match="no 'position'.*use observe=dpd.observe.positions"):
        velocity_profile(bare)
