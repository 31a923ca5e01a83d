"""Programs kept on disk, so that the next process need not compile them again."""

import hashlib
import os
import pathlib
import platform
import sys

LEAST = 0.5
"""Seconds of compiling from which a program is kept."""


def compilation_cache(folder: str | os.PathLike | None = None) -> str:
    """Keep compiled programs in a folder, where later runs of the same shapes find them; returns
    the folder.

    One line at the top of a script or notebook, best before anything has imported jax: on a CPU jax
    logs a page for every program that it reads back, and that can be silenced only before it is
    imported. From then on XLA's own log tells fatal errors only; exceptions are as before.

    Args:
        folder: by default ``dpdjax`` in the user's folder for caches (``XDG_CACHE_HOME``,
            ``~/.cache``), with a folder inside for each kind of processor, since programs of one
            need not run on another.

    Example:
        >>> before = jax.config.jax_compilation_cache_dir
        >>> folder = dpd.compilation_cache("programs")
        >>> jax.config.jax_compilation_cache_dir == folder
        True
        >>> jax.config.update("jax_compilation_cache_dir", before)
    """
    if "jax" not in sys.modules:
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    import jax

    folder = pathlib.Path(_default() if folder is None else folder).expanduser() / _processor()
    folder.mkdir(parents=True, exist_ok=True)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", LEAST)
    return str(folder)


def _default() -> pathlib.Path:
    caches = os.environ.get("XDG_CACHE_HOME")
    return (pathlib.Path(caches) if caches else pathlib.Path.home() / ".cache") / "dpdjax"


def _processor() -> str:
    """A name for what this processor can do."""
    try:
        lines = pathlib.Path("/proc/cpuinfo").read_text().splitlines()
        can = next(line for line in lines if line.lower().startswith(("flags", "features")))
    except (OSError, StopIteration):
        can = platform.processor()
    return f"{platform.machine()}-{hashlib.sha256(can.encode()).hexdigest()[:8]}"
