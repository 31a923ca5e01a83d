"""Files that one process writes at a time."""

import contextlib
import os

try:
    import fcntl
except ImportError:  # where there is no such lock, there is none
    fcntl = None

from dpdjax.errors import FileError


@contextlib.contextmanager
def held(path: str | os.PathLike, what: str | os.PathLike | None = None):
    """Hold a file that is there until the end; FileError where another process holds it, naming it
    or ``what`` it is the lock of.

    The system lets go of it when a process ends, however it ends. On a file system without locks
    nothing is held.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if fcntl is not None:
            _lock(descriptor, os.fspath(path if what is None else what))
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, what: str):
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise FileError(
            f"{what} is being written by another process: wait until it ends, or give another name"
        ) from error
    except OSError:
        pass
