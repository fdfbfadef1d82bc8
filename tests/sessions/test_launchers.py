"""Sweeps whose jobs other processes do: what becomes of all when one of them, or the sweep, is ended."""

import dataclasses
import io
import os
import re
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import pytest
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from atlantis_exp import terminal
from atlantis_exp.commands import CONF
from atlantis_exp.commands.overrides import _set_up, check, launcher, read_override
from atlantis_exp.config import Config, PathsConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, read_commit
from atlantis_exp.sessions.contracts import fingerprints
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.launchers import BASIC, Launcher, in_turn
from atlantis_exp.sessions.launchers.joblib import fitted, fitting, shared, train_side_by_side
from atlantis_exp.sessions.live import LiveTable
from atlantis_exp.sessions.training import train

REPOSITORY = Path(__file__).parents[2]
FREQUENT = ("tracking=mlflow", "tracking.commit_seconds=0.5", "evaluation.every_steps=null")
LONG = (*FREQUENT, "phase.quick.steps=100_000")

ROOMY = ("replay.capacity=900_000", "phase.quick.steps=900_000", "env.size=210")

Compose = Callable[..., Config]
Sweep = Callable[..., subprocess.Popen[bytes]]


@pytest.fixture
def sweep(tiny_overrides: tuple[str, ...], tmp_path: Path) -> Iterator[Sweep]:
    """Starts a sweep as a shell does, in a process group of its own; what it prints is in `printed.txt`."""
    started = []

    def start(*overrides: str) -> subprocess.Popen[bytes]:
        chosen = [word for word in tiny_overrides if word != "tracking=none"]
        words = replaced(chosen, f"paths.outputs={tmp_path / 'o'}", *overrides)
        command = (sys.executable, "-m", "atlantis_exp", "-m", *words)
        environment = {key: value for key, value in os.environ.items() if key != "OMP_NUM_THREADS"}
        with open(tmp_path / "printed.txt", "w") as printed:
            process = subprocess.Popen(
                command,
                cwd=REPOSITORY,
                env=environment,
                stdout=printed,
                stderr=printed,
                start_new_session=True,
            )
        started.append(process)
        return process

    yield start
    for process in started:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def holder(folder: RunFolder) -> int:
    """The process that trains a run."""
    return int((folder.path / "holder.txt").read_text().split()[1])


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 150
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.1)


def trains(folder: RunFolder) -> bool:
    commit = read_commit(folder.path)
    return folder.state == "running" and commit is not None and commit.offset > 0


def statuses(config: Config) -> list[str]:
    """Of the runs in MLflow, by the time of their making, the sweep first."""
    with closing(sqlite3.connect(Path(config.paths.outputs) / "mlflow.db")) as database:
        query = "SELECT status FROM runs ORDER BY name LIKE 'sweep%' DESC, name"
        return [status for (status,) in database.execute(query)]


@pytest.fixture
def seeds(tiny: Compose, tmp_path: Path) -> Callable[..., list[Config]]:
    """The configs of the sweep seed=0,1,2."""
    return lambda *words: [
        dataclasses.replace(tiny(*words), seed=seed, paths=PathsConfig(outputs=str(tmp_path / "o")))
        for seed in (0, 1, 2)
    ]


def test_the_launcher_of_a_command_line_is_known_and_a_wrong_setting_is_one_line() -> None:
    words = ["seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=3"]
    assert launcher(["-m", "seed=0,1"]) == BASIC
    assert launcher(["-m", *words]) == Launcher("joblib", {"n_jobs": 3})
    with pytest.raises(ConfigError, match=r"^hydra.launcher.n_jobs=many: should be an integer, as -1$"):
        launcher(["-m", "seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jobs=many"])
    with pytest.raises(ConfigError, match=r"n_jbos=3: no such key; did you mean 'hydra.launcher.n_jobs'"):
        check("config", Config, ["-m", "seed=0,1", "hydra/launcher=joblib", "hydra.launcher.n_jbos=3"])
    with pytest.raises(ConfigError, match=r"^hydra.launcher.n_jobs=2: sets up a launcher; add hydra/launcher=joblib"):
        launcher(["-m", "seed=0,1", "hydra.launcher.n_jobs=2"])
    with pytest.raises(ConfigError, match=r"_target_=os.system: no such key"):  # which would be run
        check("config", Config, ["-m", "seed=0,1", "hydra/launcher=joblib", "hydra.launcher._target_=os.system"])


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("hydra.launcher.setup='module load cuda'", "a list"),
        ("hydra.launcher.additional_parameters=requeue", "a mapping"),
        ("hydra.launcher.stderr_to_stdout=3", "true or false"),
        ("hydra.launcher.name.first=x", "text"),
    ],
)
def test_a_setting_of_slurm_has_the_kind_of_its_default(text: str, kind: str) -> None:
    settings = OmegaConf.load(CONF / "hydra" / "launcher" / "slurm.yaml")
    assert isinstance(settings, DictConfig)
    with pytest.raises(ConfigError, match=f"^{re.escape(text)}: should be {kind}, as "):
        _set_up(settings, read_override(text))
    for fitting_one in ("setup=[x]", "additional_parameters={}", "additional_parameters.exclusive=true", "gres=gpu:1"):
        _set_up(settings, read_override(f"hydra.launcher.{fitting_one}"))
    assert settings.setup == ["x"]
    assert settings.additional_parameters == {"requeue": True, "exclusive": True}


