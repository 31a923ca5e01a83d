"""Drag and noise by the implicit midpoint rule: the operator, its solution, what it leaves
alone."""

import dataclasses
import math

import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest
from marble import DT, FLOW

import dpdjax as dpd
from dpdjax.engine import compiling, implicit, order
from dpdjax.engine.forces import forces_on
from dpdjax.engine.system import System
from dpdjax.measure.statistics import block_average
from dpdjax.pairs.friction import Motion, frictions_of
from dpdjax.pairs.laws import DRAG, RANDOM

IMPLICIT = dpd.integrators.ImplicitDrag(1e-10)


def spun(state, seed):
    """Velocities and spins at random."""
    rng = np.random.default_rng(seed)
    spin = (
        None
        if state.rotation is None
        else jnp.asarray(rng.normal(size=state.rotation.velocity.shape))
    )
    return Motion(jnp.asarray(rng.normal(size=state.velocity.shape)), spin)


def moving(state, motion):
    rotation = state.rotation and dataclasses.replace(state.rotation, velocity=motion.spin)
    return dataclasses.replace(state, velocity=motion.velocity, rotation=rotation)


@pytest.fixture(scope="module", params=["water", "marbles"])
def rubbing(request):
    """A sheared system and a state of it; all projectors and rotating beads in one of them."""
    if request.param == "water":
        fluid, state = (request.getfixturevalue(name) for name in ("water", "sheared_water"))
    else:
        fluid = request.getfixturevalue("marbled").fluid
        state = request.getfixturevalue("settled_marbles")
    return System.of(fluid, DT, FLOW).as_type(state.position.dtype), state


def test_the_operator_is_the_drag(rubbing, key):
    system, state = rubbing
    frictions = frictions_of(system.fluid, state, 1.0, key, system.dt)
    one, other = spun(state, 0), spun(state, 1)
    still = jax.tree.map(jnp.zeros_like, one)
    drag = lambda motion: forces_on(
        system, moving(state, motion), motion.velocity, key, False, (DRAG,)
    )
    force, at_rest, image = drag(one), drag(still), frictions.drag(one)
    np.testing.assert_allclose(at_rest.force - force.force, image.velocity, atol=1e-10)
    if image.spin is not None:
        np.testing.assert_allclose(at_rest.torque - force.torque, image.spin, atol=1e-10)
    dot = lambda a, b: sum(float(jnp.sum(x * y)) for x, y in zip(*map(jax.tree.leaves, (a, b))))
    assert dot(other, image) == pytest.approx(dot(one, frictions.drag(other)), rel=1e-10)
    assert dot(one, image) > 0
    np.testing.assert_allclose(jnp.sum(image.velocity, axis=0), 0, atol=1e-9)
    both = frictions.force(one).velocity - frictions.force(still).velocity
    np.testing.assert_allclose(both, -image.velocity, atol=1e-9)


def matrix_of(operator, like):
    """A linear operator on motions, written out."""
    flat, shaped = jax.flatten_util.ravel_pytree(like)
    column = lambda unit: jax.flatten_util.ravel_pytree(operator(shaped(unit)))[0]
    return np.asarray(jax.lax.map(column, jnp.eye(len(flat)))).T


def test_a_step_solves_its_equation_and_keeps_the_covariance(rubbing, key):
    """Against dense algebra: the change of velocities, and the Maxwell distribution of all."""
    system, state = rubbing
    fluid, dt = system.fluid, system.dt
    frictions = frictions_of(fluid, state, 1.0, key, dt)
    mass = implicit._inertia(fluid, state)
    before = implicit._motion(state)
    weights = np.concatenate([np.repeat(np.asarray(leaf), 3) for leaf in jax.tree.leaves(mass)])
    G = matrix_of(frictions.drag, before)
    flat = lambda motion: np.asarray(jax.flatten_util.ravel_pytree(motion)[0])
    due = np.linalg.solve(np.diag(weights) + 0.5 * dt * G, dt * flat(frictions.force(before)))
    after = implicit.damped(system, state, key, True, 1e-12)
    np.testing.assert_allclose(flat(implicit._motion(after)) - flat(before), due, atol=1e-9)
    assert after.status == 0

    A = 0.5 * dt * G / np.sqrt(np.outer(weights, weights))
    once = np.linalg.inv(np.eye(len(A)) + A)
    covariance = once @ ((np.eye(len(A)) - A) @ (np.eye(len(A)) - A) + 4 * A) @ once
    np.testing.assert_allclose(covariance, np.eye(len(A)), atol=1e-10)


