"""What is warned of at a point, kept with it: beside others, a warning does not say whose it is."""

import contextlib
import functools
import threading
import warnings
from collections.abc import Iterator

_here = threading.local()
_lock, _listeners, _as_before = threading.Lock(), 0, None


@contextlib.contextmanager
def noted() -> Iterator[list[str]]:
    """A list that fills with what this thread warns of, which is not shown meanwhile; each text
    once. Filters hold as elsewhere."""
    before, _here.notes = getattr(_here, "notes", None), []
    _listen()
    try:
        yield _here.notes
    finally:
        _here.notes = before
        _leave()


def _listen():
    global _listeners, _as_before
    with _lock:
        _listeners += 1
        if _listeners > 1:
            return
        _as_before = warnings.catch_warnings()
        _as_before.__enter__()
        # A text counts at each point, where no filter of the user's speaks of it.
        warnings.filterwarnings("always", category=UserWarning, append=True)
        warnings.showwarning = functools.partial(_note, warnings.showwarning)


def _leave():
    global _listeners
    with _lock:
        _listeners -= 1
        if not _listeners:
            _as_before.__exit__(None, None, None)


def _note(show, message, *where, **how):
    """In place of ``warnings.showwarning``, for threads of all points at once."""
    notes = getattr(_here, "notes", None)
    if notes is None:
        show(message, *where, **how)
    elif str(message) not in notes:
        notes.append(str(message))
