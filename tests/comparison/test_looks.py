"""The record of looks: kept whole, and refused where the comparison cannot have written it."""

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.comparison.looks import read_looks, write_looks
from atlantis_exp.comparison.verdict import Answer, Family, Group, Question, answer, families
from atlantis_exp.faults import Fault

AROUND = (0.0, 30.0, -20.0, 10.0, -30.0, 20.0, 5.0, -15.0, 25.0, -5.0)  # points around a group's score, one a seed


def asked(there: int = 5, **question: Any) -> list[Family]:
    """Three groups: two that cannot be told apart at five seeds, and a better one."""
    scores = {"cnn": 3_000.0, "resnet": 3_015.0, "tiny": 9_000.0}
    groups = [Group((name,), {seed: score + AROUND[seed] for seed in range(there)}) for name, score in scores.items()]
    return families(groups, Question(["model"], **question))


def written(folder: Path, **question: Any) -> list[Answer]:
    """Look at five seeds, then at ten, and keep both."""
    first = answer(asked(**question), {})
    answers = answer(asked(10, **question), {"model": first[0].decision.looks})
    write_looks(folder, answers)
    return answers


def rewritten(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Keep two looks, and change their record."""
    written(folder)
    path = folder / "looks.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


def test_looks_are_read_as_they_were_written(tmp_path: Path) -> None:
    assert read_looks(tmp_path, asked()) == {}
    (each,) = written(tmp_path, delta=0.001, relative=True)
    assert [look.size for look in each.decision.looks] == [5, 10]
    assert [len(look.verdicts) for look in each.decision.looks] == [3, 1]
    assert read_looks(tmp_path, asked(delta=0.001, relative=True)) == {"model": each.decision.looks}
    assert answer(asked(10), read_looks(tmp_path, asked()))[0].taken is None


def test_a_record_that_is_gone_from_a_comparison_that_was_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(Fault, match=r"looks.json is gone: restore it, since without it the error"):
        read_looks(tmp_path, asked())


def change(look: int = 0, verdict: int = 0, **to: Any) -> Callable[[dict[str, Any]], None]:
    """Change a verdict of a look."""
    return lambda record: record["model"][look]["verdicts"][verdict].update(to)


def spend(share: float) -> Callable[[dict[str, Any]], None]:
    return lambda record: record["model"][0].update(error=record["model"][0]["error"] * share)


def seeds(name: str, chosen: list[int]) -> Callable[[dict[str, Any]], None]:
    return lambda record: record["model"][0]["seeds"].update({name: chosen})


PAIRS, NUMBERS = "are about other pairs", "have impossible numbers"
ERROR, SAID = "spent another error than the plan allows", "contradict their intervals"


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda record: record.update(sampler=record.pop("model")), "it has looks at 'sampler'"),
        (lambda record: record["model"][0].pop("error"), "its form is wrong"),
        (change(seeds="5"), "its form is wrong"),
        (change(group="other"), PAIRS),
        (lambda record: record["model"][0]["verdicts"].pop(), PAIRS),
        (lambda record: record["model"][0]["verdicts"].append(record["model"][0]["verdicts"][0]), PAIRS),
        (lambda record: record["model"][0]["seeds"].pop("tiny"), PAIRS),
        (lambda record: record["model"][0]["seeds"].update(other=[0, 1, 2, 3, 4]), PAIRS),
        (lambda record: record["model"][1]["verdicts"][0].update(other="tiny"), PAIRS),
        (change(seeds=6), NUMBERS),
        (seeds("tiny", [0, 1, 2, 3, 3]), NUMBERS),
        (seeds("tiny", [0, 1, 2, 3, 4, 5]), NUMBERS),
        (lambda record: record.update(model=[record["model"][0], record["model"][0]]), PAIRS),
        (change(low=float("-inf")), "its form is wrong|" + NUMBERS),
        (spend(1.01), ERROR),
        (spend(0.99), ERROR),
        (lambda record: record["model"].pop(0), PAIRS),
        (change(said="better"), SAID),
        (change(said="worse"), SAID),
        (change(said="equivalent"), SAID),
        (change(verdict=1, said="not decided"), SAID),
        (change(verdict=1, said="better"), SAID),
        (change(low=0.5), SAID),
        (change(high=-20.0), SAID),
        (change(difference=1e6), SAID),
        (change(difference=-1e6), SAID),
        (change(verdict=1, high=0.0), SAID),
        (change(verdict=1, said="better", low=0.0, difference=1.0, high=2.0), SAID),
    ],
)
def test_a_record_that_the_comparison_cannot_have_written_is_refused_with_the_reason(
    tmp_path: Path, damage: Callable[[dict[str, Any]], object], reason: str
) -> None:
    rewritten(tmp_path, damage)
    with pytest.raises(Fault) as refused:
        read_looks(tmp_path, asked())
    assert re.search(
        rf"is not a record of this comparison's looks \((its looks by model )?({reason})\): restore it",
        str(refused.value),
    )


@pytest.mark.parametrize(
    "edge",
    [
        change(low=0.0, difference=0.0),
        change(high=0.0),
        change(verdict=1, high=-0.5),
        change(verdict=1, said="better", low=0.5, difference=0.5, high=0.5),
    ],
)
def test_a_record_may_have_any_interval_that_its_verdict_allows(
    tmp_path: Path, edge: Callable[[dict[str, Any]], None]
) -> None:
    rewritten(tmp_path, edge)
    assert len(read_looks(tmp_path, asked())["model"]) == 2


@pytest.mark.parametrize("strike", [lambda text: text[:-20], lambda _: "[" * 100_000, lambda _: ""])
def test_a_torn_record_is_one_line(tmp_path: Path, strike: Callable[[str], str]) -> None:
    written(tmp_path)
    path = tmp_path / "looks.json"
    path.write_text(strike(path.read_text()))
    with pytest.raises(
        Fault, match=r"^.*looks.json is not a record of this comparison's looks \(its form is wrong\).*$"
    ):
        read_looks(tmp_path, asked())


def test_a_look_beyond_the_plan_or_before_five_seeds_is_refused(tmp_path: Path) -> None:
    written(tmp_path)
    with pytest.raises(Fault, match=ERROR):
        read_looks(tmp_path, asked(error=0.1))
    first = answer(asked(), {})
    write_looks(tmp_path, first)
    record = json.loads((tmp_path / "looks.json").read_text())
    (look,) = record["model"]
    for verdict in look["verdicts"]:
        verdict["seeds"] = 4
    look["seeds"] = {name: [0, 1, 2, 3] for name in look["seeds"]}
    look["error"] = 0.05 * 0.4**2
    (tmp_path / "looks.json").write_text(json.dumps(record))
    with pytest.raises(Fault, match=NUMBERS):
        read_looks(tmp_path, asked())
    written(tmp_path)
    with pytest.raises(Fault, match=NUMBERS):
        read_looks(tmp_path, asked(seeds=5, error=0.0125))
