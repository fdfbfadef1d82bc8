"""What a command does first with what earlier ones left."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.publishing import catch_up


def test_a_run_that_ends_while_it_is_looked_at_is_not_called_killed(
    tmp_path: Path, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, states = RunFolder(recorded()), []
    journal = Journal(folder.path)
    journal.status("RUNNING")
    with monkeypatch.context() as asked:
        asked.setattr(RunFolder, "is_held", property(lambda _: journal.status("FINISHED")))
        catch_up(tmp_path)
    states.append(folder.state)
    journal.status("RUNNING")
    catch_up(tmp_path)
    assert [*states, folder.state] == ["done", "interrupted"]


def test_a_folder_of_which_a_small_file_is_none_is_one_line(
    tmp_path: Path, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = recorded()
    (folder / "published.json").write_text(json.dumps({"store": "http://127.0.0.1:9#atlantis", "identity": "x"}))
    (folder / "result.json").unlink()
    os.mkfifo(folder / "result.json")
    catch_up(tmp_path)
    assert capsys.readouterr().err == f"atlantis_exp: {folder / 'result.json'} is no regular file\n"
