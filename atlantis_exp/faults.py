"""Errors that end a command with one line for a person instead of a traceback."""

from errno import EACCES, EDQUOT, EFBIG, ENOSPC, EPERM, EROFS


class Fault(RuntimeError):
    """Ends a command with one clear line and an exit code; nothing committed is lost."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code


class ConfigError(Fault, ValueError):
    """A user's mistake, in one line that names the key and the nearest valid choice."""

    def __init__(self, message: str) -> None:
        super().__init__(message, exit_code=2)


def in_words(error: OSError) -> str:
    """Return a file's error with its remedy."""
    place = f"{error.filename}: " if error.filename else ""
    remedy = ""
    if error.errno in (ENOSPC, EDQUOT, EFBIG):
        remedy = "; make room, or name a folder elsewhere with paths.outputs=FOLDER"
    elif error.errno in (EACCES, EPERM, EROFS):
        remedy = "; allow it, or name another folder with paths.outputs=FOLDER"
    return f"{place}{error.strerror or error}{remedy}"
