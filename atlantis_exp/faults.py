"""Faults at run time that a person can act on."""


class Fault(RuntimeError):
    """Ends a command with one clear line and an exit code instead of a traceback; nothing committed is lost."""

    def __init__(self, message: str, exit_code: int = 1) -> None:
        super().__init__(message)
        self.exit_code = exit_code
