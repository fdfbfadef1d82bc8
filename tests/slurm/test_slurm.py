"""Sweeps on a real Slurm, which preempts, requeues, times out and cancels their jobs."""

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
from datetime import datetime, timedelta
from importlib.util import find_spec
from pathlib import Path

import pytest

from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.contracts import fingerprints
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.launchers import Launcher
from atlantis_exp.sessions.launchers.slurm import submit
from atlantis_exp.sessions.training import train

Compose = Callable[..., Config]
REPOSITORY = Path(__file__).parents[2]
COMMAND = (sys.executable, "-m", "atlantis_exp")
HAS_PLUGIN = find_spec("submitit") is not None
LAUNCHER = (
    *("hydra/launcher=slurm", "hydra.launcher.cpus_per_task=1", "hydra.launcher.mem_gb=1"),
    *("hydra.launcher.timeout_min=10", "hydra.launcher.signal_delay_s=10"),
)
# What a process does with SQLite the interpreter itself tells, in a file, with the job that it belongs to.
AUDIT = """\
import os, sys

def tell(event, arguments=()):
    if event in ("start", "sqlite3.connect"):
        with open({log!r}, "a") as file:
            print(os.environ.get("SLURM_JOB_ID", "here"), event, file=file)

tell("start")
sys.addaudithook(tell)
"""


