"""Imports go down only, each outside library stays in its room, and the gradient is few calls away."""

import ast
import re
import traceback
from collections.abc import Callable, Iterator, Mapping, Set
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
import torch

from atlantis_exp.learning.learner import Learner

PACKAGE = Path(__file__).resolve().parents[1] / "atlantis_exp"
WINGS = {"game", "replay", "networks", "learning"}  # which know nothing of each other, nor of any config
MODULES = {"config", "checking", "components", "faults", "registry", "decision", "statistics", "media", "terminal"}
GROUND = WINGS | MODULES
MAY: dict[str, Set[str]] = {  # whatever else of the package each may import
    **dict.fromkeys(("faults", "registry", "decision", "statistics", "media", "terminal"), frozenset[str]()),
    "checking": {"faults"},
    "components": {"checking", "faults", "registry"},
    "config": {"checking", "components", "faults"},
    **dict.fromkeys(WINGS, MODULES - {"config", "checking"}),
    "runs": MODULES,
    "tracking": {"runs"} | MODULES,
    "training": {"runs"} | GROUND - {"config"},  # the trainer is handed built parts
    "comparison": {"runs"} | MODULES,
    "build": {"tracking", "training", "runs"} | GROUND,
    "sessions": {"build", "comparison", "tracking", "training", "runs"} | GROUND,
    "commands": {"sessions", "build", "comparison", "tracking", "training", "runs"} | GROUND,
    "__main__": {"commands"},
}
ROOMS = {  # the only places that may name a library, or read what a person typed
    "mlflow": ("tracking.store",),
    "hydra": ("commands",),
    "omegaconf": ("commands",),
    "sys.argv": ("commands",),
    "atlantis_exp.components.admit": ("commands",),  # nothing but a command line lets a plugin in
    "torch": ("networks", "learning", "training", "build", "sessions"),
    "safetensors.torch": ("networks", "learning", "training", "build", "sessions"),
}
FILES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
    if path != PACKAGE / "__init__.py"
}


def imported(node: ast.AST) -> Iterator[str]:
    """What an import statement names: modules, and what is taken from them."""
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        yield from (f"{'.' * node.level}{node.module or ''}.{alias.name}" for alias in node.names)


