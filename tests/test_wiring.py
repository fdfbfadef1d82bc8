"""From the command line to the built part: every option of every group becomes what it names, with its own values."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pytest
import torch
from hydra import compose, initialize_config_dir

from atlantis_exp import config as cfg
from atlantis_exp.build import build_baseline, build_plan, make_emulator
from atlantis_exp.commands import CONF
from atlantis_exp.commands.baseline import BaselineConfig
from atlantis_exp.commands.composing import checked
from atlantis_exp.components import known
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.replay.memory import Returns
from atlantis_exp.sessions.job import replaced
from atlantis_exp.training.actor import ConstantActor, RandomActor
from atlantis_exp.training.plan import Cadence
from atlantis_exp.training.trainer import Trainer

Command = Callable[..., int]
Started = Callable[[Config, Path], Trainer]

TRAINERS = (  # groups whose parts meet in a trainer
    *("model", "objective", "optimizer", "lr_schedule", "epsilon", "sampler", "env"),
    *("replay", "training", "evaluation", "tracking"),
)
SMALL = ("env.size=40", "device=cpu", "threads=1", "budget.forecast=off")


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def composed(*words: str) -> Config:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(words)))


def test_every_group_is_built_in_a_test() -> None:
    groups = {path.name for path in CONF.iterdir() if path.is_dir()}
    # Presets are trained below; launchers, places and what a search tries have tests of their own.
    assert groups == {*TRAINERS, "phase", "agent", "experiment", "hydra", "paths", "space"}


def attributes(part: object, names: Iterable[str]) -> dict[str, Any]:
    return {name: getattr(part, name) for name in names}


@pytest.mark.parametrize("turn", range(max(len(options(group)) for group in TRAINERS)))
def test_every_option_is_built_with_the_values_of_its_config(
    turn: int, started: Started, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    chosen = {group: options(group)[turn % len(options(group))] for group in TRAINERS}
    config = composed(*SMALL, *(f"{group}={option}" for group, option in chosen.items()))
    trainer = started(config, tmp_path)
    plan, learner, cadence = trainer.plan, trainer.learner, trainer.recorder.cadence
    objective, target, env = config.objective, config.objective.target, config.env
    parts: dict[str, tuple[cfg.ComponentConfig, object]] = {
        "model": (config.model, learner.network),
        "objective": (objective, learner.objective),
        "lr_schedule": (config.lr_schedule, plan.learning_rate),
        "epsilon": (config.epsilon, plan.epsilon),
        "sampler": (config.sampler, plan.phases[0].sampler),
    }
    for group, (part, built) in parts.items():
        assert part.name == chosen[group]
        assert part.component is not None
        assert type(built) is part.component.load()
        if group != "model":
            assert attributes(built, part.own) == part.settings
    with torch.no_grad():
        outputs = learner.network(torch.zeros(1, *env.state_shape)).shape
    assert outputs[2:] == tuple(objective.settings[name] for name in objective.own if name == "quantiles")
    assert (learner.tau, learner.target_every, learner.target_mode) == (target.tau, target.every, target.mode)
    assert plan.returns == Returns(
        gamma=objective.gamma,
        n_step=objective.n_step,
        scale=objective.reward_scale,
        exponent=objective.reward_exponent,
        clip=objective.reward_clip,
    )
    (settings,) = learner.optimizer.param_groups
    assert type(learner.optimizer).__name__.lower() == config.optimizer.name == chosen["optimizer"]
    own = {key: value for key, value in vars(config.optimizer).items() if key != "name"}
    assert {key: settings[key] for key in own} == own
    emulator = make_emulator(env).keywords
    assert (emulator["preprocessing"].crop, emulator["preprocessing"].size) == (env.crop, env.size)
    played = ("frameskip", "sticky", "max_frames", "max_steps", "noop_max", "max_pool")
    assert {name: emulator[name] for name in played} == attributes(env, played)
    assert (trainer.memory.capacity, trainer.memory.lags) == (config.replay.capacity, tuple(env.lags))
    learnt = ("learn_every", "learn_start", "batch_size")
    assert attributes(plan, learnt) == attributes(config.training, learnt)
    assert learner.ema == config.training.ema
    evaluation, tracking = config.evaluation, config.tracking
    assert tracking.name == chosen["tracking"]
    assert cadence == Cadence(
        curve_steps=tracking.every_steps,
        histogram_episodes=tracking.histogram_episodes,
        commit_episodes=tracking.commit_episodes,
        commit_seconds=tracking.commit_seconds,
        evaluate_episodes=evaluation.every_episodes,
        evaluate_steps=evaluation.every_steps,
        evaluate_at_end=evaluation.at_end,
        interim_episodes=evaluation.interim_episodes or evaluation.episodes,
        final_episodes=evaluation.episodes,
    )


@pytest.mark.parametrize("option", options("phase"))
def test_every_option_of_phase_is_planned_as_it_says(option: str) -> None:
    config = composed(f"phase={option}", "sampler=top_half", "optimizer.lr=0.5")
    plan = build_plan(config)
    assert [phase.name for phase in plan.phases] == [*config.phase]
    for phase, described in zip(plan.phases, config.phase.values(), strict=True):
        assert (phase.length, phase.learning_rate) == (getattr(described, plan.unit), described.lr)
        assert type(phase.sampler) is known("sampler")[described.sampler].load()


@pytest.mark.parametrize("option", options("agent"))
def test_every_option_of_agent_is_the_player_it_names(option: str) -> None:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = checked(BaselineConfig, compose("baseline", [f"agent={option}"]))
    actor = build_baseline(config.agent, config.env)
    expected = {"random": RandomActor(4), "constant": ConstantActor(config.agent.action)}[option]
    assert (type(actor), vars(actor)) == (type(expected), vars(expected))


@pytest.mark.parametrize("name", options("model"))
def test_a_config_asks_for_as_many_pixels_as_its_network_needs(name: str) -> None:
    model = composed(f"model={name}").model
    component = model.component
    assert component is not None
    network, smallest = component.load(), component.facts["smallest_side"]
    network((4, smallest, smallest), 4, torch.nn.Linear, **model.settings)
    with pytest.raises(RuntimeError, match="Kernel size can't be greater than actual input size"):
        network((4, smallest - 1, smallest - 1), 4, torch.nn.Linear, **model.settings)
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


@pytest.mark.slow
def test_a_training_that_will_not_fit_is_refused_before_it_begins_unless_a_warning_is_enough(
    command: Command,
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=2**20))
    shortage = r"memory will not suffice: \d+ MiB needed, 1 MiB available; lower replay.max_bytes, replay."
    words = replaced(tiny_overrides, "evaluation.at_end=false", "budget.steps=20", f"paths.outputs={tmp_path}")
    assert command(*replaced(words, "budget.forecast=refuse")) == 1
    shown = capsys.readouterr()
    assert re.fullmatch(rf"atlantis_exp: {shortage}.*; budget\.forecast=warn starts anyway\n", shown.err)
    assert re.search(r"^expect about [\d,]+ steps/s, \d+ seconds for 20 steps, ", shown.out, re.MULTILINE)
    assert not list(tmp_path.glob("runs/*/checkpoints/*/manifest.json"))
    assert command(*replaced(words, "budget.forecast=warn")) == 0
    shown = capsys.readouterr()
    assert re.search(rf"^warning: {shortage}", shown.out, re.MULTILINE)
    assert "20 steps, " in shown.out.splitlines()[-1]
