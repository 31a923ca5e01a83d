"""A run on disk, from which it goes on as if it had never stopped."""

import dataclasses
import os
import time

import jax
import numpy as np

import dpdjax
from dpdjax.checks import plain, positive
from dpdjax.engine.state import State
from dpdjax.engine.system import System
from dpdjax.engine.trajectory import Plan
from dpdjax.errors import FileError
from dpdjax.files import states
from dpdjax.files.told import differences, told

STATE, FRAMES, LOCK = "state.npz", "frames-{:010d}.npz", "lock"
SEEN, NEAR = 32, 1e-2
"""Beads of the start that a checkpoint remembers, and how far they may be elsewhere, over the side:
another processor rounds another way."""


@dataclasses.dataclass(frozen=True)
class Checkpoint:
    """Where a run saves itself, ``dpd.run(..., checkpoint=dpd.Checkpoint("run", seconds=600))``.

    Attributes:
        folder: of its own; made where there is none.
        seconds: between two savings at least; the run is saved when it ends or is stopped too.
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
        if not isinstance(checkpoint, str | os.PathLike):
            raise TypeError(
                f"checkpoint is {checkpoint!r}; give the name of a folder, or dpd.Checkpoint(...)"
            )
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
        except (ValueError, TypeError) as error:
            raise FileError(f"{error}. To begin anew give another folder as checkpoint") from error

    def save(self, saved: "Saved", frames: list[dict], axis: int) -> None:
        """Save a run, and frames that are not saved yet; whole, or not at all."""
        if frames:
            joined = jax.tree.map(lambda *parts: np.concatenate(parts, axis), *frames)
            with states.replacing(self._frames(saved.frames)) as file:
                np.savez(file, **joined)
        more = {f.name: getattr(saved, f.name) for f in dataclasses.fields(saved)}
        states.save(os.path.join(self.folder, STATE), more.pop("state"), more)

    def frames(self, count: int, axis: int) -> dict:
        """The first ``count`` frames that were saved, by name."""
        ends = sorted(
            int(name[len("frames-") : -len(".npz")])
            for name in os.listdir(self.folder)
            if name.startswith("frames-") and name.endswith(".npz")
        )
        parts = []
        for end in ends:
            if end <= count:
                with np.load(self._frames(end)) as file:
                    parts.append(dict(file))
        join = lambda *values: np.concatenate(values, axis)
        found = jax.tree.map(join, *parts) if parts else {}
        if (found["step"].shape[axis] if found else 0) != count:
            raise FileError(
                f"checkpoint {os.fspath(self.folder)!r} lacks some of its {count} frames; begin "
                "anew in another folder"
            )
        return found

    def drop_later(self, count: int) -> None:
        """Remove frames beyond the first ``count``, of a run that ended before it was saved."""
        for name in os.listdir(self.folder):
            if name.startswith("frames-") and int(name[len("frames-") : -len(".npz")]) > count:
                os.remove(os.path.join(self.folder, name))

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
        start: where some beads were at the start.
        out: the GSD file that holds the frames; None where the checkpoint does.
    """

    state: State
    frames: int
    failed: list
    made: dict
    start: list
    out: str | None


def made_by(system: System, state: State, key, plan: Plan, how: tuple) -> dict:
    """What makes a run what it is, to be compared with another."""
    system = system.as_type(state.position.dtype)
    return {
        "version": dpdjax.__version__,
        "dtype": str(state.position.dtype),
        "beads": list(state.position.shape[:-1]),
        "box": told(state.box.lengths),
        "step": told(state.step),
        "fluid": told(system.fluid),
        "flow": told(system.flow),
        "dt": told(system.dt),
        "integrator": told(system.integrator),
        "key": told(key),
        "observe": told(how),
        "intervals": _intervals(plan),
    }


def _intervals(plan: Plan):
    return list(plan.schedule) if plan.schedule else plan.every


def start_of(state: State) -> list:
    """Where some of the beads are, over the sides of the box."""
    position = np.asarray(state.position, float).reshape(-1, 3)
    some = position[np.linspace(0, len(position) - 1, SEEN).astype(int)]
    sides = np.asarray(state.box.lengths, float).reshape(-1, 3)[0]
    return np.round(some / sides, 6).tolist()


def check_same(saved: Saved, made: dict, state: State, out: str | None, folder) -> None:
    """Raise FileError, naming what differs, unless a run is that of a checkpoint, or longer."""
    before, now = dict(saved.made), dict(made)
    told_plans = before.pop("intervals"), now.pop("intervals")
    lines = differences(before, now)
    if not _goes_on(*told_plans, saved.frames):
        lines.append(f"plan: frames at {told_plans[0]} then, at {told_plans[1]} now")
    apart = np.asarray(saved.start) - np.asarray(start_of(state))
    if np.max(np.abs(apart - np.round(apart))) > NEAR:
        lines.append("state: its beads are elsewhere than those the run began with")
    if out != saved.out:
        lines.append(f"out: {saved.out} then, {out} now")
    if lines:
        raise FileError(
            f"checkpoint {os.fspath(folder)!r} is of another run: {'; '.join(lines)}. Give what "
            "the run began with, or another folder"
        )


def _goes_on(before, now, done: int) -> bool:
    """Whether frames at the intervals ``now`` begin with those that were done."""
    if isinstance(before, list) and isinstance(now, list):
        return before[:done] == now[:done]
    return before == now


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
