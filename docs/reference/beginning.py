"""What the examples of the reference begin with."""

import jax
import jax.numpy as jnp
import numpy as np

import dpdjax as dpd

key = jax.random.key(0)
quiet: dict = {"progress": False}

# Water in a small box, at rest and sheared.
water = dpd.fluid(
    conservative=[dpd.term(dpd.soft_repulsion, a=25.0, r_c=1.0)],
    drag=[dpd.term(dpd.central_drag, gamma=4.5, r_c=1.0)],
    kT=1.0,
)
start = dpd.initial_state(water, key, box=4.0, density=3.0)
state = dpd.run(water, start, key, 0.01, dpd.Plan(10, 20), **quiet).final
seen = [dpd.observe.standard, dpd.observe.stresses, dpd.observe.positions]
rest = dpd.run(water, state, key, 0.01, dpd.Plan(40, 5), observe=seen, **quiet)
sheared = dpd.run(
    water, rest.final, key, 0.01, dpd.Plan(40, 5), dpd.shear(0.2), observe=seen, **quiet
)

# A few colloids in a solvent, as they begin to gel.
made = dpd.suspension(key, phi=0.2, box=7.0, kT=0.1, D0=1.2, kappa=30.0, report=None)
gel = dpd.run(
    made.fluid, made.state, key, made.dt, dpd.Plan(24, 5), integrator=made.integrator,
    observe=dpd.observe.positions_of(1), **quiet,
)  # fmt: skip

# Chains of five, sheared and not.
melt = dpd.molecules(key, "A5", box=8.0, report=None)
chains = dpd.run(melt.fluid, melt.state, key, melt.dt, dpd.Plan(24, 5), observe=seen, **quiet)

# A marble that turns.
marble = dpd.marbles(key, box=6.0, radius=1.0, gamma_cs=5.0, report=None)
turning = dpd.run(
    marble.fluid, marble.state, key, marble.dt, dpd.Plan(40, 10),
    observe=[dpd.observe.positions_of(1), dpd.observe.rotations], **quiet,
)  # fmt: skip
