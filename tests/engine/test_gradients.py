"""Gradients: forward, reverse and differences agree; scaling is exact; failed runs say so."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import dpdjax as dpd
from dpdjax.pairs.box import Box

NUMBERS = {
    "a": lambda start: start["fluid"].interactions[0].conservative[0].coefficients["a"],
    "r_c of the repulsion": lambda start: (
        start["fluid"].interactions[0].conservative[0].coefficients["r_c"]
    ),
    "gamma": lambda start: start["fluid"].interactions[0].drag[0].coefficients["gamma"],
    "r_c of the drag": lambda start: start["fluid"].interactions[0].drag[0].coefficients["r_c"],
    "kT": lambda start: start["fluid"].kT,
    "mass": lambda start: start["fluid"].mass,
    "dt": lambda start: start["dt"],
    "rate": lambda start: start["flow"].rate,
    "box lengths": lambda start: start["lengths"],
    "positions": lambda start: start["position"],
    "velocities": lambda start: start["velocity"],
}


@pytest.fixture(scope="module")
def start(water, sheared_water):
    """Every number that a run starts from, as one tree."""
    state = sheared_water
    return {
        "fluid": water,
        "flow": dpd.shear(1.0),
        "dt": jnp.asarray(0.01),
        "lengths": state.box.lengths,
        "position": state.position,
        "velocity": state.velocity,
    }


@pytest.fixture(scope="module")
def stress(sheared_water, key, ten):
    """Shear stress ten steps later, as a function of those numbers."""

    def value(start, remat=False):
        state = dataclasses.replace(
            sheared_water.restarted(),
            position=start["position"],
            velocity=start["velocity"],
            box=Box(start["lengths"], sheared_water.box.strain),
        )
        run = dpd.simulate(start["fluid"], state, key, start["dt"], ten, start["flow"], remat=remat)
        return run.frames["pressure_tensor"][-1, 0, 1]

    return value


@pytest.fixture(scope="module")
def value(stress):
    return jax.jit(stress)


@pytest.fixture(scope="module")
def reverse(stress):
    return jax.jit(jax.grad(stress))


@pytest.fixture(scope="module")
def forward(stress):
    return jax.jit(lambda start, direction: jax.jvp(stress, (start,), (direction,))[1])


def along(start, leaf):
    """The direction that moves one number by its own size, or every bead by 0.1, and nothing
    else."""
    signs = jnp.asarray(np.random.default_rng(0).choice([-1.0, 1.0], leaf.shape))
    move = signs * (leaf if leaf.ndim < 2 else 0.1)
    return jax.tree.map(lambda x: move if x is leaf else jnp.zeros_like(x), start)


@pytest.mark.parametrize("name", NUMBERS)
def test_forward_reverse_and_difference_agree(name, start, value, reverse, forward):
    direction, h = along(start, NUMBERS[name](start)), 1e-6
    slope = forward(start, direction)
    beside = [value(jax.tree.map(lambda x, d: x + s * h * d, start, direction)) for s in (1, -1)]
    flat = [ravel_pytree(tree)[0] for tree in (reverse(start), direction)]
    assert abs(slope) > 1e-6
    np.testing.assert_allclose(jnp.dot(*flat), slope, rtol=1e-9)
    np.testing.assert_allclose((beside[0] - beside[1]) / (2 * h), slope, rtol=1e-6)


def test_every_gradient_is_finite(start, reverse):
    assert all(jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(reverse(start)))


def test_remat_gives_the_same_gradient(start, stress, reverse):
    again = jax.jit(jax.grad(lambda start: stress(start, remat=True)))(start)
    np.testing.assert_allclose(
        ravel_pytree(again)[0], ravel_pytree(reverse(start))[0], rtol=1e-9, atol=1e-12
    )


def test_scaling_all_energies_scales_every_stress(water, sheared_water, key, ten):
    """An exact identity: (kT, a, gamma, dt, rate, v) by (l, l, sqrt l, 1/sqrt l, sqrt l, sqrt
    l)."""

    def stresses(scale):
        root = jnp.sqrt(scale)
        fluid = water.set(kT=1.0 * scale, a=25.0 * scale, gamma=4.5 * root)
        state = dataclasses.replace(
            sheared_water.restarted(), velocity=sheared_water.velocity * root
        )
        return dpd.simulate(
            fluid, state, key, 0.01 / root, ten, dpd.shear(root), observe=dpd.observe.stresses
        ).frames

    both = jax.jit(lambda scale: jax.jvp(stresses, (scale,), (jnp.ones_like(scale),)))
    one, slope = both(jnp.asarray(1.0))
    scaled, _ = both(jnp.asarray(1.7))
    assert {"pressure_kinetic", "pressure_conservative", "pressure_drag", "pressure_random"} <= set(
        one
    )
    for origin in (name for name in one if name.startswith("pressure")):
        size = jnp.max(jnp.abs(one[origin]))
        assert size > 0.1
        np.testing.assert_allclose(scaled[origin], 1.7 * one[origin], atol=1e-11 * size)
        np.testing.assert_allclose(slope[origin], one[origin], atol=1e-11 * size)


def test_an_overflow_is_nan_in_value_and_gradient(start, value, reverse, forward):
    """Beads squeezed into a fifth of the volume hold more pairs than the list."""
    crowded = start | {"position": 0.55 * start["position"]}
    assert jnp.isnan(value(crowded))
    assert jnp.isnan(forward(crowded, along(crowded, crowded["fluid"].kT)))
    gradient = reverse(crowded)
    assert all(jnp.all(jnp.isnan(pick(gradient))) for pick in NUMBERS.values())


def test_a_poisoned_run_says_why(start, simulate, sheared_water, key, ten):
    crowded = dataclasses.replace(sheared_water, position=0.55 * sheared_water.position)
    run = simulate(start["fluid"], crowded, key, 0.01, ten, start["flow"])
    assert run.final.status & 1
    assert jnp.all(jnp.isnan(run.frames["temperature"]))
    assert jnp.all(jnp.isnan(run.final.velocity))
