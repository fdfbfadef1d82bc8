"""Decisions with real trainings: which seeds are trained and when, when it stops, and what is said."""

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest

from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.compare import VERB as COMPARE
from atlantis_exp.commands.compare import CompareConfig
from atlantis_exp.commands.decide import VERB as DECIDE
from atlantis_exp.commands.decide import DecideConfig, contest_of
from atlantis_exp.commands.overrides import check
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.machine import all_cores
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import NOTE, Tags
from atlantis_exp.sessions import deciding as deciding_module
from atlantis_exp.sessions.deciding import Contest, decide, say_what_it_takes
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.launchers import BASIC, Launcher

REPOSITORY = Path(__file__).parents[2]
# Networks so young hold one action: seeds differ since each plays other games, with half of the decisions random.
SHORT = (
    *("phase.quick.steps=40", "training.learn_every=10", "evaluation.every_steps=null"),
    *("evaluation.epsilon=0.5", "evaluation.seed=${seed}", "evaluation.episodes=4", "seeds=5"),
)
CAPS = "env.max_steps=100,900"  # who plays longer scores more

Recorded = Callable[..., Path]
Asking = Callable[..., Contest]


@pytest.fixture
def asking(tiny_overrides: tuple[str, ...], tmp_path: Path) -> Asking:
    """A decision as a command line asks for it: `asking("model=cnn,resnet")`."""

    def asked(*words: str) -> Contest:
        typed = tuple(replaced(replaced(tiny_overrides, f"paths.outputs={tmp_path}"), *words))
        ((texts, config),) = check("decide", DecideConfig, DECIDE.rewrite([*typed])).items()
        return contest_of(Asked(config, "decide", texts, typed=typed))

    return asked


