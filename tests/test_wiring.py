"""From the command line to the built part: every option of every group becomes what it names, with its own values."""

import io
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import psutil
import pytest
import torch
from hydra import compose, initialize_config_dir
from rich.console import Console

from atlantis_exp.build import build_baseline, build_plan, make_emulator
from atlantis_exp.commands import CONF
from atlantis_exp.commands.baseline import BaselineConfig
from atlantis_exp.commands.composing import checked
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.journal import NullJournal
from atlantis_exp.sessions.job import replaced
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.progress import Pace, Progress
from atlantis_exp.training.recorder import Played, Recorder
from atlantis_exp.training.trainer import Trainer

Command = Callable[..., int]
Started = Callable[[Config, Path], Trainer]

RETURNS = "Returns(gamma=0.99, n_step=1, scale=1.0, exponent=1.0, clip=None)"
FURTHER_RETURNS = "Returns(gamma=0.997, n_step=5, scale=1.0, exponent=1.0, clip=None)"
ADAM = {"lr": 1e-3, "betas": (0.9, 0.999), "eps": 1e-8, "fused": True}
RMSPROP = {"centered": True, "weight_decay": 0, "foreach": True}
TARGET = {"tau": 1e-4, "target_every": 1, "target_mode": "eval"}
FIELD = (0, 160, 210, 0)  # the whole screen
OBSERVED = {"crop": (16, 160, 96, 0), "sticky": 0.25, "max_frames": 108_000, "noop_max": 0}
RECORDED = {"curve_steps": 1_000, "histogram_episodes": 500, "commit_episodes": 100, "commit_seconds": 120.0}
BUILT: dict[str, dict[str, Any]] = {  # group, option: what it builds
    "model": {"cnn": "DQNCnn", "cnn_small": "SmallCnn", "resnet": "ResNetDQN", "resnet_fast": "ResNetFast"},
    "objective": {
        "dqn": {"class": "DQN", "outputs": 4, "returns": RETURNS, **TARGET},
        "double_dqn": {"class": "DoubleDQN", "outputs": 4, "returns": RETURNS, **TARGET},
        "quantile": {"class": "Quantile", "outputs": 4 * 51, "returns": RETURNS, **TARGET},
        "double_quantile": {"class": "DoubleQuantile", "outputs": 4 * 51, "returns": RETURNS, **TARGET},
        "rescaled_double_dqn": {"class": "RescaledDoubleDQN", "outputs": 4, "returns": FURTHER_RETURNS, **TARGET},
        "rescaled_quantile": {"class": "RescaledQuantile", "outputs": 4 * 51, "returns": FURTHER_RETURNS, **TARGET},
    },
    "optimizer": {
        "adam": {"class": "Adam", "weight_decay": 0.0, **ADAM},
        "adamw": {"class": "AdamW", "weight_decay": 0.01, **ADAM},
        "rmsprop": {"class": "RMSprop", "lr": 2.5e-4, "alpha": 0.95, "eps": 0.003125, "momentum": 0.0, **RMSPROP},
    },
    "lr_schedule": {
        "constant": "Constant(value=1.0)",
        "linear": "Linear(start=1.0, end=0.0, duration=1.0)",
        "one_cycle": "OneCycle(start=0.04, end=4e-06, rise=0.3)",
    },
    "epsilon": {
        "constant": "Constant(value=0.1)",
        "exponential": "Exponential(start=0.9, end=0.02, decay=0.5)",
        "linear": "Linear(start=1.0, end=0.01, duration=0.1)",
        "linear_steps": "LinearSteps(start=1.0, end=0.05, steps=150000)",
    },
    "sampler": {
        "uniform": ("UniformSampler", {}),
        "top_half": ("TopHalfSampler", {"oversample": 2}),
        "prioritized": ("PrioritizedSampler", {"alpha": 0.5, "beta": 0.5}),
    },
    "env": {
        "atlantis_v0": {**OBSERVED, "frameskip": (2, 5), "max_steps": 27_000, "max_pool": False},
        "atlantis_v5": {**OBSERVED, "frameskip": 4, "max_steps": None, "max_pool": False},
        "atlantis_standard": {**OBSERVED, "crop": FIELD, "frameskip": 4, "max_steps": None, "max_pool": True},
    },
    "phase": {
        "brief": ("steps", [("single", 300_000, 0.5, "TopHalfSampler")]),
        "quick": ("steps", [("quick", 3_000, 0.5, "TopHalfSampler")]),
        "single": ("episodes", [("single", 2_000, 0.5, "TopHalfSampler")]),
        "steps": ("steps", [("single", 4_000_000, 0.5, "TopHalfSampler")]),
        "two_phase": (
            "episodes",
            [("first", 10_000, 0.5, "UniformSampler"), ("second", 10_000, 3e-4, "TopHalfSampler")],
        ),
    },
    "replay": {"million": {"capacity": 1_000_000, "stack": 4}},
    "training": {"report": {"learn_every": 10, "learn_start": 10_000, "batch_size": 32, "ema": None}},
    "evaluation": {
        "quick": {"evaluate_episodes": None, "evaluate_steps": None, "interim_episodes": 5, "final_episodes": 5},
        "report": {"evaluate_episodes": 1_000, "evaluate_steps": None, "interim_episodes": 100, "final_episodes": 100},
    },
    "tracking": {
        "mlflow": ("mlflow", None, RECORDED),
        "none": ("none", None, RECORDED),
        "server": ("server", "http://127.0.0.1:5000", RECORDED),
    },
    "agent": {"random": ("RandomActor", {"num_actions": 4}), "constant": ("ConstantActor", {"action": 1})},
}
TRAINERS = (  # groups whose parts meet in a trainer
    *("model", "objective", "optimizer", "lr_schedule", "epsilon", "sampler", "env"),
    *("replay", "training", "evaluation", "tracking"),
)
SMALL = ("env.size=40", "device=cpu", "threads=1", "budget.forecast=off")