def test_the_noise_is_that_of_the_drag(water, sheared_water, key):
    """Mean square of the random forces over many steps: ``2 kT G/dt``, bead by bead."""
    dt, count = 0.05, 400
    frictions = lambda step: frictions_of(
        water, dataclasses.replace(sheared_water, step=step), 0.0, key, dt
    )
    still = Motion(jnp.zeros_like(sheared_water.velocity), None)
    noise = jax.lax.map(lambda step: frictions(step).force(still).velocity, jnp.arange(count))
    G = np.diag(matrix_of(frictions(0).drag, still)).sum()
    assert float(jnp.sum(jnp.mean(noise**2, axis=0))) == pytest.approx(2 * G / dt, rel=0.01)
    assert np.abs(np.asarray(noise).mean()) < 1e-10


def test_doors_chunks_and_companions_are_invisible(water, sheared_water, key):
    run = lambda plan, state=sheared_water, fluid=water, key=key: dpd.run(
        fluid, state, key, 0.05, plan, FLOW, integrator=IMPLICIT, progress=False
    )
    whole = run(dpd.Plan(4, 3))
    halves = run(dpd.Plan(2, 3), run(dpd.Plan(2, 3)).final)
    np.testing.assert_array_equal(whole.final.velocity, halves.final.velocity)
    np.testing.assert_array_equal(whole.final.position, halves.final.position)
    scan = run(
        dpd.Plan(4, 3), fluid=water.set(gamma=jnp.array([40.0, 4.5])), key=jnp.stack([key, key])
    )
    np.testing.assert_allclose(scan.final.velocity[1], whole.final.velocity, atol=1e-9)
    pure = dpd.simulate(water, sheared_water, key, 0.05, dpd.Plan(4, 3), FLOW, integrator=IMPLICIT)
    tensor = whole.frames["pressure_tensor"]
    np.testing.assert_allclose(pure.frames["pressure_tensor"], tensor, rtol=1e-9)


def test_sorting_is_bitwise_invisible(water, sheared_water, key, monkeypatch):
    """Scalar products are sums over all beads, whose order in memory must not show."""
    monkeypatch.setattr(order, "SMALLEST", 100)
    monkeypatch.setattr(order, "is_kept", lambda state: True)
    system = System.of(water, 0.05, FLOW).as_type(sheared_water.position.dtype)
    shuffled = order.permuted(
        sheared_water, jax.random.permutation(jax.random.key(5), sheared_water.n)
    )
    step = jax.jit(lambda state: implicit.damped(system, state, key, False, 0.01))
    here, there = step(sheared_water), order.in_order_of(step(shuffled), sheared_water.id)
    np.testing.assert_array_equal(here.velocity, there.velocity)


def test_momentum_is_kept_whatever_the_tolerance(water, sheared_water, key):
    rough = dpd.integrators.ImplicitDrag(0.5)
    final = dpd.simulate(
        water.set(gamma=100.0), sheared_water, key, 0.05, dpd.Plan(1, 20), integrator=rough
    ).final
    np.testing.assert_allclose(jnp.sum(final.velocity, axis=0), 0, atol=1e-10)


def test_gradients_equal_central_differences(water, sheared_water, key):
    """Forward and reverse, with respect to a friction, a potential and the temperature."""

    @jax.jit
    def heat(numbers):
        fluid = water.set(energies="keep", **numbers)
        final = dpd.simulate(
            fluid, sheared_water, key, 0.03, dpd.Plan(1, 4), FLOW, integrator=IMPLICIT
        ).final
        return jnp.sum(final.velocity[:20] ** 2)

    numbers = {"gamma": 20.0, "a": 25.0, "kT": 1.0}
    numbers = {name: jnp.asarray(value) for name, value in numbers.items()}
    slopes = jax.grad(heat)(numbers)
    for name, value in numbers.items():
        shift = 1e-5 * value
        up, down = (heat(numbers | {name: value + sign * shift}) for sign in (1, -1))
        assert float(slopes[name]) == pytest.approx(float((up - down) / (2 * shift)), rel=1e-5)
        unit = {other: jnp.asarray(float(other == name)) for other in numbers}
        forward = jax.jvp(heat, (numbers,), (unit,))[1]
        assert float(forward) == pytest.approx(float(slopes[name]), rel=1e-7)


