"""The pressure in slabs: all of it is there, where it is, and the tension that it adds up to."""

import dataclasses
from types import SimpleNamespace

import chains
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow
from dpdjax.engine.observables import STATIC, pressure_tensor
from dpdjax.engine.profiles import AXES


def started(fluid, state):
    """The same state with its sums over pairs."""
    return jax.jit(dpd.step)(fluid, state, jax.random.key(1), 0.005)


def total_of(fluid, state, bins, axis):
    """What the slabs add up to, x, y, z, over the volume."""
    profile = jax.jit(dpd.observe.pressure_in_slabs(bins, axis))(fluid, state)["pressure_profile"]
    return dict(zip(AXES[axis], np.asarray(profile).mean(axis=0)))


@pytest.mark.parametrize("axis, bins", [("x", 2), ("y", 7), ("z", 40)])
def test_the_slabs_add_up_to_the_pressure_tensor(axis, bins):
    """With pairs, bonds, angles and dihedrals, and lists in blocks."""
    fluid = chains.fluid()
    state = started(fluid, chains.state(fluid))
    tensor = np.diagonal(pressure_tensor(fluid, state, STATIC))
    found = total_of(fluid, state, bins, axis)
    np.testing.assert_allclose([found[k] for k in range(3)], tensor, rtol=1e-11)


@pytest.mark.parametrize("axis", ["y", "z"])
def test_in_a_tilted_box_too(axis):
    fluid = chains.fluid()
    state = started(fluid, chains.state(fluid, strain=0.3))
    tensor = np.diagonal(pressure_tensor(fluid, state, STATIC))
    found = total_of(fluid, state, 12, axis)
    np.testing.assert_allclose([found[k] for k in range(3)], tensor, rtol=1e-11)
    assert np.isnan(total_of(fluid, state, 12, "x")[0])


def test_the_drag_of_the_end_of_a_step_is_in_it(water, quiet_water, key):
    implicit = dpd.integrators.ImplicitDrag()
    state = jax.jit(dpd.step)(water, quiet_water, key, 0.02, integrator=implicit)
    assert jnp.max(jnp.abs(state.tally.carried)) > 0
    tensor = np.diagonal(pressure_tensor(water, state, STATIC))
    found = total_of(water, state, 5, "z")
    np.testing.assert_allclose([found[k] for k in range(3)], tensor, rtol=1e-11)


def pair(water, ends):
    """Two beads at rest."""
    state = dpd.initial_state(water, jax.random.key(0), box=4.0, n=2, skin=0.2)
    at = {"position": jnp.asarray(ends), "velocity": jnp.zeros((2, 3))}
    return dpd.integrators.update_lists(dataclasses.replace(state, **at))


def test_a_pair_across_the_face_by_hand(water):
    """0.8 apart along z from 3.9 to 0.7, force 25 (1 - 0.8): slabs of 0.5 have 0.1, 0.5 and 0.2
    of it."""
    state = pair(water, [[1.0, 1.0, 3.9], [1.0, 1.0, 0.7]])
    profile = dpd.observe.pressure_in_slabs(8, "z")(water, state)["pressure_profile"]
    wanted = np.zeros((8, 3))
    wanted[[7, 0, 1], 0] = 5.0 * np.array([0.1, 0.5, 0.2]) / (16.0 * 0.5)
    np.testing.assert_allclose(profile, wanted, atol=1e-14)


@pytest.mark.parametrize("z", [1.0, 1.2])
def test_a_pair_in_the_plane_is_where_it_is(water, z):
    """Between two slabs it is of both."""
    state = pair(water, [[1.0, 1.0, z], [1.6, 1.0, z]])
    profile = dpd.observe.pressure_in_slabs(8, "z")(water, state)["pressure_profile"]
    wanted, share = np.zeros((8, 3)), 25.0 * 0.4 * 0.6 / (16.0 * 0.5)
    wanted[[1, 2], 1] = [0.5 * share, 0.5 * share] if z == 1.0 else [0.0, share]
    np.testing.assert_allclose(profile, wanted, atol=1e-12)


def test_equal_arguments_give_one_observable():
    made = dpd.observe.pressure_in_slabs
    assert made(20, "y") is made(20, "y")
    with pytest.raises(ValueError, match="bins is 1; it must be a whole number of at least 2"):
        made(1)
    with pytest.raises(ValueError, match='axis is \'w\'; it is "x" or "y" or "z"'):
        made(20, "w")


