"""Imports go down only, the gradient is few calls away, and a config climbs seldom on its way there."""

import logging.config
import re
import sys
import tomllib
import traceback
from collections.abc import Callable
from dataclasses import is_dataclass
from itertools import pairwise
from pathlib import Path
from types import FrameType

import pytest
import torch
from importlinter.cli import lint_imports

from atlantis_exp import config
from atlantis_exp.config import Config
from atlantis_exp.learning.learner import Learner
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train

PACKAGE = Path(__file__).resolve().parents[1] / "atlantis_exp"


def test_imports_keep_the_contracts_of_pyproject(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(logging.config, "dictConfig", lambda _: None)  # it would silence later tests' loggers
    assert lint_imports(str(PACKAGE.parent / "pyproject.toml"), no_cache=True) == 0


class Reached(BaseException):
    """The gradient is."""


def calls_of_ours(error: BaseException) -> list[str]:
    """The functions of the package that a traceback passes, the outermost first."""
    codes = [frame.f_code for frame, _ in traceback.walk_tb(error.__traceback__)]
    return [code.co_name for code in codes if Path(code.co_filename).is_relative_to(PACKAGE)]


def test_the_gradient_is_seven_calls_of_ours_from_the_command_line(
    command: Callable[..., int], tiny_overrides: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def raise_reached(*_: object, **__: object) -> None:
        raise Reached

    monkeypatch.setattr(torch.Tensor, "backward", raise_reached)
    monkeypatch.setattr(Learner, "update_flops", lambda *_: 0)  # which makes an update to count its operations
    with pytest.raises(Reached) as reached:
        command(*tiny_overrides, f"paths.outputs={tmp_path}")
    assert calls_of_ours(reached.value) == ["main", "run", "train", "run", "update", "_map_shards", "_gradients"]


def floors() -> dict[str, int]:
    """The floor of each top-level module, the ground 0, as the first contract of pyproject.toml stacks them."""
    contract, *_ = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    layers = [layer.split(" | ") for layer in reversed(contract["layers"])]
    return {module: floor for floor, layer in enumerate(layers) for module in layer}


def test_a_config_is_handed_up_fewer_than_ten_times_before_the_gradient(
    tiny: Callable[..., Config], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A climb: a function is handed a job, a config or a part of one after a function of a lower floor was."""
    parts: tuple[type, ...] = (
        Job,
        *(each for each in vars(config).values() if isinstance(each, type) and is_dataclass(each)),
    )
    visited: list[str] = []

    def note(frame: FrameType, event: str, _: object) -> None:
        code, path = frame.f_code, Path(frame.f_code.co_filename)
        if event == "call" and path.is_relative_to(PACKAGE):
            handed = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
            if any(isinstance(frame.f_locals.get(name), parts) for name in handed if name != "self"):
                visited.append(path.relative_to(PACKAGE).parts[0].removesuffix(".py"))

    def reach(*_: object, **__: object) -> None:
        raise Reached

    monkeypatch.setattr(torch.Tensor, "backward", reach)
    job = Job(tiny())
    sys.setprofile(note)
    try:
        with pytest.raises(Reached):
            train(job)
    finally:
        sys.setprofile(None)
    floor = [floors()[module] for module in visited]
    climbs = sum(after > before for before, after in pairwise(floor))
    assert visited[0] == "sessions"
    assert {"build", "runs"} <= {*visited}
    assert climbs < 10


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
