"""A package with a component to begin with: class, YAML, test, README and entry point."""

from pathlib import Path

from atlantis_exp.checking import check_new
from atlantis_exp.components import ENTRY_POINTS
from atlantis_exp.terminal import PROGRAM

_MODEL = '''"""The network {name}."""

from typing import Annotated

import torch
from annotated_types import Interval
from torch import nn

from atlantis_exp.components import component
from atlantis_exp.networks.heads import Head

Width = Annotated[int, Interval(ge=1, le=512)]


@component("{name}", "model")
class {title}(nn.Module):
    """States (B, C, H, W) in [0, 1] to what the head returns."""

    smallest_side = 8  # pixels
    splits_batches = True  # no batch statistics, no dropout

    def __init__(self, input_shape: tuple[int, int, int], num_actions: int, head: Head, *, width: Width = 16) -> None:
        super().__init__()
        channels, height, side = input_shape
        self.features = nn.Sequential(nn.Conv2d(channels, width, kernel_size=8, stride=8), nn.ReLU(), nn.Flatten())
        self.head = head(width * (height // 8) * (side // 8), num_actions)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        q: torch.Tensor = self.head(self.features(x))
        return q
'''
_SAMPLER = '''"""The sampler {name}."""

from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from annotated_types import Interval

from atlantis_exp.components import component
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import Draw

Oversample = Annotated[int, Interval(ge=1, le=64)]


@component("{name}", "sampler")
class {title}:
    """The newest of `oversample` times the batch."""

    def __init__(self, *, oversample: Oversample = 2) -> None:
        self.oversample = oversample

    def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
        ids = np.sort(memory.draw(self.oversample * batch_size, rng))
        return Draw(ids[-batch_size:], None)

    def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
        """The errors of a batch that had weights."""

    def state_dict(self) -> dict[str, Any]:
        return {{}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
'''
_OBJECTIVE = '''"""The objective {name}."""

from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval
from torch.nn.functional import huber_loss

from atlantis_exp.components import component
from atlantis_exp.learning.objectives import DQN, taken


@component("{name}", "objective")
@dataclass(frozen=True)
class {title}(DQN):
    """DQN's targets, and a Huber loss that turns at `delta`."""

    delta: Annotated[float, Interval(gt=0)] = 1.0

    def losses(self, q: torch.Tensor, a_t: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        return huber_loss(taken(q, a_t), target, reduction="none", delta=self.delta)
'''
_SCHEDULE = '''"""The schedule {name}."""

from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from atlantis_exp.components import component

Share = Annotated[float, Interval(ge=0, le=1)]


@component("{name}", "{kind}")
@dataclass(frozen=True)
class {title}:
    """From `start` to `end` in one step, half way."""

    start: Share = 1.0
    end: Share = 0.1

    def __call__(self, progress: float, steps: int) -> float:
        return self.start if progress < 0.5 else self.end
'''
_CLASSES = {
    "model": (_MODEL, "width: 16"),
    "sampler": (_SAMPLER, "oversample: 2"),
    "objective": (_OBJECTIVE, "delta: 1.0"),
    "epsilon": (_SCHEDULE, "start: 1.0\nend: 0.1"),
    "lr_schedule": (_SCHEDULE, "start: 1.0\nend: 0.1"),
}
_PROJECT = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "{distribution}"
version = "0.1.0"
description = "A component of atlantis_exp: {kind}={name}"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["atlantis-exp"]

[project.entry-points."{group}"]
{name} = "{package}.{name}"
"""
_README = """# {distribution}

    pip install -e .
    python -m atlantis_exp {kind}={name} plugins={distribution} --cfg job
    python -m atlantis_exp check {kind}={name} plugins={distribution}     # does it keep what the rest relies on?
    python -m atlantis_exp {kind}={name} plugins={distribution} experiment=quick

Without installing it: `plugins=./{package}/{name}.py`. Settings are the constructor's arguments, their values in
`{package}/conf/{kind}/{name}.yaml`.
"""
_TEST = '''"""It keeps what atlantis_exp relies on."""

import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "{package}" / "{name}.py"


def test_it_keeps_every_contract() -> None:
    subprocess.run([sys.executable, "-m", "atlantis_exp", "check", "{kind}={name}", f"plugins={{SOURCE}}"], check=True)
'''


def begin(kind: str, name: str, folder: Path) -> None:
    """Write a package whose component plays, and say what to do with it. Raises: ConfigError."""
    check_new("to", folder)
    source, values = _CLASSES[kind]
    words = {
        "kind": kind,
        "name": name,
        "title": "".join(part.capitalize() for part in name.split("_")),
        "package": f"atlantis_{name}",
        "distribution": f"atlantis-{name.replace('_', '-')}",
        "group": ENTRY_POINTS,
    }
    package = folder / words["package"]
    files = {
        folder / "pyproject.toml": _PROJECT,
        folder / "README.md": _README,
        folder / "tests" / f"test_{name}.py": _TEST,
        package / "__init__.py": '"""A component of atlantis_exp: {kind}={name}."""\n',
        package / f"{name}.py": source,
        package / "conf" / kind / f"{name}.yaml": f"{values}\n",
    }
    for path, text in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.format_map(words))
        print(path)
    print(f"\n{PROGRAM} check {kind}={name} plugins={package / name}.py")
