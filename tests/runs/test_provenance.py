"""What is said of the code that made a run."""

import subprocess
from pathlib import Path

import pytest

from atlantis_exp.runs.provenance import provenance

REPOSITORY = Path(__file__).resolve().parents[2]


@pytest.mark.skipif(not (REPOSITORY / ".git").exists(), reason="not a checkout")
def test_the_commit_of_a_checkout_is_told() -> None:
    command = ("git", "-C", str(REPOSITORY), "rev-parse", "HEAD")
    head = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    tags = provenance("python -m atlantis_exp")
    assert tags["git.commit"] == head
    assert tags["git.dirty"] in ("true", "false")


@pytest.mark.parametrize(("name", "value"), [("PATH", ""), ("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")])
def test_where_git_is_missing_or_refuses_nothing_is_said_of_the_checkout(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    monkeypatch.setenv("HOME", str(tmp_path))  # where a person may have called the folder safe
    tags = provenance("python -m atlantis_exp")
    assert not [key for key in tags if key.startswith("git.")]
    assert tags["command"] == "python -m atlantis_exp"
