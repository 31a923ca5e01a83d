"""What this package raises where an argument is not to blame; for arguments ValueError and
TypeError name the one. And how it warns."""

import sys
import warnings


class DPDError(Exception):
    """Any error of this package that is no argument's.

    Example:
        >>> issubclass(dpd.RunError, dpd.DPDError) and issubclass(dpd.FileError, dpd.DPDError)
        True
    """


class RunError(DPDError, RuntimeError):
    """A run that could not go on; ``trajectory`` holds all that was computed before, or is None.

    Example:
        >>> plan, torn = dpd.Plan(40, 5), dpd.shear(1000.0)
        >>> try:
        ...     dpd.run(water, state, key, 0.01, plan, torn, observe=seen, **quiet)
        ... except dpd.RunError as error:
        ...     print(str(error)[:34], error.trajectory.complete)
        stopped between steps 200 and 400: False
    """

    def __init__(self, message, trajectory=None):
        super().__init__(message)
        self.trajectory = trajectory


class TargetError(DPDError, ValueError):
    """A target no parameter reaches; ``history`` holds what was measured, a point each.

    Example:
        >>> try:
        ...     raise dpd.TargetError("viscosity 0.01 cannot be reached with gamma", history=())
        ... except ValueError as error:
        ...     print(error, len(error.history))
        viscosity 0.01 cannot be reached with gamma 0
    """

    def __init__(self, message, history):
        super().__init__(message)
        self.history = history


class FileError(DPDError, OSError):
    """A file that is damaged, held by another process, of another run, or cannot be written.

    Example:
        >>> with open("notes.nc", "w") as file:
        ...     _ = file.write("gamma, viscosity")
        >>> try:
        ...     dpd.load_scan("notes.nc")
        ... except dpd.FileError as error:
        ...     print(error)
        notes.nc is no table of a scan, or a damaged one: ...
    """


class ConfigError(DPDError, ValueError):
    """A TOML file that does not say what is to be done.

    Example:
        >>> from dpdjax.cli import main
        >>> with open("run.toml", "w") as file:
        ...     _ = file.write("fluids = 3")
        >>> main(["run", "run.toml"])  # a ConfigError, told in one line: the exit status is 2
        2
    """


class Stopped(SystemExit):
    """A run ended by SIGTERM with all it had computed on disk; the process exits with ``STATUS``.

    The same call goes on with it.

    Example:
        >>> dpd.Stopped.STATUS, issubclass(dpd.Stopped, SystemExit)
        (75, True)
    """

    STATUS = 75

    def __init__(self):
        super().__init__(self.STATUS)


def warn(text: str) -> None:
    """Warn, at the line outside of this package that led here."""
    frame, level = sys._getframe(1), 2
    while frame is not None and _is_ours(frame.f_globals.get("__name__", "")):
        frame, level = frame.f_back, level + 1
    warnings.warn(text, stacklevel=level)


def _is_ours(module: str) -> bool:
    # Of a context manager of this package one frame is that of contextlib.
    return module.partition(".")[0] in ("dpdjax", "contextlib")
