"""What becomes of the frames of a run: kept in memory, or on disk as they come."""

import contextlib
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import jax
import numpy as np

from dpdjax.engine.joining import end_to_end
from dpdjax.errors import FileError
from dpdjax.files import checkpoint as points
from dpdjax.files.frames import StoredFrames, about
from dpdjax.files.gsd import GSD, check_follows, derived, gsd_writer, reading, writing
from dpdjax.files.locks import held
from dpdjax.files.states import refuse_existing, replacing
from dpdjax.host.stream import Job, Piece


class InMemory:
    """Frames that are kept in memory; ``axis`` is theirs."""

    def __init__(self, axis: int, pieces: tuple[dict, ...] = ()):
        self.axis, self._pieces = axis, pieces

    def plus(self, piece: Piece) -> "InMemory":
        """With those of one more piece."""
        return InMemory(self.axis, (*self._pieces, piece.frames))

    def frames(self) -> dict:
        """All of them, by name."""
        return end_to_end(self._pieces, self.axis)


class OnDisk:
    """Frames that are written while the next ones are computed, to a GSD file or to a checkpoint.

    Made by :func:`kept`.
    """

    def __init__(self, out: "_Out | None", saving: "_Saving | None"):
        self._out, self._saving = out, saving
        self._writer = _Background()
        self._last: Piece | None = None

    def plus(self, piece: Piece) -> "OnDisk":
        """With those of one more piece; raises what went wrong with the one before."""
        self._writer.put(self._write, piece)
        return self

    def frames(self):
        """All of them, by name: read from the file when asked for, or from the checkpoint."""
        self.close()
        if self._out is not None:
            return StoredFrames(self._out.path, self._out.begin) if self._out.is_there else {}
        return self._saving.frames()

    def close(self):
        """Wait for what is being written, and save the run as it is."""
        self._writer.wait()
        if self._saving is not None and self._last is not None:
            self._saving.save(self._last)
            self._last = None

    def _write(self, piece: Piece):
        if self._out is not None:
            self._out.write(piece.frames)
        self._last = piece
        if self._saving is not None:
            self._saving.add(piece, keeps_frames=self._out is None)
            if self._saving.clock.is_due():
                self._saving.save(piece)
                self._last = None


@contextlib.contextmanager
def kept(job: Job, out: GSD | None, checkpoint: points.Checkpoint | None, say: Callable):
    """The job as it is to go on, and where its frames go; ``say`` is told what is done with files
    that are there."""
    _check_kinds(job)
    with contextlib.ExitStack() as stack:
        saving = None
        if checkpoint is not None:
            checkpoint.make()
            stack.enter_context(held(checkpoint.lock, checkpoint.folder))
            saving = _Saving(checkpoint, job, out)
            job = saving.job
            if job.done:
                where = os.fspath(checkpoint.folder)
                say(f"goes on from frame {job.done} of {job.plan.frames}, saved in {where}")
        target = None if out is None else stack.enter_context(_opened(out, job, saving, say))
        if saving is not None:
            saving.begin(0 if target is None else target.begin)
        record = OnDisk(target, saving)
        try:
            yield job, record
        finally:
            record.close()


def _check_kinds(job: Job):
    """Raise TypeError for what is recorded of a kind that files do not hold."""
    state = jax.tree.map(lambda leaf: leaf[0], job.state) if job.key.ndim else job.state
    fluid = job.system.member(0).fluid if job.key.ndim else job.system.fluid
    for recorder in job.how:
        for name, values in jax.eval_shape(recorder.now, fluid, state).items():
            if np.dtype(values.dtype).kind not in "biuf":
                raise TypeError(
                    f"{name!r} is recorded as {values.dtype}, which files do not hold; record real "
                    "numbers, of a complex one its .real and .imag"
                )


class _Saving:
    """A checkpoint and the run it is of, which begins where it was saved."""

    def __init__(self, checkpoint: points.Checkpoint, job: Job, out: GSD | None):
        self.checkpoint, self.clock = checkpoint, points.Clock(checkpoint.seconds)
        self.axis = 1 if job.key.ndim else 0
        self.made = points.made_by(job)
        self._start, self._begin, self._out = points.start_of(job.state), 0, None
        if out is not None:
            self._out = {"file": os.path.basename(out.path), "species": out.species}
        self.saved = checkpoint.load()
        self._pending: list[dict] = []
        if self.saved is not None:
            of = self.made, job.state, job.plan, self._out, checkpoint.folder
            points.check_same(self.saved, *of)
            self._start, self._begin = self.saved.start, self.saved.begin
            checkpoint.drop_later(self.saved.frames)
            job = job.resumed(self.saved.state, self.saved.frames, dict(self.saved.failed))
        self.job, self._done = job, job.done

    def begin(self, frames: int):
        """Save the run before it goes on, with the frames that its file held before it: one that is
        killed at once begins again in the same file."""
        self._begin = frames
        if self.saved is None or self.job.plan.frames > self.saved.planned:
            self.save(Piece(self.job.state, {}, self.job.failed))

    def add(self, piece: Piece, keeps_frames: bool):
        """Take in a piece that is not yet saved."""
        self._done += piece.frames["step"].shape[self.axis]
        if keeps_frames:
            self._pending.append(piece.frames)

    def save(self, piece: Piece):
        """Save the run as it is after a piece."""
        failed = [[int(k), why] for k, why in piece.failed.items()]
        state = jax.device_get(piece.state)
        planned = self.job.plan.frames
        start = self._start, planned, self._begin, self._out
        saved = points.Saved(state, self._done, failed, self.made, *start)
        with writing(self.checkpoint.folder):
            self.checkpoint.save(saved, self._pending, self.axis)
        self._pending = []

    def frames(self) -> dict:
        """All frames that were saved."""
        return self.checkpoint.frames(self._done, self.axis) if self._done else {}


