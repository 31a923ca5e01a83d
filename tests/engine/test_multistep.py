"""Long steps for the solvent and short ones for marbles that rub and push each other."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from marble import FLOW

import dpdjax as dpd
from dpdjax.engine import order
from dpdjax.engine.part import Part
from dpdjax.pairs import neighbours as lists

HOW = dpd.integrators.MultipleTimeStep(inner=4, tolerance=1e-10)
SPAN = 0.04


@pytest.fixture(scope="module")
def cold(marbled):
    """Without noise, so that a run is a path that steps of any length approach."""
    return marbled.fluid.set(kT=0.0, energies="keep")


@pytest.fixture(scope="module")
def path(cold, settled_marbles, simulate, key):
    """``path(steps, integrator)``: the state after one span of time, in shear."""

    def end(steps, how=None):
        plan = dpd.Plan(1, steps)
        final = simulate(
            cold, settled_marbles.restarted(), key, SPAN / steps, plan, FLOW, integrator=how
        ).final
        assert final.status == 0
        return final

    return end


def parts(state):
    return state.velocity, state.rotation.velocity, state.unwrapped


def test_it_converges_to_the_path_of_velocity_verlet(path):
    """Translation, spins under all projectors, potentials between marbles, in shear.

    Two steps of the scheme differ from one of twice the length by half of what that errs by, for
    velocities are looked at after their drag; what is left then is of second order.
    """
    exact, coarse, fine = path(320), path(4, HOW), path(8, HOW)
    for due, one, other in zip(*map(parts, (exact, coarse, fine))):
        size = lambda x: float(jnp.max(jnp.abs(x)))
        assert size(other - due) < 0.6 * size(one - due) < 0.03
        assert size(2 * other - one - due) < 0.25 * size(one - due)


def test_momentum_and_the_sums_over_pairs(path, marbled, settled_marbles, simulate, key):
    """Pressure by origin, all of it: as velocity-Verlet has it at the same place."""
    final, plain = path(8, HOW), path(320)
    assert set(final.tally.virial) == set(plain.tally.virial)
    for origin, virial in plain.tally.virial.items():
        scale = 0.05 * float(jnp.max(jnp.abs(virial))) + 1e-3
        np.testing.assert_allclose(final.tally.virial[origin], virial, atol=scale)
    assert float(final.tally.energy) == pytest.approx(float(plain.tally.energy), rel=0.02)
    warm = simulate(
        marbled.fluid, settled_marbles, key, 0.005, dpd.Plan(1, 8), FLOW, integrator=HOW
    ).final
    momentum = lambda state: np.asarray(dpd.observe.momentum(marbled.fluid, state))
    np.testing.assert_allclose(momentum(warm), momentum(settled_marbles), atol=1e-9)


def test_chunks_companions_and_order_are_invisible(marbled, settled_marbles, key):
    run = lambda plan, state=settled_marbles, fluid=marbled.fluid, key=key: (
        dpd.run(fluid, state, key, 0.005, plan, FLOW, integrator=HOW, progress=False).final
    )
    whole = run(dpd.Plan(4, 2))
    halves = run(dpd.Plan(2, 2), run(dpd.Plan(2, 2)))
    for name in ("position", "velocity", "force"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(halves, name))
    np.testing.assert_array_equal(whole.rotation.velocity, halves.rotation.velocity)
    gammas = jnp.array([9.0, float(marbled.fluid.value("gamma"))])
    scan = run(dpd.Plan(4, 2), fluid=marbled.fluid.set(gamma=gammas), key=jnp.stack([key, key]))
    np.testing.assert_allclose(scan.velocity[1], whole.velocity, atol=1e-9)
    assert whole.started == HOW.mark_of(marbled.fluid)
    assert len({dpd.integrators.VelocityVerlet().mark_of(marbled.fluid), int(whole.started)}) == 2


def test_gradients_equal_central_differences(marbled, settled_marbles, key):
    @jax.jit
    def spin(gamma_cc):
        fluid = marbled.fluid.set(gamma_cc=gamma_cc)
        final = dpd.simulate(
            fluid, settled_marbles, key, 0.005, dpd.Plan(1, 3), FLOW, integrator=HOW
        ).final
        return jnp.sum(final.rotation.velocity[-2:] ** 2)

    value, shift = jnp.asarray(4.0), 1e-4
    slope = jax.grad(spin)(value)
    assert float(slope) == pytest.approx(
        float((spin(value + shift) - spin(value - shift)) / (2 * shift)), rel=1e-5
    )
    assert float(jax.jvp(spin, (value,), (1.0,))[1]) == pytest.approx(float(slope), rel=1e-7)


def test_a_part_goes_back_where_it_was(settled_marbles):
    part = Part.of(settled_marbles, (2,))
    own = part.state(settled_marbles)
    assert own.n == 3 and own.rotation.begin == 0 and np.all(own.id < 3)
    back = part.placed(settled_marbles, own)
    np.testing.assert_array_equal(back.position, settled_marbles.position)
    np.testing.assert_array_equal(back.image, settled_marbles.image)
    # A box that its own sum of strains has folded back already is the same box.
    box = settled_marbles.box
    period = box.lengths[0] / box.lengths[1]
    image = own.image.at[:, 0].add(own.image[:, 1])
    folded = dataclasses.replace(
        own, box=dataclasses.replace(box, strain=box.strain - period), image=image
    )
    np.testing.assert_array_equal(
        part.placed(settled_marbles, folded).unwrapped, settled_marbles.unwrapped
    )
    lost = dataclasses.replace(
        own, neighbours=tuple(lists.with_overflow(n, jnp.uint8(1)) for n in own.neighbours)
    )
    codes = [lists.overflow(n) for n in part.placed(settled_marbles, lost).neighbours]
    assert codes == [0, 0, 1]


def test_what_it_cannot_run_is_told(water, sheared_water, marbled, settled_marbles, key):
    how = dpd.integrators.MultipleTimeStep()
    with pytest.raises(ValueError, match="no interaction is between beads with radii"):
        dpd.simulate(water, sheared_water, key, 0.01, dpd.Plan(1), integrator=how)
    for places in ((-1,), (2, 2), (3,)):
        twice = dpd.integrators.MultipleTimeStep(stiff=places)
        with pytest.raises(ValueError, match="stiff is .*; give each place once, of 0 to 2"):
            dpd.simulate(marbled.fluid, settled_marbles, key, 0.001, dpd.Plan(1), integrator=twice)


def test_the_step_is_that_of_the_solvent():
    fluid, density = dpd.colloid_fluid(gamma=45.0, eta_0=0.95), (2.4, 0.05)
    how = dpd.integrators.MultipleTimeStep(inner=16)
    assert dpd.suggest_dt(fluid, density, integrator=how) > 10 * dpd.suggest_dt(fluid, density)
    contact = lambda inner: min(
        limit
        for name, limit in dpd.integrators.MultipleTimeStep(inner).dt_limits(fluid, density, (1, 1))
        if name.startswith("contact")
    )
    assert contact(16) == pytest.approx(4 * contact(4))
    # Stiff are those that are named: lubrication of others limits the step as ever.
    none_held = dpd.integrators.MultipleTimeStep(stiff=(0,)).dt_limits(fluid, density, (1, 1))
    assert any(name.startswith("lubrication") for name, _ in none_held)


def test_all_interactions_may_be_stiff(water, sheared_water, key):
    """The midpoint rule for all, and the potentials in short steps."""
    how = dpd.integrators.MultipleTimeStep(inner=2, stiff=(0,))
    final = dpd.simulate(water, sheared_water, key, 0.02, dpd.Plan(2, 5), FLOW, integrator=how)
    assert final.final.status == 0 and 0.5 < float(final.frames["temperature"][-1]) < 2.0
    assert not order.is_kept(final.final)