def composed(*words: str) -> Config:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(words)))


def attributes(part: object, names: Any) -> dict[str, Any]:
    return {name: getattr(part, name) for name in names}


def described(config: Config, trainer: Trainer) -> dict[str, Any]:
    """What was built for the options of each group, in the words of `BUILT`."""
    plan, learner, memory, cadence = trainer.plan, trainer.learner, trainer.memory, trainer.recorder.cadence
    (settings,) = learner.optimizer.param_groups
    expected = BUILT["optimizer"][config.optimizer.name]
    sampler = plan.phases[0].sampler
    with torch.no_grad():
        outputs = learner.network(torch.zeros(1, 4, config.env.size, config.env.size)).numel()
    emulator = make_emulator(config.env).keywords
    return {
        "model": type(learner.network).__name__,
        "objective": {
            "class": type(learner.objective).__name__,
            "outputs": outputs,
            "returns": repr(plan.returns),
            **attributes(learner, TARGET),
        },
        "optimizer": {
            "class": type(learner.optimizer).__name__,
            **{name: settings[name] for name in expected if name != "class"},
        },
        "lr_schedule": repr(plan.learning_rate),
        "epsilon": repr(plan.epsilon),
        "sampler": (type(sampler).__name__, attributes(sampler, BUILT["sampler"][config.sampler.name][1])),
        "env": {
            "crop": emulator["preprocessing"].crop,
            **{name: emulator[name] for name in ("frameskip", "max_steps", "max_pool", *OBSERVED) if name != "crop"},
        },
        "replay": attributes(memory, BUILT["replay"]["million"]),
        "training": {**attributes(plan, ("learn_every", "learn_start", "batch_size")), "ema": learner.ema},
        "evaluation": attributes(cadence, BUILT["evaluation"]["quick"]),
        "tracking": (config.tracking.name, config.tracking.uri, attributes(cadence, RECORDED)),
    }


def test_every_option_of_every_group_is_in_the_table() -> None:
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    # Presets are trained below; launchers, places and what a search tries have tests of their own.
    assert groups == set(BUILT) | {"experiment", "hydra", "paths", "space"}
    for group, options in BUILT.items():
        assert {path.stem for path in (CONF / group).glob("*.yaml")} == set(options), group


