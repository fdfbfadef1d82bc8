import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import Any
from urllib.request import urlopen
from uuid import uuid4

import pytest
from filelock import FileLock
from hydra import compose, initialize_config_dir
from hypothesis import settings
from omegaconf import DictConfig
from rich.console import Console

from atlantis_exp.build import build_trainer
from atlantis_exp.checking import to_dict
from atlantis_exp.commands import CONF, main
from atlantis_exp.commands.composing import checked
from atlantis_exp.components import facts_of
from atlantis_exp.config import Config
from atlantis_exp.runs.folder import Result, RunFolder, evaluation_at
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.tracking.store import Store
from atlantis_exp.training.evaluation import Episode, Evaluation
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Trainer

Serving = AbstractContextManager[None]

for _name in ("COLUMNS", "FORCE_COLOR", "LINES", "NO_COLOR", "TERM", "TTY_COMPATIBLE", "TTY_INTERACTIVE"):
    os.environ.pop(_name, None)  # rich's, of the terminal that the tests are started in

settings.register_profile("untimed", deadline=None)  # a busy machine must not fail a test
settings.load_profile("untimed")

TINY = (  # all features of a training, in seconds
    *("experiment=quick", "device=cpu", "threads=1", "budget.forecast=off"),
    *("tracking=none", "tracking.every_steps=20", "tracking.histogram_episodes=500"),
    *("env.size=40", "env.max_steps=40", "phase.quick.steps=160", "replay.capacity=120", "replay.max_bytes=4_194_304"),
    *("training.learn_start=20", "training.learn_every=4", "training.batch_size=4", "training.precision=fp32"),
    *("evaluation.episodes=2", "evaluation.num_envs=1", "evaluation.every_steps=80", "evaluation.video=false"),
)


@pytest.hookimpl(tryfirst=True)  # pytest's own deselects the slow ones
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    cases: Counter[str] = Counter()
    for item in items:
        if thinned := item.get_closest_marker("thinned"):
            test = item.nodeid.partition("[")[0]
            if cases[test] % thinned.args[0]:
                item.add_marker(pytest.mark.slow)
            cases[test] += 1


@pytest.fixture(scope="session")
def free_port() -> Callable[[], int]:
    """Return a function that finds a free port."""

    def found() -> int:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port: int = probe.getsockname()[1]
        return port

    return found


@pytest.fixture(scope="session")
def answering() -> Callable[..., None]:
    """Return a function that waits for an MLflow server: `answering(process, port)`."""

    def wait(process: "subprocess.Popen[Any]", port: int, seconds: float = 120) -> None:
        patience = time.monotonic() + seconds
        while True:
            try:
                urlopen(f"http://127.0.0.1:{port}/health", timeout=5)
                return
            except OSError:
                assert process.poll() is None
                assert time.monotonic() < patience
                time.sleep(0.1)

    return wait


@pytest.fixture(scope="session")
def mlflow_tables(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], None]:
    """Return a function that gives a folder a database with MLflow's tables: `mlflow_tables(folder)`.

    Creating them takes seconds, so a session's workers copy a shared one.
    """
    own = tmp_path_factory.getbasetemp()
    template = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "tables.db"

    def made() -> None:
        aside = tmp_path_factory.mktemp("tables") / "mlflow.db"
        from mlflow import MlflowClient

        MlflowClient(f"sqlite:///{aside}").get_experiment_by_name("atlantis")
        aside.replace(template)

    def put(folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / "mlflow.db").exists():
            return
        with FileLock(template.with_suffix(".lock")):
            if not template.exists():
                made()
        aside = folder / f"{uuid4().hex}.db"
        shutil.copyfile(template, aside)
        with suppress(FileExistsError):  # another thread was faster
            os.link(aside, folder / "mlflow.db")
        aside.unlink()

    return put


@pytest.fixture(scope="session", autouse=True)
def _logs_stay_open() -> Iterator[None]:
    """Keep logging handlers open when a command runs in this process: pytest's stderr would close with absl's."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(logging, "shutdown", lambda *_: None)  # Hydra calls it first
        yield


_CONNECTION = Store.__dict__["_connection"]
_connect = _CONNECTION.func


@pytest.fixture(scope="session", autouse=True)
def _stores_have_tables(
    tmp_path_factory: pytest.TempPathFactory, mlflow_tables: Callable[[Path], None]
) -> Iterator[None]:
    """Give local stores of this process, in pytest's folder, their tables."""

    def connect(store: Store) -> object:
        with suppress(OSError):  # left to the store itself
            if store.is_local and store._root.is_relative_to(tmp_path_factory.getbasetemp()):
                mlflow_tables(store._root)
        return _connect(store)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(_CONNECTION, "func", connect)
        yield


