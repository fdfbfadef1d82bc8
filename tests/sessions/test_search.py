"""A search with real trainings: in one process, in several, and through every way to end one."""

import dataclasses
import json
import math
import os
import re
import shlex
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

from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.decide import VERB as DECIDE
from atlantis_exp.commands.decide import DecideConfig, contest_of
from atlantis_exp.commands.overrides import check
from atlantis_exp.commands.search import SearchConfig, search_of
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, Metrics, Tags, read, read_commit
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.stopping import StopRequest
from atlantis_exp.sessions.training import train
from atlantis_exp.training.trainer import Trainer

pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")

from atlantis_exp.sessions.search import Search, Trials, search

REPOSITORY = Path(__file__).parents[2]
SHORT = ("phase.quick.steps=80", "env.max_steps=20", "evaluation.every_steps=null", "evaluation.episodes=1")
SPACE = ("optimizer=adam,rmsprop", "optimizer.lr=tag(log, interval(1e-5, 1e-3))")


@pytest.fixture
def searching(tmp_path: Path, tiny_overrides: tuple[str, ...]) -> "Callable[..., Search]":
    """A search as a command line asks for it: `searching("trials=3", space=SPACE)`."""

    def asked(*overrides: str, space: tuple[str, ...] = SPACE) -> Search:
        short = replaced(tiny_overrides, *SHORT, f"paths.outputs={tmp_path}")
        fixed = tuple(replaced(short, *overrides))
        ((texts, config),) = check("search", SearchConfig, fixed).items()
        return search_of(Asked(config, "search", texts, typed=(*fixed, *space)))

    return asked


Searching = Callable[..., Search]


def rows(outputs: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(outputs / "mlflow.db")) as database:
        return database.execute(query, values).fetchall()


def trials_of(searching: Searching, *overrides: str, space: tuple[str, ...] = SPACE[1:]) -> Trials:
    return Trials(searching(*overrides, space=space))


def job_of(trials: Trials, number: int) -> Job:
    return trials.job(trials.all[number], 0)


