"""A run on disk, from which it goes on as if it had never stopped."""

import dataclasses
import os
import time
from pathlib import Path

import numpy as np

import dpdjax
from dpdjax.checks import file_name, plain, positive
from dpdjax.engine.joining import end_to_end
from dpdjax.engine.state import State
from dpdjax.engine.trajectory import Plan
from dpdjax.errors import FileError
from dpdjax.files import states
from dpdjax.files.told import differences, told

STATE, FRAMES, LOCK = "state.npz", "frames-{:010d}.npz", "lock"
BEFORE, PLANNED = "recorded.", "frames at"
"""What names of recorded values begin with in a file, so that any will do; and what of a run may
become longer."""
SEEN, NEAR = 32, 1e-2
"""Beads of the start that a checkpoint remembers, and how far they may be elsewhere, over the side
or what is largest: another processor rounds another way."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Where a run saves itself, ``dpd.run(..., checkpoint=dpd.Checkpoint("run", seconds=600))``.

    Attributes:
        folder: of its own; made where there is none.
        seconds: between two savings at least; the run is saved when it ends or is stopped too.

    Example:
        >>> saved, plan = dpd.Checkpoint("saved", seconds=600), dpd.Plan(40, 5)
        >>> ran = dpd.run(water, state, key, 0.01, plan, observe=seen, checkpoint=saved, **quiet)
        >>> again = dpd.run(water, state, key, 0.01, plan, observe=seen, checkpoint=saved, **quiet)
        >>> bool(np.all(again.final.position == ran.final.position))  # read, not run again
        True
    """

    folder: str | os.PathLike
    seconds: float = 60.0

    def __post_init__(self):
        plain(self.seconds, "seconds", positive)

    @classmethod
    def of(cls, checkpoint) -> "Checkpoint | None":
        """What ``checkpoint=`` of a run means: the name of a folder, or one of these."""
        if checkpoint is None or isinstance(checkpoint, Checkpoint):
            return checkpoint
        cure = "give the name of a folder, or dpd.Checkpoint(...)"
        file_name(checkpoint, "checkpoint", cure)
        return cls(checkpoint)

    @property
    def lock(self) -> str:
        """The file that the run holds."""
        return os.path.join(self.folder, LOCK)

    def make(self) -> None:
        """The folder, with its lock; FileError where it cannot be."""
        try:
            os.makedirs(self.folder, exist_ok=True)
            with open(self.lock, "a"):
                pass
        except OSError as error:
            raise FileError(
                f"checkpoint {os.fspath(self.folder)!r} cannot be written: {error.strerror}; give "
                "a folder that can"
            ) from error

    def load(self) -> "Saved | None":
        """What was saved last; None where nothing was.

        Raises FileError for a damaged one, one of another version or precision.
        """
        try:
            state, more = states.load(os.path.join(self.folder, STATE))
            return Saved(state, **more)
        except FileNotFoundError:
            return None
        except (FileError, TypeError) as error:
            raise FileError(f"{error}. To begin anew give another folder as checkpoint") from error

    def save(self, saved: "Saved", frames: list[dict], axis: int) -> None:
        """Save a run, and frames that are not saved yet; whole, or not at all."""
        if frames:
            joined = end_to_end(frames, axis)
            with states.replacing(self._frames(saved.frames)) as file:
                np.savez(file, **{BEFORE + name: values for name, values in joined.items()})
        more = {f.name: getattr(saved, f.name) for f in dataclasses.fields(saved)}
        states.save(os.path.join(self.folder, STATE), more.pop("state"), more)

    def frames(self, count: int, axis: int) -> dict:
        """The first ``count`` frames that were saved, by name."""
        parts = []
        for end in sorted(end for end in self._ends() if end <= count):
            with np.load(self._frames(end)) as file:
                parts.append({name.removeprefix(BEFORE): file[name] for name in file})
        found = end_to_end(parts, axis)
        if (found["step"].shape[axis] if found else 0) != count:
            raise FileError(
                f"checkpoint {os.fspath(self.folder)!r} lacks some of its {count} frames; begin "
                "anew in another folder"
            )
        return found

    def drop_later(self, count: int) -> None:
        """Remove frames beyond the first ``count``, of a run that ended before it was saved."""
        for end in self._ends():
            if end > count:
                os.remove(self._frames(end))
        for unfinished in Path(self.folder).glob("*.part"):
            os.remove(unfinished)

    def _ends(self) -> list[int]:
        return [int(path.stem.split("-")[1]) for path in Path(self.folder).glob("frames-*.npz")]

    def _frames(self, end: int) -> str:
        return os.path.join(self.folder, FRAMES.format(end))


