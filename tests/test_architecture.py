"""Imports go down only, and each outside library stays in its room."""

import ast
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "atlantis_exp"
FLOORS = {
    **dict.fromkeys(
        ("game", "replay", "networks", "learning", "tracking", "statistics", "config", "media", "faults"), 1
    ),
    **dict.fromkeys(("training", "comparison"), 2),
    "build": 3,
    "commands": 4,
    "__main__": 5,
}
MODULES_ON_THE_GROUND = {"statistics", "config", "media", "faults"}
ROOMS = {  # the only places that may import a library
    "mlflow": ("tracking.store",),
    "hydra": ("commands",),
    "omegaconf": ("commands",),
    "torch": ("networks", "learning", "training", "build", "commands.train"),
}


def arrows(source: str) -> set[str]:
    """Every module that a source text imports, inside functions and type checking blocks too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            if node.level:
                found.add("." * node.level)
            elif node.module == "atlantis_exp":
                found |= {f"atlantis_exp.{alias.name}" for alias in node.names}
            else:
                found.add(str(node.module))
    return found


def violations(module: str, source: str) -> list[str]:
    """What a module, named without the package, may not import."""
    wing = module.split(".")[0]
    faults = []
    for name in sorted(arrows(source)):
        library, *inside = name.split(".")
        if library == "":
            faults.append(f"{module} imports relatively")
        elif library != "atlantis_exp":
            rooms = ROOMS.get(library)
            if rooms and not any(module == room or module.startswith(f"{room}.") for room in rooms):
                faults.append(f"{module} imports {library}")
        elif inside and inside[0] != wing:
            other = inside[0]
            up = FLOORS[other] > FLOORS[wing]
            aside = FLOORS[other] == FLOORS[wing] > 1
            between_wings = FLOORS[other] == FLOORS[wing] == 1 and (
                wing in MODULES_ON_THE_GROUND or other not in MODULES_ON_THE_GROUND or other == "config"
            )
            if up or aside or between_wings:
                faults.append(f"{module} imports {name}")
    return faults


MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path != PACKAGE / "__init__.py"
}


@pytest.mark.parametrize("module", MODULES)
def test_no_arrow_goes_up_or_across_and_libraries_stay_in_their_rooms(module: str) -> None:
    assert violations(module, MODULES[module].read_text()) == []


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        (
            "game.vector",
            "from atlantis_exp.training.actor import Actor",
            "game.vector imports atlantis_exp.training.actor",
        ),
        ("game.vector", "from atlantis_exp import build", "game.vector imports atlantis_exp.build"),
        (
            "game.vector",
            "def f():\n    import atlantis_exp.replay.memory",
            "game.vector imports atlantis_exp.replay.memory",
        ),
        ("replay.memory", "from atlantis_exp.config import Config", "replay.memory imports atlantis_exp.config"),
        ("statistics", "from atlantis_exp.media import film", "statistics imports atlantis_exp.media"),
        (
            "training.trainer",
            "import atlantis_exp.comparison.gather",
            "training.trainer imports atlantis_exp.comparison.gather",
        ),
        ("training.trainer", "if TYPE_CHECKING:\n    from mlflow import log_metric", "training.trainer imports mlflow"),
        ("tracking.journal", "import mlflow.tracking", "tracking.journal imports mlflow"),
        ("build", "from omegaconf import OmegaConf", "build imports omegaconf"),
        ("build", "from atlantis_exp.commands import VERBS", "build imports atlantis_exp.commands"),
        ("config", "def f():\n    import hydra", "config imports hydra"),
        ("config", "import torch", "config imports torch"),
        ("comparison.figures", "import torch.nn", "comparison.figures imports torch"),
        ("game.vector", "from . import emulator", "game.vector imports relatively"),
    ],
)
def test_the_check_catches_a_planted_arrow(module: str, source: str, fault: str) -> None:
    assert violations(module, source) == [fault]


def test_the_check_lets_arrows_down_pass() -> None:
    assert violations("commands.train", "import hydra\nfrom atlantis_exp.build import build_trainer") == []
    assert violations("training.trainer", "from atlantis_exp.media import film") == []
    assert violations("game.vector", "from atlantis_exp.game.emulator import Emulator") == []
    assert violations("tracking.store", "import mlflow") == []
