"""A piece of a run on the host: one compiled program, replayed with larger lists where one
overflows."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.engine import order
from dpdjax.engine import status as bits
from dpdjax.engine.members import called
from dpdjax.engine.simulate import begin, proceed
from dpdjax.engine.state import State, grow
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan
from dpdjax.pairs import neighbours as lists
from dpdjax.xla import each_member

MAX_GROWTHS = 20


def batched(state: State, key) -> State:
    """The state with the batch axis that a vector of keys asks for.

    Raises ValueError where the numbers of states and of keys disagree.
    """
    members = state.position.shape[0] if state.position.ndim == 3 else None
    if not key.ndim:
        if members is not None:
            cure = f"give {members} keys: jax.random.split(key, {members})"
            raise ValueError(f"the state is a batch of {members}; {cure}")
        return state
    if members is None:
        return jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (key.shape[0], *jnp.shape(leaf))), state
        )
    if members != key.shape[0]:
        raise ValueError(
            f"{key.shape[0]} keys for a batch of {members} states; give one key for each"
        )
    return state


def complete_lists(state: State) -> State:
    """The state with lists large enough for where the beads are now, and a clear status."""
    for _ in range(MAX_GROWTHS):
        codes = [lists.overflow(n) for n in state.neighbours]
        if not any(codes):
            break
        state = grow(state, codes)
    return dataclasses.replace(state, status=jnp.zeros_like(state.status))


def replayed(
    system: System,
    state: State,
    key,
    plan: Plan,
    how: tuple,
    shape: Plan | None = None,
    compiling=lambda: None,
):
    """Run a plan; grow the lists and replay it with the same noise until nothing overflows.

    ``state``, ``key`` and any number may be a batch; ``how`` are recorders. Returns (final state,
    frames on the host); the status of the state holds what growth could not repair. Plans share one
    program as far as :func:`shape_of` goes, or that of another plan is given, with as much room for
    frames; ``compiling()`` is called before another is made.
    """
    beads = int(np.prod(state.position.shape[:-1]))
    shape = shape_of(plan, beads) if shape is None else shape
    trips = trips_of(plan, shape.frames)
    for _ in range(MAX_GROWTHS):
        after, frames = called(
            _compiled,
            system,
            begun(system, state, key),
            key,
            trips,
            static={"shape": shape, "how": how},
            functions=how,
            making=compiling,
        )
        status = np.asarray(after.status)
        # A member that failed may overflow any list: it is given up, and decides nothing for the
        # others.
        sound = (status & ~np.uint32(bits.OVERFLOWS)) == 0
        if not np.any(status[sound] & bits.OVERFLOWS):
            break
        state = grow(state, [lists.overflow(n, sound) for n in after.neighbours])
    taken = (slice(None),) * key.ndim + (slice(plan.frames),)
    return after, jax.tree.map(lambda leaf: leaf[taken], jax.device_get(frames))


ROOM, WIDER, KEPT = 64, 4, 2**22
"""Frames there is room for in a program at least, or fewer that hold so many beads, and by what
factor there is more."""


def room_for(beads: int) -> int:
    """Most frames that a piece of a run is to hold."""
    return max(1, KEPT // beads)


def shape_of(plan: Plan, beads: int) -> Plan:
    """What of a plan is compiled: room for its frames, of few sizes, and how often the beads are
    sorted."""
    room = min(ROOM, room_for(beads))
    while room < plan.frames:
        room *= WIDER
    return Plan(room, order.LASTS if plan.longest >= order.LASTS else 1)


def trips_of(plan: Plan, room: int):
    """The frames of a plan and the steps before each (room,), as numbers given to a program."""
    intervals = np.zeros(room, np.int32)
    intervals[: plan.frames] = plan.intervals
    return np.int32(plan.frames), intervals


def without_failed(before: State, after: State, frames: dict, failed=()):
    """What a batch goes on with, state and frames: members that failed, now or before (``failed``),
    stay where they were, and their frames are NaN."""
    lost = np.asarray(after.status) != 0
    lost[list(failed)] = True
    if not lost.any():
        return after, frames
    of = lambda leaf: lost.reshape(-1, *[1] * (np.ndim(leaf) - 1))
    blank = lambda leaf: (
        np.where(of(leaf), np.nan, leaf).astype(leaf.dtype)
        if np.issubdtype(leaf.dtype, np.floating)
        else leaf
    )
    return jax.tree.map(lambda old, new: jnp.where(of(new), old, new), before, after), jax.tree.map(
        blank, frames
    )


def begun(system: System, state: State, key) -> State:
    """The state, one or a batch, with its force known.

    By a program of its own, which runs of one fluid that record other things share.
    """
    is_known = np.all(np.asarray(state.started) == system.integrator.mark_of(system.fluid))
    return state if is_known else called(_begun, system, state, key)


@jax.jit
def _begun(system: System, state, key):
    return _each(begin, system, state, key)


@functools.partial(jax.jit, static_argnames=("shape", "how"))
def _compiled(system: System, state, key, trips, shape, how):
    def one(system, state, key):
        trajectory = proceed(system, state, key, shape, how, trips=trips)
        return trajectory.final, trajectory.frames

    return _each(one, system, state, key)


def _each(function, system: System, state, key):
    """``function`` of one, or of every member of a batch."""
    if not key.ndim:
        return function(system, state, key)
    return each_member(function, (system.batch_axes(), 0, 0))(system, state, key)
