"""The host door: a run in chunks of a compiled program, repaired, reported and interruptible."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np

from dpdjax.checks import prng_key
from dpdjax.engine import flow as flows
from dpdjax.engine import status as bits
from dpdjax.engine.advice import cautions
from dpdjax.engine.batching import batch_axes, named
from dpdjax.engine.chunk import batched, complete_lists, replayed, shape_of, without_failed
from dpdjax.engine.record import averaged, recorders
from dpdjax.engine.simulate import (
    Plan,
    Trajectory,
    check_finite,
    check_kinds,
    check_plan,
    check_run,
    list_trouble,
)
from dpdjax.engine.state import State
from dpdjax.host.heat import warn_if_hot
from dpdjax.host.progress import Progress

CHUNK, LEAST = 1_000_000, 50
"""Particle-steps between two looks at the status: half a second; and steps, over which a large box
is sorted once."""


class RunError(RuntimeError):
    """A run that could not go on; ``trajectory`` holds all that was computed before."""

    def __init__(self, message, trajectory):
        super().__init__(message)
        self.trajectory = trajectory


def run(
    fluid,
    state: State,
    key,
    dt,
    plan: Plan,
    flow=None,
    *,
    observe=None,
    lam=0.5,
    progress: bool = True,
) -> Trajectory:
    """Run with everything a person at a keyboard expects; see ``simulate`` for the arguments.

    Lists that overflow are grown and the chunk is replayed with the same noise, so the
    result is the one that larger lists would have given from the start. Ctrl-C returns the
    trajectory so far, with ``complete`` False. A progress bar goes to standard error.

    **Batches.** A vector of keys runs one member for each key. The state may be a batch
    (from a vmapped ``initial_state`` or an earlier batch) or one state for all, and so may every
    number: ``fluid.set(gamma=jnp.array([2.0, 4.5, 9.0]))`` with three keys is a scan. An
    accelerator runs the members side by side, a CPU one after another: its caches hold one. A
    member that fails is named in a warning and in ``failed`` of the trajectory, and the others go
    on as if it were not there; ``trajectory.survivors`` is a batch without it.

    Raises:
        ValueError, TypeError: before the work starts, for arguments that cannot work.
        RunError: positions that became NaN, beads that ran away, in the run or in all members; its
            ``trajectory`` holds the frames before.
    """
    with Progress(plan, progress) as line:
        return run_on(line, fluid, state, key, dt, plan, flow, observe=observe, lam=lam)


def run_on(
    line: Progress, fluid, state: State, key, dt, plan: Plan, flow=None, *, observe=None, lam=0.5
) -> Trajectory:
    """:func:`run` as a part of the run that a progress line is of."""
    key = prng_key(key)
    if key.ndim > 1:
        raise ValueError(
            f"keys have shape {key.shape}; give a vector of them, keys.reshape(-1), and numbers "
            "alike, one for each"
        )
    check_kinds(fluid, state)
    flow = flows.quiet() if flow is None else flow
    state = batched(state, key)
    one = jax.tree.map(lambda leaf: leaf[0], state) if key.ndim else state
    check_plan(plan, state)
    check_run(fluid, one, key, dt, flow)
    if key.ndim:
        check_finite(state)
    for caution in cautions(fluid, state, dt, plan):
        warnings.warn(caution, stacklevel=3)
    _check_members(fluid, dt, flow, key)
    state = complete_lists(state)
    _refuse(fluid, state, key)
    observe = tuple(recorders(observe))
    numbers = (fluid, dt, flow, averaged(observe, fluid, state))

    pieces, done, failed = [], 0, {}
    beads = int(np.prod(state.position.shape[:-1]))
    size = chunk_frames(plan, beads)
    # The last piece, which is shorter, by the same program.
    shape = shape_of(Plan(size, plan.every), beads)
    try:
        while done < plan.frames:
            chunk = Plan(min(size, plan.frames - done), plan.every)
            after, frames = replayed(
                fluid, state, key, dt, chunk, flow, observe, lam, shape, line.compiling
            )
            lost = after.status
            if key.ndim:
                after, frames = without_failed(state, after, frames)
            last = int(np.max(state.step))
            failed = _failed(
                failed, lost, numbers[:3], f"stopped between steps {last} and {last + chunk.steps}"
            )
            if len(failed) == np.size(lost):
                partial = _trajectory(state, pieces, numbers, plan, False, failed)
                raise RunError("; ".join(dict.fromkeys(failed.values())), partial)
            # One statement, which Ctrl-C cannot split.
            state, done, pieces = after, done + chunk.frames, [*pieces, frames]
            line.advance(chunk.frames)
    except KeyboardInterrupt:
        line.interrupted()
    trajectory = _trajectory(state, pieces, numbers, plan, done == plan.frames, failed)
    warn_if_hot(trajectory, stacklevel=4)
    for member in failed.values():
        warnings.warn(f"{member}; the others went on: trajectory.survivors", stacklevel=3)
    return trajectory


def chunk_frames(plan: Plan, beads: int) -> int:
    """Frames in a chunk: about ``CHUNK`` particle-steps or ``LEAST`` steps."""
    return max(1, min(plan.frames, round(max(CHUNK / beads, LEAST) / plan.every)))


def _failed(before: dict, status, numbers, when: str) -> dict[int, str]:
    """The members that failed so far, each with its own numbers, when and why."""
    status = np.atleast_1d(np.asarray(status))
    fresh = [k for k in np.flatnonzero(status) if k not in before]
    whose = lambda k: f"{named(k, numbers)} of {len(status)} " if len(status) > 1 else ""
    return before | {
        int(k): f"{whose(k)}{when}: {bits.describe(status[k], grown=True)}" for k in fresh
    }


def _check_members(fluid, dt, flow, key):
    """Raise unless there is a key for each member of a scan over numbers."""
    axes = batch_axes(fluid, dt, flow)
    length = lambda axis, leaf: None if axis is None else len(leaf)
    lengths = jax.tree.map(length, axes, (fluid, dt, flow), is_leaf=lambda axis: axis is None)
    for members in jax.tree.leaves(lengths):
        if key.shape != (members,):
            raise ValueError(
                f"numbers for {members} members and keys of shape {key.shape}: "
                f"give {members} keys, jax.random.split(key, {members})"
            )


_list_trouble = jax.jit(list_trouble)


def _refuse(fluid, state, key):
    """Raise for a list that cannot serve the fluid, before anything runs."""
    check = jax.vmap(list_trouble, (fluid.batch_axes(), 0)) if key.ndim else _list_trouble
    trouble = bits.describe(check(fluid, state))
    if trouble:
        raise ValueError(trouble)


def _trajectory(state, pieces, numbers, plan, complete, failed):
    fluid, dt, flow, means = numbers
    axis = 1 if state.position.ndim == 3 else 0
    frames = jax.tree.map(lambda *parts: np.concatenate(parts, axis), *pieces) if pieces else {}
    dt = jnp.asarray(dt, state.position.dtype)
    return Trajectory(
        state, frames, fluid, flow, dt, plan.every, complete, means, tuple(failed.items())
    )
