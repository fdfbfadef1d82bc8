"""Names on disk that no terminal should see, through every verb that prints them."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

STRANGE = (b"cnn-\x1b[2J", "cnn-\u202eb".encode(), b"cnn-\xff")


@pytest.mark.parametrize("verb", ["report", "compare", "sync", "evaluate"])
def test_a_folder_with_a_strange_name_is_named_in_characters_that_print(
    command: Callable[..., int],
    recorded: Callable[..., Path],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    verb: str,
) -> None:
    for seed in range(2):
        recorded("model=cnn", f"seed={seed}")
        source = recorded("model=cnn_small", f"seed={seed}", scores=(5_000.0, 6_000.0))
    for name in STRANGE:
        shutil.copytree(source, os.fsdecode(os.fsencode(source.parent) + b"/" + name))
    words = {"evaluate": ["run=nothing"], "sync": [], "compare": ["tracking=none"]}.get(verb, [])
    code = command(verb, *words, f"paths.outputs={tmp_path}")
    printed = capsys.readouterr()
    assert code == {"evaluate": 2}.get(verb, 0), printed.err
    assert not [each for each in printed.out + printed.err if each != "\n" and not each.isprintable()]
    assert "Traceback" not in printed.err


def test_a_working_folder_whose_name_is_not_utf_8_is_one_line(
    command: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = os.fsdecode(os.fsencode(tmp_path) + b"/\xff")
    os.mkdir(folder)
    monkeypatch.chdir(folder)
    assert command("paths.outputs=o", "--cfg", "job") == 2
    said = "atlantis_exp: paths.outputs=o: is in a folder whose name is not UTF-8; name another folder\n"
    assert capsys.readouterr().err == said
