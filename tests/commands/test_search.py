"""A search with real trainings: in one process, in several, and through every way to end one."""

import dataclasses
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.commands.app import check
from atlantis_exp.commands.runs import RunFolder
from atlantis_exp.commands.search import _CLOSED, _open, _Session, main, search
from atlantis_exp.commands.train import StopRequest, train
from atlantis_exp.config import Config, ConfigError, SearchConfig
from atlantis_exp.faults import Fault
from atlantis_exp.tracking.journal import Metrics, Tags, read, read_commit

optuna = pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")

from optuna.distributions import (  # noqa: E402
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from atlantis_exp.commands.space import check_space, read_space  # noqa: E402

REPOSITORY = Path(__file__).parents[2]
SHORT = ("phase.quick.steps=80", "env.max_steps=20", "evaluation.every_steps=null", "evaluation.episodes=1")
SPACE = ("optimizer=adam,rmsprop", "optimizer.lr=tag(log, interval(1e-5, 1e-3))")


@pytest.fixture
def searching(tmp_path: Path, tiny_overrides: tuple[str, ...]) -> Callable[..., tuple[SearchConfig, tuple[str, ...]]]:
    """A search's config and the overrides that make it: `searching("trials=3")`."""

    def composed(*overrides: str) -> tuple[SearchConfig, tuple[str, ...]]:
        fixed = (*tiny_overrides, *SHORT, f"paths.outputs={tmp_path}", *overrides)
        return check("search", SearchConfig, list(fixed))[0], fixed

    return composed


Searching = Callable[..., tuple[SearchConfig, tuple[str, ...]]]


def rows(outputs: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(outputs / "mlflow.db")) as database:
        return database.execute(query, values).fetchall()


def session_of(searching: Searching, *overrides: str, space: tuple[str, ...] = SPACE[1:]) -> _Session:
    config, fixed = searching(*overrides)
    return _open(config, space, fixed)


def config_of(session: _Session, number: int) -> Config:
    values = [f"{key}={value}" for key, value in session.trials[number].params.items()]
    return check("config", Config, [*session.overrides, *values])[0]


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("choice(adam, rmsprop)", CategoricalDistribution(["adam", "rmsprop"])),
        ("adam,rmsprop,adam", CategoricalDistribution(["adam", "rmsprop"])),
        ("choice([1,2],[3,4])", CategoricalDistribution(["[1,2]", "[3,4]"])),
        ("interval(1, 5)", FloatDistribution(1.0, 5.0)),
        ("tag(log, interval(1e-5, 1e-3))", FloatDistribution(1e-5, 1e-3, log=True)),
        ("int(interval(1, 5))", IntDistribution(1, 5)),
        ("tag(log, int(interval(1, 64)))", IntDistribution(1, 64, log=True)),
        ("range(1, 10, 3)", IntDistribution(1, 7, step=3)),
        ("range(10, 1, -3)", IntDistribution(4, 10, step=3)),
        ("range(0.25, 1.25, 0.25)", FloatDistribution(0.25, 1.0, step=0.25)),
    ],
)
def test_a_space_is_written_as_for_hydras_optuna_sweeper(text: str, drawn: BaseDistribution) -> None:
    assert read_space({"optimizer.lr": text}, set()) == {"optimizer.lr": drawn}


