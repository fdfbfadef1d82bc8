"""Texts on a terminal as they are: a name with brackets is no markup, and nothing is coloured by a guess."""

import shutil

from rich.console import Console


def console(least: int | None = None) -> Console:
    """A console; least: columns of a table that would be cut on a narrower one, None to leave long lines to it."""
    if least is None:
        return Console(highlight=False, markup=False, emoji=False, soft_wrap=True)
    width = max(shutil.get_terminal_size().columns, least)
    return Console(highlight=False, markup=False, emoji=False, width=width)
