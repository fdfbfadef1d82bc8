"""A component that breaks a promise is found out, and the promise named."""

import re
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp import documents, terminal
from atlantis_exp.commands import CHECKOUT
from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.check import CheckConfig, _work
from atlantis_exp.commands.overrides import check
from atlantis_exp.components import KINDS, admit
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.sessions import contracts as contracts_module
from atlantis_exp.sessions.contracts import _train, contracts_of
from atlantis_exp.sessions.contracts import check as check_contracts
from atlantis_exp.sessions.job import Job, replaced

Command = Callable[..., int]
Compose = Callable[..., Config]

PARTS = """
import random

import numpy as np
import torch
from torch import nn

from atlantis_exp.components import component
from atlantis_exp.learning.objectives import DQN, bootstrapped
from atlantis_exp.replay.samplers import Draw


@component("mine", "model")
class Mine(nn.Module):
    splits_batches = True

    def __init__(self, input_shape, num_actions, head):
        super().__init__()
        channels, *_ = input_shape
        self.layers = nn.Sequential(nn.AdaptiveAvgPool2d(4), nn.Flatten(), nn.Linear(16 * channels, 16), nn.ReLU())
        self.head = head(16, num_actions)

    def forward(self, x):
        return self.head(self.layers(x))


@component("mine", "objective")
class Same(DQN):
    pass


@component("mine", "sampler")
class Every:
    drawn = 0

    def sample(self, memory, batch_size, rng):
        self.drawn += 1
        return Draw(np.sort(memory.draw(batch_size + self.drawn, rng))[:batch_size], None)

    def feed_back(self, ids, errors):
        pass

    def state_dict(self):
        return {"drawn": self.drawn}

    def load_state_dict(self, state):
        self.drawn = state["drawn"]


@component("mine", "epsilon", "lr_schedule")
class Half:
    def __call__(self, progress, steps):
        return 0.5
"""
CHOSEN = ("model=mine", "objective=mine", "sampler=mine", "epsilon=mine", "lr_schedule=mine")
FORWARD = "    def forward(self, x):"
SEQUENCE = """    units, burn_in, unroll = 4, 1, 2

    def sequence(self, x, h, first):
        return torch.stack([self(x[:, t]) for t in range(x.shape[1])], 1), h

"""
BREACHES = [  # what a part is replaced by, and the contracts that it breaks
    ("", "", ()),
    ("nn.ReLU())", "nn.Dropout(0.5))", ("draws no global random numbers", "a split batch gives the same values")),
    ("nn.Flatten(),", "nn.BatchNorm2d(4), nn.Flatten(),", ("a split batch gives the same values",)),
    ("head(16, num_actions)", "nn.Linear(16, num_actions)", ("learns: quantile",)),
    ("head(16, num_actions)", "head(16, num_actions + 1)", ("learns: plain",)),
    ("self.layers(x)", "self.layers(x.double())", ("learns: plain, 84 pixels, fp32",)),
    (
        "self.layers = ",
        "self.level = float(torch.ones(1).sum()); self.layers = ",
        ("loads its saved weights, also on meta",),
    ),
    (FORWARD, SEQUENCE + FORWARD, ()),
    (FORWARD, SEQUENCE.replace("units", "size") + FORWARD, ("a sequence is its steps",)),
    (FORWARD, SEQUENCE.replace("1), h", "1) + h.sum(), h") + FORWARD, ("a sequence is its steps",)),
    ("self.head(self", "random.random() * self.head(self", ("draws no global random numbers",)),
    (
        "(DQN):\n    pass",
        "(DQN):\n    def losses(self, *given):\n        return super().losses(*given).mean()",
        ("one finite target",),
    ),
    (
        *(
            "(DQN):\n    pass",
            "(DQN):\n    def targets(self, r, s, d, online, target):\n        return r + target(s).mean(1)",
        ),
        ("at discount 0",),
    ),
    ('{"drawn": self.drawn}', '{"drawn": 0}', ("continues from its saved state",)),
    ("[:batch_size], None", ", None", ("draws available transitions",)),
    ("return 0.5", "return 1.5 - progress", ("in [0, 1]",)),
    ("return 0.5", "return 0.5 - progress", ("in [0, 1]", "finite, not negative")),
]