@pytest.fixture(scope="module")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    """The environment in which a real Slurm of this machine alone answers."""
    if missing := [name for name in ("slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]:
        pytest.skip(f"no {', '.join(missing)}: apt-get install slurmctld slurmd slurm-client")
    if not HAS_PLUGIN:
        pytest.skip("no submitit: pip install -e '.[slurm]'")
    folder = tmp_path_factory.mktemp("slurm")
    cluster = subprocess.Popen(
        (sys.executable, Path(__file__).with_name("cluster.py"), folder), stdout=subprocess.PIPE, text=True
    )
    assert cluster.stdout is not None
    assert cluster.stdout.readline().startswith("export SLURM_CONF=")
    yield {**os.environ, "SLURM_CONF": f"{folder}/slurm.conf", "PATH": f"{folder}/bin:{os.environ['PATH']}"}
    cluster.terminate()
    cluster.wait()


def wait_for(condition: Callable[[], bool]) -> None:
    patience = time.monotonic() + 120
    while not condition():
        assert time.monotonic() < patience
        time.sleep(0.05)


def refusal(*launcher: str) -> str:
    with pytest.raises(ConfigError) as error:
        check("config", Config, ["-m", "seed=0,1", "hydra/launcher=slurm", *launcher])
    return str(error.value)


@pytest.mark.skipif(HAS_PLUGIN, reason="submitit is installed")
def test_slurm_without_its_extra_is_one_line_that_names_it() -> None:
    assert refusal() == "hydra/launcher=slurm: needs pip install 'atlantis-exp[slurm]'"


@pytest.mark.skipif(not HAS_PLUGIN, reason="no submitit: pip install -e '.[slurm]'")
def test_slurm_where_there_is_none_and_wrong_settings_are_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert refusal() == "hydra/launcher=slurm: srun is not installed; submit from a node of the cluster"
    (tmp_path / "srun").write_text("#!/bin/sh")
    (tmp_path / "srun").chmod(0o755)
    assert refusal("hydra.launcher.partion=x").startswith(
        "hydra.launcher.partion=x: no such key; did you mean 'hydra.launcher.partition'?"
    )
    assert refusal("hydra.launcher.timeout_min=abc") == "hydra.launcher.timeout_min=abc: should be an integer, as 240"


@pytest.mark.skipif(not HAS_PLUGIN, reason="no submitit: pip install -e '.[slurm]'")
def test_who_stops_waiting_for_jobs_is_told_that_they_go_on(
    tiny: Compose, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    import submitit

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(submitit.AutoExecutor, "map_array", interrupted)
    monkeypatch.setattr(submitit.AutoExecutor, "__init__", lambda *_, **__: None)
    monkeypatch.setattr(submitit.AutoExecutor, "update_parameters", lambda *_, **__: None)
    with pytest.raises(SystemExit) as left:
        submit([Job(tiny())], Launcher("slurm", {"max_num_timeout": 1}), lambda _: None)
    assert left.value.code == 130
    assert capsys.readouterr().err == (
        "atlantis_exp: the jobs go on; python -m atlantis_exp sync publishes their runs\n"
    )


@pytest.mark.slow
@pytest.mark.timeout(600)  # seconds
def test_jobs_that_are_preempted_requeued_timed_out_or_cancelled_end_as_the_unbroken_runs(
    tiny: Compose,
    tiny_overrides: tuple[str, ...],
    slurm: dict[str, str],
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> None:
    chosen = ("phase.quick.steps=1_000", "evaluation.every_steps=null", "tracking=mlflow", "tracking.commit_seconds=1")
    configs = [tiny(*chosen, f"seed={seed}") for seed in range(4)]
    folders = [RunFolder.of(config) for config in configs]
    (tmp_path / "sitecustomize.py").write_text(AUDIT.format(log=str(tmp_path / "told")))
    environment = {**slurm, "PYTHONPATH": str(tmp_path)}
    overrides = replaced(tiny_overrides, *chosen, f"paths.outputs={tmp_path}", "seed=0,1,2,3", *LAUNCHER)
    command = (*COMMAND, "train", "-m", *overrides)

    def say(*words: str) -> str:
        return subprocess.run(words, env=slurm, check=True, capture_output=True, text=True).stdout

    def job(array: str, seed: int) -> dict[str, str]:
        return dict(re.findall(r"(\w+)=(\S*)", say("scontrol", "show", "job", "-o", f"{array}_{seed}")))

    sweep = subprocess.Popen(
        command, cwd=REPOSITORY, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    request.addfinalizer(sweep.kill)
    running = set(range(4))

    def halt_those_that_have_committed() -> bool:  # so that none ends before its misfortune, however fast the machine
        assert sweep.poll() is None
        for seed in list(running):
            if list(folders[seed].path.glob("checkpoints/0*/manifest.json")):
                process = (folders[seed].path / "holder.txt").read_text().split()[1]
                os.kill(int(process), signal.SIGSTOP)  # Slurm sends a SIGCONT with each signal of its own
                running.remove(seed)
        return not running

    wait_for(halt_those_that_have_committed)
    array = say("squeue", "-h", "-o", "%F").split()[0]
    say("sbatch", "--partition=high", "--output=/dev/null", "--wrap=true")  # all four processors are taken
    wait_for(lambda: any(job(array, seed)["Restarts"] != "0" for seed in range(4)))
    preempted = next(seed for seed in range(4) if job(array, seed)["Restarts"] != "0")
    timed_out, requeued, cancelled = (seed for seed in range(4) if seed != preempted)
    soon = datetime.now() + timedelta(seconds=35)
    say("scontrol", "update", f"JobId={array}_{timed_out}", f"EndTime={soon:%FT%T}")
    say("scontrol", "requeue", f"{array}_{requeued}")
    say("scancel", f"{array}_{cancelled}")
    out, error = sweep.communicate()

    assert sweep.returncode == 1
    assert f"atlantis_exp: Job {array}_{cancelled}" in error
    assert "(state: CANCELLED)" in error
    assert out.splitlines()[-1] == "sweep of 4 runs: 3 done, 1 interrupted"
    assert f"  interrupted {folders[cancelled].name}" in out.splitlines()

    def printed(seed: int) -> str:
        return next(tmp_path.glob(f"sweeps/*/{array}_{seed}/*.out")).read_text()

    for seed in (preempted, timed_out, requeued):
        assert f"continuing run {folders[seed].name} at step" in printed(seed)
        assert job(array, seed)["Restarts"] != "0"
    for seed in (preempted, timed_out):
        assert f"atlantis_exp: SIGUSR2: run {folders[seed].name} is committed at step" in printed(seed)
    for seed in (requeued, cancelled):
        assert "SIGTERM: committed at step" in printed(seed)

    again = subprocess.run(command, cwd=REPOSITORY, env=environment, check=True, capture_output=True, text=True)
    assert again.stdout.splitlines()[-1] == "sweep of 4 runs: 4 done"
    for config in configs:
        unbroken = tiny(*chosen, f"seed={config.seed}", "tracking=none", f"paths.outputs={tmp_path}/unbroken")
        train(Job(unbroken))
        assert fingerprints(config, tmp_path) == fingerprints(unbroken, tmp_path / "unbroken")

    told = [line.split() for line in (tmp_path / "told").read_text().splitlines()]
    assert len({process for process, _ in told}) >= 1 + 2 * 4  # jobs, which keep their number when they are requeued
    assert {process for process, event in told if event == "sqlite3.connect"} == {"here"}
    with closing(sqlite3.connect(tmp_path / "mlflow.db")) as database:
        states = database.execute("SELECT status FROM runs").fetchall()
        evaluated = database.execute("SELECT run_uuid FROM latest_metrics WHERE key = 'evaluation/mean'").fetchall()
    assert states == 5 * [("FINISHED",)]  # the runs and their sweep
    assert len(evaluated) == 4
    compared = subprocess.run(
        (*COMMAND, "compare", "by=model", f"paths.outputs={tmp_path}"), cwd=REPOSITORY, capture_output=True, text=True
    )
    assert compared.returncode == 0, compared.stderr
    assert "cnn" in compared.stdout


@pytest.mark.slow
@pytest.mark.timeout(600)  # seconds
def test_a_decision_has_slurm_train_what_it_needs_with_a_sampler_from_a_file(
    tiny_overrides: tuple[str, ...], slurm: dict[str, str], tmp_path: Path
) -> None:
    chosen = (
        *("plugins=examples/paying.py", "sampler=paying", "env.max_steps=100,900", "seeds=5"),
        *("phase.quick.steps=40", "training.learn_every=10"),
        *("evaluation.every_steps=null", "evaluation.epsilon=0.5", "evaluation.seed=${seed}", "evaluation.episodes=4"),
    )
    words = replaced(tiny_overrides, *chosen, f"paths.outputs={tmp_path}", *LAUNCHER)
    decided = subprocess.run(
        (*COMMAND, "decide", *words), cwd=REPOSITORY, env=slurm, capture_output=True, text=True, check=False
    )
    assert decided.returncode == 0, decided.stdout + decided.stderr
    assert "max_steps=900 plays better than max_steps=100 by" in decided.stdout
    configs = [json.loads(path.read_bytes()) for path in tmp_path.glob("runs/*/config.json")]
    assert sorted(config["seed"] for config in configs) == sorted(2 * list(range(5)))
    assert {config["sampler"]["name"] for config in configs} == {"paying"}
    assert len(list(tmp_path.glob("sweeps/*/*/*.out"))) == 10
