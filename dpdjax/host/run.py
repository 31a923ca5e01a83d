"""The host door: a stream of pieces collected, reported and interruptible."""

import warnings
from collections.abc import Callable

import jax
from jax.typing import ArrayLike

from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.record import Observing
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.host.heat import warn_if_hot
from dpdjax.host.progress import Progress
from dpdjax.host.stream import Job, Lost, Piece, RunError
from dpdjax.model.fluid import Fluid


def run(
    fluid: Fluid,
    state: State,
    key: jax.Array,
    dt: ArrayLike,
    plan: Plan,
    flow: Driving = None,
    *,
    observe: Observing = None,
    integrator: Integrator | None = None,
    progress: bool = True,
) -> Trajectory:
    """Run with everything a person at a keyboard expects; see ``simulate`` for the arguments.

    Lists that overflow are grown and the chunk is replayed with the same noise, so the
    result is the one that larger lists would have given from the start. Ctrl-C returns the
    trajectory so far, with ``complete`` False. A progress bar goes to standard error.

    **Batches.** A vector of keys runs one member for each key. The state may be a batch
    (from a vmapped ``initial_state`` or an earlier batch) or one state for all, and so may every
    number: ``fluid.set(gamma=jnp.array([2.0, 4.5, 9.0]))`` with three keys is a scan. An
    accelerator runs the members side by side in one program, a CPU each on a core of its own: its
    caches hold one. A member that fails is named in a warning and in ``failed`` of the trajectory,
    and the others go on as if it were not there; ``trajectory.survivors`` is a batch without it.

    Raises:
        ValueError, TypeError: before the work starts, for arguments that cannot work.
        RunError: positions that became NaN, beads that ran away, in the run or in all members; its
            ``trajectory`` holds the frames before.
    """
    system = System.of(fluid, dt, flow, integrator)
    with Progress(plan, progress) as line:
        job = Job.of(system, state, key, plan, observe, stacklevel=2)
        return collected(job, line)


def collected(
    job: Job, line: Progress, size: int | None = None, keep: Callable[[Piece], dict] | None = None
) -> Trajectory:
    """The trajectory of a job, told on a line: of each piece, of ``size`` frames, what ``keep``
    makes of it, by default its frames."""
    state, pieces, failed = job.state, [], {}
    try:
        for piece in job.pieces(size, line.compiling):
            frames = piece.frames if keep is None else keep(piece)
            # One statement, which Ctrl-C cannot split.
            state, pieces, failed = piece.state, [*pieces, frames], piece.failed
            line.advance(len(frames["step"].T))
    except KeyboardInterrupt:
        line.interrupted()
    except Lost as lost:
        raise RunError(str(lost), job.trajectory(state, pieces, lost.failed)) from None
    trajectory = job.trajectory(state, pieces, failed)
    warn_if_hot(trajectory, stacklevel=4)
    for member in failed.values():
        warnings.warn(f"{member}; the others went on: trajectory.survivors", stacklevel=3)
    return trajectory
