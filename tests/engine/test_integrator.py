"""Integrators: the parts they are made of add up, and one of one's own runs through every door."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.forces import EVERYTHING, forces_on
from dpdjax.engine.integrator import drifted, settled
from dpdjax.engine.system import System
from dpdjax.model.beads import masses
from dpdjax.pairs.laws import DRAG


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class SelfConsistent(dpd.integrators.Integrator):
    """Velocity-Verlet whose drag is that of the velocity it ends at, found by iteration.

    Besold, Vattulainen, Karttunen & Polson, Phys. Rev. E 62, R7611 (2000).
    """

    rounds: int = dataclasses.field(default=10, metadata={"static": True})

    def step(self, system, state, key, tally):
        moved, drift = drifted(system, state, 0.5)
        still = tuple(kind for kind in EVERYTHING if kind != DRAG)
        first = forces_on(system, moved, moved.velocity, key, tally, still)
        mass, velocity = masses(system.fluid, state)[:, None], drift.predicted(0.5)
        for _ in range(self.rounds):
            drag = forces_on(system, moved, velocity, key, tally, (DRAG,))
            total = first + drag
            velocity = (drift.carried + 0.5 * drift.kick).T + 0.5 * system.dt * total.force / mass
        return settled(system, state, moved, drift, total)


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
    own, flow, plan = SelfConsistent(), dpd.shear(0.5), dpd.Plan(3, 4)
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


@pytest.mark.slow
def test_self_consistency_keeps_the_temperature(water, fresh, key):
    """At dt 0.05 velocity-Verlet is 3 % too hot, and self-consistent it is less so."""
    settled_ = dpd.run(water, fresh, key, 0.01, dpd.Plan(5, 100), progress=False).final
    heat = lambda how: dpd.measure.block_average(
        dpd.run(
            water, settled_, key, 0.05, dpd.Plan(400, 20), integrator=how, progress=False
        ).frames["temperature"]
    )
    plain, own = heat(None), heat(SelfConsistent())
    assert abs(own.value - 1.0) < abs(plain.value - 1.0) - own.error - plain.error


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