@pytest.mark.parametrize(
    ("overrides", "space", "hint"),
    [
        ("", "optimizer=adam,rmsprpo", "optimizer=rmsprpo: no such option in conf/optimizer; did you mean 'rmsprop'?"),
        ("", "optimizer.l=0.1,0.2", "did you mean 'optimizer.lr'?"),
        ("", "optimizer.lr=interval(-1,1)", "optimizer.lr=-1.0: should be greater than 0"),
        ("", "optimizer.lr=interval(2,1)", "`low <= high` must hold"),
        ("", "optimizer.lr=tag(log,interval(0,1))", "`low > 0` must hold"),
        ("", "optimizer.lr=range(1,1)", "there is no number in it"),
        ("", "optimizer.lr=0.1", "no set of values; write choice"),
        ("", "model=glob(*)", "no set of values; write choice"),
        ("", "seed=0,1", "not to be searched"),
        ("", "evaluation.epsilon=0.1,0.2", "not to be searched"),
        ("", "trials=5,10", "not to be searched"),
        ("optimizer=adam", "optimizer=adam,adamw", "optimizer: has one value and is to be searched"),
        ("", "env.num_envs=int(interval(1,40))", "training.learn_start=20: nothing would be learned"),
        (  # too many corners to try them all
            "",
            "env.sticky=0,2 optimizer.lr=0.1,0.2 env.stack=1,2,3,4 objective.n_step=1,2,3,4",
            "env.sticky=2: should be less than or equal to 1",
        ),
    ],
)
def test_an_impossible_space_is_refused_in_one_line_before_anything_starts(
    tiny_overrides: tuple[str, ...], overrides: str, space: str, hint: str
) -> None:
    fixed = [*tiny_overrides, *overrides.split()]
    with pytest.raises(ConfigError) as caught:
        check_space(read_space(dict(text.split("=", 1) for text in space.split(" ")), _CLOSED), fixed)
    assert hint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("trials=2", "nothing to search: give a key several values"),
        ("-m optimizer=adam,rmsprop", "-m: a search is no sweep"),
        ("modle=cnn optimizer=adam,rmsprop", "did you mean 'model'?"),
        ("optimizer=adam,rmsprop evaluation.at_end=false", "evaluation.at_end=false: a search compares"),
        ("space=optimzer", "did you mean 'optimizer'?"),
    ],
)
def test_a_mistake_ends_the_command_with_code_2(
    line: str, hint: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys, "argv", ["search", *line.split(), f"paths.outputs={tmp_path}"])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    assert hint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_without_optuna_the_extra_is_named(searching: Searching, monkeypatch: pytest.MonkeyPatch) -> None:
    config, fixed = searching()
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(Fault, match=r"pip install 'atlantis-exp\[search\]'") as caught:
        search(config, SPACE, fixed)
    assert caught.value.exit_code == 2


def test_a_search_trains_its_trials_under_a_run_of_its_own_and_goes_on_where_more_are_asked_for(
    searching: Searching, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    config, fixed = searching("trials=1")
    search(config, SPACE, fixed)
    (first,) = tmp_path.glob("runs/*/result.json")
    trained = first.stat().st_mtime_ns
    config, fixed = searching("trials=2")
    search(config, SPACE, fixed)
    printed = capsys.readouterr().out
    assert first.stat().st_mtime_ns == trained
    assert len(list(tmp_path.glob("runs/*/result.json"))) == 2
    assert "trial 1: optimizer=" in printed
    assert f"the best in full: python -m atlantis_exp {fixed[0]}" in printed

    session = _open(config, SPACE, fixed)
    best, other = session.ranking
    result = RunFolder(tmp_path / "runs" / best.user_attrs["run"]).result
    assert result is not None
    assert best.value == result.evaluation["evaluation/mean"] >= (other.value or 0.0)
    points = [record for _, record in read(session.folder.path) if isinstance(record, Metrics)]
    assert [point.step for point in points] == [0, 1]
    assert points[-1].values["search/best"] == best.value
    artifacts = session.folder.path / "artifacts"
    assert {path.name for path in artifacts.iterdir()} == {"history.png", "importance.png", "parallel_coordinates.png"}
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in artifacts.iterdir())

    runs = [RunFolder(tmp_path / "runs" / trial.user_attrs["run"]) for trial in (best, other)]
    assert {run.parent.resolve() for run in runs if run.parent} == {session.folder.path}
    tags = [record.values for _, record in read(runs[0].path) if isinstance(record, Tags)]
    (command,) = [values["command"] for values in tags if "command" in values]
    assert command.endswith(f"optimizer={best.params['optimizer']} optimizer.lr={best.params['optimizer.lr']}")
    page = read_commit(session.folder.path)
    assert page is not None
    assert page.status == "FINISHED"


