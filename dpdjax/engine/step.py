"""One step of velocity-Verlet with a predicted velocity."""

import dataclasses

import jax
import jax.numpy as jnp

from dpdjax.engine import box as boxes
from dpdjax.engine import neighbours as lists
from dpdjax.engine import order
from dpdjax.engine.batching import any_in_batch
from dpdjax.engine.compensated import plus
from dpdjax.engine.forces import pair_force
from dpdjax.engine.rotation import turn_by
from dpdjax.engine.state import State, inertias, masses


def total_force(fluid, state: State, velocity, key, dt, flow, tally):
    """Pair and body forces at the state's positions, with drag from ``velocity``: force, torque or
    None, sums over pairs."""
    with jax.named_scope("forces"):
        force, torque, sums = pair_force(
            fluid, state, velocity, flow.rate_at(state.time), key, dt, tally
        )
        body, twist = flow.force(state, masses(fluid, state)[:, None]), flow.torque(state)
    force, torque = (
        f if extra is None else f + extra for f, extra in ((force, body), (torque, twist))
    )
    return force, torque, (sums if tally else state.tally)


def started(fluid, state: State, key, dt, flow) -> State:
    """The state with its force known, computed now if it was not."""

    def compute(state):
        updated = update_lists(state)
        force, torque, sums = total_force(fluid, updated, updated.velocity, key, dt, flow, True)
        rotation = None if torque is None else dataclasses.replace(updated.rotation, torque=torque)
        new = dataclasses.replace(
            updated,
            force=force,
            rotation=rotation,
            tally=sums,
            started=jnp.ones_like(state.started),
        )
        return jax.tree.map(lambda old, new: jnp.where(state.started, old, new), state, new)

    # In a batch all compute as soon as one must: a branch of its own for each would be no branch.
    return jax.lax.cond(any_in_batch(~state.started), compute, lambda state: state, state)


def update_lists(state: State) -> State:
    ids = order.list_ids(state)
    with jax.named_scope("neighbours"):
        neighbours = tuple(
            lists.update(n, state.box, state.position, ids) for n in state.neighbours
        )
    return dataclasses.replace(state, neighbours=neighbours)


def step(fluid, state: State, key, dt, flow, lam, tally: bool) -> State:
    """Advance one step (Groot & Warren 1997, eq. 15), in peculiar velocities.

    | in the method                       | here                                   |
    |-------------------------------------|----------------------------------------|
    | r += dt v + dt^2 f / 2m             | ``move``, with v = c + rate y e_x      |
    | strain += rate dt                   | ``flow.strain_in``, ``moved_on``       |
    | v~ = v + lambda dt f / m            | ``predicted``                          |
    | f' = F(r, v~), noise of step + 1    | ``total_force``                        |
    | v += dt (f + f') / 2m               | ``velocity``                           |
    | the same for angles, with I for m   | ``turning``, ``rotated``               |

    The streaming velocity at a bead changes as the bead moves in y, so the peculiar velocity loses
    ``rate dy`` along x: in steady shear the exact rewriting of the lab-frame step, with no jump
    when a bead crosses the boundary. Where the rate changes, the whole box follows at once (SLLOD).
    ``tally`` (static): keep the sums over pairs.
    """
    # By component, (3, n): XLA vectorises along the beads, and along three numbers it cannot.
    mass, velocity = masses(fluid, state)[None], state.velocity.T
    kick = dt * state.force.T / mass
    with jax.named_scope("integration"):
        strain = flow.strain_in(state.time, dt)
        move = dt * velocity + 0.5 * dt * kick
        carried = velocity - _along_x(strain / dt * move[1])
        moved = update_lists(moved_on(state, move, strain, dt))
    predicted = carried + lam * kick
    moved, twist = (moved, None) if state.rotation is None else turning(fluid, moved, dt, lam)
    force, torque, sums = total_force(fluid, moved, predicted.T, key, dt, flow, tally)
    velocity = carried + 0.5 * (kick + dt * force.T / mass)
    rotation = None if twist is None else rotated(fluid, state, moved, twist, torque, dt)
    return dataclasses.replace(
        moved, velocity=velocity.T, force=force, tally=sums, rotation=rotation
    )


def turning(fluid, state: State, dt, lam):
    """The state with its spheres turned and their predicted angular velocity, and the kick
    ``dt T / I`` of the old torque."""
    old = state.rotation
    twist = dt * old.torque / inertias(fluid, state)[:, None]
    turn = turn_by(old.orientation, dt * (old.velocity + 0.5 * twist))
    orientation, rest = plus(old.orientation, old.orientation_rest, turn)
    new = dataclasses.replace(
        old, orientation=orientation, orientation_rest=rest, velocity=old.velocity + lam * twist
    )
    return dataclasses.replace(state, rotation=new), twist


def rotated(fluid, before: State, moved: State, twist, torque, dt):
    """The rotation at the end of a step, from that before it."""
    velocity = before.rotation.velocity + 0.5 * (
        twist + dt * torque / inertias(fluid, moved)[:, None]
    )
    return dataclasses.replace(moved.rotation, velocity=velocity, torque=torque)


def moved_on(state: State, move, strain, dt) -> State:
    """The state a step later: beads moved by ``move`` (3, n), and they and the box by a shear
    strain."""
    move = move + _along_x(strain * state.position[:, 1])
    position, position_rest = plus(state.position.T, state.position_rest.T, move)
    total, strain_rest = plus(state.box.strain, state.strain_rest, strain)
    time, time_rest = plus(state.time, state.time_rest, dt)
    box, periods = boxes.Box(state.box.lengths, total).folded()
    position, crossed = boxes.wrapped_columns(box, position)
    # A period less of strain leaves an upper image a side further back along x.
    image = state.image + (crossed + _along_x(periods.astype(jnp.int32) * state.image[:, 1])).T
    rests = {"position_rest": position_rest.T, "strain_rest": strain_rest, "time_rest": time_rest}
    new = {"position": position.T, "image": image, "box": box, "step": state.step + 1, "time": time}
    return dataclasses.replace(state, **new, **rests)


def _along_x(values):
    """A vector along x for each bead, (3, n)."""
    return jnp.stack([values, jnp.zeros_like(values), jnp.zeros_like(values)])
