"""Texts on a terminal as they are, where a name with brackets is no markup, and durations."""

import shutil

from rich.console import Console


def console(least: int | None = None) -> Console:
    """A console; least: columns of a table that would be cut on a narrower one, None to leave long lines to it."""
    if least is None:
        return Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    width = max(shutil.get_terminal_size().columns, least)
    return Console(highlight=False, markup=False, emoji=False, width=width)


def clock(seconds: float) -> str:
    """A duration as hours, minutes and seconds, 26:07:09; what is below zero is zero."""
    minutes, second = divmod(max(int(seconds), 0), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{second:02}"
