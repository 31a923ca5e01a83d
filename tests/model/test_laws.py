"""Laws: small pure functions, truncated, differentiated and balanced by the engine."""

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd
from dpdjax.engine.state import assemble
from dpdjax.pairs import box as boxes
from dpdjax.pairs.forces import pair_force
from dpdjax.pairs.neighbours import plan_grid

R = jnp.linspace(0.01, 0.99, 99)


def pair(r, speed=0.0, species=(0, 0)):
    """Two beads on the x axis, ``r`` apart across the boundary; the first recedes at ``speed``."""
    box = boxes.box(3.0)
    position = jnp.array([[0.1, 1.0, 1.0], [3.1 - r, 1.0, 1.0]])
    velocity = jnp.array([[speed, 0.0, 0.0], [0.0, 0.0, 0.0]])
    return assemble(
        box,
        position,
        velocity,
        jnp.asarray(species, jnp.int32),
        (plan_grid(2, box.lengths, 1.0, 0.1),),
    )


def force_on_first(fluid, state):
    force, _, tally = pair_force(fluid, state, state.velocity, 0.0, jax.random.key(0), 0.01, True)
    assert jnp.array_equal(force[0], -force[1])
    return force[0], tally


def test_soft_repulsion_has_the_force_of_groot_and_warren():
    force = -jax.vmap(jax.grad(lambda r: dpd.soft_repulsion(r, a=25.0, r_c=1.2)))(R)
    np.testing.assert_allclose(force, 25.0 * (1 - R / 1.2), rtol=1e-13)


def test_central_drag_is_gamma_times_the_weight_squared():
    np.testing.assert_allclose(
        dpd.central_drag(R, gamma=4.5, r_c=1.2), 4.5 * (1 - R / 1.2) ** 2, rtol=1e-13
    )


def test_power_drag_of_exponent_two_is_central_drag():
    for derivative in (lambda law: law, lambda law: jax.vmap(jax.grad(law))):
        power = derivative(lambda r: dpd.laws.power_drag(r, gamma=4.5, r_c=1.2, s=2.0))(R)
        central = derivative(lambda r: dpd.central_drag(r, gamma=4.5, r_c=1.2))(R)
        np.testing.assert_allclose(power, central, rtol=1e-13)


def test_engine_force_is_minus_the_slope_of_the_energy():
    fluid = dpd.fluid([dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)], kT=1.0)
    force, tally = force_on_first(fluid, pair(0.4))
    np.testing.assert_allclose(force, [25.0 * 0.6, 0.0, 0.0], atol=1e-13)
    np.testing.assert_allclose(tally.energy, 0.5 * 25.0 * 0.6**2)
    np.testing.assert_allclose(tally.virial["conservative"][0, 0], 0.4 * 25.0 * 0.6)


def test_drag_opposes_the_relative_velocity_and_sets_the_noise():
    drag = dpd.fluid(drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)], kT=0.0)
    zeta = 4.5 * 0.6**2
    np.testing.assert_allclose(
        force_on_first(drag, pair(0.4, 2.0))[0], [-2.0 * zeta, 0.0, 0.0], atol=1e-13
    )
    noise = [force_on_first(drag.set(kT=kT), pair(0.4))[0][0] for kT in (1.0, 4.0)]
    np.testing.assert_allclose(noise[1], 2 * noise[0])
    assert 0 < abs(noise[0]) <= np.sqrt(3 * 2 * zeta / 0.01)


def test_two_drags_have_the_noise_of_their_sum():
    term = lambda gamma: dpd.term(dpd.central_drag, gamma=gamma, r_c=1.0)
    both, one = dpd.fluid(drag=[term(1.5), term(3.0)], kT=1.0), dpd.fluid(drag=[term(4.5)], kT=1.0)
    np.testing.assert_allclose(
        force_on_first(both, pair(0.4))[0], force_on_first(one, pair(0.4))[0]
    )


def test_laws_end_at_their_reach():
    repulsion = dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0, reach=0.5)
    short = dpd.fluid([repulsion], [dpd.term(dpd.central_drag, gamma=4.5, r_c=0.5)], kT=1.0)
    assert abs(force_on_first(short, pair(0.499, 1.0))[0][0]) > 1
    assert jnp.all(force_on_first(short, pair(0.501, 1.0))[0] == 0)


def test_each_pair_of_species_takes_its_own_entry():
    a = [[10.0, 20.0], [20.0, 40.0]]
    fluid = dpd.fluid([dpd.term(dpd.soft_repulsion, a=a, r_c=1.0)], kT=1.0)
    for species, entry in (((0, 0), 10.0), ((0, 1), 20.0), ((1, 1), 40.0)):
        force, _ = force_on_first(fluid, pair(0.4, species=species))
        np.testing.assert_allclose(force[0], entry * 0.6)


def quartic(h, *, k, width):
    return 0.25 * k * (1 - h / width) ** 4


def test_a_law_of_a_user_runs_and_differentiates(key):
    fluid = dpd.fluid(
        [dpd.term(quartic, k=25.0, width=1.0, reach=1.0)],
        [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
        kT=1.0,
    )
    state = dpd.initial_state(fluid, key, box=2.8, density=3.0, skin=0.2)

    def pressure(k):
        run = dpd.simulate(fluid.set(k=k), state, key, 0.01, dpd.Plan(2, 5))
        return jnp.trace(run.frames["pressure_tensor"][-1])

    value, slope = jax.jit(jax.value_and_grad(pressure))(25.0)
    assert jnp.isfinite(value)
    assert slope > 0


def test_float32_water_has_the_right_temperature():
    with jax.enable_x64(False):
        water = dpd.fluid(
            [dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
            [dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
            kT=1.0,
        )
        state = dpd.initial_state(water, jax.random.key(1), box=4.2, density=3.0, skin=0.2)
        run = jax.jit(dpd.simulate, static_argnames="plan")(
            water, state, jax.random.key(2), 0.01, dpd.Plan(400, 4)
        )
        assert run.final.position.dtype == run.frames["temperature"].dtype == jnp.float32
        assert run.final.status == 0
        assert abs(np.mean(run.frames["temperature"][100:]) - 1) < 0.05


def test_energy_error_without_drag_falls_as_dt_squared(water, quiet_water, simulate, key, long):
    start = quiet_water.tally.energy + 0.5 * jnp.sum(quiet_water.velocity**2)

    def error(dt):
        """Root mean square change of the total energy at the times 0.08, 0.16 ... 0.48."""
        frames = simulate(water.set(gamma=0.0), quiet_water.restarted(), key, dt, long).frames
        energy = frames["potential_energy"] + 1.5 * (quiet_water.n - 1) * frames["temperature"]
        every = round(0.02 / dt)
        return jnp.sqrt(jnp.mean((energy - start)[every - 1 :: every][:6] ** 2))

    order = jnp.log(error(0.01) / error(0.0025)) / jnp.log(4.0)
    assert 1.6 < order < 2.4
    assert error(0.005) < 1e-4 * quiet_water.n
