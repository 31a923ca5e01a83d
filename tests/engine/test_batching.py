"""Batching: each member is worked on where it needs to be, and sees nothing of the others."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax import xla
from dpdjax.engine import members
from dpdjax.engine.system import System
from dpdjax.xla import all_at_once, each_member, on_cpu, one_by_one, where_needed

NEEDED = jnp.array([[True, False, True], [False, False, True]])
OLD = {"x": jnp.arange(6.0).reshape(2, 3), "k": jnp.arange(24).reshape(2, 3, 4)}
STEP = jnp.array([10.0, 20.0, 30.0])


def work(old, step):
    return {"x": old["x"] + step, "k": -old["k"]}


EXPECTED = {
    "x": np.where(NEEDED, OLD["x"] + STEP[None], OLD["x"]),
    "k": np.where(NEEDED[..., None], -OLD["k"], OLD["k"]),
}


def test_members_are_worked_on_where_needed():
    twice = jax.vmap(jax.vmap(where_needed(work)), in_axes=(0, 0, None))
    for apply in (twice, jax.jit(twice)):
        jax.tree.map(np.testing.assert_array_equal, apply(NEEDED, OLD, STEP), EXPECTED)


def test_one_flag_serves_a_whole_batch():
    apply = jax.vmap(where_needed(work), in_axes=(None, 0, 0))
    first = jax.tree.map(lambda x: x[0], OLD)
    jax.tree.map(np.testing.assert_array_equal, apply(jnp.asarray(False), first, STEP), first)
    np.testing.assert_array_equal(apply(jnp.asarray(True), first, STEP)["x"], first["x"] + STEP)


@pytest.mark.parametrize("way", [one_by_one, all_at_once])
@pytest.mark.parametrize("row", [0, 1])
def test_both_ways_are_one(way, row):
    """The first way is what a CPU does, the second what accelerators do."""
    old, expected = (jax.tree.map(lambda x: x[row], tree) for tree in (OLD, EXPECTED))
    jax.tree.map(
        np.testing.assert_array_equal, jax.jit(way(work))(NEEDED[row], old, (STEP,)), expected
    )


def test_work_is_done_only_where_needed():
    seen = []

    def noted(old, step):
        jax.debug.callback(lambda s: seen.append(float(s)), step)
        return work(old, step)

    old = jax.tree.map(lambda x: x[0], OLD)
    jax.block_until_ready(jax.jit(jax.vmap(where_needed(noted)))(NEEDED[0], old, STEP))
    jax.effects_barrier()
    assert sorted(seen) == [10.0, 30.0]


@pytest.mark.parametrize("cpu", [True, False], ids=["cpu", "accelerator"])
def test_each_member_is_vmap(cpu, monkeypatch):
    monkeypatch.setattr(xla, "on_cpu", lambda: cpu)
    function = lambda tree, shift, key: {
        "x": tree["x"] * tree["c"] + shift,
        "u": jax.random.uniform(key),
    }
    axes = ({"x": 0, "c": None}, None, 0)
    arguments = (
        {"x": jnp.arange(6.0).reshape(3, 2), "c": 2.0},
        jnp.arange(2.0),
        jax.random.split(jax.random.key(0), 3),
    )
    expected = jax.vmap(function, axes)(*arguments)
    jax.tree.map(
        np.testing.assert_array_equal, jax.jit(each_member(function, axes))(*arguments), expected
    )
    everywhere = each_member(lambda x, y: x - y)(jnp.arange(3.0), jnp.ones(3))
    np.testing.assert_array_equal(everywhere, [-1.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def scanned(water, fresh, key):
    """Six members of a scan as a run would leave them, no step run."""
    fluid = water.set(gamma=jnp.array([2.0, 2.0, 2.0, 9.0, 9.0, 9.0]))
    final = jax.tree.map(lambda x: jnp.stack([x] * 6), fresh)
    return dpd.Trajectory(
        final,
        {"number": np.arange(12).reshape(6, 2)},
        System.of(fluid, 0.01, dpd.shear(jnp.arange(6.0))),
    )


def test_members_are_chosen_by_number_slice_or_list(scanned):
    for which in (slice(3, 6), [3, 4, 5], slice(-3, None)):
        part = scanned[which]
        assert part.is_batch and len(part.members()) == 3
        assert np.array_equal(part.fluid.value("gamma"), [9, 9, 9]) and np.array_equal(
            part.flow.rate, [3, 4, 5]
        )
        assert np.array_equal(part.frames["number"], [[6, 7], [8, 9], [10, 11]])
    assert not scanned[4].is_batch and scanned[-1].flow.rate == 5 and scanned[4].dt == 0.01
    assert [m.flow.rate for m in scanned] == [m.flow.rate for m in scanned.members()]
    for which in (6, -7, slice(6, None)):
        with pytest.raises(IndexError):
            scanned[which]
    with pytest.raises(TypeError, match="no batch"):
        scanned[0][0]


def test_members_that_fail_are_named_with_their_numbers(scanned):
    failed = sys.modules[dpd.stream.__module__]._failed
    told = failed({1: "before"}, np.uint32([0, 4, 0, 0, 4, 0]), scanned.system, "stopped")
    assert told.keys() == {1, 4} and told[1] == "before"
    assert told[4].startswith(
        "member 4 (gamma = 9., rate = 4.) of 6 stopped: positions or velocities became NaN"
    )
    alone = failed({}, np.uint32(4), scanned[0].system, "stopped")
    assert alone[0].startswith("stopped: positions")


@pytest.mark.skipif(not on_cpu(), reason="an accelerator has one program for all")
@pytest.mark.parametrize("count", [1, 3])
def test_members_on_cores_are_runs_of_their_own(water, fresh, key, monkeypatch, count):
    """To the last bit, on however many cores."""
    monkeypatch.setattr(members, "cores", lambda: count)
    gammas, keys = jnp.array([2.0, 4.5, 9.0, 4.5]), jax.random.split(key, 4)
    go = lambda gamma, key: dpd.run(
        water.set(gamma=gamma), fresh, key, 0.005, dpd.Plan(3, 4), progress=False
    )
    batch = go(gammas, keys)
    for k in (0, 3):
        alone = go(gammas[k], keys[k])
        jax.tree.map(np.testing.assert_array_equal, batch[k].final.beads, alone.final.beads)
        jax.tree.map(np.testing.assert_array_equal, batch[k].frames, alone.frames)


@pytest.mark.skipif(not on_cpu(), reason="an accelerator has one program for all")
def test_members_on_cores_are_of_the_precision_of_who_asks(fresh, key):
    """Settings of one thread are not those of others."""
    with jax.enable_x64(not jax.config.jax_enable_x64):
        matter = dpd.water(gamma=9.0)
        state = dpd.initial_state(matter, key, box=4.2, density=3.0)
        keys = jax.random.split(key, 2)
        other = dpd.run(matter, state, keys, 0.005, dpd.Plan(2, 2), progress=False).final
        assert other.velocity.dtype == state.velocity.dtype != fresh.velocity.dtype


def test_what_one_member_raises_ends_the_batch():
    """An error of a program, and not the results of the others."""

    def program(k):
        if k == 2:
            raise RuntimeError("out of memory")
        return np.arange(3) + k

    stacked = members.on_cores(program, lambda k: (k,), 2)
    np.testing.assert_array_equal(stacked, [[0, 1, 2], [1, 2, 3]])
    with pytest.raises(RuntimeError, match="out of memory"):
        members.on_cores(program, lambda k: (k,), 4)


def test_a_member_that_fails_leaves_the_others_as_they_were(water, fresh, key):
    """The whole batch stopped, without a name and without its frames."""
    go = lambda rates: dpd.run(
        water,
        fresh,
        jax.random.split(key, 3),
        0.01,
        dpd.Plan(4, 10),
        dpd.shear(jnp.array(rates)),
        progress=False,
    )
    told = (
        r"member 1 \(rate = 90.\) of 3 stopped between steps 0 and 40: the beads ran "
        r"away.*survivors"
    )
    with pytest.warns(UserWarning, match=told):
        run = go([0.2, 90.0, 0.4])
    well = go([0.2, 0.3, 0.4])
    assert [k for k, _ in run.failed] == [1] and run.complete
    assert [m.complete for m in run.members()] == [True, False, True] and run[1].failed[0][0] == 0
    assert np.all(np.isnan(run.frames["temperature"][1])) and np.all(
        np.isfinite(run.final.velocity)
    )
    kept = run.survivors
    assert not kept.failed and np.array_equal(kept.flow.rate, [0.2, 0.4])
    jax.tree.map(np.testing.assert_array_equal, kept.frames, well[[0, 2]].frames)
    jax.tree.map(np.testing.assert_array_equal, kept.final.position, well[[0, 2]].final.position)
    with pytest.raises(
        ValueError,
        match=r"the run failed: member 1 \(rate = 90.\) of 3 stopped.*measure the others, "
        r"trajectory.survivors",
    ):
        dpd.shear_viscosity(run)
    with pytest.raises(
        ValueError, match=r"the run failed: member 1 .*the survivors of the batch it was in"
    ):
        dpd.shear_viscosity(run[1])
    with pytest.raises(dpd.RunError, match=r"member 0 \(rate = 80.\) of 3 .*member 2") as caught:
        go([80.0, 90.0, 100.0])
    with pytest.raises(ValueError, match="all 3 members failed"):
        _ = caught.value.trajectory.survivors


def test_a_grid_of_keys_is_told_what_to_give(water, fresh, key):
    with pytest.raises(
        ValueError, match=r"shape \(3, 3\); give a vector of them, keys.reshape\(-1\)"
    ):
        dpd.run(water, fresh, jax.random.split(key, (3, 3)), 0.01, dpd.Plan(1))


def test_beads_that_no_list_holds(water, fresh, key):
    """An attraction without a core: lists grow and grow; the cure is no larger list."""
    told = "the beads crowd together until no neighbour list holds them; give repulsions"
    with pytest.warns(UserWarning, match=rf"member 1 \(a = -300.\) of 2 .*{told}"):
        run = dpd.run(
            water.set(a=jnp.array([25.0, -300.0])),
            fresh,
            jax.random.split(key, 2),
            0.005,
            dpd.Plan(20, 100),
            progress=False,
        )
    assert [k for k, _ in run.failed] == [1] and "overflow" not in run.failed[0][1]
