"""Whether the beads still move as matter does: what a run looks at after every frame."""

import jax.numpy as jnp

from dpdjax.bonded.topology import is_torn
from dpdjax.engine import status as bits
from dpdjax.engine.observables import rotational_temperature, temperature

HOTTEST = 10.0
"""Kinetic temperature over ``kT`` and the potential energy of a bead, beyond which beads ran away.

A start without structure turns potential energy into heat, and shear heats; neither comes near.
"""
FARTHEST = 0.5
"""Share of the reach of a law that no bead passes in one step."""


def trouble(fluid, state, dt):
    """Bits for beads whose velocities are not finite, or that ran away, and for bonds that tore."""
    velocities = (
        [state.velocity] if state.rotation is None else [state.velocity, state.rotation.velocity]
    )
    broken = jnp.any(jnp.stack([~jnp.all(jnp.isfinite(v)) for v in velocities]))
    lost = _is_hot(fluid, state) | _outruns_lists(state, dt)
    trouble = bits.flag(broken, bits.NOT_FINITE) | bits.flag(lost & ~broken, bits.RUN_AWAY)
    return trouble | bits.flag(_is_torn(state) & ~broken, bits.TORN)


def _is_torn(state):
    where = state.box, state.position, state.image, state.id
    return False if state.topology is None else is_torn(state.topology, *where)


def _is_hot(fluid, state):
    scale = HOTTEST * (fluid.kT + jnp.abs(state.tally.energy) / state.n)
    hot = temperature(fluid, state) > scale * _spread(3 * state.n - 3)
    if state.rotation is None or not any(fluid.is_turned(k) for k in fluid.rotating):
        return hot & (fluid.kT > 0)
    return (
        hot | (rotational_temperature(fluid, state) > scale * _spread(3 * state.rotation.m))
    ) & (fluid.kT > 0)


def _spread(freedoms: int) -> float:
    """Room for what the temperature of few degrees of freedom fluctuates by, ten standard
    deviations."""
    return 1.0 + 10.0 * (2.0 / freedoms) ** 0.5


def _outruns_lists(state, dt):
    """Whether a bead passes a good part of the reach of one of its lists in one step."""
    step = dt * jnp.sqrt(jnp.max(jnp.sum(state.velocity**2, axis=1)))
    return step > FARTHEST * min(n.grid.reach for n in state.neighbours)