@pytest.mark.parametrize("turn", range(max(len(BUILT[group]) for group in TRAINERS)))
def test_every_option_is_built_as_what_it_names(
    turn: int, started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    chosen = {group: list(BUILT[group])[turn % len(BUILT[group])] for group in TRAINERS}
    config = composed(*SMALL, *(f"{group}={option}" for group, option in chosen.items()))
    built = described(config, started(config, tmp_path))
    assert built == {group: BUILT[group][option] for group, option in chosen.items()}


@pytest.mark.parametrize("option", BUILT["phase"])
def test_every_option_of_phase_is_planned_as_it_says(option: str) -> None:
    plan = build_plan(composed(f"phase={option}", "sampler=top_half", "optimizer.lr=0.5"))
    phases = [(phase.name, phase.length, phase.learning_rate, type(phase.sampler).__name__) for phase in plan.phases]
    assert (plan.unit, phases) == BUILT["phase"][option]


@pytest.mark.parametrize("option", BUILT["agent"])
def test_every_option_of_agent_is_the_player_it_names(option: str) -> None:
    name, settings = BUILT["agent"][option]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = checked(BaselineConfig, compose("baseline", [f"agent={option}"]))
    actor = build_baseline(config.agent, config.env)
    assert (type(actor).__name__, attributes(actor, settings)) == (name, settings)


@pytest.mark.parametrize("name", BUILT["model"])
def test_a_config_asks_for_as_many_pixels_as_its_network_needs(name: str) -> None:
    component = composed(f"model={name}").model.component
    assert component is not None
    network, smallest = component.load(), component.facts["smallest_side"]
    assert network.smallest_side == smallest
    network((4, smallest, smallest), 4, torch.nn.Linear)
    with pytest.raises(ValueError, match=f"needs {smallest} pixels"):
        network((4, smallest - 1, smallest - 1), 4, torch.nn.Linear)
    with pytest.raises(ConfigError, match=f"needs at least {smallest} pixels|than or equal to {smallest}$"):
        composed(f"model={name}", f"env.size={smallest - 1}")


@pytest.mark.parametrize(
    "preset",
    [
        # The rungs between the first and the last of the ablation differ in one value each.
        pytest.param(name, marks=pytest.mark.slow if re.match(r"ablation_0[1-9]", name) else ())
        for name in sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
    ],
)
@pytest.mark.thinned(3)
def test_every_preset_trains(preset: str, started: Started, tmp_path: Path) -> None:
    """Smaller and shorter; `fast` with two environments, while which it learns."""
    envs = 2 if preset == "fast" else 1
    config = composed(
        *(f"experiment={preset}", *SMALL, f"env.num_envs={envs}", "env.workers=1", "training.precision=fp32"),
        *("training.learn_start=10", "training.learn_every=4", "training.batch_size=4", "replay.capacity=100"),
        *("replay.max_bytes=4_194_304", "evaluation.at_end=false", "tracking=none", "budget.steps=30"),
    )
    trainer = started(config, tmp_path)
    assert trainer.run() == "budget"
    assert trainer.counters.steps == 30
    assert trainer.learner.updates >= 4
    assert all(parameter.isfinite().all() for parameter in trainer.learner.network.parameters())


@pytest.mark.parametrize(
    ("memory", "disk", "shortage"),
    [
        (
            2**20,
            2**40,
            r"memory will not suffice: \d+ MiB needed, 1 MiB available; lower replay.max_bytes or replay.",
        ),
        (
            2**40,
            2**20,
            r"disk will not suffice: \d+ MiB needed, 1 MiB free; lower replay.capacity, or set paths.outputs",
        ),
    ],
)
@pytest.mark.slow
def test_a_training_that_will_not_fit_is_refused_before_it_begins_unless_a_warning_is_enough(
    memory: int,
    disk: int,
    shortage: str,
    command: Command,
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=memory))
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=disk))
    words = replaced(tiny_overrides, "evaluation.at_end=false", "budget.steps=20", f"paths.outputs={tmp_path}")
    assert command(*replaced(words, "budget.forecast=refuse")) == 1
    shown = capsys.readouterr()
    assert re.fullmatch(rf"atlantis_exp: {shortage}.*; budget\.forecast=warn starts all the same\n", shown.err)
    assert re.search(r"^expect about [\d,]+ steps/s, \d+ seconds for 20 steps, ", shown.out, re.MULTILINE)
    assert not list(tmp_path.glob("runs/*/checkpoints/*/manifest.json"))
    if memory < disk:  # once is enough
        assert command(*replaced(words, "budget.forecast=warn")) == 0
        shown = capsys.readouterr()
        assert re.search(rf"^warning: {shortage}", shown.out, re.MULTILINE)
        assert "20 steps, " in shown.out.splitlines()[-1]


