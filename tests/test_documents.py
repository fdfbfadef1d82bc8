"""The JSON documents that verbs print, and their schema in the documentation."""

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import pytest
from pydantic import Field, TypeAdapter

from atlantis_exp import terminal
from atlantis_exp.documents import Check, Compared, Query, Report
from atlantis_exp.faults import Fault
from atlantis_exp.sessions.contracts import check

AnyDocument: TypeAdapter[Compared | Report | Query | Check] = TypeAdapter(
    Annotated[Compared | Report | Query | Check, Field(discriminator="verb")]
)
Command = Callable[..., int]
SCHEMA = Path(__file__).resolve().parents[1] / "docs" / "json.schema.json"


@pytest.fixture
def answer(command: Command, capfd: pytest.CaptureFixture[str]) -> Callable[..., Any]:
    """Runs a verb with format=json; returns its only line on stdout, read by the schema."""

    def run(*words: str, code: int = 0) -> Any:
        capfd.readouterr()
        assert command(*words, "format=json") == code
        (line,) = capfd.readouterr().out.splitlines()
        assert json.loads(line)["version"] == 1
        return AnyDocument.validate_json(line)

    return run


def test_the_schema_in_the_docs_is_that_of_the_documents() -> None:
    assert json.loads(SCHEMA.read_text()) == AnyDocument.json_schema(mode="serialization")


def test_a_report_has_the_last_evaluation_of_each_run(
    answer: Callable[..., Any], recorded: Callable[..., Path], tmp_path: Path
) -> None:
    assert answer("report", f"paths.outputs={tmp_path}").runs == []
    names = sorted(recorded(f"seed={seed}", scores=(100.0, 300.0 + seed)).name for seed in (0, 1))
    found = answer("report", f"paths.outputs={tmp_path}")
    assert isinstance(found, Report)
    assert [run.run for run in found.runs] == names
    assert [run.evaluation["evaluation/mean"] for run in found.runs] == [200.0, 200.5]
    assert {(run.state, run.steps, run.evaluated_at) for run in found.runs} == {("done", 160, 160)}
    assert [run.run for run in answer("report", "where=seed=1", f"paths.outputs={tmp_path}").runs] == names[1:]


def test_a_query_has_what_gymnasium_says_and_the_config(answer: Callable[..., Any]) -> None:
    found = answer("query", "env.sticky=0.5")
    assert isinstance(found, Query)
    assert found.environment["possible_actions"] == ["NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE"]
    assert found.config["sticky"] == 0.5


def test_a_comparison_has_numbers_only_where_there_are_some(
    answer: Callable[..., Any], recorded: Callable[..., Path], tmp_path: Path
) -> None:
    for model in ("cnn", "resnet"):
        recorded(f"model={model}")
    found = answer("compare", "tracking=none", f"paths.outputs={tmp_path}")
    assert isinstance(found, Compared)
    assert not found.decided
    (verdict,) = found.verdicts
    assert (verdict.said, verdict.difference, verdict.low, verdict.seeds) == ("not decided", None, None, 0)
    assert [(each.group, each.score, each.low, each.seeds) for each in found.scores] == [
        (model, 2_500.0, None, {0: 2_500.0}) for model in ("cnn", "resnet")
    ]
    assert [(each.planned, each.taken, each.next, each.spent) for each in found.looks] == [([5, 10], [], 5, 0)]


def test_a_mistake_leaves_stdout_empty(command: Command, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert command("compare", f"paths.outputs={tmp_path}", "format=json") == 2
    shown = capfd.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("atlantis_exp: no finished training")


def test_only_documents_reach_stdout_also_from_other_processes_and_where_the_work_fails(
    capfd: pytest.CaptureFixture[str],
) -> None:
    def work() -> None:
        with terminal.only_documents():
            print("a line")
            os.system("echo from another process")
            terminal.console().print("a table")
            terminal.document("{}")
            raise Fault("worse")

    with pytest.raises(Fault):
        work()
    terminal.document("nobody asked")
    print("after")
    shown = capfd.readouterr()
    assert shown.out.splitlines() == ["{}", "after"]
    assert {"a line", "from another process", "a table"} == {*shown.err.splitlines()}


def test_a_check_names_what_is_broken_in_its_document_before_it_fails(capfd: pytest.CaptureFixture[str]) -> None:
    def broken() -> None:
        raise ValueError("loses a batch\nsomewhere")

    def work() -> None:
        with terminal.only_documents():
            check(iter([("model=mine", "learns", lambda: None), ("model=mine", "splits", broken)]), {})

    with pytest.raises(Fault, match=r"^broken: model=mine: splits$"):
        work()
    found = Check.model_validate_json(capfd.readouterr().out)
    assert [(each.contract, each.kept, each.because) for each in found.trials] == [
        ("learns", True, ""),
        ("splits", False, "ValueError: loses a batch"),
    ]
    assert found.costs == []