class _Out:
    """A GSD file that a run writes: opened when there is something to write, so that a run that
    ends at once leaves an old file as it was."""

    def __init__(self, target: GSD, mode: str, job: Job, begin: int, about: dict, stack):
        self.path, self._target, self._mode, self._job = target.path, target, mode, job
        self.begin = begin
        self._about, self._stack, self._put = about, stack, None

    @property
    def is_there(self) -> bool:
        """Whether anything was written, now or before."""
        return self._put is not None or self._mode == "r+"

    def write(self, frames: dict):
        """Append frames to the file."""
        if self._put is None:
            fluid, state = self._job.system.fluid, self._job.state
            kinds = {"species": self._target.species, "about": self._about}
            kinds |= {"untold": derived(self._job.how)}
            opened = gsd_writer(self.path, fluid, state, self._mode, **kinds)
            self._put = self._stack.enter_context(opened)
            if self._mode != "r+":
                self._stack.enter_context(held(self.path))
        self._put(frames, self._job.system.flow)


@contextlib.contextmanager
def _opened(target: GSD, job: Job, saving: _Saving | None, say: Callable):
    """The file of a run, made ready to be written."""
    if job.key.ndim:
        raise ValueError(
            "a GSD file holds one run; run the batch with observe=dpd.observe.gsd_record and write "
            "its members by dpd.write_gsd"
        )
    with contextlib.ExitStack() as stack:
        resumed = saving is not None and saving.saved is not None
        begin = _resume(target, saving, say) if resumed else _begin(target, job)
        mode = "r+" if begin or job.done else "w"
        if mode == "r+":
            stack.enter_context(held(target.path))
        made = saving.made if saving is not None else points.made_by(job)
        told = target.about | {"version": made["version"], "every": job.plan.every, "made": made}
        yield _Out(target, mode, job, begin, None if job.done else told, stack)


def _begin(target: GSD, job: Job) -> int:
    """Frames in the file of a run that begins, to be gone on with."""
    folder, exists = os.path.dirname(target.path) or ".", os.path.exists(target.path)
    if not os.path.isdir(folder):
        raise FileError(f"out is {os.fspath(target.path)!r}, and there is no folder {folder}")
    if target.mode == "x":
        cure = 'out=dpd.GSD(..., mode="w") to replace it, mode="a" to go on with it'
        refuse_existing(target.path, cure)
    if target.mode == "a" and exists:
        with held(target.path):
            check_follows(target.path, job.system.fluid, job.state, target.species)
        with reading(target.path) as file:
            return len(file)
    if exists:
        with held(target.path):
            pass
    return 0


def _resume(target: GSD, saving: _Saving, say: Callable) -> int:
    """Leave of a file the frames that were saved with the run; those that were there before it."""
    saved, begin = saving.saved, saving.saved.begin
    count = begin + saved.frames
    if not os.path.exists(target.path):
        if count:
            raise FileError(
                f"{target.path} is gone, and the checkpoint of its run is there: bring it back, or "
                "begin anew with another folder as checkpoint"
            )
        return 0
    with held(target.path):
        with reading(target.path) as file:
            there, wrote = len(file), about(file, begin).get("made", {})
        if there < count:
            raise FileError(
                f"{target.path} holds {there} frames and its checkpoint is at frame {count}: bring "
                "the file back, or begin anew"
            )
        other = points.differing(wrote, saving.made) if there > begin else []
        if other:
            raise FileError(f"{target.path} is of another run than its checkpoint: {other[0]}")
        if there > count and saved.is_finished:
            raise FileError(
                f"{target.path} was gone on with by another run, after frame {count}: give that "
                "run's state and plan, or another file"
            )
        if there > count:
            say(f"{target.path}: {there - count} frames after the last checkpoint are dropped")
            trim(target.path, count)
    return begin


def trim(path, count: int) -> None:
    """Leave the first ``count`` frames of a GSD file: copied, and put in its place when whole."""
    import gsd.fl

    with writing(path), reading(path) as old:
        source = old.file
        names = source.find_matching_chunk_names("")
        with replacing(path) as unfinished:
            copy = gsd.fl.open(
                unfinished.name, "w", source.application, source.schema, source.schema_version
            )
            with copy:
                for frame in range(count):
                    for name in names:
                        if source.chunk_exists(frame, name):
                            copy.write_chunk(name, source.read_chunk(frame, name))
                    copy.end_frame()


class _Background:
    """One thing at a time, done beside what goes on."""

    def __init__(self):
        self._pool, self._running = ThreadPoolExecutor(1), None

    def put(self, work: Callable, *arguments):
        """Begin it when what was begun before has ended; raises what that raised."""
        self.wait()
        self._running: Future | None = self._pool.submit(work, *arguments)

    def wait(self):
        """Wait for what was begun; raises what it raised. Interrupted, it is waited for again."""
        try:
            if self._running is not None:
                self._running.result()
        except KeyboardInterrupt:
            raise
        except BaseException:
            self._running = None
            raise
        self._running = None
