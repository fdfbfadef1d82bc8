"""The table of results, where there is none yet."""

from pathlib import Path

import pytest

from atlantis_exp.config import PathsConfig
from atlantis_exp.sessions.reporting import report


def test_a_report_on_an_empty_folder_says_so_and_creates_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report(paths=PathsConfig(outputs=str(tmp_path / "nothing")))
    assert capsys.readouterr().out == f"there is no run under {tmp_path}/nothing/runs yet\n"
    assert not (tmp_path / "nothing").exists()