@pytest.fixture
def stores_without_tables(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let stores create their own tables, as outside of tests."""
    monkeypatch.setattr(_CONNECTION, "func", _connect)


@pytest.fixture
def outputs(tmp_path: Path, mlflow_tables: Callable[[Path], None]) -> Path:
    """Return an outputs folder whose database has MLflow's tables, for commands in other processes."""
    mlflow_tables(tmp_path / "outputs")
    return tmp_path / "outputs"


@pytest.fixture(scope="session")
def mlflow_server(
    answering: Callable[..., None], mlflow_tables: Callable[[Path], None]
) -> Callable[[Path, int], Serving]:
    """Return a context manager of a server on a folder's store, which ends by SIGKILL."""

    @contextmanager
    def serving(folder: Path, port: int) -> Iterator[None]:
        mlflow_tables(folder)
        files = ("--artifacts-destination", f"{folder}/artifacts")
        store = ("--backend-store-uri", f"sqlite:///{folder}/mlflow.db", *files)
        process = subprocess.Popen(
            (sys.executable, "-m", "mlflow", "server", "--port", str(port), "--workers", "1", *store),
            env={**os.environ, "MLFLOW_SERVER_ENABLE_JOB_EXECUTION": "false"},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # it has a process that serves
        )
        try:
            answering(process, port)
            yield
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()

    return serving


@cache  # Hydra takes a third of a second
def _composed(*overrides: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [*TINY, *overrides])


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., Config]:
    """Return a function that composes a training of seconds: `tiny("model=resnet", "seed=1")`."""

    def composed(*overrides: str) -> Config:
        seeds = [override for override in overrides if re.fullmatch(r"seed=\d+", override)]
        config = _composed(*(override for override in overrides if override not in seeds)).copy()
        if seeds:
            config.seed = int(seeds[-1].removeprefix("seed="))
        if not any(override.startswith("paths.outputs=") for override in overrides):
            config.paths.outputs = str(tmp_path)
        return checked(Config, config)

    return composed


@pytest.fixture(scope="session")
def tiny_overrides() -> tuple[str, ...]:
    """Return the overrides of `tiny`, for another process."""
    return TINY


@pytest.fixture
def started() -> Iterator[Callable[[Config, Path], Trainer]]:
    """Return a function that builds a trainer and continues from a folder's checkpoint, as the command does."""
    trainers = []

    def trainer_of(config: Config, folder: Path) -> Trainer:
        set_up_torch(config, config.device)
        trainer = build_trainer(config, 1, folder, Journal(folder), Progress(Console(quiet=True)))
        trainers.append(trainer)
        if (state := trainer.checkpoints.load(trainer.memory)) is not None:
            trainer.load_state_dict(state)
        return trainer

    yield trainer_of
    for trainer in trainers:
        trainer.emulators.close()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait less for a folder that another process holds."""
    monkeypatch.setattr("atlantis_exp.runs.folder._HOLD_SECONDS", 0.1)


@pytest.fixture
def recorded(tiny: Callable[..., Config]) -> Callable[..., Path]:
    """Return a function that writes the folder of a finished training without training it.

    scores are its evaluation's; curve has (frames, hours, updates, mean score) a point.
    """

    def record(
        *overrides: str,
        scores: Sequence[float] = (1_000.0, 2_000.0, 3_000.0, 4_000.0),
        curve: Sequence[tuple[float, float, float, float]] = ((0, 0, 0, 1_000), (600, 0.5, 30, 2_000)),
        flops: int | None = 100,
        truncated: int = 0,
        steps: int = 160,
        outcome: str = "finished",
        updates: int = 0,
    ) -> Path:
        config = tiny(*overrides)
        counts: dict[str, float] = {"updates": updates, "flops": updates * (flops or 0)} if updates else {}
        game = facts_of(config.game)
        folder = RunFolder.of(config)
        journal = Journal(folder.path)
        folder.write_config(to_dict(config))
        if flops is not None:
            journal.tags({"flops_per_update": str(flops)})
        for frames, hours, learned, score in curve:
            point = {"throughput/frames": frames, "throughput/hours": hours, "learning/updates": learned}
            journal.metrics({**point, "score/mean_100": score, "actions/epsilon": 0.5}, int(frames) // 3)
        episodes = [
            Episode(
                *(index, score, 12, index < truncated, bytearray([0, 1, 2, 3]), bytearray([0, 0, 0, 1])),
                points=[0.0, score / 4, 0.0, 0.0, score * 3 / 4][: len(game.sources)],
            )
            for index, score in enumerate(scores)
        ]
        evaluation = Evaluation(config.evaluation.epsilon, episodes, game)
        journal.artifact(evaluation_at(steps), evaluation.table().to_csv().encode())
        journal.finish()
        folder.write_result(Result(outcome, steps, counts, evaluation.metrics(), evaluation.report()))
        return folder.path

    return record


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Return a function that runs a command line and returns its exit code: `command("evaluate", "run=latest")`."""

    def run(*words: str) -> int:
        monkeypatch.setattr(sys, "argv", ["atlantis_exp", *words])
        try:
            main()
        except SystemExit as ended:
            return int(str(ended.code))
        return 0

    return run
