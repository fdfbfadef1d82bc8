from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from rich.console import Console

from atlantis_exp.build import build_trainer
from atlantis_exp.commands.app import CONF, checked
from atlantis_exp.config import Config
from atlantis_exp.tracking.journal import Journal
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Trainer

TINY = (  # everything that a training can do, in seconds
    *("experiment=quick", "device=cpu", "threads=1", "tracking=none", "tracking.every_steps=20", "budget.forecast=off"),
    *("env.size=40", "env.max_steps=40", "phase.quick.steps=160", "replay.capacity=120", "replay.max_bytes=4_194_304"),
    *("training.learn_start=20", "training.learn_every=4", "training.batch_size=4", "training.precision=fp32"),
    *("evaluation.episodes=2", "evaluation.num_envs=1", "evaluation.every_steps=80", "evaluation.video=false"),
)


@pytest.fixture
def tiny(tmp_path: Path) -> Callable[..., Config]:
    """Composes a config of a training of seconds: `tiny("model=resnet", "seed=1")`."""

    def composed(*overrides: str) -> Config:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return checked(Config, compose("config", [*TINY, f"paths.outputs={tmp_path}", *overrides]))

    return composed


@pytest.fixture
def tiny_overrides() -> tuple[str, ...]:
    """What `tiny` composes with, for a process of its own."""
    return TINY


@pytest.fixture
def started() -> Iterator[Callable[[Config, Path], Trainer]]:
    """Builds a trainer in a folder and continues from the checkpoint there, as the command does."""
    trainers = []

    def trainer_of(config: Config, folder: Path) -> Trainer:
        trainer = build_trainer(config, folder, Journal(folder), Progress(Console(quiet=True)))
        trainers.append(trainer)
        if (state := trainer.checkpoints.load(trainer.memory)) is not None:
            trainer.load_state_dict(state)
        return trainer

    yield trainer_of
    for trainer in trainers:
        trainer.emulators.close()
