"""What a disk refuses, in words."""

import re

import pytest

from atlantis_exp.faults import in_words


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (OSError(28, "No space left on device", "/o/x"), "/o/x: No space left on device; make room, or name a folder "),
        (PermissionError(13, "Permission denied", "/o"), "/o: Permission denied; allow it, or name another folder "),
        (FileNotFoundError(2, "No such file or directory", "/p"), "/p: No such file or directory$"),
        (OSError("of a library"), "of a library$"),
    ],
)
def test_what_a_disk_refuses_is_told_with_a_remedy(error: OSError, words: str) -> None:
    assert re.match(words, in_words(error))
