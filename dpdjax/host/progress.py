"""The line that says how far a run is."""

import functools
import sys
import time

from tqdm import tqdm

from dpdjax.engine import compiling
from dpdjax.engine.trajectory import Plan


class Progress:
    """Steps done of those planned, on standard error; what compiling takes is told, and no part of
    the rate or the time left."""

    def __init__(self, plan: Plan, shown: bool):
        self.plan, self.frames, self._shown = plan, 0, shown
        self._compiled = compiling.seconds()

    @functools.cached_property
    def _bar(self):
        # Once there is something to say: a run that is refused shows none.
        return tqdm(total=self.plan.steps, unit="step", disable=not self._shown, mininterval=0.5)

    def compiling(self):
        """Say that a program is being made."""
        self._bar.set_description("compiling")

    def advance(self, frames: int):
        """Frames more are done."""
        self.frames += frames
        self._leave_out(compiling.seconds() - self._compiled)
        self._compiled = compiling.seconds()
        self._bar.set_description(None, refresh=False)
        self._bar.update(frames * self.plan.every)

    def interrupted(self):
        """Say how much of the run there is."""
        tqdm.write(f"interrupted after {self.frames} of {self.plan.frames} frames", file=sys.stderr)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        if "_bar" in vars(self):
            self._bar.close()

    def _leave_out(self, seconds: float):
        if not self._bar.disable:
            now = time.time()
            for clock in ("start_t", "last_print_t"):
                setattr(self._bar, clock, min(getattr(self._bar, clock) + seconds, now))