def test_a_trial_that_nobody_holds_goes_on_before_a_new_one_is_drawn(searching: Searching) -> None:
    session = session_of(searching, "trials=3")
    with session.claimed() as left:
        pass
    with open(session.folder.path / "trials.jsonl", "ab") as file:
        file.write(b'{"op_code":4,"work')  # a line that the process was killed in
    other = session_of(searching, "trials=3")
    with other.claimed() as trial, session.claimed() as new:
        assert left is not None
        assert trial is not None
        assert new is not None
        assert (trial.number, trial.params) == (left.number, left.params)
        assert new.number == 1
        assert new.params != trial.params


def test_what_is_drawn_depends_on_the_number_of_the_trial_and_those_before_alone(searching: Searching) -> None:
    drawn = []
    for name in ("a", "b"):
        session = session_of(searching, f"name={name}")
        with session.claimed() as first, session.claimed() as second:
            assert first is not None
            assert second is not None
            drawn.append((first.params, second.params))
    assert drawn[0] == drawn[1]
    assert drawn[0][0] != drawn[0][1]


def test_values_that_are_under_way_are_not_trained_twice(searching: Searching) -> None:
    session = session_of(searching, "trials=2", space=("optimizer=choice(adam)",))
    with session.claimed(), session.claimed() as again:
        assert again is not None
        session.train(again, StopRequest())
    assert session.trials[1].state.name == "FAIL"
    assert "trial 0, which is under way, has the same values" in session.trials[1].user_attrs["error"]


@pytest.mark.slow
def test_a_trial_below_the_median_is_committed_and_can_be_trained_to_its_end(searching: Searching) -> None:
    session = session_of(
        searching, "trials=2", "evaluation.every_steps=40", "pruning.trials=1", "pruning.evaluations=0"
    )
    with session.claimed() as good:
        assert good is not None
        good.report(1e6, 1)
        session.study.tell(good.number, 1e6)
    with session.claimed() as trial:
        assert trial is not None
        session.train(trial, StopRequest())
    pruned = session.trials[1]
    assert pruned.state.name == "PRUNED"
    assert list(pruned.intermediate_values) == [1]
    config = config_of(session, 1)
    folder = RunFolder.of(config)
    assert folder.state == "interrupted"
    tags = {
        key: value
        for _, record in read(folder.path)
        if isinstance(record, Tags)
        for key, value in record.values.items()
    }
    assert tags["pruned"] == f"trial 1 of {session.folder.name}, at step 40"
    train(config)
    assert folder.result is not None
    assert [number for number, value in enumerate(session.trials) if value.state.name == "COMPLETE"] == [0]


@pytest.mark.slow
def test_a_trial_that_fails_is_recorded_and_the_search_goes_on(
    searching: Searching, capsys: pytest.CaptureFixture[str]
) -> None:
    config, fixed = searching("trials=3")
    search(config, ("optimizer.lr=1e-4,1e30",), fixed)  # the larger one diverges
    session = _open(config, ("optimizer.lr=1e-4,1e30",), fixed)
    states = {(trial.params["optimizer.lr"], trial.state.name) for trial in session.trials}
    assert states == {("0.0001", "COMPLETE"), ("1e+30", "FAIL")}
    assert "no finite number" in capsys.readouterr().out


def test_a_search_without_a_trial_that_was_trained_to_its_end_says_so(searching: Searching) -> None:
    with pytest.raises(Fault, match="no trial was trained to its end; 0 of 20 trials"):
        session_of(searching).print_results()


def test_a_run_that_went_on_beyond_the_budget_is_no_result_of_a_search_within_it(searching: Searching) -> None:
    session = session_of(searching, "budget.steps=40", space=("optimizer=choice(adam)",))
    with session.claimed() as trial:
        assert trial is not None
        train(dataclasses.replace(config_of(session, 0), budget=dataclasses.replace(session.config.budget, steps=None)))
        session.train(trial, StopRequest())
    assert "was trained for 80 steps already" in session.trials[0].user_attrs["error"]
    with session.claimed() as trial:
        assert trial is not None
        session.study.tell(trial.number, 1.0)
    assert "budget.steps" not in session.best_command()
    assert session.best_command().endswith("optimizer=adam")


def test_a_name_is_one_searchs(searching: Searching) -> None:
    session_of(searching, "name=mine", space=("optimizer=choice(adam)",))
    with pytest.raises(ConfigError, match="name=mine: was begun for another space or another training"):
        session_of(searching, "name=mine", "env.size=48", space=("optimizer=choice(adam)",))