def recorded(lengths=(4.0, 5.0, 6.0), frames=40, **values):
    """What a run leaves behind that recorded some values."""
    box = SimpleNamespace(lengths=np.array(lengths), strain=np.zeros(()))
    final = SimpleNamespace(box=box, position=np.zeros((3, 3)))
    found = {name: np.asarray(x) for name, x in values.items()}
    return SimpleNamespace(
        frames=found | {"time": np.arange(frames) * 0.1},
        flow=Flow.of(None),
        final=final,
        fluid=SimpleNamespace(kT=1.0, batch_axes=lambda: None),
        dt=0.1,
        is_batch=False,
    )


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_the_tension_by_hand(axis):
    pressure = np.random.default_rng(0).normal(20.0, 1.0, (40, 3, 3))
    run, k = recorded(pressure_tensor=pressure), "xyz".index(axis)
    found = dpd.measure.surface_tension(run, axis=axis, interfaces=3, skip=0.25)
    own = np.diagonal(pressure[10:].mean(axis=0))
    wanted = (4.0, 5.0, 6.0)[k] * (own[k] - np.delete(own, k).mean()) / 3
    np.testing.assert_allclose(found.value, wanted)
    assert found.error > 0


def test_a_profile_by_hand(tmp_path):
    rng = np.random.default_rng(1)
    slabs, side = rng.normal(20.0, 1.0, (40, 8, 3)), rng.normal(6.0, 0.1, 40)
    run = recorded(pressure_profile=slabs, pressure_profile_side=side)
    found = dpd.measure.pressure_profile(run, skip=0.0)
    np.testing.assert_allclose(found.normal, slabs[..., 0].mean(axis=0))
    np.testing.assert_allclose(found.tangential, slabs[..., 1:].mean(axis=(0, 2)))
    np.testing.assert_allclose(found.z, (np.arange(8) + 0.5) * side.mean() / 8)
    each = (slabs[..., 0] - slabs[..., 1:].mean(axis=-1)).mean(axis=1) * side / 2
    np.testing.assert_allclose(found.tension.value, each.mean())
    ax = found.plot()
    assert [t.get_text() for t in ax.get_legend().get_texts()] == ["normal", "tangential"]


def test_both_tensions_are_of_one_run(water, quiet_water, key):
    """Of a fluid at rest, whose drag has no mean: the same steps, the same numbers but for it."""
    how = dpd.integrators.CellRescaling(23.0, coupling="normal")
    static = lambda fluid, state: {"pressure_tensor": pressure_tensor(fluid, state, STATIC)}
    record = [static, dpd.observe.pressure_in_slabs(6), dpd.observe.box]
    given = water, quiet_water, key, 0.01, dpd.Plan(12, every=2)
    run = dpd.run(*given, integrator=how, observe=record, progress=False)
    whole = dpd.measure.surface_tension(run, interfaces=1)
    of_slabs = dpd.measure.pressure_profile(run, interfaces=1).tension
    np.testing.assert_allclose(whole.value, of_slabs.value, rtol=1e-9)
    unknown = dpd.run(*given, integrator=how, observe=static, progress=False)
    with pytest.raises(ValueError, match="its sides in each frame are unknown: record them"):
        dpd.measure.surface_tension(unknown)


def test_what_was_not_recorded_is_told():
    pressure = np.ones((40, 3, 3))
    for measure, told in (
        (lambda: dpd.measure.pressure_profile(recorded()), "use observe=.*pressure_in_slabs"),
        (lambda: dpd.measure.surface_tension(recorded()), "use observe=dpd.observe.standard"),
        (
            lambda: dpd.measure.surface_tension(recorded(pressure_tensor=pressure), interfaces=0),
            "interfaces is 0",
        ),
        (
            lambda: dpd.measure.surface_tension(recorded(pressure_tensor=pressure), axis="n"),
            "axis is 'n'",
        ),
        (
            lambda: dpd.measure.surface_tension(recorded(pressure_tensor=pressure), skip=1.0),
            "skip is 1, and leaves no frame",
        ),
    ):
        with pytest.raises(ValueError, match=told):
            measure()
