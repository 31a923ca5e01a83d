"""The line that says how far a run is."""

import functools
import sys
import time

import numpy as np
from tqdm import tqdm

from dpdjax.engine import compiling
from dpdjax.engine.trajectory import Plan
from dpdjax.host.stream import Piece

SELDOM = 60.0
"""Seconds between two lines where standard error is no terminal."""


def bar(total: int, unit: str, shown: bool, **how) -> tqdm:
    """A progress bar; a line now and then where standard error is no terminal."""
    interval = 0.5 if sys.stderr.isatty() else SELDOM
    return tqdm(total=total, unit=unit, disable=not shown, mininterval=interval, **how)


class Progress:
    """Steps done of those planned, on standard error; what compiling takes is told, and no part of
    the rate or the time left. Where standard error is no terminal, a line now and then."""

    def __init__(self, plan: Plan, shown: bool):
        self.plan, self.frames, self._begun, self._shown = plan, 0, 0, shown
        self._compiled = compiling.seconds()

    @functools.cached_property
    def _bar(self):
        # Once there is something to say: a run that is refused shows none.
        done = self.plan.until(self._begun)
        return bar(self.plan.steps, "step", self._shown, initial=done)

    def begin(self, frames: int):
        """So many frames were done before."""
        self.frames = self._begun = frames

    def compiling(self):
        """Say that a program is being made."""
        self._bar.set_description("compiling")

    def advance(self, piece: Piece):
        """One more piece is done."""
        frames = piece.frames["step"].shape[-1]
        steps = self.plan.until(self.frames + frames) - self.plan.until(self.frames)
        self.frames += frames
        self._leave_out(compiling.seconds() - self._compiled)
        self._compiled = compiling.seconds()
        self._bar.set_description(None, refresh=False)
        self._bar.set_postfix_str(self._so_far(piece), refresh=False)
        self._bar.update(steps)

    def say(self, text: str):
        """A line of its own."""
        if self._shown:
            tqdm.write(text, file=sys.stderr)

    def interrupted(self, why: str = ""):
        """Say how much of the run there is."""
        by = f" by {why}" if why else ""
        told = f"interrupted{by} after {self.frames} of {self.plan.frames} frames"
        tqdm.write(told, file=sys.stderr)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if "_bar" in vars(self):
            self._bar.close()

    def _so_far(self, piece: Piece) -> str:
        """Particle-steps a second, and temperature and pressure of the last frame."""
        rate = self._bar.format_dict["rate"]
        beads = int(np.prod(piece.state.position.shape[:-1]))
        told = [f"{beads * rate:.2g} particle-steps/s"] if rate else []
        if "temperature" in piece.frames:
            told.append(f"T {np.nanmean(piece.frames['temperature'][..., -1]):.4g}")
        if "pressure_tensor" in piece.frames:
            tensor = piece.frames["pressure_tensor"][..., -1, :, :]
            told.append(f"p {np.nanmean(np.trace(tensor, axis1=-2, axis2=-1)) / 3:.4g}")
        return ", ".join(told)

    def _leave_out(self, seconds: float):
        if not self._bar.disable:
            now = time.time()
            for clock in ("start_t", "last_print_t"):
                setattr(self._bar, clock, min(getattr(self._bar, clock) + seconds, now))
