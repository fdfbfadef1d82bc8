import dataclasses
import json
import os
import re
import shutil
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import torch

from atlantis_exp.build import build_learner
from atlantis_exp.checking import parse, to_dict
from atlantis_exp.commands.overrides import read_override
from atlantis_exp.commands.train import VERB
from atlantis_exp.config import Config, PathsConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.machine import Machine
from atlantis_exp.runs.facts import read_facts
from atlantis_exp.runs.folder import RunFolder, find_run
from atlantis_exp.runs.journal import Journal, Metrics, adopt, read
from atlantis_exp.sessions.contracts import fingerprints
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.launchers import BASIC
from atlantis_exp.sessions.reporting import report
from atlantis_exp.sessions.sweep import sweep
from atlantis_exp.sessions.training import _kin, train
from atlantis_exp.tracking.mirror import publish
from atlantis_exp.tracking.store import Store
from atlantis_exp.training.checkpoint import CheckpointError, Checkpoints
from atlantis_exp.training.forecast import Forecast
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.trainer import Trainer
from benchmarks.kills import train_and_kill

Compose = Callable[..., Config]
REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-m", "atlantis_exp")
SHORT = ("phase.quick.steps=40", "evaluation.at_end=false", "evaluation.every_steps=null")
LONG = ("phase.quick.steps=100_000", "evaluation.every_steps=null", "tracking.commit_seconds=0.2")


