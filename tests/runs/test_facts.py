"""What a journal says apart from its points."""

from pathlib import Path

import pytest

from atlantis_exp.runs.facts import JournalFacts, read_facts
from atlantis_exp.runs.journal import Artifact, Journal, Tags, read


def test_each_tags_last_value_and_each_files_name_once_as_reading_every_line_finds_them(tmp_path: Path) -> None:
    journal = Journal(tmp_path, {"mlflow.runName": "a name", "policy": "none yet"})
    for step in range(50):
        journal.metrics({"score/episode": step}, step)
        journal.tags({"policy": f"at {step}", "text": 'a\n{"kind":"tags","values":{"no":"tag"}}\n'})
        journal.artifact(f"evaluation/{step // 2}.csv", b"")
    journal.flush()
    facts = read_facts(tmp_path)
    records = [record for _, record in read(tmp_path)]
    tags = {"mlflow.runName": "a name", "policy": "none yet"}
    for record in records:
        tags |= record.values if isinstance(record, Tags) else {}
    paths = dict.fromkeys(record.path for record in records if isinstance(record, Artifact))
    assert facts == JournalFacts(tags, tuple(paths))
    assert facts.tags["policy"] == "at 49"
    assert "no" not in facts.tags


def test_what_is_not_committed_does_not_count(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.tags({"a": "1"})
    assert read_facts(tmp_path) == JournalFacts({}, ())
    journal.flush()
    journal.tags({"a": "2"})
    journal.artifact("file", b"")
    journal.state_dict()
    assert read_facts(tmp_path) == JournalFacts({"a": "1"}, ())


def test_a_journal_that_was_cut_is_an_error(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.tags({"a": "1"})
    journal.flush()
    path = tmp_path / "journal.jsonl"
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError, match="before its commit"):
        read_facts(tmp_path)
