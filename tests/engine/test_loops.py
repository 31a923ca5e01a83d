"""A loop of one's own: single steps and forces, outside any run."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import neighbours as lists


def test_steps_are_those_of_a_run(water, fresh, key):
    """In a loop of Python under jit, and in a scan: what ``simulate`` comes to."""
    flow = dpd.shear(0.5)
    run = dpd.simulate(water, fresh, key, 0.01, dpd.Plan(3, 10), flow)
    one = jax.jit(lambda state: dpd.step(water, state, key, 0.01, flow))
    state = dpd.step(water, fresh, key, 0.01, flow)
    for _ in range(29):
        state = one(state)
    assert state.status == 0 and state.step == 30
    np.testing.assert_allclose(state.position, run.final.position, atol=1e-9)
    seen = dpd.observe.standard(water, state)
    np.testing.assert_allclose(seen["pressure_tensor"], run.frames["pressure_tensor"][-1])

    def energy(a):
        stiffer = water.set(a=a)
        turn = lambda state, _: (dpd.step(stiffer, state, key, 0.01, flow), None)
        return jax.lax.scan(turn, fresh, length=5)[0].tally.energy

    slope, step = jax.jvp(energy, (25.0,), (1.0,))[1], 1e-4
    by_hand = float(energy(25.0 + step) - energy(25.0 - step)) / (2 * step)
    assert float(slope) == pytest.approx(by_hand, rel=1e-5)


def test_steps_in_a_batch(water, fresh, key):
    keys = jax.random.split(key, 2)
    both = jax.vmap(lambda key: dpd.step(water, fresh, key, 0.01))(keys)
    np.testing.assert_allclose(
        both.velocity[1], dpd.step(water, fresh, keys[1], 0.01).velocity, atol=1e-12
    )


def test_forces_of_beads_moved_by_hand(water, fresh, key):
    """The lists follow: forces are the slope of the energy, wherever beads were put."""
    elsewhere = jnp.roll(fresh.position, 7, axis=0) + 0.05
    moved = dataclasses.replace(fresh, position=elsewhere % float(fresh.box.lengths[0]))
    still = ("conservative",)

    def energy(position):
        state = dataclasses.replace(moved, position=position)
        return dpd.forces(water, state, key, 0.01, kinds=still).tally.energy

    found = dpd.forces(water, moved, key, 0.01, kinds=still)
    assert found.torque is None and not np.any(found.tally.virial["drag"])
    np.testing.assert_allclose(found.force, -jax.grad(energy)(moved.position), atol=1e-7)
    apart = [dpd.forces(water, moved, key, 0.01, kinds=(k,)).force for k in ("drag", "random")]
    whole = dpd.forces(water, moved, key, 0.01).force
    np.testing.assert_allclose(found.force + sum(apart), whole, atol=1e-9)


def test_forces_that_cannot_be_had(water, fresh, key):
    with pytest.raises(ValueError, match="kinds has 'friction'; they are conservative, drag"):
        dpd.forces(water, fresh, key, 0.01, kinds=("friction",))
    grid = dataclasses.replace(fresh.neighbours[0].grid, capacity=64)
    tight = dpd.initial_state(water, key, box=4.2, density=3.0)
    short = lists.allocate(grid, tight.box, tight.position)
    tight = dataclasses.replace(tight, neighbours=(short,))
    assert np.all(np.isnan(dpd.forces(water, tight, key, 0.01).force))
    assert dpd.step(water, tight, key, 0.01).status != 0
