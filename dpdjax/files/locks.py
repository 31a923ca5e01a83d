"""Files that one process writes at a time."""

import contextlib
import os

try:
    import fcntl
except ImportError:  # where there is no such lock, there is none
    fcntl = None

from dpdjax.errors import FileError


@contextlib.contextmanager
def held(path: str | os.PathLike):
    """Hold a file that is there until the end; FileError where another process holds it.

    The system lets go of it when a process ends, however it ends. On a file system without locks
    nothing is held.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        if fcntl is not None:
            _lock(descriptor, path)
        yield
    finally:
        os.close(descriptor)


def _lock(descriptor: int, path):
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise FileError(
            f"{path} is being written by another process: wait until it ends, or give another name"
        ) from error
    except OSError:
        pass
