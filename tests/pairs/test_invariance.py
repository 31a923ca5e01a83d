"""Invariance: a run depends on its physics and its key, never on how it is carried out."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import box as boxes
from dpdjax.pairs import neighbours as lists

DT, FLOW = 0.01, dpd.shear(1.0)


def same_bits(a, b):
    return all(
        jnp.array_equal(getattr(a, name), getattr(b, name))
        for name in ("position", "velocity", "force", "image")
    )


def agree(box, a, b):
    """Equal to rounding that ten steps have amplified, whichever image a bead is in."""
    moved = np.asarray(a.position - b.position) / np.asarray(box.lengths)[None]
    across = np.round(moved[:, 1])
    moved[:, 0] -= across * float(box.strain * box.lengths[1] / box.lengths[0])
    np.testing.assert_allclose(moved - np.round(moved), 0, atol=1e-12)
    np.testing.assert_allclose(a.velocity, b.velocity, atol=1e-10)


@pytest.fixture(scope="module")
def run(simulate, water, sheared_water, key):
    """``run(plan, state=..., key=...)``: sheared water from one state, compiled."""
    return lambda plan, state=sheared_water, key=key: simulate(water, state, key, DT, plan, FLOW)


@pytest.fixture(scope="module")
def batch(water, sheared_water, ten):
    """``batch(kT, keys)``: a compiled batch of members that start from one state."""
    member = lambda kT, key: dpd.simulate(water.set(kT=kT), sheared_water, key, DT, ten, FLOW)
    compiled = jax.jit(jax.vmap(member))
    return lambda kT, keys: compiled(jnp.asarray(kT), jnp.stack(keys))


def test_same_key_same_bits_and_other_key_other_bits(run, ten):
    once, again, other = run(ten), run(ten), run(ten, key=jax.random.key(8))
    assert same_bits(once.final, again.final)
    assert not jnp.any(once.final.velocity == other.final.velocity)


@pytest.mark.parametrize("plan, pieces", [(dpd.Plan(2, 5), 2), (dpd.Plan(20, 1), 1)], ids=str)
def test_chunk_length_is_bitwise_invisible(plan, pieces, run):
    whole, state = run(dpd.Plan(4, 5)).final, run(plan).final
    for _ in range(pieces - 1):
        state = run(plan, state).final
    assert same_bits(whole, state)
    assert whole.step == state.step


def test_chunk_of_one_frame_agrees_to_rounding(run):
    """Not bitwise: the compiler unrolls a loop of a single trip, and may round it differently."""
    whole = run(dpd.Plan(4, 5)).final
    agree(whole.box, whole, run(dpd.Plan(1, 20)).final)


def test_list_capacity_is_bitwise_invisible(run, sheared_water, ten):
    larger = dpd.grow(sheared_water)
    assert larger.neighbours[0].grid.capacity > sheared_water.neighbours[0].grid.capacity
    assert larger.neighbours[0].grid.window > sheared_water.neighbours[0].grid.window
    assert same_bits(run(ten).final, run(ten, larger).final)


def test_companions_in_a_batch_are_bitwise_invisible(batch):
    keys = [jax.random.key(k) for k in range(3)]
    first, second = batch([1.0, 1.0], keys[:2]), batch([1.0, 25.0], keys[::2])
    rebuilt = ~jnp.all(
        first.final.neighbours[0].list.reference_position
        == second.final.neighbours[0].list.reference_position,
        axis=(1, 2),
    )
    assert rebuilt.tolist() == [False, True], (
        "the hot companion forces rebuilds that the first member does not take"
    )
    member = lambda run: jax.tree.map(lambda leaf: leaf[0], run.final)
    assert same_bits(member(first), member(second))
    assert not same_bits(member(first), jax.tree.map(lambda leaf: leaf[1], first.final))


def test_batch_agrees_with_its_members_run_alone(batch, run, water, simulate, sheared_water, ten):
    keys = [jax.random.key(k) for k in range(2)]
    together = batch([1.0, 4.0], keys)
    for k, kT in enumerate((1.0, 4.0)):
        alone = simulate(water.set(kT=kT), sheared_water, keys[k], DT, ten, FLOW).final
        agree(alone.box, alone, jax.tree.map(lambda leaf: leaf[k], together.final))


def test_skin_is_invisible_to_rounding(run, sheared_water, ten):
    """The wider list of this box is built from all pairs, so cells are compared with all pairs
    too."""
    state = sheared_water
    wide = lists.plan_grid(state.n, state.box.lengths, 1.0, 0.4)
    assert wide.cells is None
    wider = dataclasses.replace(
        state, neighbours=(lists.allocate(wide, state.box, state.position),)
    )
    agree(state.box, run(ten).final, run(ten, wider).final)


def test_order_of_beads_is_invisible_to_rounding(run, sheared_water, ten):
    state, order = sheared_water, jax.random.permutation(jax.random.key(5), sheared_water.n)
    beads = {
        name: getattr(state, name)[order]
        for name in ("position", "velocity", "force", "image", "id", "species")
    }
    shuffled = dataclasses.replace(state, **beads)
    grid = state.neighbours[0].grid
    shuffled = dataclasses.replace(
        shuffled, neighbours=(lists.allocate(grid, state.box, shuffled.position),)
    )
    straight = run(ten).final
    straight = dataclasses.replace(
        straight, position=straight.position[order], velocity=straight.velocity[order]
    )
    agree(state.box, straight, run(ten, shuffled).final)


def test_origin_of_a_sheared_box_is_invisible_to_rounding(run, sheared_water, ten):
    state = sheared_water
    position, _ = boxes.wrap(state.box, state.position + jnp.array([[0.7, 1.9, -3.1]]))
    moved = dataclasses.replace(state, position=position)
    moved = dataclasses.replace(
        moved, neighbours=(lists.allocate(state.neighbours[0].grid, state.box, position),)
    )
    np.testing.assert_allclose(run(ten, moved).final.velocity, run(ten).final.velocity, atol=1e-10)


def test_recording_is_bitwise_invisible(run, simulate, water, sheared_water, key, ten):
    observed = simulate(
        water, sheared_water, key, DT, ten, FLOW, observe=dpd.mean(dpd.observe.stresses)
    )
    assert same_bits(run(ten).final, observed.final)