@pytest.fixture(autouse=True)
def _nothing_is_admitted_afterwards() -> Iterator[None]:
    yield
    admit([])


@pytest.mark.thinned(3)
@pytest.mark.parametrize(("part", "instead", "contracts"), BREACHES, ids=[instead for _, instead, _ in BREACHES])
def test_a_breach_is_named(
    part: str, instead: str, contracts: tuple[str, ...], tmp_path: Path, tiny_overrides: tuple[str, ...]
) -> None:
    assert part in PARTS
    (tmp_path / "mine.py").write_text(PARTS.replace(part, instead, 1))
    ((_, config),) = check("config", Config, [*tiny_overrides, f"plugins={tmp_path / 'mine.py'}", *CHOSEN]).items()
    broken = set()
    for _, contract, trial in contracts_of(config, Job(config), KINDS):
        if not contract.startswith("killed"):  # which takes processes
            try:
                trial()
            except Exception:
                broken.add(contract)
    for wanted in contracts:
        assert any(contract.startswith(wanted) for contract in broken), broken
    assert bool(broken) == bool(contracts)


def test_what_is_broken_is_said_before_anything_is_measured() -> None:
    not_measured: Any = {"model=mine": None}
    with pytest.raises(Fault, match=r"^broken: model=mine: learns$"):
        check_contracts(iter([("model=mine", "learns", partial(int, "x"))]), not_measured)


def test_a_training_that_fails_while_it_is_measured_is_broken_and_the_others_are_shown(
    monkeypatch: pytest.MonkeyPatch, tiny: Compose, capsys: pytest.CaptureFixture[str]
) -> None:
    def cost(name: str, *_: object) -> documents.Cost:
        if name == "model=late":
            raise ZeroDivisionError("of 16")
        numbers = dict.fromkeys(("pixels", "parameters"), 7)
        rates = dict.fromkeys(("flops_per_sample", "updates_per_second", "steps_per_second"), 7.0)
        return documents.Cost(component=name, **numbers, **rates)

    monkeypatch.setattr(contracts_module, "_cost", cost)
    job = Job(tiny("training.batch_size=16"))
    with pytest.raises(Fault, match=r"^broken: model=late: learns from batches of 16 \(ZeroDivisionError: of 16\)$"):
        check_contracts(iter(()), {"model=late": job, "model=cnn": job})
    assert "model=cnn" in capsys.readouterr().out


def test_how_many_contracts_are_left_is_said_while_one_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    asked, said = list[Callable[[], str]](), list[str]()

    def working(_: str, how_far: Callable[[], str]) -> AbstractContextManager[None]:
        asked.append(how_far)
        return nullcontext()

    monkeypatch.setattr(terminal, "working", working)
    check_contracts(iter([(part, "learns", lambda: said.append(asked[0]())) for part in ("mine", "all")]), {})
    assert said == ["contract 1 of 2: mine: learns", "contract 2 of 2: all: learns"]


