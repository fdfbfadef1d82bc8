"""What makes two baselines the same."""

from pathlib import Path

from hydra import compose, initialize_config_dir

from atlantis_exp.commands import CONF
from atlantis_exp.commands.baseline import BaselineConfig
from atlantis_exp.commands.composing import checked


def composed(outputs: Path, *overrides: str) -> BaselineConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(BaselineConfig, compose("baseline", [f"paths.outputs={outputs}", "agent=constant", *overrides]))


def test_the_identity_of_a_baseline_depends_on_its_player_and_not_on_its_processes(tmp_path: Path) -> None:
    identity = composed(tmp_path).identity()
    assert composed(tmp_path / "elsewhere", "env.workers=2", "tracking=none").identity() == identity
    for override in ("agent=random", "agent.action=2", "evaluation.seed=1", "env=atlantis_v5"):
        assert composed(tmp_path, override).identity() != identity
