"""One step of velocity-Verlet with a predicted velocity."""

import dataclasses

import jax
import jax.numpy as jnp

from dpdjax.engine import box as boxes
from dpdjax.engine import neighbours as lists
from dpdjax.engine import order
from dpdjax.engine.batching import any_in_batch
from dpdjax.engine.forces import pair_force
from dpdjax.engine.state import State, masses


def total_force(fluid, state: State, velocity, key, dt, flow, tally):
    """Pair and body forces at the state's positions, with drag from ``velocity``."""
    with jax.named_scope("forces"):
        force, sums = pair_force(fluid, state, velocity, flow.rate_at(state.time), key, dt, tally)
        body = flow.force(state, masses(fluid, state)[:, None])
    return (force if body is None else force + body), (sums if tally else state.tally)


def started(fluid, state: State, key, dt, flow) -> State:
    """The state with its force known, computed now if it was not."""

    def compute(state):
        updated = update_lists(state)
        force, sums = total_force(fluid, updated, updated.velocity, key, dt, flow, True)
        new = dataclasses.replace(updated, force=force, tally=sums, started=jnp.ones_like(state.started))
        return jax.tree.map(lambda old, new: jnp.where(state.started, old, new), state, new)

    # In a batch all compute as soon as one must: a branch of its own for each would be no branch.
    return jax.lax.cond(any_in_batch(~state.started), compute, lambda state: state, state)


def update_lists(state: State) -> State:
    ids = order.list_ids(state)
    with jax.named_scope("neighbours"):
        neighbours = tuple(lists.update(n, state.box, state.position, ids) for n in state.neighbours)
    return dataclasses.replace(state, neighbours=neighbours)


def step(fluid, state: State, key, dt, flow, lam, tally: bool) -> State:
    """Advance one step (Groot & Warren 1997, eq. 15), in peculiar velocities.

    | in the method                       | here                                   |
    |-------------------------------------|----------------------------------------|
    | r += dt v + dt^2 f / 2m             | ``move``, with v = c + rate y e_x      |
    | strain += rate dt                   | ``flow.strain_in``, ``box.strained``   |
    | v~ = v + lambda dt f / m            | ``predicted``                          |
    | f' = F(r, v~), noise of step + 1    | ``total_force``                        |
    | v += dt (f + f') / 2m               | ``velocity``                           |

    The streaming velocity at a bead changes as the bead moves in y, so the peculiar
    velocity loses ``rate dy`` along x: in steady shear the exact rewriting of the lab-frame step, with no
    jump when a bead crosses the boundary. Where the rate changes, the whole box follows at once (SLLOD).
    ``tally`` (static): keep the sums over pairs.
    """
    mass = masses(fluid, state)[:, None]
    kick = dt * state.force / mass
    with jax.named_scope("integration"):
        strain = flow.strain_in(state.time, dt)
        move = dt * state.velocity + 0.5 * dt * kick
        carried = state.velocity - _along_x(strain / dt * move[:, 1])
        position = state.position + move + _along_x(strain * state.position[:, 1])
        box = state.box.strained(strain)
        position, crossed = boxes.wrap(box, position)
    moved = dataclasses.replace(state, position=position, image=state.image + crossed, box=box, step=state.step + 1)
    moved = update_lists(_later(moved, dt))
    predicted = carried + lam * kick
    force, sums = total_force(fluid, moved, predicted, key, dt, flow, tally)
    velocity = carried + 0.5 * (kick + dt * force / mass)
    return dataclasses.replace(moved, velocity=velocity, force=force, tally=sums)


def _later(state: State, dt) -> State:
    """The state at ``time + dt``, by compensated summation: plain sums of small steps stop growing."""
    increment = dt + state.time_rest
    time = state.time + increment
    return dataclasses.replace(state, time=time, time_rest=increment - (time - state.time))


def _along_x(values):
    return jnp.stack([values, jnp.zeros_like(values), jnp.zeros_like(values)], axis=1)