@pytest.mark.parametrize(
    ("chosen", "tried", "measured"),
    [
        (("sampler=mine",), {"sampler=mine"}, ["sampler=mine", "sampler=uniform"]),
        (("objective=mine",), {"objective=mine"}, ["objective=mine", "objective=dqn"]),
        (("model=mine",), {"model=mine"}, ["model=mine", "model=cnn", "model=resnet"]),
        (("epsilon=mine",), {"epsilon=mine"}, ["epsilon=mine", "epsilon=exponential"]),
        (("env=pong",), {"env.id=ALE/Pong-v5"}, ["env=pong", "env=atlantis_standard"]),
        (
            ("model=mine", "lr_schedule=mine"),
            {"model=mine", "lr_schedule=mine"},
            ["model=mine\nlr_schedule=mine", "model=cnn", "model=resnet", "lr_schedule=constant"],
        ),
        (("model=cnn",), {"model=cnn"}, ["model=cnn", "model=resnet"]),
    ],
)
def test_components_that_are_named_are_tried_and_no_others(
    chosen: tuple[str, ...], tried: set[str], measured: list[str], tmp_path: Path, tiny_overrides: tuple[str, ...]
) -> None:
    (tmp_path / "mine.py").write_text(PARTS)
    words = [text for text in tiny_overrides if text.partition("=")[0] not in KINDS]
    plugins = f"plugins=[{tmp_path / 'mine.py'},{CHECKOUT / 'examples' / 'pong.py'}]"
    ((overrides, config),) = check("check", CheckConfig, [*words, plugins, *chosen]).items()
    call: Any = _work(Asked(config, "check", overrides))
    contracts, jobs = call.args
    assert {part for part, *_ in contracts} == {*tried, "all"}
    assert [*jobs] == measured
    assert {job.config.env.size for job in jobs.values()} == {40}


def test_a_training_that_fails_amid_the_contracts_is_said_with_its_last_line(tmp_path: Path, tiny: Compose) -> None:
    with pytest.raises(Fault, match=r"a session failed: .*model=none: no such option"):
        _train(Job(tiny(), overrides=("model=none",)), tmp_path)


@pytest.mark.slow
def test_a_training_that_is_continued_otherwise_breaks_the_contract(
    tmp_path: Path, tiny_overrides: tuple[str, ...]
) -> None:
    lost = PARTS.replace('{"drawn": self.drawn}', '{"drawn": 0}', 1)
    (tmp_path / "mine.py").write_text(lost)
    words = [*tiny_overrides, f"plugins={tmp_path / 'mine.py'}", "sampler=mine"]
    ((overrides, config),) = check("config", Config, words).items()
    call: Any = _work(Asked(config, "check", overrides))
    *_, (part, _, resumes) = call.args[0]
    assert part == "all"
    with pytest.raises(Fault, match="differ"):
        resumes()


@pytest.mark.slow
def test_the_table_says_what_is_kept_and_what_it_costs(
    command: Command,
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    said, working = list[str](), terminal.working

    def noting(what: str, how_far: Callable[[], str] = str) -> AbstractContextManager[None]:
        said.append(what)
        return working(what, how_far)

    monkeypatch.setattr(terminal, "working", noting)
    (tmp_path / "mine.py").write_text(PARTS)
    words = [*tiny_overrides, f"plugins={tmp_path / 'mine.py'}", *CHOSEN, f"paths.outputs={tmp_path / 'outputs'}"]
    assert command("check", *words) == 0
    shown = capsys.readouterr().out
    assert "BROKEN" not in shown
    assert re.search(r"killed and continued equals unbroken, bit for bit +│ kept", shown)
    assert re.search(r"│ model=mine +│ learns: plain, [^│]+│ kept │", shown)  # from the left
    names = ("model=mine", "model=cnn", "model=resnet", "sampler=uniform", "objective=dqn")
    assert [re.search(rf"│ {name} +│ +40 │ +[\d,]+ │", shown) is not None for name in names] == [True] * 5
    assert not (tmp_path / "outputs").exists()
    costs = [each for each in said if "costs" in each]
    assert costs == [f"measuring costs, {number} of {len(costs)}" for number in range(1, len(costs) + 1)]
    assert len(costs) >= len(names)
    (tmp_path / "mine.py").write_text(PARTS.replace("return 0.5", "return 7"))
    assert command("check", *replaced(words, "model=cnn")) == 1
    assert "broken: epsilon=mine: in [0, 1]" in capsys.readouterr().err
