"""Integrators: the parts they are made of add up, and one of one's own runs through every door."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from dpd_vv import DPDVV

import dpdjax as dpd
from dpdjax.engine.forces import EVERYTHING, forces_on
from dpdjax.engine.system import System
from dpdjax.pairs.laws import DRAG


def test_kinds_of_force_add_up(water, sheared_water, key):
    """Drag of a velocity, and all the rest: together what one pass gives."""
    system, state = System.of(water, 0.01, dpd.shear(1.0)), sheared_water
    whole = forces_on(system, state, state.velocity, key, True)
    still = tuple(kind for kind in EVERYTHING if kind != DRAG)
    rest = forces_on(system, state, state.velocity, key, True, still)
    drag = forces_on(system, state, state.velocity, key, True, (DRAG,))
    np.testing.assert_allclose(rest.force + drag.force, whole.force, atol=1e-9)
    virial = (rest + drag).tally.virial
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, atol=1e-9), virial, whole.tally.virial
    )
    other = forces_on(system, state, 2 * state.velocity, key, True, still)
    # All but drag knows no velocity.
    np.testing.assert_array_equal(other.force, rest.force)
    assert not np.any(drag.tally.energy) and not np.any(rest.tally.virial["drag"])


def test_an_integrator_of_ones_own_goes_through_every_door(water, sheared_water, key):
    """Velocities at the end of a step are those that its drag is of."""
    own, flow, plan = DPDVV(), dpd.shear(0.5), dpd.Plan(3, 4)
    run = dpd.run(water, sheared_water, key, 0.01, plan, flow, integrator=own, progress=False)
    pure = dpd.simulate(water, sheared_water, key, 0.01, plan, flow, integrator=own)
    np.testing.assert_allclose(run.frames["pressure_tensor"], pure.frames["pressure_tensor"])
    end, system = run.final, System.of(water, 0.01, flow, own)
    np.testing.assert_allclose(
        forces_on(system, end, end.velocity, key, False).force, end.force, rtol=0, atol=1e-7
    )
    plain = dpd.run(water, sheared_water, key, 0.01, plan, flow, progress=False).final
    assert np.max(np.abs(plain.velocity - end.velocity)) > 1e-5
    slope = jax.grad(
        lambda gamma: dpd.simulate(
            water.set(gamma=gamma), sheared_water, key, 0.01, plan, flow, integrator=own
        ).frames["pressure_tensor"][-1, 0, 1]
    )(4.5)
    assert np.isfinite(slope) and slope != 0


def test_it_is_velocity_verlet_where_no_drag_is_renewed(water, sheared_water, key):
    """And its numbers go through scans; a share of more than one is refused."""
    go = lambda how, keys=key: dpd.run(
        water,
        sheared_water,
        keys,
        0.01,
        dpd.Plan(2, 4),
        dpd.shear(0.5),
        integrator=how,
        progress=False,
    )
    plain, none = go(None), go(DPDVV(0.0))
    np.testing.assert_allclose(none.final.velocity, plain.final.velocity, atol=1e-12)
    stress = "pressure_tensor"
    np.testing.assert_allclose(none.frames[stress], plain.frames[stress], atol=1e-10)
    scan = go(DPDVV(jnp.array([0.0, 1.0])), jnp.stack([key, key]))
    np.testing.assert_allclose(scan.final.velocity[0], plain.final.velocity, atol=1e-12)
    with pytest.raises(ValueError, match="renewed is a share, 0 to 1, not 2.0"):
        go(DPDVV(2.0))
    suggested = lambda gamma, how: dpd.suggest_dt(water.set(gamma=gamma), 3.0, integrator=how)
    assert suggested(45.0, DPDVV()) < 0.5 * suggested(45.0, None)
    assert suggested(45.0, DPDVV(0.0)) == suggested(45.0, None)


def test_classes_of_as_many_numbers_are_programs_of_their_own():
    """JAX took them for one structure, and ran the program of another in one case of ten."""
    register = lambda cls: jax.tree_util.register_dataclass(dataclasses.dataclass(frozen=True)(cls))
    many = [
        register(type(f"Own{k}", (dpd.integrators.Integrator,), {"value": float(k)}))()
        for k in range(60)
    ]
    value = jax.jit(lambda how, x: x + how.value)
    assert [float(value(how, 0.0)) for how in many] == list(range(60))
    known = [
        dpd.integrators.VelocityVerlet(),
        dpd.integrators.ImplicitDrag(),
        DPDVV(),
        dpd.shear(0.1),
    ]
    assert len({jax.tree.structure(part) for part in known}) == 4
    assert jax.tree.structure(known[0]) == jax.tree.structure(dpd.integrators.VelocityVerlet(0.3))


@pytest.mark.parametrize(
    "step, error, told",
    [
        (lambda moved, drift, still: None, TypeError, "step of Own gives None; return the state"),
        (lambda moved, drift, still: moved, ValueError, "whose step or force is that before it"),
        (
            lambda moved, drift, still: dpd.integrators.with_forces(
                moved, still._replace(tally=None)
            ),
            ValueError,
            "leaves the sums over pairs as they were",
        ),
    ],
    ids=["nothing", "no forces", "no sums"],
)
def test_a_step_that_is_none_is_told(water, sheared_water, key, step, error, told):
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Own(dpd.integrators.Integrator):
        def step(self, system, state, key, tally):
            moved, drift = dpd.integrators.drifted(system, state, 0.5)
            still = forces_on(system, moved, moved.velocity, key, tally)
            return step(moved, drift, still)

    with pytest.raises(error, match=told):
        dpd.simulate(water, sheared_water, key, 0.01, dpd.Plan(1, 1), integrator=Own())


def test_forces_of_what_kind_and_of_what_velocities(water, sheared_water, key):
    system, state = System.of(water, 0.01), sheared_water
    for kinds, named in ((("conservative", "dissipative"), "dissipative"), ("drag", "drag")):
        with pytest.raises(ValueError, match=f"kinds has '{named}'; they are conservative, drag"):
            forces_on(system, state, state.velocity, key, False, kinds)
    with pytest.raises(ValueError, match=r"velocities have shape \(3, \d+\)"):
        forces_on(system, state, state.velocity.T, key, False)
    whole = forces_on(system, state, state.velocity, key, True)
    for half in (0.5 * whole, whole * 0.5):
        np.testing.assert_allclose(2 * half.force, whole.force)
        np.testing.assert_allclose(2 * half.tally.energy, whole.tally.energy)


def test_a_scan_over_lambda(water, sheared_water, key):
    """The weight of velocity-Verlet is a number as others are."""
    keys, how = jax.random.split(key, 2), dpd.integrators.VelocityVerlet(jnp.array([0.5, 0.65]))
    scan = dpd.run(water, sheared_water, keys, 0.01, dpd.Plan(2, 4), integrator=how, progress=False)
    alone = dpd.run(
        water,
        sheared_water,
        keys[1],
        0.01,
        dpd.Plan(2, 4),
        integrator=dpd.integrators.VelocityVerlet(0.65),
        progress=False,
    )
    np.testing.assert_allclose(scan.final.velocity[1], alone.final.velocity, atol=1e-8)
    assert scan.system.differing().keys() == {"lam"}


def test_what_is_no_integrator(water, fresh, key):
    with pytest.raises(TypeError, match="integrator is 0.5; give dpd.integrators.VelocityVerlet()"):
        dpd.simulate(water, fresh, key, 0.01, dpd.Plan(1), integrator=0.5)
    with pytest.raises(TypeError, match="Integrator is not registered: .*register_dataclass"):
        dpd.simulate(water, fresh, key, 0.01, dpd.Plan(1), integrator=dpd.integrators.Integrator())


def test_a_plan_goes_through_jit(water, fresh, key):
    """``jax.jit(dpd.simulate)`` of everything but the observables."""
    plan = dpd.Plan(2, 3)
    compiled = jax.jit(dpd.simulate)(water, fresh, key, 0.01, plan, dpd.shear(0.2))
    plain = dpd.simulate(water, fresh, key, 0.01, plan, dpd.shear(0.2))
    np.testing.assert_allclose(compiled.frames["temperature"], plain.frames["temperature"])