@pytest.mark.slow
def test_the_forecast_is_measured_before_there_is_anything_for_mlflow(
    tiny: Compose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny(*SHORT, "tracking=mlflow", "budget.forecast=warn")
    folder, seen = RunFolder.of(config), []

    def measured(_: Trainer, *, done: Counters, **__: float) -> Forecast:
        time.sleep(0.5)  # for a publisher that would begin
        seen.append((folder.state, folder.status, (tmp_path / "mlflow.lock").exists(), done.steps))
        return Forecast(1, 40, 0, 1, 0, 1)

    monkeypatch.setattr("atlantis_exp.sessions.training.forecast", measured)
    train(Job(config))
    assert seen == [("running", None, False, 0)]
    assert folder.state == "done"


def test_a_training_whose_memory_will_not_suffice_is_refused_before_it_begins(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "atlantis_exp.sessions.training.forecast", lambda *_, **__: Forecast(1, 40, 2 * 2**20, 2**20, 0, 1)
    )
    config = tiny(*SHORT, "budget.forecast=refuse")
    with pytest.raises(Fault, match=r"memory will not suffice: 2 MiB needed, .*; budget\.forecast=warn starts anyway"):
        train(Job(config))
    assert not list(RunFolder.of(config).checkpoints.glob("*/manifest.json"))


@pytest.mark.slow
def test_a_forecast_changes_nothing_of_a_training(tiny: Compose, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[float] = []

    def timed(call: Callable[[], object], at_least: int, seconds: float) -> float:
        for _ in range(at_least):
            call()
        calls.append(seconds)
        return 0.001

    monkeypatch.setattr("atlantis_exp.training.forecast._median_seconds", timed)
    for steps in ("28", "null"):  # the second one amid an episode, and after updates
        config = tiny(*SHORT, "budget.forecast=warn", f"budget.steps={steps}")
        train(Job(config))
    unbroken = at(tiny(*SHORT), Path(config.paths.outputs, "u"))
    train(Job(unbroken))
    assert len(calls) == 2 * 3
    assert fingerprints(config, Path(config.paths.outputs)) == fingerprints(unbroken, Path(unbroken.paths.outputs))


def at(config: Config, outputs: Path) -> Config:
    """A training under another folder."""
    return dataclasses.replace(config, paths=PathsConfig(outputs=str(outputs)))


def session(config: Config, tiny_overrides: tuple[str, ...], *overrides: str, **environment: str) -> Any:
    """A training in a process of its own."""
    return subprocess.Popen(
        (*COMMAND, "train", *replaced(tiny_overrides, f"paths.outputs={config.paths.outputs}", *overrides)),
        cwd=REPOSITORY,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def generation(folder: RunFolder) -> int:
    return max((int(path.parent.name) for path in folder.path.glob("checkpoints/0*/manifest.json")), default=0)


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.02)


def test_more_of_a_run_whose_plan_is_over_is_answered_with_what_begins_with_its_weights(
    tiny: Compose, recorded: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    folder = RunFolder(recorded())
    train(Job(tiny("budget.steps=160")))
    assert "has no effect" not in capsys.readouterr().out
    train(Job(tiny("budget.steps=600"), overrides=("phase.quick.steps=160", "budget.steps=600")))
    out = capsys.readouterr().out
    assert "budget.steps=600 has no effect: the run's plan has ended" in out
    assert (
        f"atlantis_exp export run={folder.name} to=pretrained/{folder.name} paths.outputs={tiny().paths.outputs}" in out
    )
    train(Job(tiny("budget.flops=1e3"), overrides=("phase.quick.steps=160", "budget.flops=1e3")))
    assert "budget.flops=1000.0 has no effect: the run's plan has ended" in capsys.readouterr().out
    assert out.endswith(f"atlantis_exp phase.quick.steps=160 training.weights=pretrained/{folder.name}\n")


def test_a_longer_plan_says_which_run_is_the_same_over_a_shorter_one_and_why_it_begins_at_0(
    tiny: Compose, recorded: Callable[..., Path]
) -> None:
    folder = RunFolder(recorded())
    job = Job(tiny("phase.quick.steps=200"), overrides=("phase.quick.steps=200",))
    said = _kin(job, RunFolder.of(job.config))
    assert f"run {folder.name}, of 160 steps, has another plan (epsilon=exponential follow" in said
    assert f"phase.quick.steps=200 training.weights=pretrained/{folder.name}" in said
    fixed = ("epsilon=constant", "epsilon.value=0.1")
    recorded(*fixed)
    job = Job(tiny(*fixed, "phase.quick.steps=200"))
    assert "has another plan: this one begins at step 0" in _kin(job, RunFolder.of(job.config))
    assert _kin(Job(tiny("seed=1")), RunFolder.of(tiny("seed=1"))) == ""


def test_a_folder_that_is_moved_meanwhile_is_said_to_be_and_the_same_command_finishes_the_run(
    tiny: Compose, tmp_path: Path
) -> None:
    job = Job(tiny(*SHORT))
    folder = RunFolder.of(job.config)

    def move(trainer: Trainer) -> bool:
        if trainer.counters.steps >= 20 and not (tmp_path / "moved").exists():
            folder.path.rename(tmp_path / "moved")
        return False

    with pytest.raises(Fault, match=rf"^run {folder.name}: .* was moved or deleted meanwhile; finish it with: "):
        train(job, move)
    assert folder.result is None
    train(job)
    assert folder.result is not None


def test_a_run_that_was_put_aside_has_no_other_plan(tiny: Compose, recorded: Callable[..., Path]) -> None:
    folder = RunFolder(recorded())
    folder.put_aside()
    assert _kin(Job(tiny()), folder) == ""


def test_a_budget_that_cuts_a_schedule_says_so(tiny: Compose, capsys: pytest.CaptureFixture[str]) -> None:
    fixed = ("epsilon=constant", "epsilon.value=0.1", "evaluation.at_end=false")
    train(Job(tiny(*SHORT, "budget.steps=20", *fixed, "lr_schedule=linear")))
    share = 20 / sum(phase.steps or 0 for phase in tiny(*SHORT).phase.values())
    assert f"budget.steps=20 ends at {share:.0%} of lr_schedule=linear: set" in capsys.readouterr().out
    train(Job(tiny(*SHORT, "budget.steps=20", *fixed)))
    train(Job(tiny(*SHORT, "budget.steps=20", "epsilon=linear")))  # over after a tenth of the plan
    assert "ends at" not in capsys.readouterr().out


def test_a_run_that_has_ended_is_reported_and_not_trained_again(
    tiny: Compose, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("evaluation.every_steps=null")
    train(Job(config))
    folder = RunFolder.of(config)
    files = {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")}
    capsys.readouterr()
    train(Job(config))
    assert f"run {folder.name} has ended (finished after 160 steps)" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in folder.path.rglob("*")} == files
    assert folder.state == "done"


@pytest.mark.slow
@pytest.mark.parametrize("gone", [".", "*/manifest.json"])
def test_a_run_whose_checkpoints_are_gone_is_not_begun_anew_by_a_larger_budget(
    tiny: Compose, capsys: pytest.CaptureFixture[str], gone: str
) -> None:
    short, longer = (tiny(f"budget.steps={steps}", "evaluation.every_steps=null") for steps in (80, 120))
    train(Job(short))
    folder = RunFolder.of(short)
    for path in [folder.checkpoints] if gone == "." else folder.checkpoints.glob(gone):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    files = {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()}
    with pytest.raises(Fault, match=f"run {folder.name}: its checkpoints are gone from {folder.checkpoints}"):
        train(Job(longer))
    assert {path: path.read_bytes() for path in folder.path.rglob("*") if path.is_file()} == files
    capsys.readouterr()
    train(Job(short))
    assert "has ended (budget after 80 steps)" in capsys.readouterr().out
    train(Job(dataclasses.replace(longer, resume="never")))
    assert (RunFolder(folder.path.with_name(f"{folder.name}~1")).path / "result.json").exists()


def test_scores_of_an_evaluation_before_the_last_step_are_said_to_be(
    tiny: Compose, capsys: pytest.CaptureFixture[str]
) -> None:
    config = tiny("evaluation.at_end=false", "evaluation.every_steps=70")
    train(Job(config))
    assert "\nevaluated last at step 140 of 160 (evaluation.at_end=false):\n" in capsys.readouterr().out
    report(Path(config.paths.outputs))
    assert "160 (evaluated at 140)" in capsys.readouterr().out


def test_a_training_that_never_learned_says_so(tiny: Compose, capsys: pytest.CaptureFixture[str]) -> None:
    train(Job(tiny("training.learn_start=160", "replay.capacity=200")))
    assert "no update was made in 160 steps: see training.learn_start and learn_every\n" in capsys.readouterr().out


def test_a_run_says_what_it_was_made_on(tiny: Compose) -> None:
    config = tiny(
        "budget.steps=40", "training.precision=fp32", "evaluation.at_end=false", "evaluation.every_steps=null"
    )
    train(Job(config))
    tags = read_facts(RunFolder.of(config).path).tags
    assert (tags["device"], tags["precision"]) == ("cpu", "float32")
    name, instructions = tags["processor"].rsplit(", ", 1)
    assert name
    assert ":" not in name
    assert instructions == torch.backends.cpu.get_cpu_capability()


@pytest.mark.parametrize("more", ["budget.flops=1e9", "budget.flops=null"])
def test_a_budget_of_arithmetic_ends_a_run_at_the_step_that_spends_it_and_a_larger_one_goes_on(
    tiny: Compose, more: str
) -> None:
    quiet = ("evaluation.at_end=false", "evaluation.every_steps=null")
    each = build_learner(tiny(*quiet)).update_flops((4, 40, 40), 4)
    for flops in (5 * each, 5 * each + 1):  # ends at five updates, then at six
        train(Job(config := tiny(*quiet, f"budget.flops={flops}")))
        result = RunFolder.of(config).result
        assert result is not None
        assert (result.outcome, result.counts["flops"]) == ("budget", each * -(-flops // each))
        assert RunFolder.of(config).ended(config.budget.limits) == result
    train(Job(config := tiny(*quiet, more)))
    result = RunFolder.of(config).result
    assert result is not None
    assert result.outcome == "finished"


@pytest.mark.parametrize(
    ("name", "damaged"),
    [
        *(pytest.param("result.json", text, marks=pytest.mark.slow) for text in ("", "[1]")),
        ("result.json", '{"outcome": "finished", "steps": "many", "counts": {}, "evaluation": {}, "report": ""}'),
        pytest.param(
            "commit.json", '{"identity": "a", "started": 1, "updated": 1, "offset": 0', marks=pytest.mark.slow
        ),
        ("commit.json", '{"identity": "a", "started": 1, "updated": 1, "offset": "0", "status": "RUNNING"}'),
    ],
)
def test_a_damaged_file_of_a_run_is_one_clear_line_and_is_written_anew_once_it_is_removed(
    tiny: Compose, name: str, damaged: str
) -> None:
    config = tiny(*SHORT, "budget.steps=20")
    train(Job(config))
    folder = RunFolder.of(config)
    path = folder.path / name
    whole = json.loads(path.read_bytes())
    path.write_text(damaged)
    with pytest.raises(Fault, match=f"{path} is damaged: remove it and repeat the run's command"):
        train(Job(tiny(*SHORT)))
    path.unlink()
    train(Job(tiny(*SHORT)))
    assert json.loads(path.read_bytes()).keys() == whole.keys()
    assert folder.state == "done"


def test_a_damaged_run_is_no_obstacle_to_finding_another(tmp_path: Path) -> None:
    for name, config in (("one", '{"model": {}}'), ("other", "{")):
        (tmp_path / "runs" / name).mkdir(parents=True)
        (tmp_path / "runs" / name / "config.json").write_text(config)
    assert {find_run(tmp_path, name).name for name in ("one", "o", "latest")} == {"one"}
    with pytest.raises(Fault, match=r"other/config\.json is damaged"):
        find_run(tmp_path, "other")
    shutil.copytree(tmp_path / "runs" / "one", tmp_path / "runs" / "before")
    os.utime(tmp_path / "runs" / "before" / "config.json", (0, 0))
    assert find_run(tmp_path, "latest").name == "one"


def test_a_run_that_ended_has_its_journal_again_where_its_commit_was_removed(tiny: Compose) -> None:
    config = tiny(*SHORT)
    train(Job(config))
    folder = RunFolder.of(config)
    before, records = folder.commit, [*folder.records()]
    assert before is not None
    with (folder.path / "journal.jsonl").open("a") as file:
        file.write('{"kind":"metr')  # as a kill leaves a line
    (folder.path / "commit.json").unlink()
    adopt(folder.path, folder.path.parents[1] / "sweeps" / "s")  # a sweep of it begins so
    train(Job(config))
    after = folder.commit
    assert after is not None
    assert (after.offset, after.status, after.labels) == (before.offset, "FINISHED", before.labels)
    assert [*folder.records()] == records
    assert folder.state == "done"


def test_a_run_without_its_checkpoints_and_its_commit_is_left_as_it_is(tiny: Compose) -> None:
    config = tiny(*SHORT)
    train(Job(config), lambda trainer: trainer.counters.steps == 20)
    folder = RunFolder.of(config)
    shutil.rmtree(folder.checkpoints)
    (folder.path / "commit.json").unlink()
    before = (folder.path / "journal.jsonl").read_bytes()
    assert before
    with pytest.raises(Fault, match="its checkpoints are gone"):
        train(Job(config))
    assert (folder.path / "journal.jsonl").read_bytes() == before


def test_a_damaged_run_is_no_obstacle_to_another(tiny: Compose, capsys: pytest.CaptureFixture[str]) -> None:
    damaged = tiny(*SHORT).paths.outputs + "/runs/damaged/commit.json"
    Path(damaged).parent.mkdir(parents=True)
    Path(damaged).write_text("{")
    train(Job(tiny(*SHORT)))
    assert capsys.readouterr().err.startswith(f"atlantis_exp: {damaged} is damaged")


def test_a_config_that_was_lost_is_written_again(tiny: Compose) -> None:
    config = tiny(*SHORT)
    train(Job(config))
    (RunFolder.of(config).path / "config.json").unlink()
    assert str(RunFolder.of(config).state) == "queued"
    train(Job(config))
    assert RunFolder.of(config).config == to_dict(config)
    assert RunFolder.of(config).state == "done"


def test_slurms_next_try_of_a_run_goes_on_whatever_resume_says(tiny: Compose) -> None:
    config = tiny(*SHORT, "resume=never")
    train(Job(config))
    train(Job(config, machine=Machine(cores=1, slurm_restarts=1)))
    assert [path.name for path in RunFolder.of(config).path.parent.iterdir()] == [config.run_name()]


def test_a_run_that_is_made_longer_is_done_at_its_new_end(recorded: Callable[..., Path]) -> None:
    folder = RunFolder(recorded(outcome="budget"))
    states: list[str] = [folder.state]
    journal = Journal(folder.path)
    with folder.held():
        journal.status("RUNNING")
        states.append(folder.state)
    states.append(folder.state)
    for status in ("KILLED", "FAILED", "FINISHED"):
        journal.status(status)
        states.append(folder.state)
    assert states == ["done", "running", "interrupted", "interrupted", "failed", "done"]


def test_resume_must_refuses_to_start_and_resume_never_keeps_what_was_there(tiny: Compose) -> None:
    with pytest.raises(ConfigError, match="resume=must: no run"):
        train(Job(tiny(*SHORT, "resume=must")))
    for resume in ("auto", "must", "never"):
        config = tiny(*SHORT, f"resume={resume}")
        train(Job(config))
    names = sorted(path.name for path in RunFolder.of(config).path.parent.iterdir())
    assert names == [config.run_name(), f"{config.run_name()}~1"]


@pytest.mark.usefixtures("impatient")
def test_a_run_that_another_process_holds_is_not_touched(tiny: Compose) -> None:
    config = tiny()
    folder = RunFolder.of(config)
    holder = f"process {os.getpid()} on {os.uname().nodename}"
    with folder.held(), pytest.raises(Fault, match=f"run {folder.name} is held by {holder}") as fault:
        train(Job(config))
    assert fault.value.exit_code == 75
    (folder.path / "holder.txt").write_text("process 1 on a machine long gone\n")
    with folder.held():
        pass


def test_time_that_is_up_commits_and_says_how_to_continue(tiny: Compose) -> None:
    config = tiny("budget.wall_clock=1s", *LONG)
    with pytest.raises(Fault, match=r"budget\.wall_clock: run .* is committed at step .*; continue with: ") as fault:
        train(Job(config))
    assert fault.value.exit_code == 124
    assert RunFolder.of(config).state == "interrupted"


def with_time(config: Config, text: str) -> Config:
    """A config with a time as it is written on a command line."""
    tree = to_dict(config)
    tree["budget"]["wall_clock"] = read_override(f"budget.wall_clock={text}").value()
    return parse(Config, tree)


@pytest.mark.parametrize(
    ("text", "seconds"), [("90", 90), ("90s", 90), ("10min", 600), ("10m", 600), ("3h", 10_800), ("1h30m", 5_400)]
)
def test_a_time_is_read_in_the_usual_ways_and_is_no_part_of_the_identity(
    tiny: Compose, text: str, seconds: int
) -> None:
    config = with_time(tiny(), text)
    assert config.budget.seconds == seconds
    assert config.identity() == tiny().identity()


@pytest.mark.parametrize("text", ["3x", "0", "h", "-3h", "'3 h'", "1h30", "10m5"])
def test_a_time_that_is_none_is_refused_in_one_line(tiny: Compose, text: str) -> None:
    with pytest.raises(ConfigError, match=r"budget\.wall_clock"):
        with_time(tiny(), text)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 64 MiB, where mounting one is allowed."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ("mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(disk))
    if (refused := subprocess.run(mount, capture_output=True, text=True, check=False)).returncode:
        pytest.skip(f"may not mount a file system: {refused.stderr.strip()}")
    yield disk
    subprocess.run(("umount", str(disk)), check=True)


@pytest.mark.slow
def test_a_full_disk_is_one_clear_line_and_costs_nothing_committed(tiny: Compose, small_disk: Path) -> None:
    chosen = (*SHORT, "phase.quick.steps=100", "tracking.commit_seconds=1e-9")
    config = at(tiny(*chosen), small_disk)
    folder, ballast = RunFolder.of(config), small_disk / "ballast"
    train(Job(dataclasses.replace(config, budget=dataclasses.replace(config.budget, steps=50))))
    for space in (0, 4, 8, 64):  # KiB: no config, no replay segment, no state, no tensors
        filesystem = os.statvfs(small_disk)
        ballast.write_bytes(bytes(max(filesystem.f_bavail * filesystem.f_frsize - space * 1024, 0)))
        with pytest.raises((Fault, OSError), match="No space left on device") as fault:
            train(Job(config))
        assert "\n" not in str(fault.value)
        ballast.unlink()
        state = Checkpoints(folder.path / "checkpoints", config.identity()).load(warn=pytest.fail)
        assert state is not None
        assert state["counters"]["steps"] == 50
    train(Job(config))
    assert folder.state == "done"
    unbroken = tiny(*chosen)
    train(Job(unbroken))
    assert fingerprints(config, small_disk) == fingerprints(unbroken, Path(unbroken.paths.outputs))


@pytest.mark.parametrize("forged", [{"steps": 10**400}, {"steps": 1}, {"episodes": -1}, {"steps": "many"}])
def test_counters_that_no_training_comes_to_are_one_line(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch, forged: dict[str, Any]
) -> None:
    """Before anything is expected of them."""
    saved = {**dataclasses.asdict(Counters(steps=80, episodes=2)), **forged}
    monkeypatch.setattr(Checkpoints, "load", lambda *_: {"counters": saved})
    with pytest.raises(CheckpointError, match=r"does not fit this training \((ValueError|TypeError): "):
        train(Job(tiny(*SHORT, "budget.forecast=warn")))


def test_a_commit_that_the_disk_refuses_is_one_clear_line_and_costs_nothing_committed(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = tiny(*SHORT, "tracking.commit_seconds=1e-9")
    synced, calls = os.fsync, iter(range(100))

    def full(file: int) -> None:
        if next(calls, None) is None:
            raise OSError(28, "No space left on device")
        synced(file)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", full)
        with pytest.raises(Fault, match=r"No space left on device; make room, or name .*; continue with: "):
            train(Job(config))
    folder = RunFolder.of(config)
    assert folder.state == "interrupted"
    train(Job(config))
    unbroken = at(config, Path(config.paths.outputs, "u"))
    train(Job(unbroken))
    assert fingerprints(config, Path(config.paths.outputs)) == fingerprints(unbroken, Path(unbroken.paths.outputs))


def test_a_journal_that_was_cut_is_one_clear_line(tiny: Compose) -> None:
    config = tiny("budget.steps=80", "evaluation.at_end=false", "evaluation.every_steps=null")
    train(Job(config))
    path = RunFolder.of(config).path / "journal.jsonl"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(Fault, match="is shorter than in the checkpoint"):
        train(Job(tiny("evaluation.at_end=false", "evaluation.every_steps=null")))


@pytest.mark.slow
@pytest.mark.parametrize("sampler", ["prioritized", "uniform"])
@pytest.mark.parametrize("damaged", ["newest", "oldest"])
def test_a_damaged_part_of_the_replay_memory_costs_that_part_and_is_said(
    tiny: Compose, sampler: str, damaged: str, capsys: pytest.CaptureFixture[str]
) -> None:
    overrides = (f"sampler={sampler}", "evaluation.every_steps=null", "tracking.commit_episodes=1", "env.num_envs=2")
    train(Job(tiny(*overrides, "budget.steps=120")))
    config = tiny(*overrides)
    segments = sorted(RunFolder.of(config).checkpoints.glob("segments/*"))
    for path in [segments[0]] if damaged == "oldest" else segments:
        (path / "arrays.safetensors").write_bytes(b"damaged")
    capsys.readouterr()
    train(Job(config))
    assert "no checkpoint has its whole replay memory: " in capsys.readouterr().out
    facts = read_facts(RunFolder.of(config).path)
    assert re.fullmatch(r"\d+ observations of the replay memory, at step 120", facts.tags["lost"])
    assert RunFolder.of(config).state == "done"


def points(outputs: Path, name: str) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(outputs / "mlflow.db")) as database:
        return database.execute(
            "SELECT metrics.key, step, timestamp, metrics.value FROM metrics JOIN runs USING (run_uuid) "
            "JOIN tags USING (run_uuid) WHERE tags.key = 'atlantis.folder' AND tags.value LIKE ? "
            "AND lifecycle_stage = 'active' ORDER BY metrics.key, timestamp, step",
            (f"%/{name}",),
        ).fetchall()


def journaled(folder: Path) -> list[tuple[Any, ...]]:
    found = [
        (key, record.step, record.time, value)
        for _, record in read(folder)
        if isinstance(record, Metrics)
        for key, value in record.values.items()
    ]
    return sorted(found, key=lambda point: (point[0], point[2], point[1]))


@pytest.mark.slow
def test_a_killed_run_is_shown_as_interrupted_then_continued_and_sigterm_ends_it_with_143(
    tiny: Compose, tiny_overrides: tuple[str, ...]
) -> None:
    folder = RunFolder.of(tiny(*LONG))
    killed = session(tiny(*LONG), tiny_overrides, *LONG)
    wait_for(lambda: generation(folder) > 0)
    assert str(folder.state) == "running"
    with pytest.raises(Fault, match=f"is held by process {killed.pid} on"), folder.held():
        pass
    killed.kill()
    killed.wait()
    assert folder.state == "interrupted"

    before = generation(folder)
    ended = session(tiny(*LONG), tiny_overrides, *LONG)
    wait_for(lambda: generation(folder) > before)
    ended.send_signal(signal.SIGTERM)
    out, error = ended.communicate()
    assert ended.returncode == 143
    assert f"run {folder.name} was killed; repeat its command to continue it" in out
    assert f"continuing run {folder.name} at step" in out
    assert error.startswith(f"atlantis_exp: SIGTERM: run {folder.name} is committed at step")
    assert "continue with: python -m atlantis_exp experiment=quick" in error
    assert folder.status == "KILLED"


def test_a_sweep_runs_what_is_missing_and_tables_what_it_found(
    tiny: Compose,
    tiny_overrides: tuple[str, ...],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    config, missing = tiny(*SHORT), tiny(*SHORT, "seed=1")
    train(Job(config))
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", ["atlantis_exp"])
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    words = replaced(tiny_overrides, *SHORT, f"paths.outputs={config.paths.outputs}", "seed=0,1")
    VERB.run([*words, "hydra/launcher=basic", "-m"])
    done, error = capsys.readouterr()
    assert error == ""
    tables = [line for line in done.splitlines() if line.startswith("sweep of 2 runs")]
    assert tables == ["sweep of 2 runs: 1 done, 1 queued", "sweep of 2 runs: 2 done"]
    assert f"run {config.run_name()} has ended" in done
    assert f"starting run {missing.run_name()}" in done


def test_a_signal_that_comes_when_a_run_has_nothing_left_to_stop_ends_its_sweep(tiny: Compose) -> None:
    trained: list[int] = []

    def train(job: Job) -> int:
        trained.append(job.config.seed)
        return signal.SIGTERM

    jobs = [Job(tiny(*SHORT, f"seed={seed}")) for seed in (0, 1)]
    with pytest.raises(SystemExit, match="143"):
        sweep(jobs, BASIC, ["seed=0,1"], "again", lambda _: None, train)
    assert trained == [0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "overrides",
    [
        ("model=cnn", "env.num_envs=1", "phase.quick.steps=20_000"),
        ("model=resnet", "env.size=16", "env.num_envs=8", "env.workers=2", "phase.quick.steps=20_000"),
    ],
)
@pytest.mark.timeout(2_400)  # seconds; twenty sessions import torch
def test_a_training_killed_twenty_times_is_the_unbroken_one_and_mlflow_has_each_point_once(
    tiny: Compose, tiny_overrides: tuple[str, ...], tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    chosen = (*overrides, "evaluation.every_steps=null", "tracking.histogram_episodes=100", "tracking.every_steps=100")
    config = tiny(*chosen)
    assert train_and_kill(config, replaced(tiny_overrides, *chosen), tmp_path / "unbroken", 0) == 0
    killed = tmp_path / "killed"
    struck = train_and_kill(config, replaced(tiny_overrides, *chosen, "tracking=mlflow"), killed, 20)
    assert struck >= 15  # each after a commit of its own session; the last ones may find the training at its end
    assert fingerprints(config, tmp_path / "unbroken") == fingerprints(config, killed)
    publish(killed / "runs" / config.run_name(), Store(killed))  # what the last command did not wait for
    shown = points(killed, config.run_name())
    assert shown == journaled(killed / "runs" / config.run_name())
    for key in {point[0] for point in shown}:
        steps = [step for other, step, *_ in shown if other == key]
        assert steps == sorted(steps)
        # Episodes of several environments may end at one step.
        assert len(set(steps)) == len(steps) or (config.env.num_envs > 1 and key.startswith(("score/", "throughput/")))


@pytest.mark.slow
def test_a_machine_that_cannot_compile_is_told_in_one_line(tiny_overrides: tuple[str, ...], tmp_path: Path) -> None:
    done = subprocess.run(
        (*COMMAND, *tiny_overrides, "compile=true", f"paths.outputs={tmp_path}"),
        cwd=REPOSITORY,
        env={**os.environ, "CXX": str(tmp_path / "none"), "TORCHINDUCTOR_FORCE_DISABLE_CACHES": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "torch.compile failed, InvalidCxxCompiler" in done.stderr.splitlines()[-1]
    assert done.stderr.splitlines()[-1].endswith("set compile=false")
    assert "Traceback" not in done.stderr
