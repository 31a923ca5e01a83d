"""Compilation: once per shape. Numbers, keys and states never compile anything again."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd

PLAN = dpd.Plan(3, 7)  # no other test has it


@pytest.fixture(scope="module")
def mixture():
    """``mixture(a, gamma)``: a fluid of two species."""

    def make(a, gamma):
        repulsion = dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)
        drag = dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)
        return dpd.fluid([repulsion], [drag], kT=1.0, species=2)

    return make


@pytest.fixture(scope="module")
def two_species(sheared_water):
    species = jnp.arange(sheared_water.n, dtype=jnp.int32) % 2
    return dataclasses.replace(sheared_water.restarted(), species=species)


def test_other_numbers_keys_and_states_do_not_recompile(simulate, water, fresh, sheared_water, key):
    simulate(water, sheared_water, key, 0.01, PLAN, dpd.shear(1.0))
    compiled = simulate._cache_size()
    run = simulate(water.set(gamma=9.0, a=15.0, kT=0.5, mass=2.0), fresh, jax.random.key(1), 0.005, PLAN, dpd.shear(0.3))
    simulate(water, run.final, key, 0.01, PLAN, dpd.shear(1.0))
    simulate(water, run.final.restarted(), key, 0.01, dpd.Plan(frames=3, every=7), dpd.shear(1.0))
    assert simulate._cache_size() == compiled
    simulate(water, dpd.grow(fresh), key, 0.01, PLAN, dpd.shear(1.0))
    assert simulate._cache_size() == compiled + 1, "another shape is another program"


def test_mixture_of_equal_species_is_one_fluid(simulate, mixture, water, sheared_water, two_species, key):
    same = mixture(np.full((2, 2), 25.0), np.full((2, 2), 4.5))
    two = simulate(same, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    one = simulate(water, sheared_water.restarted(), key, 0.01, PLAN, dpd.shear(1.0))
    np.testing.assert_allclose(two.final.velocity, one.final.velocity, atol=1e-11)
    np.testing.assert_allclose(two.frames["pressure_tensor"], one.frames["pressure_tensor"], atol=1e-9)


def test_mixtures_share_one_program(simulate, mixture, two_species, key):
    first = mixture([[25.0, 25.0], [25.0, 25.0]], [[4.5, 4.5], [4.5, 4.5]])
    other = mixture([[25.0, 40.0], [40.0, 25.0]], [[4.5, 9.0], [9.0, 2.0]])
    a = simulate(first, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    compiled = simulate._cache_size()
    b = simulate(other, two_species, key, 0.01, PLAN, dpd.shear(1.0))
    assert simulate._cache_size() == compiled
    assert b.final.status == 0
    assert b.frames["potential_energy"][-1] > 1.1 * a.frames["potential_energy"][-1]
