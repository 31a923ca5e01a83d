"""Rotation: exact laws of motion, the order of the step, and the temperature of spins."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marble import DT, relisted, rub

import dpdjax as dpd
from dpdjax.engine.rotation import Rotation, axis_of, rotation_step
from dpdjax.model.beads import inertias, masses
from dpdjax.pairs import sums


def test_a_turning_sphere_comes_round():
    omega = jnp.array([[0.3, -0.5, 0.2]])
    q = Rotation.of(omega, 0).orientation
    steps = 2000
    angle = 2 * math.pi / jnp.linalg.norm(omega)
    for _ in range(2):
        q = jax.lax.fori_loop(
            0, steps // 2, lambda _, q: q + rotation_step(q, omega * angle / steps), q
        )
    np.testing.assert_allclose(jnp.abs(q[0, 0]), 1.0, atol=1e-5)
    level = Rotation.of(omega, 0).orientation
    half = level + rotation_step(level, jnp.array([[1e-3, 0.0, 0.0]]))
    np.testing.assert_allclose(axis_of(half)[0], [0.0, -1e-3, 1.0], atol=1e-6)


def test_without_friction_spins_stay_and_energy_does_not_drift(key):
    """10^5 steps; the error of energy goes as dt^2."""
    made = dpd.marbles(
        key,
        box=5.6,
        radius=1.5,
        density=0.15,
        gamma=0.0,
        gamma_cs=0.0,
        skin=0.25,
        dt=0.01,
        report=None,
    )
    fluid, weights = made.fluid, masses(made.fluid, made.state)

    def energy(fluid, state):
        spin = 0.5 * jnp.sum(inertias(fluid, state)[:, None] * state.rotation.velocity**2)
        return {
            "E": 0.5 * jnp.sum(weights[:, None] * state.velocity**2) + spin + state.tally.energy,
            "w": state.rotation.velocity,
        }

    def of(dt, frames, every):
        run = jax.jit(
            lambda s: dpd.simulate(fluid, s, key, dt, dpd.Plan(frames, every), observe=energy)
        )(made.state)
        assert run.final.status == 0
        return run.frames

    long = of(0.01, 500, 200)
    np.testing.assert_allclose(long["w"], long["w"][:1] + 0 * long["w"], rtol=1e-12)
    drift = np.polyfit(np.arange(500), np.asarray(long["E"]), 1)[0] * 500
    assert abs(drift) < 5 * np.std(long["E"]) < 0.01 * long["E"][0]
    errors = [np.std(of(dt, 200, round(0.04 / dt))["E"]) for dt in (0.01, 0.005, 0.0025)]
    slope = np.polyfit(np.log([0.01, 0.005, 0.0025]), np.log(errors), 1)[0]
    assert 1.7 < slope < 2.6


@pytest.fixture(scope="module")
def touching(key):
    """Two spheres a small gap apart that rub each other and nothing else, spinning; and what they
    are."""
    fluid = dpd.fluid(
        drag=[dpd.term(rub, gamma_cc=4.0, r_c=1.0, projector="full")],
        kT=0.0,
        mass=2.0,
        radius=(1.0,),
        inertia=(0.5,),
    )
    state = dpd.initial_state(fluid, key, box=6.5, n=2, skin=0.2, dt=DT, sheared=False)
    position = jnp.array([[3.0, 3.0, 3.0], [3.0, 3.0, 5.3]])
    spins = dataclasses.replace(
        state.rotation, velocity=jnp.array([[2.0, -1.0, 0.5], [1.0, 2.0, -3.0]])
    )
    velocity = jnp.array([[0.3, 0.2, 0.1], [-0.3, -0.2, -0.1]])
    return fluid, relisted(
        dataclasses.replace(state, position=position, velocity=velocity, rotation=spins)
    )


def order_of(outcome, steps, exact):
    """Minus the slope of the error with the number of steps."""
    errors = [np.linalg.norm(outcome(s) - exact) for s in steps]
    return -np.polyfit(np.log(steps), np.log(errors), 1)[0]


@pytest.mark.parametrize("lam, order", [(1.0, 2.0), (0.5, 1.0)])
def test_order_of_rotation(lam, order, touching, key):
    """With drag and without noise: error over a fixed time at dt, dt/2, dt/4 against a much smaller
    step.

    Of second order where the predicted velocity is that at the end of the step, of first with half
    of the kick.
    """
    fluid, start = touching

    def spins(steps, lam=lam):
        how = dpd.integrators.VelocityVerlet(lam)
        final = jax.jit(
            lambda s: dpd.simulate(
                fluid,
                s,
                key,
                0.3 / steps,
                dpd.Plan(2, steps // 2),
                integrator=how,
            )
        )(start).final
        assert final.status == 0
        return np.concatenate(
            [np.ravel(final.rotation.velocity), np.ravel(final.rotation.orientation)]
        )

    found = order_of(spins, np.array([32, 64, 128]), spins(4096, 1.0))
    assert abs(found - order) < 0.2


def test_order_of_orientation_under_a_torque(touching, key):
    """Without friction: the error of the directions that driven spheres point in goes as dt^2."""
    fluid, start = touching
    drive = dpd.drive(torque=(3.0, 1.0, 0.0), species=0)

    def axis(steps):
        run = jax.jit(
            lambda s: dpd.simulate(
                fluid.set(gamma_cc=0.0), s, key, 0.5 / steps, dpd.Plan(2, steps // 2), drive
            )
        )
        return np.asarray(run(start).final.rotation.axis)

    assert abs(order_of(axis, np.array([20, 40, 80]), axis(4000)) - 2.0) < 0.1


def spin_energy(fluid, state):
    return {"T": dpd.observe.rotational_temperature(fluid, state)}


def rotational_temperature_after(made, key, steps=6000):
    run = jax.jit(
        lambda s: dpd.simulate(
            made.fluid, s, key, made.dt, dpd.Plan(steps // 100, 100), observe=dpd.mean(spin_energy)
        )
    )
    return np.asarray(run(dpd.grow(made.state)).frames["T"])


@pytest.fixture(scope="module")
def light(key):
    """Eight light marbles, whose spins are soon forgotten."""
    return lambda coupling: dpd.marbles(
        key,
        box=7.0,
        count=8,
        radius=1.0,
        density=1.5,
        mass=2.0,
        inertia=0.5,
        coupling=coupling,
        dt=DT,
        skin=0.25,
        report=None,
    )


@pytest.mark.parametrize("coupling", ["transverse", "full"])
def test_spins_have_the_temperature(coupling, light, key):
    T = rotational_temperature_after(light(coupling), key)
    late = T[5:].reshape(11, -1).mean(1)
    assert abs(late.mean() - 1) < max(0.05, 4 * late.std() / math.sqrt(len(late)))


def test_central_drag_turns_nothing(light, key):
    T = rotational_temperature_after(light("central"), key, 200)
    np.testing.assert_allclose(T, T[0] + 0 * T, rtol=1e-12)


def test_the_printed_sign_of_the_torque_runs_away(light, key, monkeypatch):
    right = sums.torque_add
    monkeypatch.setattr(
        sums, "torque_add", lambda torque, *a: torque - (right(torque, *a) - torque)
    )
    T = rotational_temperature_after(light("full"), key, 1000)
    assert not np.all(np.isfinite(T)) or T[-1] > 100
