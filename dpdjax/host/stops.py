"""What ends a run before its plan does: signals, and the hours it was given."""

import contextlib
import signal
import threading
import time

from dpdjax.checks import plain, positive


class Stop:
    """Whether a run is to end at its next piece, and why.

    Attributes:
        why: in words; empty while it is to go on.
        is_terminated: whether SIGTERM asked for it.
        is_interrupted: whether what was being done was broken off.
    """

    def __init__(self, hours: float | None):
        self.why, self.is_terminated, self.is_interrupted = "", False, False
        hours = None if hours is None else plain(hours, "hours", positive)
        self._hours, self._began = hours, time.monotonic()
        self._last, self._longest = self._began, 0.0

    def ask(self, number: int, _frame=None):
        """Ask for it by a signal; a second Ctrl-C interrupts at once."""
        if self.why and number == signal.SIGINT:
            self.is_interrupted = True
            raise KeyboardInterrupt
        self.why = signal.Signals(number).name
        self.is_terminated |= number == signal.SIGTERM

    def is_over(self) -> bool:
        """Whether it was asked for, or the hours are over."""
        return self._ends_by(time.monotonic())

    def is_due(self) -> bool:
        """To be asked after each piece: whether there is no time for another as long as the longest
        so far."""
        now = time.monotonic()
        self._longest, self._last = max(self._longest, now - self._last), now
        return self._ends_by(now + self._longest)

    def _ends_by(self, moment: float) -> bool:
        if not self.why and self._hours is not None:
            if moment - self._began > self._hours * 3600:
                self.why = f"{self._hours:g} hours"
        return bool(self.why)


@contextlib.contextmanager
def stopping(hours: float | None, signals: bool):
    """A :class:`Stop` that SIGINT and SIGTERM ask for until the end, if ``signals``; only the main
    thread can listen to them."""
    stop = Stop(hours)
    is_main = threading.current_thread() is threading.main_thread()
    listened = (signal.SIGINT, signal.SIGTERM) if signals and is_main else ()
    before = {number: signal.signal(number, stop.ask) for number in listened}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            # Of a handler that is none of Python's nothing is known.
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