def test_a_search_trains_its_trials_under_a_run_of_its_own_and_goes_on_where_more_are_asked_for(
    searching: Searching, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    request = searching("trials=1", "resume=auto")
    search(request)
    (first,) = tmp_path.glob("runs/*/result.json")
    trained = first.stat().st_mtime_ns
    request = dataclasses.replace(request, trials=2)
    search(request)
    printed = capsys.readouterr().out
    assert first.stat().st_mtime_ns == trained
    assert len(list(tmp_path.glob("runs/*/result.json"))) == 2
    assert "trial 1: optimizer=" in printed
    assert f"The best in full: python -m atlantis_exp {request.overrides[0]}" in printed
    assert "resume" not in printed.partition("The best in full")[2]

    trials = Trials(request)
    (best, scores), (other, _) = trials.ranking
    result = RunFolder(tmp_path / "runs" / best.user_attrs["runs"][0]).result
    assert result is not None
    assert scores == [best.value] == [result.evaluation["evaluation/mean"]]
    assert scores[0] >= (other.value or 0.0)
    points = [record for _, record in read(trials.folder.path) if isinstance(record, Metrics)]
    assert [point.step for point in points] == [0, 1]
    assert points[-1].values["search/best"] == best.value

    runs = [RunFolder(tmp_path / "runs" / trial.user_attrs["runs"][0]) for trial in (best, other)]
    assert {run.parent.resolve() for run in runs if run.parent} == {trials.folder.path}
    tags = [record.values for _, record in read(runs[0].path) if isinstance(record, Tags)]
    (command,) = [values["command"] for values in tags if "command" in values]
    assert command.endswith(f"optimizer={best.params['optimizer']} optimizer.lr={best.params['optimizer.lr']}")
    page = read_commit(trials.folder.path)
    assert page is not None
    assert page.status == "FINISHED"


def test_a_search_that_only_waits_writes_nothing(searching: Searching) -> None:
    trials = trials_of(searching)
    journal = Journal(trials.folder.path)
    trials.describe(journal)
    written = (trials.folder.path / "journal.jsonl").stat().st_size
    assert written
    trials.describe(journal)
    assert (trials.folder.path / "journal.jsonl").stat().st_size == written


@pytest.mark.slow
def test_a_signal_that_comes_when_a_trial_has_nothing_left_to_stop_ends_the_search_after_it(
    searching: Searching, capsys: pytest.CaptureFixture[str]
) -> None:
    def trained(job: Job, watch: Callable[[Trainer], bool]) -> int:
        assert train(job, watch) is None
        return signal.SIGTERM

    request = searching("trials=2", space=SPACE[1:])
    with pytest.raises(SystemExit, match="143"):
        search(request, trained)
    assert capsys.readouterr().err.endswith(f"SIGTERM: continue the search with: {request.command}\n")
    assert [trial.state.name for trial in Trials(request).all] == ["COMPLETE"]


def test_a_trial_that_nobody_holds_goes_on_before_a_new_one_is_drawn(searching: Searching) -> None:
    trials = trials_of(searching, "trials=3")
    with trials.claimed() as left:
        pass
    with open(trials.folder.path / "trials.jsonl", "ab") as file:
        file.write(b'{"op_code":4,"work')  # a line that the process was killed in
    other = Trials(trials.asked)
    with other.claimed() as trial, trials.claimed() as new:
        assert left is not None
        assert trial is not None
        assert new is not None
        assert (trial.number, trial.params) == (left.number, left.params)
        assert new.number == 1
        assert new.params != trial.params


@pytest.mark.parametrize(
    "line",
    [
        *(b"garbage", b"5", b"{}", b"null", b"\xff\xfe", b'{"op_code":99,"worker_id":"x"}'),
        b'{"a":' * 20_000 + b"1" + b"}" * 20_000,
        b'{"op_code":6,"worker_id":"x","trial_id":0,"state":1,"values":"a"}',
    ],
    ids=lambda line: line[:20].decode(errors="replace"),
)
def test_a_damaged_record_of_the_trials_is_one_line_and_loses_no_other_line(searching: Searching, line: bytes) -> None:
    trials = trials_of(searching, "trials=3")
    with trials.claimed():
        pass
    file = trials.folder.path / "trials.jsonl"
    content = file.read_bytes()
    file.write_bytes(content + line + b"\n")
    with pytest.raises(Fault, match=f"{file} is damaged") as fault:
        Trials(trials.asked)
    assert "\n" not in str(fault.value)
    assert file.read_bytes().startswith(content)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"scores": [', '"scored": ['),
        ('"runs": ["', '"runs": [1, "'),
        ('"values": [', '"values": [1.0, '),
        ('"state": 1, "values": [', '"state": 3, "values": ['),
        ("optimizer.lr", "optimizer.eps"),
    ],
)
def test_a_forged_trial_is_one_line(searching: Searching, old: str, new: str) -> None:
    trials = trials_of(searching, "trials=1")
    with trials.claimed() as trial:
        assert trial is not None
        trial.set_user_attr("runs", ["cnn"])
        trial.set_user_attr("scores", [1.0])
        trials.study.tell(trial, 1.0)
    assert Trials(trials.asked).ranking
    file = trials.folder.path / "trials.jsonl"
    content = json.dumps([json.loads(line) for line in file.read_text().splitlines()])
    assert old in content
    lines = json.loads(content.replace(old, new))
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    with pytest.raises(Fault, match=f"{file} is damaged"):
        Trials(trials.asked)


def test_a_record_of_the_trials_that_is_a_link_or_a_pipe_is_one_line(searching: Searching, tmp_path: Path) -> None:
    trials = trials_of(searching, "trials=3")
    file = trials.folder.path / "trials.jsonl"
    (tmp_path / "mine").write_text("mine")
    for is_link in (True, False):
        file.unlink()
        if is_link:
            file.symlink_to(tmp_path / "mine")
        else:
            os.mkfifo(file)
        with pytest.raises(Fault, match="not a regular file"):
            Trials(trials.asked)
    assert (tmp_path / "mine").read_text() == "mine"


def test_what_is_drawn_depends_on_the_number_of_the_trial_and_those_before_alone(searching: Searching) -> None:
    request, drawn = searching(space=SPACE[1:]), []
    for name in ("a", "b"):
        trials = Trials(dataclasses.replace(request, name=name))
        with trials.claimed() as first, trials.claimed() as second:
            assert first is not None
            assert second is not None
            drawn.append((first.params, second.params))
    assert drawn[0] == drawn[1]
    assert drawn[0][0] != drawn[0][1]


Played = Callable[[Job, Callable[[Trainer], bool]], None]


@pytest.fixture
def played(recorded: Callable[..., Path]) -> Played:
    """Writes the result of a training in the place of training it: its mean is the seed's last digit."""

    def play(job: Job, _: Callable[[Trainer], bool]) -> None:
        score = float(job.config.seed % 10)
        recorded(*job.overrides, scores=(score,))

    return play


def test_a_trial_is_as_good_as_the_mean_of_its_seeds(
    searching: Searching, played: Played, capsys: pytest.CaptureFixture[str]
) -> None:
    search(searching("trials=1", "seeds=3", space=("optimizer=choice(rmsprop)",)), played)
    shown = capsys.readouterr().out
    assert re.search(r"│ +0 │ +1 │ -1 to 3 │ rmsprop +│ cnn-uniform-s1000-", shown)  # of 0, 1 and 2; t of 2 is 4.30
    assert "One training each" not in shown


@pytest.mark.slow
def test_values_that_are_drawn_again_are_trained_with_other_seeds(
    searching: Searching, played: Played, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    search(searching("trials=3", space=("optimizer=choice(rmsprop)",)), played)
    assert sorted(path.name.split("-")[2] for path in tmp_path.glob("runs/*")) == ["s1000", "s1001", "s1002"]
    shown = capsys.readouterr().out
    assert re.search(r"│ +0 │ +1 │ -1 to 3 │ rmsprop", shown)
    assert "partly luck" not in shown  # there is nothing it was chosen from


@pytest.mark.slow
def test_the_best_is_called_lucky_and_tested_against_the_default_with_other_seeds(
    searching: Searching, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    def better_than_the_default(job: Job, _: Callable[[Trainer], bool]) -> None:
        recorded(*job.overrides, scores=(1 / job.config.optimizer.lr,), steps=100, outcome="budget")

    request = searching("trials=2", "seed=1_007", "budget.wall_clock=1h", "budget.steps=100")
    search(request, better_than_the_default)
    shown = capsys.readouterr().out
    assert "The best of 2 is partly luck: its own mean is optimistic.\n" in shown
    assert "One training each: other seeds may rank them differently" in shown
    values = [f"{key}={value}" for key, value in Trials(request).ranking[0][0].params.items()]
    (line,) = (line for line in shown.splitlines() if line.startswith("Better than the default? "))
    typed = shlex.split(line)[7:]
    assert shlex.split(line)[4:7] == ["python", "-m", "atlantis_exp"]
    assert typed[0] == "decide"
    assert typed[-1] == f"against={','.join(values)}"
    assert "budget.steps=100" in typed
    assert not any(text.startswith(("seed=", "budget.wall_clock=")) for text in typed)
    ((texts, config),) = check("decide", DecideConfig, DECIDE.rewrite(typed[1:])).items()
    contest = contest_of(Asked(config, "decide", texts, typed=tuple(typed[1:])))
    default, best = contest.contenders.values()
    assert default.config.optimizer.name == "adamw"
    assert best.config.science() == {
        **Trials(request).job(Trials(request).ranking[0][0], 0).config.science(),
        "seed": 0,
    }


@pytest.mark.slow
def test_the_default_is_not_tested_against_itself(
    searching: Searching, played: Played, capsys: pytest.CaptureFixture[str]
) -> None:
    search(searching("trials=1", space=("optimizer=choice(adamw)",)), played)
    assert "Better than the default?" not in capsys.readouterr().out


@pytest.mark.slow
def test_a_trial_below_the_median_is_committed_and_can_be_trained_to_its_end(searching: Searching) -> None:
    trials = trials_of(searching, "trials=2", "evaluation.every_steps=40", "pruning.trials=1", "pruning.evaluations=0")
    with trials.claimed() as good:
        assert good is not None
        good.report(1e6, 1)
        trials.study.tell(good.number, 1e6)
    with trials.claimed() as trial:
        assert trial is not None
        trials.train(trial, StopRequest())
    pruned = trials.all[1]
    assert pruned.state.name == "PRUNED"
    assert list(pruned.intermediate_values) == [1]
    job = job_of(trials, 1)
    folder = RunFolder.of(job.config)
    assert folder.state == "interrupted"
    tags = {
        key: value
        for _, record in read(folder.path)
        if isinstance(record, Tags)
        for key, value in record.values.items()
    }
    assert tags["pruned"] == f"trial 1 of {trials.folder.name}, at step 40"
    train(job)
    assert folder.result is not None
    assert [number for number, value in enumerate(trials.all) if value.state.name == "COMPLETE"] == [0]


@pytest.mark.slow
def test_a_trial_that_fails_is_recorded_and_the_search_goes_on(
    searching: Searching, capsys: pytest.CaptureFixture[str]
) -> None:
    def diverging(job: Job, watch: Callable[[Trainer], bool]) -> int | None:
        def poison(trainer: Trainer) -> bool:
            if job.config.optimizer.lr == 1.0:
                next(trainer.learner.network.parameters()).data.fill_(math.inf)
            return watch(trainer)

        return train(job, poison)

    request = searching("trials=3", space=("optimizer.lr=1e-4,1.0",))
    search(request, diverging)
    trials = Trials(request)
    states = {(trial.params["optimizer.lr"], trial.state.name) for trial in trials.all}
    assert states == {("0.0001", "COMPLETE"), ("1.0", "FAIL")}
    assert re.search(r"trial \d: optimizer.lr=1.0, failed: .*is not finite", capsys.readouterr().out)


def test_a_search_without_a_trial_that_was_trained_to_its_end_says_so(searching: Searching) -> None:
    with pytest.raises(Fault, match="no trial finished; 0 of 20 trials"):
        trials_of(searching).print_results()


@pytest.mark.slow
def test_a_run_that_went_on_beyond_the_budget_is_no_result_of_a_search_within_it(searching: Searching) -> None:
    trials = trials_of(searching, "budget.steps=40", space=("optimizer=choice(adam)",))
    with trials.claimed() as trial:
        assert trial is not None
        config = job_of(trials, 0).config
        train(Job(dataclasses.replace(config, budget=dataclasses.replace(config.budget, steps=None))))
        trials.train(trial, StopRequest())
    assert "already trained for 80 steps" in trials.all[0].user_attrs["error"]


def test_a_name_is_one_searchs(searching: Searching) -> None:
    trials_of(searching, "name=mine", space=("optimizer=choice(adam)",))
    with pytest.raises(ConfigError, match="name=mine: is a search of another space or training"):
        trials_of(searching, "name=mine", "env.size=48", space=("optimizer=choice(adam)",))


@pytest.mark.slow
def test_at_the_end_of_its_time_a_search_leaves_its_trial_to_be_continued(searching: Searching, tmp_path: Path) -> None:
    for seconds in (2, 8, 32):  # which can be over before a first trial, where other programs want the machine
        request = searching(f"budget.wall_clock={seconds}s", "phase.quick.steps=100_000")
        with pytest.raises(
            Fault, match="continue the search with: python -m atlantis_exp search experiment=quick"
        ) as caught:
            search(request)
        assert caught.value.exit_code == 124
        trials = Trials(request)
        if trials.all:
            break
    assert [trial.state.name for trial in trials.all] == ["RUNNING"]
    assert RunFolder(tmp_path / "runs" / trials.all[0].user_attrs["runs"][0]).state == "interrupted"
    commit = read_commit(trials.folder.path)
    assert commit is not None
    assert commit.status == "KILLED"


def started(request: Search) -> "subprocess.Popen[str]":
    """A process of the command that a search says continues it."""
    return subprocess.Popen(
        (sys.executable, *shlex.split(request.command)[1:]),
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
    def results(trials: Trials) -> list[Any]:
        return [(trial.number, trial.state, trial.params, trial.value) for trial in trials.all]

    request = searching(*LONG, f"paths.outputs={tmp_path}/unbroken")
    search(request)
    unbroken = Trials(request)

    request = searching(*LONG, f"paths.outputs={tmp_path}/broken")
    for number in (signal.SIGINT, signal.SIGKILL):
        before = len(list(tmp_path.glob("broken/runs/*/checkpoints/*/manifest.json")))
        process = started(request)
        wait_for(
            lambda before=before: len(list(tmp_path.glob("broken/runs/*/checkpoints/*/manifest.json"))) > before  # type: ignore[misc]
        )
        process.send_signal(number)
        _, errors = process.communicate()
        assert process.returncode == (130 if number == signal.SIGINT else -9)
        if number == signal.SIGINT:
            assert "continue the search with: python -m atlantis_exp search" in errors
    process = started(request)
    out, errors = process.communicate()
    assert process.returncode == 0, errors
    assert "continuing run" in out
    assert results(Trials(request)) == results(unbroken)
    assert len(list(tmp_path.glob("broken/runs/*"))) == 2


@pytest.mark.slow
def test_several_processes_share_a_search_and_end_together(searching: Searching, tmp_path: Path) -> None:
    request = searching("trials=4", "tracking=mlflow", "tracking.every_steps=20", "phase.quick.steps=600")
    processes = [started(request), started(request)]
    outputs = [process.communicate() for process in processes]
    assert [process.returncode for process in processes] == [0, 0], outputs
    assert all("The best in full" in out for out, _ in outputs)
    trials = Trials(request)
    assert [trial.state.name for trial in trials.all] == ["COMPLETE"] * 4
    assert len({trial.user_attrs["runs"][0] for trial in trials.all}) == len(list(tmp_path.glob("runs/*"))) == 4
    trained = ["starting run" in out for out, _ in outputs]
    assert trained == [True, True]
    stored = dict(rows(tmp_path, "SELECT name, run_uuid FROM runs"))
    assert len(stored) == 5
    parent = stored.pop("search optimizer optimizer.lr")
    assert rows(tmp_path, "SELECT status FROM runs WHERE run_uuid = ?", parent) == [("FINISHED",)]
    assert rows(tmp_path, "SELECT COUNT(*) FROM metrics WHERE key = 'search/mean' AND run_uuid = ?", parent) == [(4,)]
    children = rows(tmp_path, "SELECT run_uuid FROM tags WHERE key = 'mlflow.parentRunId' AND value = ?", parent)
    assert {child for (child,) in children} == set(stored.values())