def test_a_force_of_other_kinds_is_computed_anew(water, sheared_water, key):
    """The force of a state is that of one integrator; another does not go on with it."""
    verlet, implicit_ = dpd.integrators.VelocityVerlet(), IMPLICIT
    mark = verlet.mark_of(water), implicit_.mark_of(water)
    assert mark[0] != mark[1] and sheared_water.started == mark[0]
    go = lambda state, how: (
        dpd.run(water, state, key, 0.01, dpd.Plan(1, 2), integrator=how, progress=False).final
    )
    went = go(sheared_water, implicit_)
    assert went.started == mark[1]
    np.testing.assert_array_equal(went.velocity, go(sheared_water.restarted(), implicit_).velocity)
    np.testing.assert_array_equal(go(went, verlet).velocity, go(went.restarted(), verlet).velocity)


def test_a_drag_stress_is_that_of_the_mean_velocity(water, sheared_water, key):
    """And the parts of the pressure add up to what forces at that velocity do."""
    system = System.of(water, 0.05, FLOW).as_type(sheared_water.position.dtype)
    after = implicit.damped(system, sheared_water, key, True, 1e-12)
    middle = 0.5 * (sheared_water.velocity + after.velocity)
    drag = forces_on(system, sheared_water, middle, key, True, (DRAG,)).tally.virial[DRAG]
    added = after.tally.virial[DRAG] - sheared_water.tally.virial[DRAG]
    np.testing.assert_allclose(added, drag, atol=1e-8)
    assert np.any(after.tally.virial[RANDOM] != sheared_water.tally.virial[RANDOM])


def test_what_it_cannot_run_is_told(water, sheared_water, key, monkeypatch):
    drag = dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)
    literal = dpd.fluid(interactions=[dpd.interaction((0, 0), drag=[drag], random=[drag])], kT=1.0)
    state = dataclasses.replace(sheared_water)
    run = lambda fluid, **numbers: dpd.run(
        fluid, state, key, 0.05, dpd.Plan(2, 3), progress=False, **numbers
    )
    with pytest.raises(ValueError, match="ImplicitDrag needs noise that follows from the drag"):
        run(literal, integrator=IMPLICIT)
    monkeypatch.setattr(implicit, "MOST", 1)
    compiling.forget(), jax.clear_caches()
    with pytest.raises(dpd.RunError, match="the drag of a step was not solved for"):
        run(water.set(gamma=300.0), integrator=dpd.integrators.ImplicitDrag(1e-9))
    compiling.forget(), jax.clear_caches()


def test_strong_drag_allows_the_step_of_the_potentials(water, ideal):
    """Until it stops beads within a step, which the viscosity feels; without potentials that and
    motion in a step are all."""
    suggested = lambda fluid, gamma, how=IMPLICIT: dpd.suggest_dt(
        fluid.set(gamma=gamma), 3.0, integrator=how
    )
    assert suggested(water, 100.0) == suggested(water, 4.5)
    assert suggested(water, 100.0, None) < 0.5 * suggested(water, 100.0)
    rate = lambda fluid: dpd.theory.damping_rate(fluid, 3.0)
    for fluid in (water, ideal):
        held = suggested(fluid, 500.0) * rate(fluid.set(gamma=500.0))
        assert held == pytest.approx(math.sqrt(0.005 / 0.007), rel=1e-5)
    assert suggested(ideal, 5.0) == pytest.approx(math.sqrt(0.005 / 4), rel=1e-5)
    assert [name for name, dt in IMPLICIT.dt_errors(ideal, 3.0) if dt == math.inf] == [
        "configurational temperature of a stiff repulsion",
        "length of bonds",
    ]


@pytest.mark.slow
def test_the_temperature_is_exact_at_any_step(ideal, key):
    """Where velocity-Verlet is 3 % too hot at a tenth of the step."""
    fluid = ideal.set(gamma=90.0)
    state = dpd.initial_state(fluid, key, box=8.0, density=3.0)
    run = lambda frames: dpd.run(
        fluid,
        state,
        key,
        0.05,
        dpd.Plan(frames, 5),
        integrator=dpd.integrators.ImplicitDrag(),
        progress=False,
    )
    heat = block_average(run(1500).frames["temperature"][100:])
    assert heat.error < 0.0015 and abs(heat.value - 1) < 3 * heat.error + 0.0005
