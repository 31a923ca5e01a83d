"""Order in memory: beads are sorted by cell while a run goes on, and nobody sees it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine import order
from dpdjax.pairs import cells as by_cell

FLOW, PLAN = dpd.shear(1.0), dpd.Plan(3, 5)


def places(fluid, state):
    """An observable that tells the beads apart."""
    return {"where": state.position, "who": state.id, "pairs": state.neighbours[0].list.idx}


OBSERVE = [dpd.mean(dpd.observe.stresses), places]


@pytest.fixture
def run(monkeypatch, water, key):
    """``run(state, kept, plan, lasts)``: sheared water with and without sorting, each frame or
    once."""

    def go(state, kept, plan=PLAN, lasts=3):
        monkeypatch.setattr(order, "SMALLEST", 100 if kept else 10**9)
        monkeypatch.setattr(order, "LASTS", lasts)
        simulate = lambda state, key: dpd.simulate(
            water, state, key, 0.01, plan, FLOW, observe=OBSERVE
        )
        simulate = jax.jit(simulate if state.position.ndim == 2 else jax.vmap(simulate))
        return simulate(
            state, key if state.position.ndim == 2 else jax.random.split(key, len(state.position))
        )

    return go


def arrays(run):
    return jax.tree.leaves((run.final, run.frames))


def same_bits(a, b):
    return all(np.array_equal(x, y) for x, y in zip(arrays(a), arrays(b), strict=True))


@pytest.mark.parametrize("lasts", [3, 100], ids=["each frame", "once"])
def test_sorting_is_bitwise_invisible(lasts, run, sheared_water):
    sorted_run, plain = run(sheared_water, True, lasts=lasts), run(sheared_water, False)
    assert jnp.any(
        plain.final.neighbours[0].list.reference_position
        != sheared_water.neighbours[0].list.reference_position
    )
    assert same_bits(sorted_run, plain)


def test_sorting_is_bitwise_invisible_in_a_batch(run, sheared_water):
    batch = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (3, *leaf.shape)), sheared_water)
    assert same_bits(run(batch, True), run(batch, False))


def test_cutting_a_sorted_run_is_bitwise_invisible(run, sheared_water):
    whole, state = run(sheared_water, True, dpd.Plan(4, 4)), sheared_water
    for _ in range(2):
        part = run(state, True, dpd.Plan(2, 4))
        state = part.final
    assert all(
        np.array_equal(x, y) for x, y in zip(jax.tree.leaves(whole.final), jax.tree.leaves(state))
    )


def test_beads_come_back_in_the_order_they_were_given(run, sheared_water):
    shuffled = order.permuted(
        sheared_water, jax.random.permutation(jax.random.key(5), sheared_water.n)
    )
    ran, straight = run(shuffled, True).final, run(sheared_water, True).final
    assert jnp.array_equal(ran.id, shuffled.id)
    assert jnp.array_equal(ran.position, straight.position[shuffled.id])
    assert jnp.array_equal(ran.velocity, straight.velocity[shuffled.id])


def test_beads_of_a_cell_lie_together(monkeypatch, sheared_water):
    monkeypatch.setattr(order, "SMALLEST", 0)
    state = order.in_cell_order(sheared_water)
    grid = state.neighbours[0].grid
    cell = by_cell._cells(grid, state.box, state.position)[0]
    assert jnp.all(jnp.diff(cell) >= 0)
    assert jnp.all((jnp.diff(cell) > 0) | (jnp.diff(state.id) > 0))
    assert jnp.array_equal(state.position, sheared_water.position[state.id])


@pytest.mark.parametrize("cpu", [True, False], ids=["cpu", "accelerator"])
@pytest.mark.parametrize("n, cells", [(300, 5), (1, 1), (70_000, 300_000)], ids=str)
def test_the_sort_by_cell_and_id(n, cells, cpu, monkeypatch):
    monkeypatch.setattr(by_cell, "on_cpu", lambda: cpu)
    rng = np.random.default_rng(0)
    cell, ids = rng.integers(0, cells, n), rng.permutation(n)
    expected = np.lexsort((ids, cell))
    got = by_cell._sorted(jnp.asarray(cell, jnp.int32), cells, jnp.asarray(ids, jnp.int32))
    assert np.array_equal(got, expected)
    assert np.array_equal(
        by_cell._sorted(jnp.asarray(cell, jnp.int32), cells), np.argsort(cell, kind="stable")
    )


@pytest.mark.parametrize("value", [jnp.nan, jnp.inf, -1e30])
def test_beads_that_are_nowhere_are_sorted_all_the_same(value, monkeypatch, sheared_water):
    monkeypatch.setattr(order, "SMALLEST", 0)
    lost = dataclasses.replace(sheared_water, position=sheared_water.position.at[5:9].set(value))
    assert jnp.array_equal(jnp.sort(order.in_cell_order(lost).id), sheared_water.id)


def test_derivatives_of_a_sorted_run(monkeypatch, water, sheared_water, key):
    def speed(gamma, kept):
        monkeypatch.setattr(order, "SMALLEST", 100 if kept else 10**9)
        final = dpd.simulate(
            water.set(gamma=gamma), sheared_water, key, 0.01, dpd.Plan(2, 3), FLOW
        ).final
        return jnp.sum(final.velocity[:7] ** 2)

    for derivative in (jax.grad, jax.jacfwd):
        kept, plain = (derivative(lambda gamma: speed(gamma, kept))(4.5) for kept in (True, False))
        assert kept != 0
        np.testing.assert_allclose(kept, plain, rtol=1e-12)


def test_small_boxes_are_left_alone(monkeypatch, sheared_water):
    assert not order.is_kept(sheared_water)
    monkeypatch.setattr(order, "SMALLEST", sheared_water.n)
    assert order.is_kept(sheared_water)
