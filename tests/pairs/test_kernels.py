"""A kernel of one's own stands behind the same runs: here one that sums every bead's own row of all
pairs, without a list and without a scatter."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.pairs import kernels
from dpdjax.pairs import neighbours as lists
from dpdjax.pairs.geometry import geometry
from dpdjax.pairs.laws import central_forces
from dpdjax.pairs.sums import Forces, Tally, sum_pairs


def by_rows(fluid, interaction, beads, idx, moment, wanted):
    """Forces of central laws between all beads, each pair seen from either side."""
    n = beads.id.shape[0]
    i = jnp.repeat(jnp.arange(n), n - 1)
    j = (i + 1 + jnp.tile(jnp.arange(n - 1), n)) % n
    pairs = geometry(fluid, interaction, beads, jnp.stack([i, j]), moment)
    energy, along = central_forces(interaction, fluid.kT, pairs, moment, wanted)
    of_bead = lambda values: jnp.sum(values.reshape(n, n - 1), axis=1)
    force = jnp.stack([of_bead(sum(along.values()) * e) for e in pairs.e], axis=1)
    if not wanted.tally:
        return Forces(force, None, None)
    halves = jax.tree.map(lambda total: 0.5 * total, sum_pairs(pairs, energy, along))
    return Forces(force, None, Tally.zero(force.dtype, fluid.origins).plus(*halves))


def with_kernel(state, kernel):
    changed = lambda n: lists.pad(n, dataclasses.replace(n.grid, kernel=kernel))
    return dataclasses.replace(state, neighbours=tuple(map(changed, state.neighbours)))


@pytest.mark.parametrize("kernel", [by_rows, kernels.scattered, kernels.blocked])
def test_all_kernels_make_the_same_run(kernel, water, sheared_water, simulate, key, ten):
    def stress(gamma, state):
        run = simulate(water.set(gamma=gamma), state, key, 0.01, ten, dpd.shear(1.0))
        return run.frames["pressure_tensor"][-1, 0, 1], run

    both = jax.value_and_grad(stress, has_aux=True)
    (value, run), slope = both(4.5, with_kernel(sheared_water, kernel))
    (expected, reference), expected_slope = both(4.5, sheared_water)
    assert run.final.status == 0
    np.testing.assert_allclose(run.final.position, reference.final.position, atol=1e-10)
    np.testing.assert_allclose(value, expected, rtol=1e-8)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-7)


def test_a_saved_state_takes_the_kernel_of_the_machine_that_reads_it(quiet_water, tmp_path):
    dpd.save_state(tmp_path / "state.npz", with_kernel(quiet_water, by_rows))
    (held,) = dpd.load_state(tmp_path / "state.npz").neighbours
    assert held.grid.kernel is kernels.suited()
