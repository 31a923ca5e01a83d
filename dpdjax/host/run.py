"""The host door: a stream of pieces collected, reported, saved and interruptible."""

import os
from collections.abc import Callable

import jax
from jax.typing import ArrayLike

from dpdjax.engine.flow import Driving
from dpdjax.engine.integrator import Integrator
from dpdjax.engine.record import Observing, recorders
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan, Trajectory
from dpdjax.errors import RunError, Stopped, warn
from dpdjax.files.checkpoint import Checkpoint
from dpdjax.files.gsd import GSD, beads_record
from dpdjax.host.heat import warn_if_hot
from dpdjax.host.keeping import InMemory, kept
from dpdjax.host.progress import Progress
from dpdjax.host.stops import Stop, stopping
from dpdjax.host.stream import Job, Lost, Piece
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
    out: str | os.PathLike | GSD | None = None,
    checkpoint: str | os.PathLike | Checkpoint | None = None,
    hours: float | None = None,
    callback: Callable[[Piece], object] | None = None,
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

    **Files.** With ``out`` every frame goes into a GSD file while the next ones are computed, the
    beads and what is observed, readable by others at any moment; the trajectory then reads its
    frames from there, and memory holds none. With ``checkpoint`` the run is saved as it goes on;
    the same call again goes on from there, to the last bit as if it had never stopped, however it
    ended, and one with a longer plan goes on with a finished run. Ctrl-C and SIGTERM then let the
    piece that is being computed end, and save; after SIGTERM the process exits with the status 75.

    Args:
        out: a GSD file, such as ``"run.gsd"``, or ``dpd.GSD(...)``, of one run.
        checkpoint: a folder of the run's own, or ``dpd.Checkpoint(...)``.
        hours: of wall time after which the run ends, as after Ctrl-C.
        callback: called with each ``Piece`` as it comes (its ``state`` and ``frames``), for plots
            on the way.

    Raises:
        ValueError, TypeError: before the work starts, for arguments that cannot work.
        FileExistsError, FileError: for files that are there, damaged, of another run, held by
            another process or cannot be written.
        RunError: positions that became NaN, beads that ran away, in the run or in all members; its
            ``trajectory`` holds the frames before.
        Stopped: after SIGTERM, with ``checkpoint`` or ``out``.

    Example:
        >>> ran = dpd.run(water, state, key, 0.01, dpd.Plan(40, 5), observe=seen, progress=False)
        >>> ran.frames["position"].shape, ran.complete
        ((40, 192, 3), True)
        >>> bool(np.all(ran.frames["position"] == rest.frames["position"]))  # the same key
        True
    """
    system = System.of(fluid, dt, flow, integrator)
    out, checkpoint = GSD.of(out), Checkpoint.of(checkpoint)
    on_disk = out is not None or checkpoint is not None
    with Progress(plan, progress) as line, stopping(hours, on_disk) as stop:
        how = recorders(observe)
        how += recorders(beads_record) if out is not None else []
        job = Job.of(system, state, key, plan, how)
        if not on_disk:
            return collected(job, line, stop, InMemory(1 if job.key.ndim else 0), callback)
        with kept(job, out, checkpoint, line.say) as (job, record):
            trajectory = collected(job, line, stop, record, callback)
    if stop.is_terminated:
        raise Stopped
    return trajectory


def collected(
    job: Job, line: Progress, stop: Stop, record, callback: Callable | None = None
) -> Trajectory:
    """The trajectory of a job, told on a line, its frames where ``record`` keeps them."""
    state, failed, is_over = job.state, job.failed, False
    line.begin(job.done)
    try:
        for piece in job.pieces(line.compiling):
            # One statement, which Ctrl-C cannot split.
            state, failed, record = piece.state, piece.failed, record.plus(piece)
            line.advance(piece)
            if callback is not None:
                callback(piece)
            if stop.is_due():
                is_over = True
                break
    except KeyboardInterrupt:
        is_over = True
    except Lost as lost:
        raise RunError(str(lost), job.trajectory(state, record.frames(), lost.failed)) from None
    trajectory = job.trajectory(state, record.frames(), failed)
    if is_over and not trajectory.complete:
        line.interrupted(stop.why)
    warn_if_hot(trajectory)
    for member in failed.values():
        warn(f"{member}; the others went on: trajectory.survivors")
    return trajectory