def test_jobs_in_turn_print_every_error_and_raise_the_first(capsys: pytest.CaptureFixture[str]) -> None:
    def work(job: int) -> int | None:
        if job < 3:
            raise Fault(f"job {job} fails")
        return None if job == 3 else signal.SIGTERM

    with pytest.raises(Fault, match="job 1 fails"):
        in_turn(work, [1, 2, 3], terminal.warn)
    assert capsys.readouterr().err == "atlantis_exp: job 2 fails\n"
    with pytest.raises(SystemExit, match="143"):
        in_turn(work, [1, 4], terminal.warn)
    assert capsys.readouterr().err == "atlantis_exp: job 1 fails\n"


def test_jobs_of_one_run_are_never_trained_side_by_side(
    command: Callable[..., int],
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    words = [*replaced(tiny_overrides, f"paths.outputs={tmp_path / 'o'}", "budget.forecast=off"), "budget.steps=80,160"]
    assert command("-m", *words, "hydra/launcher=joblib") == 2
    last = "budget.steps={}"
    error = capsys.readouterr().err
    assert f"{last.format(160)}: makes the same run as " in error
    assert error.endswith(f"{last.format(80)}; continue it in turn, with hydra/launcher=basic\n")
    assert not (tmp_path / "o").exists()
    launchers: list[Launcher] = []
    monkeypatch.setattr("atlantis_exp.sessions.sweep.sweep", lambda _, chosen, *__: launchers.append(chosen))
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    assert command("-m", *words) == 0
    assert command("-m", *words, "hydra/launcher=basic") == 0
    assert launchers == [BASIC, BASIC]


@pytest.mark.parametrize(
    ("n_jobs", "at_once", "share"), [(1, 1, 8), (2, 2, 4), (3, 3, 2), (16, 3, 2), (-1, 3, 2), (-7, 2, 4), (-99, 1, 8)]
)
def test_jobs_that_are_left_share_the_cores_of_the_machine(
    tiny: Compose, recorded: Callable[..., Path], n_jobs: int, at_once: int, share: int
) -> None:
    jobs = [Job(tiny(f"seed={seed}")) for seed in range(4)]
    recorded("seed=3")
    assert shared(8, n_jobs, jobs) == (at_once, share)


@pytest.mark.parametrize(
    ("words", "machine", "at_once", "cores"),
    [
        ((), (10, 2, 2, 64, False), 2, 1),
        ((), (10, 16, 16, 64, False), 10, 1),
        ((), (3, 16, 16, 64, False), 3, 5),
        ((), (10, 16, 16, 64, True), 4, 4),
        ((), (10, 1, 1, 64, False), 1, 1),
        ((), (10, 16, 16, 5, False), 4, 4),  # memory for four
        ((), (10, 16, 16, 1, False), 1, 16),
        ((), (10, 16, 4, 64, False), 4, 4),  # OMP_NUM_THREADS=4
        (("threads=4",), (10, 16, 16, 64, False), 4, 4),
        (("env.workers=8",), (10, 16, 16, 64, False), 2, 8),
        (("threads=32",), (10, 16, 16, 64, False), 1, 16),
        ((*ROOMY, "replay.max_bytes=2_147_483_648"), (10, 16, 16, 16, False), 5, 3),
        ((*ROOMY, "replay.max_bytes=268_435_456"), (10, 16, 16, 16, False), 10, 1),
        ((*ROOMY, "replay.max_bytes=2_147_483_648", "budget.steps=999"), (10, 16, 16, 16, False), 10, 1),
    ],
)
def test_as_many_trainings_go_on_at_a_time_as_the_machine_runs_well(
    tiny: Compose, words: tuple[str, ...], machine: tuple[int, int, int, int, bool], at_once: int, cores: int
) -> None:
    planned, there, own, gigabytes, on_gpu = machine
    words = ("threads=null", *words) if not any(word.startswith("threads") for word in words) else words
    memory = gigabytes * 2**30
    assert fitted([tiny(*words)], planned, there, own, memory, memory, on_gpu) == (at_once, cores)
    assert fitted([tiny(*words)], planned, there, own, memory, 2**30, on_gpu) == (1, cores)  # beside another program


def test_a_training_has_as_many_cores_when_it_goes_on_after_others_have_ended(
    tiny: Compose, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    jobs = [Job(tiny(f"seed={seed}")) for seed in range(4)]
    assert fitting(jobs, 4) == fitting(jobs[:1], 4) == Launcher("joblib", {"n_jobs": 4, "cores": 2})
    assert fitting(jobs[:1], 1) == BASIC
    with monkeypatch.context() as beside_another_program:
        memory = SimpleNamespace(total=2**40, available=2**30)
        beside_another_program.setattr("psutil.virtual_memory", lambda: memory)
        assert fitting(jobs, 4) == Launcher("joblib", {"n_jobs": 1, "cores": 2})
    told: list[str] = []

    class Ends(FakeProcess):
        def __init__(self, _: list[str], env: dict[str, str], **__: object) -> None:
            told.append(env["OMP_NUM_THREADS"])

    monkeypatch.setattr(subprocess, "Popen", Ends)
    for seed in range(3):
        recorded(f"seed={seed}")
    train_side_by_side(jobs, fitting(jobs, 4))
    assert told == ["2"]


class FakeProcess:
    """A process that ends at once."""

    code = 0

    def wait(self) -> int:
        return self.code


def test_jobs_side_by_side_are_told_their_share_unless_a_person_has_said_one(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, str]] = []

    class Ends(FakeProcess):
        def __init__(self, _: list[str], env: dict[str, str], **__: object) -> None:
            told.append((env["OMP_NUM_THREADS"], env["ATLANTIS_EXP_JOB_OF"]))

    monkeypatch.setattr(subprocess, "Popen", Ends)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    jobs = [Job(tiny(f"seed={seed}")) for seed in range(2)]
    train_side_by_side(jobs, Launcher("joblib", {"n_jobs": 2}))
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    train_side_by_side(jobs, Launcher("joblib", {"n_jobs": 2}))
    assert told == [("4", "joblib")] * 2 + [("3", "joblib")] * 2


def test_the_table_follows_the_commits_of_runs(
    tiny: Compose, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    jobs = [Job(tiny(f"seed={seed}")) for seed in (0, 1)]
    folders = [RunFolder.of(job.config) for job in jobs]
    folder = folders[0]
    shown = io.StringIO()
    with folder.held():
        journal = Journal(folder.path)
        folder.write_config({})
        journal.status("RUNNING")
        table = LiveTable(jobs, folders, Console(file=shown, width=200))
        for step in (40, 80):
            journal.metrics({"throughput/steps_per_second": 20.0, "throughput/hours": step / 7_200}, step)
            journal.metrics({"score/episode": 100.0 * step}, step)
            journal.state_dict()
            journal.commit()
            table.look()
            journal.metrics({"score/episode": -1.0}, step + 1)  # which no commit covers yet
            journal.state_dict()
            with monkeypatch.context() as later:
                now = time.time()
                later.setattr(time, "time", lambda now=now: now + 2)  # less is left, which is no news
                table.look()
    recorded("seed=1")
    table.look()
    drawn = io.StringIO()
    LiveTable(jobs, folders, Console(file=drawn, width=120, force_terminal=True)).look()
    assert "80 of 160 steps" in drawn.getvalue()
    lines = shown.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["running", "running", "interrupted", "done"]
    assert "80 of 160 steps" in lines[1]
    assert "20 steps/s" in lines[1]
    assert "left 0:00:0" in lines[1]  # at the speed shown; at the mean, a machine long busy, it would be 40 seconds
    assert "last score 8,000" in lines[1]


def test_a_damaged_journal_leaves_the_other_runs_in_the_table(tiny: Compose) -> None:
    jobs = [Job(tiny(f"seed={seed}")) for seed in (0, 1)]
    folders = [RunFolder.of(job.config) for job in jobs]
    for folder in folders:
        journal = Journal(folder.path)
        folder.write_config({})
        journal.metrics({"score/episode": 100.0}, 40)
        journal.finish()
    (folders[0].path / "journal.jsonl").write_bytes(b"x" * 200 + b"\n")
    shown = io.StringIO()
    LiveTable(jobs, folders, Console(file=shown, width=200)).look()
    assert "40 of 160 steps" in shown.getvalue()


def test_a_job_may_print_bytes_that_are_no_text_and_its_last_line_says_why_it_failed(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Prints(FakeProcess):
        def __init__(self, *_: object, stdout: io.TextIOWrapper, **__: object) -> None:
            os.write(stdout.fileno(), b"\xff\n" * 6_000 + b"atlantis_exp: no room \xff\n")

    monkeypatch.setattr(subprocess, "Popen", Prints)
    job, alone = Job(tiny()), Launcher("joblib", {"n_jobs": 1})
    train_side_by_side([job], alone)
    monkeypatch.setattr(Prints, "code", 2)
    with pytest.raises(Fault, match=": no room \N{REPLACEMENT CHARACTER}; see "):
        train_side_by_side([job], alone)


@pytest.mark.parametrize("code", [-signal.SIGKILL, 1])
def test_a_job_whose_process_dies_after_its_run_has_ended_is_not_marked(
    tiny: Compose, recorded: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    job = Job(tiny())

    class Dies(FakeProcess):
        def __init__(self, *_: object, **__: object) -> None:
            recorded()
            self.code = code

    monkeypatch.setattr(subprocess, "Popen", Dies)
    with pytest.raises(Fault, match=RunFolder.of(job.config).name):
        train_side_by_side([job], Launcher("joblib", {"n_jobs": 1}))
    assert RunFolder.of(job.config).state == "done"


@pytest.mark.slow
def test_jobs_side_by_side_fail_and_are_killed_alone_and_the_same_command_runs_what_is_missing(
    sweep: Sweep, seeds: Callable[..., list[Config]], tiny: Compose, tmp_path: Path
) -> None:
    words = (*FREQUENT, "phase.quick.steps=400")
    configs = seeds(*words)
    killed, failing, whole = (RunFolder.of(config) for config in configs)
    failing.path.mkdir(parents=True)
    (failing.path / "checkpoints").write_text("in the way")
    command = (*words, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1,2")
    process = sweep(*command)
    wait_for(lambda: trains(killed))
    os.kill(holder(killed), signal.SIGKILL)
    assert process.wait(timeout=200) == 128 + signal.SIGKILL  # of the first job that did not end well
    printed = (tmp_path / "printed.txt").read_text()
    assert f"interrupted {killed.name}: killed by SIGKILL" in printed
    assert f"failed      {failing.name}: " in printed
    assert f"({failing.path / 'traceback.txt'})" in printed
    assert (failing.path / "traceback.txt").read_text().startswith("Traceback")
    assert whole.state == "done"
    assert statuses(configs[0]) == ["FAILED", "KILLED", "FAILED", "FINISHED"]
    artifacts = Path(configs[0].paths.outputs, "artifacts").rglob("traceback.txt")
    assert [path.read_text() for path in artifacts] == [(failing.path / "traceback.txt").read_text()]

    (failing.path / "checkpoints").unlink()
    files = {path: path.stat().st_mtime_ns for path in whole.path.rglob("checkpoints/*")}
    assert sweep(*command).wait(timeout=200) == 0, (tmp_path / "printed.txt").read_text()
    assert statuses(configs[0]) == ["FINISHED"] * 4
    assert {path: path.stat().st_mtime_ns for path in whole.path.rglob("checkpoints/*")} == files
    paths = PathsConfig(outputs=str(tmp_path / "u"))
    unbroken = dataclasses.replace(tiny(*words, "tracking=none"), paths=paths)
    train(Job(unbroken))
    assert fingerprints(configs[0], tmp_path / "o") == fingerprints(unbroken, tmp_path / "u")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["interrupted", "terminated", "killed"])
def test_the_end_of_a_sweep_commits_its_jobs(sweep: Sweep, seeds: Callable[..., list[Config]], how: str) -> None:
    configs = seeds(*LONG)
    folders = [RunFolder.of(config) for config in configs]
    process = sweep(*LONG, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2", "seed=0,1,2")
    wait_for(lambda: all(trains(folder) for folder in folders[:2]))
    if how == "interrupted":
        os.killpg(process.pid, signal.SIGINT)
    else:
        os.kill(process.pid, signal.SIGTERM if how == "terminated" else signal.SIGKILL)
    assert process.wait(timeout=60) == {"interrupted": 130, "terminated": 143, "killed": -signal.SIGKILL}[how]
    wait_for(lambda: not any(folder.is_held for folder in folders))
    assert [folder.state for folder in folders] == ["interrupted", "interrupted", "queued"]
    assert [folder.status for folder in folders[:2]] == ["KILLED", "KILLED"]
    if how != "killed":
        assert statuses(configs[0]) == ["KILLED"] * 3
