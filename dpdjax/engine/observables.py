"""Observables: functions ``observe(fluid, state) -> dict`` of one state.

A run evaluates them inside its compiled loop. Stresses are kept as pressure tensors
(positive in compression), apart by origin; under shear all velocities are peculiar.
"""

import jax
import jax.numpy as jnp

from dpdjax.engine.forces import Beads, evaluate, pair_geometry, sum_onto_beads


def kinetic_pressure(fluid, state):
    """``sum m c c / V`` from peculiar velocities, (3, 3) [energy / volume]."""
    weighted = fluid.mass[state.species][:, None] * state.velocity
    return jnp.einsum("na,nb->ab", weighted, state.velocity) / state.box.volume


def pressure_by_origin(fluid, state) -> dict:
    """The pressure tensor by origin, (3, 3) each: kinetic, conservative, drag, random."""
    tally, volume = state.tally, state.box.volume
    return {
        "kinetic": kinetic_pressure(fluid, state),
        "conservative": tally.conservative / volume,
        "drag": tally.drag / volume,
        "random": tally.random / volume,
    }


def pressure_tensor(fluid, state):
    """Kinetic + conservative + drag; the random part has mean zero and is only noise."""
    parts = pressure_by_origin(fluid, state)
    return parts["kinetic"] + parts["conservative"] + parts["drag"]


def total_pressure(fluid, state):
    """The whole momentum flux, random part included, for integrals over time."""
    return pressure_tensor(fluid, state) + state.tally.random / state.box.volume


def temperature(fluid, state):
    """Kinetic temperature ``sum m c^2 / (3 n - 3)`` [energy]; three momenta are fixed."""
    twice = jnp.sum(fluid.mass[state.species][:, None] * state.velocity**2)
    return twice / (3 * state.position.shape[0] - 3)


def momentum(fluid, state):
    """Total peculiar momentum (3,)."""
    return jnp.sum(fluid.mass[state.species][:, None] * state.velocity, axis=0)


def standard(fluid, state) -> dict:
    """What a run records unless told otherwise."""
    return {
        "temperature": temperature(fluid, state),
        "pressure_tensor": pressure_tensor(fluid, state),
        "potential_energy": state.tally.energy,
        "momentum": momentum(fluid, state),
    }


def stresses(fluid, state) -> dict:
    """The pressure tensor by origin under the names ``pressure_kinetic`` and so on."""
    return {f"pressure_{origin}": p for origin, p in pressure_by_origin(fluid, state).items()}


def positions(fluid, state) -> dict:
    """Wrapped and unwrapped positions and velocities, for structure and diffusion."""
    return {"position": state.position, "unwrapped": state.unwrapped, "velocity": state.velocity}


def _geometries(fluid, state):
    beads = Beads.of(state, state.velocity)
    for interaction, neighbours in zip(fluid.interactions, state.neighbours):
        yield interaction, pair_geometry(state.box, beads, neighbours.list.idx, 0.0)


def configurational_temperature(fluid, state):
    """``<|grad U|^2> / <laplacian U>`` [energy] (Rugh 1997; Butler et al. 1998).

    A thermometer that never looks at velocities. Needs a conservative force.
    """
    n = state.position.shape[0]
    gradient, laplacian = jnp.zeros_like(state.position), 0.0
    for interaction, pairs in _geometries(fluid, state):
        force = lambda r: evaluate(interaction.conservative, pairs._replace(r=r), derivative=True)[1]
        f, slope = jax.jvp(force, (pairs.r,), (jnp.ones_like(pairs.r),))
        gradient += sum_onto_beads(pairs, f, n)
        curvature = -slope - 2 * f / jnp.where(pairs.real, pairs.r, 1.0)
        laplacian += 2 * jnp.sum(jnp.where(pairs.real, curvature, 0.0))
    return jnp.sum(gradient**2) / laplacian


def instantaneous_viscosity(fluid, state):
    """``sum zeta r^2 e_x^2 e_y^2 / V``: the part of the viscosity with no delay.

    The mean over xy, xz and yz; the response of the drag stress to a sudden shear.
    """
    total = 0.0
    for interaction, pairs in _geometries(fluid, state):
        zeta = evaluate(interaction.drag, pairs, derivative=False)
        x, y, z = (e * e for e in pairs.e)
        r = jnp.where(pairs.real, pairs.r, 0.0)
        total += jnp.sum(zeta * r * r * (x * y + x * z + y * z)) / 3.0
    return total / state.box.volume
