"""What this package raises where an argument is not to blame; for arguments ValueError and
TypeError name the one."""


class DPDError(Exception):
    """Any error of this package that is no argument's."""


class RunError(DPDError, RuntimeError):
    """A run that could not go on; ``trajectory`` holds all that was computed before."""

    def __init__(self, message, trajectory=None):
        super().__init__(message)
        self.trajectory = trajectory


class TargetError(DPDError, ValueError):
    """A target no parameter reaches; ``history`` holds what was measured."""

    def __init__(self, message, history):
        super().__init__(message)
        self.history = history


class FileError(DPDError, OSError):
    """A file that is damaged, held by another process, of another run, or cannot be written."""


class ConfigError(DPDError, ValueError):
    """A TOML file that does not say what is to be done."""


class Stopped(SystemExit):
    """A run ended by SIGTERM with all it had computed on disk; the process exits with ``STATUS``.

    The same call goes on with it.
    """

    STATUS = 75

    def __init__(self):
        super().__init__(self.STATUS)