@pytest.mark.slow
def test_what_was_trained_is_evaluated_compared_and_reported(
    command: Command, tiny_overrides: tuple[str, ...], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place = f"paths.outputs={tmp_path}"
    for seed in (0, 1):
        options = (f"seed={seed}", "evaluation.every_steps=null", "tracking=mlflow", place)
        assert command(*replaced(tiny_overrides, *options)) == 0
    first, second = sorted(path.name for path in (tmp_path / "runs").iterdir())
    assert [name[: len("cnn-uniform-s0")] for name in (first, second)] == ["cnn-uniform-s0", "cnn-uniform-s1"]

    capsys.readouterr()
    protocol = ("epsilon=1", "episodes=3", "evaluation.num_envs=2", "evaluation.video=false", "tracking=none")
    assert command("evaluate", "run=cnn-uniform-s1", *protocol, place) == 0
    assert f"{second} at step 160: 3 episodes, epsilon 1" in capsys.readouterr().out
    (evaluated,) = (tmp_path / "evaluations").iterdir()
    result = json.loads((evaluated / "result.json").read_bytes())
    assert result["outcome"] == "finished"
    assert (result["evaluation"]["evaluation/episodes"], result["evaluation"]["actions/random_share"]) == (3, 1)
    assert len((evaluated / "artifacts/evaluation/episodes.csv").read_text().splitlines()) == 4

    assert command("compare", "by=seed", "at_epsilon=0.05", "tracking=none", place) == 0
    *_, ui, _, path = capsys.readouterr().out.rstrip().splitlines()
    assert ui.endswith(f"ui {place}")
    page = Path(path)
    assert page.is_relative_to(tmp_path / "comparisons")
    runs = (page.parent / "tables" / "runs.csv").read_text()
    assert first in runs
    assert second in runs

    assert command("report", place) == 0
    shown = capsys.readouterr().out
    assert first in shown
    assert second in shown


def test_without_a_terminal_a_line_now_and_then_says_how_far_a_training_is(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr("time.monotonic", lambda: now)
    text, counters, learner = io.StringIO(), Counters(), SimpleNamespace(updates=0)
    plan: Any = SimpleNamespace(
        length=10_000,
        done=lambda counters: counters.steps,
        epsilon_at=lambda _: 0.456,
        phase_at=lambda _: SimpleNamespace(name="first"),
    )
    unused: Any = SimpleNamespace(histogram_episodes=500)
    recorder = Recorder(
        plan=plan,
        cadence=unused,
        learner=cast(Any, learner),
        memory=unused,
        tracker=NullJournal(),
        progress=Progress(Console(file=text, width=80, soft_wrap=True)),
        evaluate=unused,
        film=unused,
        score_range=(0.0, 1.0),
    )
    recorder.begin(counters, None)
    recorder._pace = Pace(lambda: now)
    for look in range(7):
        now = 100 + (5 * look if look % 2 == 0 else 5 * look - 4)  # too early for a line at every second look
        counters.steps, learner.updates = 500 * look, 1_000 * look
        if look == 3:
            scores = (*np.linspace(0, 2_000, 21).tolist(), 12_345.0)
            for number, score in enumerate(scores):
                recorder.episode(Played(number + 1, counters.steps, 0, score, 1_000 + 10 * number, 0))
            counters.episodes = len(scores)
        if look == 5:
            recorder._max_steps = 3_500
        recorder.show(counters)
    assert text.getvalue().splitlines() == [
        "episode 1  first episode  epsilon 0.46  step 1,000  "
        "updates 2,000  100 steps/s  phase first  10.0%  left 0:01:30",
        "episode 23  score 12,345  mean of 20 1,662  duration 1,210 (mean of 100 1,105)  epsilon 0.46  step 2,000  "
        "updates 4,000  100 steps/s  phase first  20.0%  left 0:01:20",
        "episode 23  score 12,345  mean of 20 1,662  duration 1,210 (mean of 100 1,105)  epsilon 0.46  step 3,000  "
        "updates 6,000  100 steps/s  phase first  85.7%  left 0:00:05",
    ]
