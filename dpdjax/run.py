"""The host door: a run in chunks of a compiled program, repaired, reported and interruptible."""

import dataclasses
import functools
import sys

import jax
import jax.numpy as jnp
import numpy as np
from tqdm import tqdm

from dpdjax.checks import prng_key
from dpdjax.engine import flow as flows
from dpdjax.engine import status as bits
from dpdjax.engine.record import recorders
from dpdjax.engine.simulate import Plan, Trajectory, advance, check_run, list_trouble
from dpdjax.engine.state import State, grow

CHUNK = 1_000_000
"""Particle-steps between two looks at the status: about a second."""
MAX_GROWTHS = 12


class RunError(RuntimeError):
    """A run that could not go on; ``trajectory`` holds all that was computed before."""

    def __init__(self, message, trajectory):
        super().__init__(message)
        self.trajectory = trajectory


def run(
    fluid, state: State, key, dt, plan: Plan, flow=None, *, observe=None, lam=0.5, progress: bool = True
) -> Trajectory:
    """Run with everything a person at a keyboard expects; see ``simulate`` for the arguments.

    Lists that overflow are grown and the chunk is replayed with the same noise, so the
    result is the one that larger lists would have given from the start. Ctrl-C returns the
    trajectory so far, with ``complete`` False. A progress bar goes to standard error.

    **Batches.** A vector of keys runs one member for each key. The state may be a batch
    (from a vmapped ``initial_state`` or an earlier batch) or one state for all, and so may
    every number: ``fluid.set(gamma=jnp.array([2.0, 4.5, 9.0]))`` with three keys is a scan.

    Raises:
        ValueError, TypeError: before the work starts, for arguments that cannot work.
        RunError: positions that became NaN; its ``trajectory`` holds the frames before.
    """
    key = prng_key(key)
    flow = flows.quiet() if flow is None else flow
    state = _batched(state, key)
    one = jax.tree.map(lambda leaf: leaf[0], state) if key.ndim else state
    check_run(fluid, one, key, dt, flow)
    _check_members(fluid, dt, flow, key)
    state = _complete_lists(state)
    _refuse(fluid, state, key)
    observe = tuple(recorders(observe))
    numbers = (fluid, dt, flow, lam)

    pieces, done = [], 0
    size = chunk_frames(plan, int(np.prod(state.position.shape[:-1])))
    bar = tqdm(total=plan.steps, unit="step", disable=not progress, mininterval=0.5)
    try:
        while done < plan.frames:
            chunk = Plan(min(size, plan.frames - done), plan.every)
            after, frames = _replayed(numbers, state, key, chunk, observe)
            broken = bits.describe(after.status)
            if broken:
                partial = _trajectory(state, pieces, numbers, plan, complete=False)
                last = int(np.max(state.step))
                raise RunError(f"stopped between steps {last} and {last + chunk.steps}: {broken}", partial)
            frames = jax.device_get(frames)
            # One statement, which Ctrl-C cannot split.
            state, done, pieces = after, done + chunk.frames, [*pieces, frames]
            bar.update(chunk.steps)
    except KeyboardInterrupt:
        tqdm.write(f"interrupted after {done} of {plan.frames} frames", file=sys.stderr)
    finally:
        bar.close()
    return _trajectory(state, pieces, numbers, plan, complete=done == plan.frames)


def chunk_frames(plan: Plan, beads: int) -> int:
    """Frames in a chunk: about ``CHUNK`` particle-steps, a divisor of the plan where one is near."""
    aim = max(1, min(plan.frames, round(CHUNK / (plan.every * beads))))
    near = [d for d in range(max(1, aim // 2), min(plan.frames, 2 * aim) + 1) if plan.frames % d == 0]
    return min(near, key=lambda d: abs(d - aim)) if near else aim


def _replayed(numbers, state, key, plan, observe):
    """One chunk; grown lists and the same noise until nothing overflows."""
    for _ in range(MAX_GROWTHS):
        after, frames = _chunk(*numbers, state, key, plan, observe)
        status = np.bitwise_or.reduce(np.asarray(after.status).ravel())
        if not status & bits.OVERFLOWS:
            return after, frames
        state = grow(state, bool(status & bits.PAIRS_OVERFLOW), bool(status & bits.WINDOW_OVERFLOW))
    return after, frames


@functools.partial(jax.jit, static_argnames=("plan", "observe"))
def _chunk(fluid, dt, flow, lam, state, key, plan, observe):
    def one(fluid, dt, flow, state, key):
        trajectory = advance(fluid, state, key, dt, plan, flow, observe, lam)
        return trajectory.final, trajectory.frames

    if not key.ndim:
        return one(fluid, dt, flow, state, key)
    axes = (fluid.batch_axes(), 0 if jnp.ndim(dt) else None, flow.batch_axes(), 0, 0)
    return jax.vmap(one, axes)(fluid, dt, flow, state, key)


def _check_members(fluid, dt, flow, key):
    """Raise unless there is a key for each member of a scan over numbers."""
    axes = (fluid.batch_axes(), 0 if jnp.ndim(dt) else None, flow.batch_axes())
    length = lambda axis, leaf: None if axis is None else len(leaf)
    lengths = jax.tree.map(length, axes, (fluid, dt, flow), is_leaf=lambda axis: axis is None)
    for members in jax.tree.leaves(lengths):
        if key.shape != (members,):
            raise ValueError(
                f"numbers for {members} members and keys of shape {key.shape}: "
                f"give {members} keys, jax.random.split(key, {members})"
            )


def _batched(state, key):
    """The state with the batch axis that the keys ask for."""
    members = state.position.shape[0] if state.position.ndim == 3 else None
    if not key.ndim:
        if members is not None:
            raise ValueError(f"the state is a batch of {members}; give {members} keys: jax.random.split(key, {members})")
        return state
    if members is None:
        return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (key.shape[0], *jnp.shape(leaf))), state)
    if members != key.shape[0]:
        raise ValueError(f"{key.shape[0]} keys for a batch of {members} states; give one key for each")
    return state


def _complete_lists(state):
    """The state with lists large enough for where the beads are now."""
    for _ in range(MAX_GROWTHS):
        codes = [np.asarray(n.list.error.code) for n in state.neighbours]
        if not any(np.any(c) for c in codes):
            break
        state = grow(state, any(np.any(c & 1) for c in codes), any(np.any(c & 2) for c in codes))
    return dataclasses.replace(state, status=jnp.zeros_like(state.status))


def _refuse(fluid, state, key):
    """Raise for a list that cannot serve the fluid, before anything runs."""
    check = lambda fluid, state: list_trouble(fluid, state)
    if key.ndim:
        check = jax.vmap(check, (fluid.batch_axes(), 0))
    trouble = bits.describe(check(fluid, state))
    if trouble:
        raise ValueError(trouble)


def _trajectory(state, pieces, numbers, plan, complete):
    fluid, dt, flow, _ = numbers
    axis = 1 if state.position.ndim == 3 else 0
    frames = jax.tree.map(lambda *parts: np.concatenate(parts, axis), *pieces) if pieces else {}
    return Trajectory(state, frames, fluid, flow, jnp.asarray(dt, state.position.dtype), plan.every, complete)