@pytest.fixture
def deciding(tiny_overrides: tuple[str, ...], tmp_path: Path) -> Callable[..., subprocess.Popen[str]]:
    """Starts a decision as a shell does."""

    def start(*words: str, env: dict[str, str] | None = None) -> subprocess.Popen[str]:
        overrides = replaced(replaced(tiny_overrides, *SHORT), f"paths.outputs={tmp_path / 'o'}", *words)
        return subprocess.Popen(
            (sys.executable, "-m", "atlantis_exp", "decide", *overrides),
            cwd=REPOSITORY,
            env=env,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    return start


def looks(outputs: Path) -> dict[str, list[dict[str, object]]]:
    (path,) = outputs.glob("comparisons/*/looks.json")
    found: dict[str, list[dict[str, object]]] = json.loads(path.read_bytes())
    return found


def record_seeds(recorded: Recorded, first: float, seeds: range, *overrides: str) -> None:
    """Finished trainings with scores about `first`, a few points apart."""
    for seed in seeds:
        score = first + 7 * (seed % 3) + seed
        recorded(*overrides, f"seed={seed}", scores=(score, score + 1, score + 2, score + 3))


@pytest.mark.slow
def test_contenders_are_trained_level_until_a_look_decides_and_compare_says_the_same(
    asking: Asking, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    contest = asking(*SHORT, CAPS)
    contest.here = BASIC  # side by side they end in any order
    decide(contest)
    printed = capsys.readouterr().out
    labels = ["max_steps=100", "max_steps=900"]
    folders = [contest.run(label, seed) for seed in range(5) for label in labels]
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {folder.name for folder in folders}
    began = {folder.name: (folder.path / "result.json").stat().st_mtime_ns for folder in folders}
    assert list(began) == sorted(began, key=began.__getitem__)  # seed 0 of both, seed 1 of both, ...
    assert folders[2].config["evaluation"]["seed"] == 1
    answer = next(line for line in printed.splitlines() if line.startswith("max_steps=900 plays better than"))
    before = looks(tmp_path)
    assert [look["error"] for look in before["env.max_steps"]] == [0.05]

    again = shlex.split(contest.comparing)
    assert f"compare its runs again: {contest.comparing}" in printed
    assert again[:4] == ["python", "-m", "atlantis_exp", "compare"]
    COMPARE.run([*again[4:], "tracking=none"])
    assert answer in capsys.readouterr().out.splitlines()
    assert looks(tmp_path) == before
    decide(contest)
    assert answer in capsys.readouterr().out.splitlines()
    assert looks(tmp_path) == before
    assert {name: (tmp_path / "runs" / name / "result.json").stat().st_mtime_ns for name in began} == began


def test_decided_pairs_are_dropped_and_each_look_is_on_the_page_once(
    asking: Asking,
    recorded: Recorded,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("atlantis_exp.sessions.comparing.draw", lambda _: {})  # most of the time
    rates = {0.001: 9_000.0, 0.002: 1_000.0, 0.003: 1_000.0}
    contest = asking("optimizer.lr=0.001,0.002,0.003")
    assert list(contest.contenders) == [f"lr={rate}" for rate in rates]
    trained: list[tuple[float, int]] = []

    def train(job: Job) -> None:
        rate, seed = job.config.optimizer.lr, job.config.seed
        trained.append((rate, seed))
        record_seeds(recorded, rates[rate], range(seed, seed + 1), f"optimizer.lr={rate}")

    decide(contest, train)
    printed = " ".join(capsys.readouterr().out.split())
    first = [(rate, seed) for seed in range(5) for rate in rates]
    assert trained == first + [(rate, seed) for seed in range(5, 10) for rate in (0.002, 0.003)]
    assert [look["error"] for look in looks(tmp_path)["optimizer.lr"]] == [0.0125, pytest.approx(0.0375)]
    assert [len(look["seeds"]) for look in looks(tmp_path)["optimizer.lr"]] == [3, 2]  # type: ignore[arg-type]
    assert "lr=0.001 plays better than lr=0.002 by" in printed
    assert "Not decided: lr=0.002 against lr=0.003" in printed
    assert "would have been found with 80 %" in printed

    tags = [record.values for record in contest.folder.records() if isinstance(record, Tags)]
    said = {key: value for values in tags for key, value in values.items()}
    assert contest.folder.status == "FINISHED"
    assert contest.folder.title == "decide optimizer.lr=0.001,0.002,0.003"
    assert said["verdict"].startswith("lr=0.001 plays better than lr=0.002")
    note = said[NOTE]
    row = r"^\| (\d+) \| (\d+) \| ([\d.]+%) \| (.+) \| (.+) \| ([\d,]+) \(.+ to .+\) \| (.+) \|$"
    assert re.findall(row, note, re.MULTILINE) == [
        ("1", "5", "1.25%", "lr=0.001", "lr=0.002", "8,000", "better"),
        ("1", "5", "1.25%", "lr=0.001", "lr=0.003", "8,000", "better"),
        ("1", "5", "1.25%", "lr=0.002", "lr=0.003", "0", "not decided"),
        ("2", "10", "3.75%", "lr=0.002", "lr=0.003", "0", "not decided"),
    ]
    assert f"`{contest.command}`" in note
    assert f"`{contest.comparing}`" in note
    assert note.index(contest.comparing) < note.index("looks planned at")  # MLflow cuts the end of a long note


def test_what_stops_a_training_stops_its_decision_with_the_same_code(
    asking: Asking, capsys: pytest.CaptureFixture[str]
) -> None:
    contest = asking("model=cnn,resnet", "seeds=5")
    again = f"continue the decision with: {contest.command}"
    cases: list[tuple[BaseException | int | None, int, str, str]] = [
        (SystemExit(143), 143, "KILLED", ""),
        (KeyboardInterrupt(), 130, "KILLED", ""),
        (signal.SIGTERM, 143, "KILLED", ""),  # it came too late to stop the training
        (Fault("no disk", exit_code=7), 7, "FAILED", f"no disk; {again}"),
        (Fault("late", exit_code=124), 124, "KILLED", f"late; {again}"),
        (None, 1, "FAILED", f"run {contest.run('cnn', 0).name} has not ended; {again}"),
    ]
    for does, ended, status, reason in cases:

        def train(_: Job, does: BaseException | int | None = does) -> int | None:
            if isinstance(does, BaseException):
                raise does
            return does

        with pytest.raises((Fault, SystemExit)) as stopped:
            decide(contest, train)
        assert getattr(stopped.value, "exit_code", getattr(stopped.value, "code", None)) == ended
        assert (contest.folder.status, contest.folder.error) == (status, reason)
        assert capsys.readouterr().err == ("" if reason else f"atlantis_exp: {again}\n")


def test_only_seeds_that_are_missing_are_trained_the_contenders_in_turns(asking: Asking, recorded: Recorded) -> None:
    contest = asking("model=cnn,resnet", "seeds=5")
    record_seeds(recorded, 1_000, range(4), "model=cnn")
    needed = contest.needed(None)
    assert needed == {"cnn": [4], "resnet": [0, 1, 2, 3, 4]}
    jobs = [(job.config.model.name, job.config.seed) for job in contest.jobs(needed)]
    assert jobs == [*(("resnet", seed) for seed in range(4)), ("cnn", 4), ("resnet", 4)]


@pytest.mark.slow
def test_a_plan_whose_error_is_spent_trains_nothing_and_says_how_to_go_on(
    asking: Asking, recorded: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    def train(job: Job) -> None:
        raise AssertionError(job)

    for model in ("cnn", "resnet"):
        record_seeds(recorded, 1_000, range(10), f"model={model}")
    for seeds, left in ((10, ""), (20, "error=0.05 is spent, so seeds for a look at 20 are not trained. ")):
        decide(asking("model=cnn,resnet", f"seeds={seeds}"), train)
        shown = capsys.readouterr().out
        assert "Not decided: cnn against resnet" in shown
        assert "is found" not in shown  # a forecast
        assert ("is spent" in shown) == bool(left)
        assert left in shown
    contest = asking("model=cnn,resnet", "seeds=20", "error=0.1")
    with pytest.raises(AssertionError):
        decide(contest, train)
    assert "of the score is found with a probability of 80 % at 20 seeds" in " ".join(capsys.readouterr().out.split())


def test_several_keys_at_once_are_two_contenders(asking: Asking) -> None:
    contest = asking("against=optimizer=rmsprop,optimizer.lr=0.002", "optimizer=adam", "seeds=5")
    assert list(contest.contenders) == ["lr=0.001 adam", "lr=0.002 rmsprop"]
    one, other = contest.contenders.values()
    assert (one.config.optimizer.name, one.config.optimizer.lr) == ("adam", 0.001)
    assert (other.config.optimizer.name, other.config.optimizer.lr) == ("rmsprop", 0.002)
    assert [family.name for family in contest.families] == ["optimizer.lr,optimizer"]
    texts = {label: contest.job(label, 3).overrides for label in contest.contenders}
    assert "optimizer=adam" in texts["lr=0.001 adam"]
    assert {"optimizer=rmsprop", "optimizer.lr=0.002", "seed=3"} < {*texts["lr=0.002 rmsprop"]}
    assert "optimizer=adam" not in texts["lr=0.002 rmsprop"]


@pytest.mark.slow
def test_a_run_that_cannot_be_compared_is_named(asking: Asking, recorded: Recorded) -> None:
    record_seeds(recorded, 1_000, range(5), "model=cnn")
    record_seeds(recorded, 2_000, range(5), "model=resnet")
    contest = asking("model=cnn,resnet", "seeds=5")
    run = contest.run("resnet", 3)
    (table,) = run.path.glob("artifacts/evaluation/*.csv")
    table.unlink()
    with pytest.raises(
        Fault, match=f"^run {run.name} has ended but cannot be compared, as the warning above explains$"
    ):
        decide(contest)


def test_a_run_that_was_trained_longer_than_is_asked_is_no_seed_of_the_question(
    asking: Asking, recorded: Recorded
) -> None:
    record_seeds(recorded, 1_000, range(5), "model=cnn")
    longer = recorded("model=resnet", "seed=3", "budget.steps=161", outcome="budget", steps=161)
    line = (
        f"^budget.steps=160: run {longer.name} was trained for 161 steps; ask for as many, or name other paths.outputs$"
    )
    with pytest.raises(ConfigError, match=line):
        asking("model=cnn,resnet", "budget.steps=160")


def test_contenders_are_asked_about_at_equal_arithmetic(asking: Asking, recorded: Recorded) -> None:
    contest = asking("model=cnn,resnet", "budget.flops=3e3")
    assert contest.folder != asking("model=cnn,resnet").folder
    assert contest.folder == asking("model=cnn,resnet", "budget.flops=3000").folder
    recorded("model=cnn", "seed=0", "budget.flops=3e3", outcome="budget", updates=30)  # of 100 FLOPs each
    recorded("model=resnet", "seed=0", "budget.flops=2e3", outcome="budget", updates=20)
    assert contest.needed(None)["cnn"] == [1, 2, 3, 4]
    assert contest.needed(None)["resnet"] == [0, 1, 2, 3, 4]
    longer = recorded("model=resnet", "seed=3", outcome="finished", updates=31)
    with pytest.raises(ConfigError, match=f"^budget.flops=3000: run {longer.name} was trained for 3100 FLOPs; ask"):
        asking("model=cnn,resnet", "budget.flops=3e3")


def test_the_command_that_compares_is_read_as_it_is_meant(asking: Asking, tmp_path: Path) -> None:
    contest = asking("optimizer.lr=0.001,0.002", "baseline='lr=0.001'", "delta=1234567")
    words = shlex.split(contest.comparing)[4:]
    (config,) = check("compare", CompareConfig, COMPARE.rewrite(words)).values()
    assert config.question(config.by) == contest.question
    assert contest.question.delta == 1_234_567
    assert contest.question.identity.keys() == {"by", "seeds", "error", "delta", "relative", "baseline"}
    assert config.at_epsilon == 0.05
    assert config.paths.outputs == str(tmp_path)


@pytest.mark.slow
def test_a_question_about_the_training_score_is_handed_on_with_its_window(asking: Asking) -> None:
    contest = asking("optimizer.lr=0.001,0.002", "score=training", "window=25%", "format=json")
    words = shlex.split(contest.comparing)[4:]
    (config,) = check("compare", CompareConfig, COMPARE.rewrite(words)).values()
    assert config.question(config.by) == contest.question
    assert (contest.question.score, contest.question.window) == ("training", 0.25)
    other = asking("optimizer.lr=0.001,0.002", "score=training", "window=20%")
    assert other.folder != contest.folder
    assert asking("optimizer.lr=0.001,0.002", "window=25%").folder == asking("optimizer.lr=0.001,0.002").folder


def test_contenders_that_explore_differently_are_refused_by_the_training_score_before_they_are_trained(
    asking: Asking,
) -> None:
    asking("epsilon=constant", "epsilon.value=0.1,0.2")
    with pytest.raises(ConfigError, match=r"^score=training: depends on epsilon, .*; use score=last$"):
        asking("epsilon=constant", "epsilon.value=0.1,0.2", "score=training")


def test_the_same_question_is_the_same_decision_however_it_is_written(asking: Asking) -> None:
    one = asking("optimizer.lr=0.001,0.002", "budget.steps=1_000_000")
    again = asking("optimizer.lr=0.002,1e-3", "budget.steps=1000000", "threads=2", "tracking=mlflow")
    assert again.folder == one.folder
    assert again.folder.path.parent.name == "decisions"
    for words in (("budget.steps=2_000_000",), ("budget.steps=1_000_000", "delta=5%"), ("score=training",)):
        assert asking("optimizer.lr=0.001,0.002", *words).folder != one.folder


def said(contest: Contest, capsys: pytest.CaptureFixture[str]) -> str:
    say_what_it_takes(contest)
    return capsys.readouterr().out


def test_before_it_starts_it_says_how_many_runs_there_may_be_and_what_they_can_find(
    asking: Asking, recorded: Recorded, capsys: pytest.CaptureFixture[str]
) -> None:
    contest = asking("model=cnn,resnet_fast", "delta=5%")
    contest.here = Launcher("joblib", {"n_jobs": 4, "cores": 2})
    assert said(contest, capsys).splitlines() == [
        "cnn, resnet_fast: 10 to 20 runs, looks at 5 and 10 seeds each; 0 exist.",
        "4 trainings at a time, 2 cores each",
        "a difference of 12 % of the score is found, and no difference where delta is 14 % or more, with a "
        "probability of 80 % at 10 seeds",
        "(if the standard deviation over seeds is 9 % of the mean, as in published runs (Dopamine's, five seeds))",
    ]
    record_seeds(recorded, 1_000, range(2), "model=cnn")
    assert "published" in said(contest, capsys)
    for seed, score in ((2, 900.0), (3, 1_100.0)):
        recorded("model=cnn", f"seed={seed}", scores=(score, score, score, score))
    assert said(contest, capsys).splitlines() == [
        "cnn, resnet_fast: 10 to 20 runs, looks at 5 and 10 seeds each; 4 exist.",
        "4 trainings at a time, 2 cores each",
        "a difference of 11 % of the score is found, and no difference where delta is 13 % or more, with a "
        "probability of 80 % at 10 seeds",
        "(if the standard deviation over seeds is 8 % of the mean, as in the existing runs)",
    ]
    shown = said(asking("model=cnn,resnet_fast", "sampler=uniform,top_half", "seeds=5"), capsys).splitlines()
    assert shown[0].endswith("20 runs, looks at 5 seeds each; 4 exist.")
    assert [line.partition(" is found")[0] for line in shown[2:-1]] == [
        "by model, a difference of 14 % of the score",
        "by sampler, a difference of 14 % of the score",
        "by model,sampler, a difference of 27 % of the score",
    ]


def test_a_look_waits_for_its_last_run(
    asking: Asking, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    hours = {"cnn": 1.0, "resnet_fast": 2.0}
    monkeypatch.setattr(
        deciding_module, "measure", lambda job, _: (None, SimpleNamespace(hours=hours[job.config.model.name]))
    )
    contest = asking("model=cnn,resnet_fast", "budget.forecast=warn")
    for at_once, most in ((4, "10.0 hours side by side"), (1, "30.0 hours one after the other")):
        contest.here = Launcher("joblib", {"n_jobs": at_once, "cores": 2})
        assert f"at most {most}, evaluations not counted" in said(contest, capsys)


@pytest.mark.slow
def test_before_it_starts_it_says_what_hours_the_runs_take(asking: Asking, capsys: pytest.CaptureFixture[str]) -> None:
    contest = asking("model=cnn,resnet_fast", "budget.forecast=warn")
    contest.here = BASIC
    shown = said(contest, capsys)
    assert "one training after the other" in shown
    assert re.search(r"^ *cnn: [\d,]+ (seconds|minutes) a run, alone on this machine", shown, re.MULTILINE)
    assert re.search(r"resnet_fast: [\d,]+ (seconds|minutes) a run, alone on this machine", shown)
    assert re.search(r"at most [\d,]+ (seconds|minutes) one after the other", shown)
    contest.here = Launcher("joblib", {"n_jobs": 4, "cores": 1})
    shown = said(contest, capsys)
    assert re.search(r"^ *cnn: [\d,]+ (seconds|minutes) a run, on its share", shown, re.MULTILINE)
    assert re.search(r"at most [\d,]+ (seconds|minutes) side by side, evaluations not counted", shown)


@pytest.mark.slow
@pytest.mark.timeout(900)  # seconds
def test_a_decision_that_was_killed_goes_on_and_ends_as_the_unbroken_one(
    deciding: Callable[..., subprocess.Popen[str]], asking: Asking, tmp_path: Path
) -> None:
    unbroken = asking(*SHORT, CAPS, f"paths.outputs={tmp_path / 'unbroken'}")
    decide(unbroken)
    runs = tmp_path / "o" / "runs"
    for number, ended, sent in ((1, -9, signal.SIGKILL), (4, 130, signal.SIGINT), (7, 143, signal.SIGTERM)):
        process = deciding(CAPS)
        patience = time.monotonic() + 200
        while len(list(runs.glob("*/result.json"))) < number:
            assert process.poll() is None
            assert time.monotonic() < patience
            time.sleep(0.05)
        if all_cores() > 1:
            assert len([*runs.glob("*/output.txt")]) > 1  # of trainings side by side
        process.send_signal(sent)
        out, error = process.communicate()
        assert process.returncode == ended, out + error
        if ended > 0:
            assert "atlantis_exp: continue the decision with: python -m atlantis_exp decide" in error
            assert "Traceback" not in error
            (folder,) = (tmp_path / "o" / "decisions").iterdir()
            assert RunFolder(folder).status == "KILLED"
    process = deciding(CAPS)
    out, error = process.communicate()
    assert process.returncode == 0, error
    assert looks(tmp_path / "o") == looks(tmp_path / "unbroken")
    assert {path.name for path in runs.iterdir()} == {path.name for path in (tmp_path / "unbroken" / "runs").iterdir()}
    for path in runs.glob("*/result.json"):
        other = json.loads((tmp_path / "unbroken" / path.relative_to(tmp_path / "o")).read_bytes())
        assert json.loads(path.read_bytes())["evaluation"] == other["evaluation"]