@pytest.mark.slow
def test_at_the_end_of_its_time_a_search_leaves_its_trial_to_be_continued(searching: Searching) -> None:
    for seconds in (2, 8, 32):  # which can be over before a first trial, where other programs want the machine
        config, fixed = searching(f"budget.wall_clock={seconds}s", "phase.quick.steps=100_000")
        with pytest.raises(
            Fault, match="the search goes on with: python -m atlantis_exp search experiment=quick"
        ) as caught:
            search(config, SPACE, fixed)
        assert caught.value.exit_code == 124
        session = _open(config, SPACE, fixed)
        if session.trials:
            break
    assert [trial.state.name for trial in session.trials] == ["RUNNING"]
    assert RunFolder(Path(config.paths.outputs) / "runs" / session.trials[0].user_attrs["run"]).state == "interrupted"
    commit = read_commit(session.folder.path)
    assert commit is not None
    assert commit.status == "KILLED"


def started(fixed: tuple[str, ...], space: tuple[str, ...] = SPACE) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        (sys.executable, "-m", "atlantis_exp", "search", *fixed, *space),
        cwd=REPOSITORY,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.02)


LONG = ("phase.quick.steps=1_500", "tracking.commit_seconds=0.2", "trials=2")


@pytest.mark.slow
def test_a_search_that_is_interrupted_and_killed_is_the_unbroken_one(searching: Searching, tmp_path: Path) -> None:
    def results(session: _Session) -> list[Any]:
        return [(trial.number, trial.state, trial.params, trial.value) for trial in session.trials]

    config, fixed = searching(*LONG, f"paths.outputs={tmp_path}/unbroken")
    search(config, SPACE, fixed)
    unbroken = _open(config, SPACE, fixed)

    config, fixed = searching(*LONG, f"paths.outputs={tmp_path}/broken")
    for number in (signal.SIGINT, signal.SIGKILL):
        before = len(list(tmp_path.glob("broken/runs/*/checkpoints/*/manifest.json")))
        process = started(fixed)
        wait_for(
            lambda before=before: len(list(tmp_path.glob("broken/runs/*/checkpoints/*/manifest.json"))) > before  # type: ignore[misc]
        )
        process.send_signal(number)
        _, errors = process.communicate()
        assert process.returncode == (130 if number == signal.SIGINT else -9)
        if number == signal.SIGINT:
            assert "the search goes on with: python -m atlantis_exp search" in errors
    process = started(fixed)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "continuing run" in out
    assert results(_open(config, SPACE, fixed)) == results(unbroken)
    assert len(list(tmp_path.glob("broken/runs/*"))) == 2


@pytest.mark.slow
def test_several_processes_share_a_search_and_end_together(searching: Searching, tmp_path: Path) -> None:
    config, fixed = searching("trials=4", "tracking=mlflow", "tracking.every_steps=20", "phase.quick.steps=600")
    processes = [started(fixed), started(fixed)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert all("the best in full" in out for out, _ in outputs)
    session = _open(config, SPACE, fixed)
    assert [trial.state.name for trial in session.trials] == ["COMPLETE"] * 4
    assert len({trial.user_attrs["run"] for trial in session.trials}) == len(list(tmp_path.glob("runs/*"))) == 4
    trained = ["starting run" in out for out, _ in outputs]
    assert trained == [True, True]
    stored = dict(rows(tmp_path, "SELECT name, run_uuid FROM runs"))
    assert len(stored) == 5
    parent = stored.pop("search optimizer optimizer.lr")
    assert rows(tmp_path, "SELECT status FROM runs WHERE run_uuid = ?", parent) == [("FINISHED",)]
    assert rows(tmp_path, "SELECT COUNT(*) FROM metrics WHERE key = 'search/mean' AND run_uuid = ?", parent) == [(4,)]
    children = rows(tmp_path, "SELECT run_uuid FROM tags WHERE key = 'mlflow.parentRunId' AND value = ?", parent)
    assert {child for (child,) in children} == set(stored.values())