@dataclasses.dataclass(frozen=True)
class Saved:
    """What a checkpoint holds.

    Attributes:
        state: after the last frame that was saved.
        frames: how many there are.
        failed: of a batch, the members that failed so far, number and reason.
        made: what made it, as :func:`made_by` tells it.
        start: of some beads at the start, places, velocities and sizes.
        planned: frames of the plan it was saved under.
        begin: frames that its GSD file held before it.
        out: the name of that file and the species written there; None where the checkpoint holds
            the frames.
    """

    state: State
    frames: int
    failed: list
    made: dict
    start: list
    planned: int
    begin: int
    out: dict | None

    @property
    def is_finished(self) -> bool:
        """Whether it was saved at the end of its plan."""
        return self.frames >= self.planned


def made_by(job) -> dict:
    """What makes a run what it is, to be compared with another; ``job`` has its system, state, key,
    plan and recorders ``how``."""
    state, system = job.state, job.system.as_type(job.state.position.dtype)
    return {
        "version": dpdjax.__version__,
        "dtype": str(state.position.dtype),
        "beads": list(state.position.shape[:-1]),
        "species": told(state.species),
        "box": told(state.box.lengths),
        "step": told(state.step),
        "fluid": told(system.fluid),
        "flow": told(system.flow),
        "dt": told(system.dt),
        "integrator": told(system.integrator),
        "key": told(job.key),
        "observe": told(job.how),
        PLANNED: _intervals(job.plan),
    }


def _intervals(plan: Plan):
    return list(plan.schedule) if plan.schedule else plan.every


def start_of(state: State) -> list:
    """Of some of the beads where they are, over the sides of the box, their velocities, over the
    largest, and their sizes."""
    position, velocity = (
        np.asarray(x, float).reshape(-1, 3) for x in (state.position, state.velocity)
    )
    sides = np.asarray(state.box.lengths, float).reshape(-1, 3)[0]
    largest = max(float(np.abs(velocity).max()), np.finfo(float).tiny)
    size = np.asarray(state.size, float).reshape(-1, 1)
    rows = np.concatenate([position / sides, velocity / largest, size], axis=1)
    rows = np.concatenate([rows, np.full((len(rows), 1), largest)], axis=1)
    return np.round(rows[np.linspace(0, len(rows) - 1, SEEN).astype(int)], 6).tolist()


def differing(before: dict, now: dict) -> list[str]:
    """Where two runs differ, but for how long they are."""
    return differences(*({k: v for k, v in made.items() if k != PLANNED} for made in (before, now)))


def check_same(saved: Saved, made: dict, state: State, plan: Plan, out, folder) -> None:
    """Raise FileError, naming what differs, unless a run is that of a checkpoint, or longer."""
    lines = differing(saved.made, made)
    before, now = saved.made[PLANNED], made[PLANNED]
    if plan.frames < saved.frames:
        lines.append(f"plan: {saved.frames} frames were done, and it has {plan.frames} now")
    elif _steps(before, saved.frames) != _steps(now, saved.frames):
        lines.append(f"plan: frames at {before} then, at {now} now")
    if not lines:
        lines += _moved(saved.start, start_of(state))
    lines += differences(saved.out or {"file": None}, out or {"file": None}, "out")
    if lines:
        raise FileError(
            f"checkpoint {os.fspath(folder)!r} is of another run: {'; '.join(lines)}. Give what "
            "the run began with, or another folder"
        )


def _moved(before: list, now: list) -> list[str]:
    apart = np.asarray(before) - np.asarray(now)
    apart[:, :3] -= np.round(apart[:, :3])
    apart[:, 7] /= np.asarray(now)[:, 7]
    off = np.abs(apart).max(axis=0) > NEAR
    what = {"places": off[:3].any(), "velocities": off[3:6].any() | off[7], "sizes": off[6]}
    names = [name for name, is_off in what.items() if is_off]
    return [f"state: it began with other {' and '.join(names)} of its beads"] if names else []


def _steps(intervals, count: int) -> list[int]:
    """Steps of the first frames of a plan."""
    if isinstance(intervals, list):
        return intervals[:count]
    return [intervals * (k + 1) for k in range(count)]


class Clock:
    """When a run is to be saved."""

    def __init__(self, seconds: float):
        self.seconds, self._last = seconds, time.monotonic()

    def is_due(self) -> bool:
        """Whether so many seconds have gone by since the last time it was."""
        now = time.monotonic()
        if now - self._last < self.seconds:
            return False
        self._last = now
        return True
