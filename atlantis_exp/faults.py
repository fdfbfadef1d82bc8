"""Mistakes and faults that end a command with one line, which a person can act on, instead of a traceback."""

import errno


class Fault(RuntimeError):
    """Ends a command with one clear line and an exit code; nothing committed is lost."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class RunFault(Fault):
    """Ended a run at its last commit, from where the same command continues it."""


class ConfigError(Fault, ValueError):
    """A user's mistake, in one line that names the key and the nearest valid choice."""

    def __init__(self, message: str) -> None:
        super().__init__(message, exit_code=2)


def remedied(error: Exception) -> str:
    """Return an error's message, of a full disk with the key and the remedy."""
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        return f"paths.outputs: {error}; make room there, or name another disk"
    return str(error)
