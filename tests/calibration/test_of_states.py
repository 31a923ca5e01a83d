"""Measurements and calibrations in boxes that begin as a given state."""

import jax
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.calibration import experiment, gauges, wishes
from dpdjax.calibration.goal import custom_goal

KEY = jax.random.key(9)
SPRING = dpd.term(dpd.laws.harmonic_bond, k=40.0)


@pytest.fixture(scope="module")
def melt():
    return dpd.molecules(KEY, "A4", box=4.0, bonds=SPRING, report=None)


def test_memory_is_that_of_the_longest_molecule(melt):
    """As the model of Rouse has it: about as N^2, in proportion to the drag."""
    memory = lambda made, **numbers: experiment.chain_memory(made.fluid.set(**numbers), made.state)
    longer = dpd.molecules(KEY, {"A16": 0.5, "A2": 0.5}, box=4.0, bonds=SPRING, report=None)
    ratio = np.sin(np.pi / 8) ** 2 / np.sin(np.pi / 32) ** 2
    np.testing.assert_allclose(memory(longer) / memory(melt), ratio, rtol=1e-6)
    np.testing.assert_allclose(memory(melt, gamma=9.0) / memory(melt), 2.0, rtol=1e-6)
    # k 40 and kT 1: b^2 is 3/40, and the damping rate of gamma 4.5 at density 3 is 1.885.
    wanted = 2 * 1.885 * 0.075 / (12 * np.sin(np.pi / 8) ** 2)
    np.testing.assert_allclose(memory(melt), wanted, rtol=0.01)


def test_what_has_no_bond_remembers_nothing(melt):
    none = {"bond": np.zeros((0, 2), int)}
    assert experiment.chain_memory(melt.fluid, melt.state.bonded(none)) == 0.0


def test_boxes_of_a_state_become_strangers(melt):
    """And blocks last as long as chains remember."""
    goal = custom_goal(1.0, dpd.observe.temperature)
    how = {"state": melt.state, "boxes": 2}
    boxes = experiment.adopt(melt.fluid, goal, KEY, **how)
    x = np.asarray(boxes.state.unwrapped)
    assert x.shape[0] == 2 and np.sqrt(np.mean((x[0] - x[1]) ** 2)) > 0.3
    read = experiment.measure(boxes, melt.fluid, 1.0, 0.0, 10**9, lambda text: None)
    assert abs(read.estimate.value - 1.0) < 5 * read.estimate.error + 0.02
    per_box = read.time[-1] / boxes.memory(melt.fluid)
    assert per_box >= experiment.LEAST_BLOCKS / 2


def test_slow_states_have_slopes_by_chords(melt):
    setup = wishes.Setup(3.0, 0.1, state=melt.state)
    goal = custom_goal(1.0, dpd.observe.temperature)
    made = setup.mean(melt.fluid, KEY, lambda fluid: goal)
    assert isinstance(made, gauges.SlowMean)
    assert gauges.SlowMean.slopes is not gauges.Mean.slopes


def test_a_melt_is_sheared_more_slowly_than_its_chains_relax(melt):
    long = dpd.molecules(KEY, "A16", box=4.0, bonds=SPRING, report=None)
    rate = lambda made: float(
        wishes.Setup(3.0, 0.1, state=made.state).viscosity_goal(made.fluid, 1.0).flow.rate
    )
    memory = experiment.chain_memory(long.fluid, long.state)
    assert rate(long) <= wishes.SLOW_ENOUGH / memory < rate(melt)


@pytest.mark.parametrize(
    "how, told",
    [
        ({"viscosity": 1.0, "density": 3.0}, "density= is that of the state"),
        ({"viscosity": 1.0, "box": 3.0}, "box= is that of the state"),
        ({"diffusion": 1.0}, "diffusion= is measured of one kind of bead"),
    ],
)
def test_what_does_not_go_with_a_state_is_refused(melt, how, told):
    with pytest.raises(ValueError, match=told):
        dpd.calibrate(melt.fluid, "gamma", key=KEY, state=melt.state, **how)


def test_bonds_without_a_state_are_refused(melt):
    with pytest.raises(ValueError, match="give a state of it to begin from"):
        dpd.measure_viscosity(melt.fluid, key=KEY)
    with pytest.raises(ValueError, match="memory= is of the molecules of a state"):
        dpd.calibrate(dpd.water(), "gamma", viscosity=1.0, key=KEY, memory=3.0)
    with pytest.raises(TypeError, match="no single state"):
        dpd.calibrate(melt.fluid, "gamma", viscosity=1.0, key=KEY, state=melt)