def arrows(source: str) -> set[str]:
    """Everything that a source text imports, inside functions and type checking blocks too, and `sys.argv`."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        found |= {*imported(node)}
        if isinstance(node, ast.Attribute) and ast.unparse(node) == "sys.argv":
            found.add("sys.argv")
    return found


def is_in(name: str, places: tuple[str, ...]) -> bool:
    return any(name == place or name.startswith(f"{place}.") for place in places)


def violations(module: str, source: str) -> list[str]:
    """What a module, named without the package, may not import."""
    wing = module.split(".")[0]
    faults = []
    for name in sorted(arrows(source)):
        top, *inside = name.split(".")
        if top == "":
            faults.append(f"{module} imports relatively")
        elif top == "atlantis_exp" and inside and inside[0] not in MAY[wing] | {wing}:
            faults.append(f"{module} imports {inside[0]}")
        else:
            room = next((room for room in ROOMS if is_in(name, (room,))), None)
            if room and not is_in(module, ROOMS[room]):
                faults.append(f"{module} imports {room}")
    return list(dict.fromkeys(faults))


@pytest.mark.parametrize("module", FILES)
def test_no_arrow_goes_up_or_across_and_libraries_stay_in_their_rooms(module: str) -> None:
    assert violations(module, FILES[module].read_text()) == []


@pytest.mark.parametrize(
    ("module", "source", "fault"),
    [
        ("game.vector", "from atlantis_exp.training.actor import Actor", "game.vector imports training"),
        ("game.vector", "from atlantis_exp import build", "game.vector imports build"),
        ("game.vector", "def f():\n    import atlantis_exp.replay.memory", "game.vector imports replay"),
        ("game.vector", "from . import emulator", "game.vector imports relatively"),
        ("replay.memory", "from atlantis_exp.config import Config", "replay.memory imports config"),
        ("learning.learner", "from atlantis_exp.checking import parse", "learning.learner imports checking"),
        ("networks.cnn", "from atlantis_exp.learning import learner", "networks.cnn imports learning"),
        ("statistics", "from atlantis_exp.media import film", "statistics imports media"),
        ("faults", "from atlantis_exp.checking import nearest", "faults imports checking"),
        ("checking", "from atlantis_exp.config import Config", "checking imports config"),
        ("config", "from atlantis_exp.runs.folder import RunFolder", "config imports runs"),
        ("config", "def f():\n    import hydra", "config imports hydra"),
        ("config", "import torch", "config imports torch"),
        ("runs.folder", "from atlantis_exp.tracking.store import Store", "runs.folder imports tracking"),
        ("runs.episodes", "from atlantis_exp.game.emulator import Emulator", "runs.episodes imports game"),
        ("runs.journal", "import mlflow.tracking", "runs.journal imports mlflow"),
        ("runs.journal", "from torch import save", "runs.journal imports torch"),
        ("tracking.publishing", "from mlflow import MlflowClient", "tracking.publishing imports mlflow"),
        ("tracking.store", "from atlantis_exp.training import trainer", "tracking.store imports training"),
        ("training.trainer", "import atlantis_exp.comparison.gather", "training.trainer imports comparison"),
        ("training.trainer", "import atlantis_exp.tracking.store", "training.trainer imports tracking"),
        ("training.trainer", "from atlantis_exp.config import Config", "training.trainer imports config"),
        ("training.trainer", "if TYPE_CHECKING:\n    from mlflow import log_metric", "training.trainer imports mlflow"),
        ("comparison.gather", "from atlantis_exp.training import evaluation", "comparison.gather imports training"),
        ("comparison.figures", "import torch.nn", "comparison.figures imports torch"),
        ("comparison.figures", "from safetensors.torch import load", "comparison.figures imports safetensors.torch"),
        ("build", "from omegaconf import OmegaConf", "build imports omegaconf"),
        ("build", "from atlantis_exp.comparison import tables", "build imports comparison"),
        ("build", "from atlantis_exp.commands import VERBS", "build imports commands"),
        ("sessions.training", "from atlantis_exp.commands.app import Verb", "sessions.training imports commands"),
        ("sessions.launchers.ray", "import hydra", "sessions.launchers.ray imports hydra"),
        ("sessions.job", "import sys\ncommand = sys.argv[1:]", "sessions.job imports sys.argv"),
        (
            *("sessions.cards", "from atlantis_exp.components import admit"),
            "sessions.cards imports atlantis_exp.components.admit",
        ),
        ("sessions.job", "from sys import argv", "sessions.job imports sys.argv"),
        ("commands.train", "import torch", "commands.train imports torch"),
        ("commands.train", "from atlantis_exp import __main__", "commands.train imports __main__"),
    ],
)
def test_the_check_catches_a_planted_arrow(module: str, source: str, fault: str) -> None:
    assert violations(module, source) == [fault]


def test_the_check_lets_arrows_down_pass() -> None:
    assert violations("commands.train", "import hydra\nfrom atlantis_exp.build import build_trainer") == []
    assert violations("training.trainer", "from atlantis_exp.media import film") == []
    assert violations("training.recorder", "from atlantis_exp.runs.journal import Tracker") == []
    assert violations("game.vector", "from atlantis_exp.game.emulator import Emulator") == []
    assert violations("networks.cnn", "import torch\nfrom atlantis_exp.components import component") == []
    assert violations("tracking.store", "import mlflow") == []
    assert violations("sessions.comparing", "from atlantis_exp.tracking.publishing import publishing") == []
    assert violations("sessions.job", "import sys, safetensors.numpy\nsys.exit(1)") == []


def loaded(tree: ast.AST) -> Iterator[str]:
    """What a module imports when it is loaded: nothing in functions, nothing for type checkers alone."""
    yield from imported(tree)
    inner = [*ast.iter_child_nodes(tree)]
    if isinstance(tree, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
        inner = []
    elif isinstance(tree, ast.If) and ast.unparse(tree.test) == "TYPE_CHECKING":
        inner = [*tree.orelse]
    for node in inner:
        yield from loaded(node)


def circle(sources: Mapping[str, str]) -> list[str]:
    """The modules, named without the package, of a circle in which each needs the next to be loaded; none without."""
    needs = {}
    for module, source in sources.items():
        ours = [name for name in loaded(ast.parse(source)) if name.startswith("atlantis_exp.")]
        names = [name.removeprefix("atlantis_exp.") for name in ours]
        needs[module] = {name if name in sources else name.rpartition(".")[0] for name in names} & sources.keys()
    try:
        TopologicalSorter(needs).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_no_file_needs_one_that_needs_it() -> None:
    assert circle({module: path.read_text() for module, path in FILES.items()}) == []


@pytest.mark.parametrize(
    ("back", "is_circle"),
    [
        ("from atlantis_exp.runs.folder import RunFolder", True),
        ("from atlantis_exp.runs import folder", True),
        ("import atlantis_exp.runs.folder", True),
        ("class A:\n    from atlantis_exp.runs import folder", True),
        ("try:\n    pass\nexcept OSError:\n    import atlantis_exp.runs.folder", True),
        ("if not TYPE_CHECKING:\n    import atlantis_exp.runs.folder", True),
        ("if TYPE_CHECKING:\n    import atlantis_exp.runs.folder", False),
        ("def f():\n    import atlantis_exp.runs.folder", False),
        ("class A:\n    def f(self):\n        import atlantis_exp.runs.folder", False),
        ("from atlantis_exp.runs import other", False),
    ],
)
def test_a_planted_circle_is_found(back: str, is_circle: bool) -> None:
    sources = {"runs.folder": "import atlantis_exp.runs.lock", "runs.lock": "from atlantis_exp.faults import Fault"}
    sources |= {"runs": "", "runs.other": "", "faults": back}
    assert bool(circle(sources)) == is_circle


class Reached(BaseException):
    """The gradient is."""


def calls_of_ours(error: BaseException) -> list[str]:
    """The functions of the package that a traceback passes, the outermost first."""
    codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
    return [code.co_name for code in codes if Path(code.co_filename).is_relative_to(PACKAGE)]


def test_the_gradient_is_six_calls_of_ours_from_the_command_line(
    command: Callable[..., int], tiny_overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_reached(*_: object, **__: object) -> None:
        raise Reached

    monkeypatch.setattr(torch.Tensor, "backward", raise_reached)
    monkeypatch.setattr(Learner, "update_flops", lambda *_: 0)  # which makes an update to count its operations
    with pytest.raises(Reached) as reached:
        command(*tiny_overrides, f"paths.outputs={tmp_path}")
    assert calls_of_ours(reached.value) == ["main", "run", "train", "run", "update", "_gradients"]


def test_files_that_the_pages_name_are_there() -> None:
    root = PACKAGE.parent
    pages = [root / "README.md", root / "CONTRIBUTING.md", root / "SECURITY.md", *(root / "docs").glob("*.md")]
    named = {
        (page.name, path)
        for page in pages
        for path in re.findall(r"`((?:tests|benchmarks|docs|conf|atlantis_exp)/[\w./]+)`", page.read_text())
    }
    assert len(named) > 20
    assert {(page, path) for page, path in named if not (root / path).exists()} == set()
