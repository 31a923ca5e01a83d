"""Sums of many small steps in single precision: strain, positions, orientations, time, means and
integrals."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.compensated import plus
from dpdjax.engine.rotation import Rotation, rotation_step
from dpdjax.measure.rotation import angle_turned

STEPS = 10_000


@pytest.fixture
def single():
    with jax.enable_x64(False):
        yield


@pytest.fixture
def beads(single):
    """Beads that meet nobody, in single precision, and the fluid they are of."""
    fluid = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=0.0, r_c=1.0)], kT=0.01)
    return fluid, dpd.initial_state(fluid, jax.random.key(0), box=30.0, n=20, dt=0.01)


@pytest.fixture(scope="module")
def far():
    """``far(fluid, state, dt, rate)``: the state ``STEPS`` steps later, one program for all."""
    go = lambda fluid, state, dt, rate: (
        dpd.simulate(fluid, state, jax.random.key(1), dt, dpd.Plan(1, STEPS), dpd.shear(rate)).final
    )
    return jax.jit(go)


def test_a_sum_of_small_steps_goes_on(single):
    """A plain sum of 1e-3 over 100,000 steps is off by a part in 10,000."""
    step, zero = jnp.float32(1e-3), jnp.float32(0)
    both = lambda carry, _: ((*plus(carry[0], carry[1], step), carry[2] + step), None)
    total, _, plain = jax.jit(lambda: jax.lax.scan(both, (zero, zero, zero), length=100_000)[0])()
    assert total.dtype == jnp.float32
    assert abs(float(total) / 100 - 1) < 1e-6
    assert abs(float(plain) / 100 - 1) > 1e-4


def test_the_rest_of_a_sum_has_no_derivative():
    slope = jax.grad(lambda x: sum(plus(jnp.float32(1e4), x * 0, x)))(jnp.float32(1e-3))
    assert slope == 1.0


@pytest.mark.parametrize("rate", [1e-1, 1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_slow_shear_strains_the_box(beads, far, rate):
    """From a strain of 0.3: at rate 1e-5, 20,000 steps of 1e-3 strained it by 1e-8 where 2e-4 is
    due."""
    fluid, state = beads
    start = jnp.float32(0.3)
    state = dataclasses.replace(state, box=state.box.strained(start))
    after = far(fluid, state, 1e-3, rate).box.strain
    gained = float(after) - float(start)
    due = rate * 1e-3 * STEPS
    assert gained - round(gained - due) == pytest.approx(due, rel=1e-3, abs=2.0**-22)


@pytest.mark.parametrize("dt", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6])
def test_small_steps_move_beads(beads, far, dt):
    """Free flight; of <d^2> a fifth was left at 1e-6, and 16 % too much at 1e-5."""
    fluid, state = beads
    after = far(fluid, state, dt, 0.0)
    sides = np.asarray(state.box.lengths, float)
    moved = (
        np.asarray(after.position, float)
        + np.asarray(after.image) * sides
        - np.asarray(state.position, float)
    )
    due = np.asarray(state.velocity, float) * dt * STEPS
    assert np.sum(moved**2) == pytest.approx(np.sum(due**2), rel=1e-3)
    assert np.sum(moved * due) == pytest.approx(np.sum(due**2), rel=1e-3)


@pytest.mark.parametrize("rate", [1e-4, 1e-6])
def test_slow_shear_carries_beads_along(beads, far, rate):
    """At rest otherwise, a bead goes along with the strain of its place."""
    fluid, state = beads
    state = dataclasses.replace(state, velocity=jnp.zeros_like(state.velocity))
    after = far(fluid, state, 1e-3, rate)
    moved = np.asarray(after.position, float)[:, 0] - np.asarray(state.position, float)[:, 0]
    moved -= 30.0 * np.round(moved / 30.0)
    due = rate * 1e-3 * STEPS * np.asarray(state.position, float)[:, 1]
    assert np.sum(moved * due) == pytest.approx(np.sum(due**2), rel=1e-3)


@pytest.mark.parametrize("dt", [1e-3, 1e-5, 1e-6, 1e-7])
def test_small_steps_turn_spheres(single, dt):
    omega = jnp.array([[0.1, 0.2, -0.15]], jnp.float32)
    rows = np.random.default_rng(1).normal(size=(1, 4))
    start = Rotation.of(omega, 0).orientation * 0 + jnp.asarray(
        rows / np.linalg.norm(rows), jnp.float32
    )
    body = lambda carry, _: (plus(*carry, rotation_step(carry[0], dt * omega)), None)
    end = jax.jit(lambda q: jax.lax.scan(body, (q, 0 * q), length=4000)[0][0])(start)
    turned = angle_turned(np.stack([np.asarray(start, float), np.asarray(end, float)]))[-1, 0]
    np.testing.assert_allclose(turned, np.asarray(omega)[0] * dt * 4000, rtol=1e-3)


@pytest.mark.parametrize("record, tenth", [(dpd.mean, 0.1), (dpd.integral, 0.1 * 300)])
def test_means_and_integrals_of_many_steps(single, record, tenth):
    """Plain sums over 300,000 steps were off by 0.3 %."""
    steps = 300_000
    recorder = record(lambda fluid, state: {"tenth": jnp.float32(0.1)})
    sums = jax.lax.fori_loop(
        0, steps, lambda _, sums: recorder.add(sums, None, None), recorder.zero(None, None)
    )
    assert recorder.value(None, None, sums, jnp.float32(1e-3), steps)["tenth"] == pytest.approx(
        tenth, rel=1e-6
    )


def test_a_mean_of_truths_is_their_share(beads):
    fluid, state = beads
    recorder = dpd.mean(lambda fluid, state: {"true": state.step >= 0, "count": state.step + 3})
    sums = recorder.add(recorder.add(recorder.zero(fluid, state), fluid, state), fluid, state)
    assert recorder.value(fluid, state, sums, 0.01, 4) == {"true": 0.5, "count": 1.5}
