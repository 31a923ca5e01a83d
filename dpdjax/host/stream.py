"""A run as a stream of pieces: each a compiled program's worth of frames, checked and repaired."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from dpdjax.checks import prng_key
from dpdjax.engine import status as bits
from dpdjax.engine.batching import each_fluid
from dpdjax.engine.chunk import (
    batched,
    complete_lists,
    replayed,
    room_for,
    shape_of,
    without_failed,
)
from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.record import Observing, averaged, recorders
from dpdjax.engine.refusals import (
    check_finite,
    check_kinds,
    check_plan,
    check_run,
    fitted,
    list_trouble,
)
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.errors import RunError, warn
from dpdjax.host.cautions import cautions
from dpdjax.model.fluid import Fluid

CHUNK, LEAST = 1_000_000, 50
"""Particle-steps between two looks at the status: half a second; and steps, over which a large box
is sorted once."""


class Piece(NamedTuple):
    """Frames that follow one another, and where they end.

    Attributes:
        state: after the last of them, one or a batch.
        frames: recorded values by name, on the host; a batch has its axis in front of the frames.
        failed: of a batch, the members that failed so far and why.
    """

    state: State
    frames: dict[str, Any]
    failed: dict[int, str]


def stream(
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    plan: Plan,
    flow: Driving = None,
    *,
    observe: Observing = None,
    integrator: Integrator | None = None,
    piece: int | None = None,
) -> Iterator[Piece]:
    """Run piece by piece, for what is to be written, drawn or stopped on the way.

    As in :func:`dpdjax.run` lists that overflow are grown and a piece is replayed; but nothing is
    kept, and nothing is printed.

    Args:
        fluid, state, key, dt, plan, flow, observe, integrator: as for :func:`dpdjax.run`.
        piece: frames in each piece; by default about half a second's worth.

    Returns an iterator of ``Piece``: ``state`` after its last frame, ``frames`` by name, and
    ``failed``, of a batch the members that failed so far and why. Raises as :func:`dpdjax.run`
    does: what cannot work at the call, RunError without a trajectory on the way.

    Example:
        >>> pieces = dpd.stream(water, state, key, 0.01, dpd.Plan(80, 5), observe=seen, piece=40)
        >>> for piece in pieces:
        ...     print(len(piece.frames["temperature"]), piece.state)
        40 State(192 beads, box 4 x 4 x 4, step 400, time 4)
        40 State(192 beads, box 4 x 4 x 4, step 600, time 6)
    """
    job = Job.of(System.of(fluid, dt, flow, integrator), state, key, plan, observe)
    return job.pieces(size=piece)


@dataclasses.dataclass(frozen=True)
class Job:
    """A run that was checked and can begin: what moves from where, and what is recorded.

    Attributes:
        system, state, key, plan: what is run.
        how: recorders.
        done: frames of the plan that were done before, up to the state.
        failed: members of a batch that failed before, and why.
    """

    system: System
    state: State
    key: Any
    plan: Plan
    how: tuple
    done: int = 0
    failed: dict[int, str] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, system: System, state, key, plan: Plan, observe) -> "Job":
        """Raise for what cannot work, warn of what is seldom meant."""
        key = prng_key(key)
        if key.ndim > 1:
            raise ValueError(
                f"keys have shape {key.shape}; give a vector of them, keys.reshape(-1), and "
                "numbers alike, one for each"
            )
        check_kinds(system, state)
        state = fitted(system.fluid, batched(state, key))
        one = jax.tree.map(lambda leaf: leaf[0], state) if key.ndim else state
        check_plan(plan, state)
        check_run(system, one, key)
        if key.ndim:
            check_finite(state)
        for caution in cautions(system.fluid, state, system.dt, plan):
            warn(caution)
        _check_members(system, key)
        state = complete_lists(state)
        _refuse(system.fluid, state, key)
        return cls(system, state, key, plan, tuple(recorders(observe)))

    def resumed(self, state: State, done: int, failed: dict[int, str]) -> "Job":
        """The job from a state at which some of its frames were done."""
        return dataclasses.replace(self, state=state, done=done, failed=failed)

    def pieces(self, compiling: Callable = lambda: None, size: int | None = None):
        """An iterator of :class:`Piece`, of ``size`` frames each but for the last."""
        system, state, key, plan = self.system, self.state, self.key, self.plan
        beads = int(np.prod(state.position.shape[:-1]))
        most = plan.frames if size is None else max(1, min(size, plan.frames))
        # All pieces by one program, the shorter ones too.
        shape = shape_of(Plan(min(most, chunk_frames(plan, beads)), plan.longest), beads)
        done, failed = self.done, self.failed
        while done < plan.frames:
            count = most if size is not None else chunk_frames(plan, beads, done)
            part = plan.part(done, min(count, plan.frames - done))
            after, frames = replayed(system, state, key, part, self.how, shape, compiling)
            lost = after.status
            if key.ndim:
                after, frames = without_failed(state, after, frames, failed)
            last = int(np.max(state.step))
            when = f"stopped between steps {last} and {last + part.steps}"
            failed = _failed(failed, lost, system, when)
            if len(failed) == np.size(lost):
                raise Lost(failed)
            state, done = after, done + part.frames
            yield Piece(state, frames, failed)

    def trajectory(self, state, frames, failed: dict) -> Trajectory:
        """What all frames, by name, that end in a state, come to."""
        axis = 1 if self.key.ndim else 0
        done = np.shape(frames["step"])[axis] if frames else 0
        dt = jnp.asarray(self.system.dt, state.position.dtype)
        return Trajectory(
            state,
            frames,
            dataclasses.replace(self.system, dt=dt),
            self.plan.every,
            done >= self.plan.frames,
            averaged(self.how, self.system.fluid, state),
            tuple(failed.items()),
        )


class Lost(RunError):
    """All members failed; ``failed`` says why."""

    def __init__(self, failed: dict[int, str]):
        super().__init__("; ".join(dict.fromkeys(failed.values())))
        self.failed = failed


def chunk_frames(plan: Plan, beads: int, begin: int = 0) -> int:
    """Frames in a chunk from number ``begin`` on: about ``CHUNK`` particle-steps or ``LEAST``
    steps, and no more than a program has room for."""
    most = max(CHUNK / beads, LEAST)
    if not plan.schedule:
        count = min(plan.frames, round(most / plan.every))
    else:
        steps = np.cumsum(plan.intervals[begin:])
        count = int(np.searchsorted(steps, most, side="right"))
    return max(1, min(count, room_for(beads)))


def _failed(before: dict, status, system: System, when: str) -> dict[int, str]:
    """The members that failed so far, each with its own numbers, when and why."""
    status = np.atleast_1d(np.asarray(status))
    fresh = [int(k) for k in np.flatnonzero(status) if k not in before]
    whose = lambda k: f"{system.named(k)} of {len(status)} " if len(status) > 1 else ""
    return before | {k: f"{whose(k)}{when}: {bits.describe(status[k], grown=True)}" for k in fresh}


def _check_members(system: System, key):
    """Raise unless there is a key for each member of a scan over numbers."""
    for members in system.lengths():
        if key.shape != (members,):
            raise ValueError(
                f"numbers for {members} members and keys of shape {key.shape}: "
                f"give {members} keys, jax.random.split(key, {members})"
            )


_list_trouble = jax.jit(list_trouble)


def _refuse(fluid, state, key):
    """Raise for a list that cannot serve the fluid, before anything runs."""
    check = each_fluid(list_trouble, fluid, True) if key.ndim else _list_trouble
    trouble = bits.describe(check(fluid, state))
    if trouble:
        raise ValueError(trouble)
