"""Flows of several parts: at most one deformation, and drivers that add up."""

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import dpdjax as dpd
from dpdjax.engine.flow import Flow


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Walls(dpd.flows.Driver):
    """Two soft walls at the faces z = 0 and z = L of a box, each a half-harmonic push."""

    stiffness: Any
    width: Any

    def force(self, state, mass):
        z, side = state.position[:, 2], state.box.lengths[2]
        inside = lambda depth: jnp.maximum(self.width - depth, 0.0)
        push = self.stiffness * (inside(z) - inside(side - z))
        return jnp.stack([jnp.zeros_like(push), jnp.zeros_like(push), push], axis=1)

    def batch_axes(self):
        axes = [0 if jnp.ndim(x) == 1 else None for x in (self.stiffness, self.width)]
        return None if axes == [None, None] else Walls(*axes)


PLAN = dpd.Plan(4, 5)


def test_walls_beside_a_shear(water, sheared_water, key):
    """A driver of one's own, by every door: it keeps beads off the faces; measures tell of it."""
    flow = [dpd.shear(0.3), Walls(200.0, 0.5)]
    run = dpd.run(water, sheared_water, key, 0.005, dpd.Plan(20, 20), flow, progress=False)
    bare = dpd.run(water, sheared_water, key, 0.005, dpd.Plan(20, 20), flow[0], progress=False)
    side = float(run.final.box.lengths[2])
    near = lambda run: np.mean(abs(np.asarray(run.final.position)[:, 2] / side - 0.5) > 0.47)
    assert near(run) < 0.5 * near(bare)
    assert run.flow.rate == 0.3 and run.final.box.strain == bare.final.box.strain
    with pytest.warns(UserWarning, match="Walls drove this run too"):
        dpd.shear_viscosity(run)

    def height(stiffness):
        walls = [dpd.shear(0.3), Walls(stiffness, 0.5)]
        final = dpd.simulate(water, sheared_water, key, 0.005, PLAN, walls).final
        return jnp.mean((final.position[:, 2] / side - 0.5) ** 2)

    slope = jax.grad(height)(200.0)
    step = 1e-3
    by_hand = float(height(200 + step) - height(200 - step)) / (2 * step)
    assert float(slope) == pytest.approx(by_hand, rel=1e-3)


def test_a_scan_over_the_numbers_of_one_part(water, sheared_water, key):
    keys, stiffness = jax.random.split(key, 2), jnp.array([10.0, 200.0])
    flow = [dpd.shear(0.3), Walls(stiffness, 0.5)]
    scan = dpd.run(water, sheared_water, keys, 0.005, PLAN, flow, progress=False)
    assert list(scan.system.differing()) == ["stiffness"]
    alone = [dpd.shear(0.3), Walls(200.0, 0.5)]
    one = dpd.run(water, sheared_water, keys[1], 0.005, PLAN, alone, progress=False)
    np.testing.assert_allclose(scan.final.velocity[1], one.final.velocity, atol=1e-8)
    assert scan[1].flow.drivers[0].stiffness == 200.0


def test_drivers_add_up(water, fresh):
    wave, walls = dpd.flows.sinusoidal_force(0.3, float(fresh.box.lengths[1])), Walls(50.0, 0.4)
    mass = jnp.ones((fresh.n, 1))
    both = Flow.of([wave, walls]).force(fresh, mass)
    np.testing.assert_allclose(both, wave.force(fresh, mass) + walls.force(fresh, mass))
    assert Flow.of(None).force(fresh, mass) is None and Flow.of(wave).torque(fresh) is None


def test_what_measures_want_is_found_among_the_parts(water, fresh, key):
    """A wave beside a shear is no wave at rest, and a drive beside a shear no drive."""
    wave = dpd.flows.sinusoidal_force(0.3, float(fresh.box.lengths[1]))
    how = dict(observe=[dpd.observe.wave_of(), dpd.observe.positions], progress=False)
    both = dpd.run(water, fresh, key, 0.01, PLAN, [wave, dpd.shear(0.2)], **how)
    with pytest.raises(ValueError, match="sheared, and the wave without the shear is unknown"):
        dpd.measure.sinusoidal_viscosity(both)
    with pytest.raises(ValueError, match="2 drivers of this run are a Wave"):
        dpd.measure.sinusoidal_viscosity(
            dpd.run(water, fresh, key, 0.01, PLAN, [wave, wave], **how)
        )
    with pytest.raises(ValueError, match="equilibrium, and this run was sheared"):
        dpd.measure.green_kubo(both, window=0.1)
    pulled = [dpd.drive(1.0, species=0), dpd.shear(0.2)]
    with pytest.raises(ValueError, match="sheared, and the drift without the flow is unknown"):
        dpd.measure.driven_diffusion(dpd.run(water, fresh, key, 0.01, PLAN, pulled, **how))
