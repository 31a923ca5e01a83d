"""The line that says how far a scan is."""

import sys
import time

from tqdm import tqdm

from dpdjax.host.progress import bar
from dpdjax.scans.drive import Outcome


class Progress:
    """Runs done of those there are, particle-steps a second, time left; on standard error."""

    def __init__(self, runs: int, shown: bool):
        self._bar = bar(runs, "run", shown)
        self._shown, self._began, self._steps, self._failed = shown, time.monotonic(), 0, 0

    def advance(self, outcome: Outcome):
        """One more run is done."""
        self._steps += outcome.particle_steps
        self._failed += bool(outcome.reason)
        rate = self._steps / (time.monotonic() - self._began)
        lost = f", {self._failed} failed" if self._failed else ""
        self._bar.set_postfix_str(f"{rate:.2g} particle-steps/s{lost}", refresh=False)
        self._bar.update(1)

    def say(self, text: str):
        """A line of its own."""
        if self._shown:
            tqdm.write(text, file=sys.stderr)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._bar.close()
