"""The config groups: every option and preset composes, and means what the documents say."""

from functools import cache
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.checking import flatten, to_dict
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.config import Config

GROUPS = {path.name: sorted(file.stem for file in path.glob("*.yaml")) for path in CONF.iterdir() if path.is_dir()}
NO_PART = ("agent", "experiment", "hydra", "space")  # of a training, or chosen otherwise


@cache
def composed(*overrides: str) -> Config:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(overrides)))


@pytest.mark.parametrize(
    "experiment",
    ["fast", *(pytest.param(name, marks=pytest.mark.slow) for name in GROUPS["experiment"] if name != "fast")],
)
def test_every_option_of_every_group_goes_with_every_experiment(experiment: str) -> None:
    groups = {group: options for group, options in GROUPS.items() if group not in NO_PART}
    for turn in range(max(map(len, groups.values()))):
        chosen = {group: options[turn % len(options)] for group, options in groups.items()}
        config = composed(f"experiment={experiment}", *(f"{group}={option}" for group, option in chosen.items()))
        named = {"model", "objective", "optimizer", "lr_schedule", "epsilon", "sampler", "tracking"}
        assert {group: getattr(config, group).name for group in named} == {group: chosen[group] for group in named}


def test_a_preset_gives_way_to_what_is_written_beside_it() -> None:
    config = composed("experiment=paper_cnn", "model=resnet", "evaluation.epsilon=0.3", "phase=single")
    assert (config.model.name, config.evaluation.epsilon, list(config.phase)) == ("resnet", 0.3, ["single"])


@pytest.mark.parametrize(
    ("preset", "model", "size", "epsilon"), [("cnn", "cnn", 84, 0.1), ("resnet", "resnet", 159, 0.05)]
)
def test_the_papers_presets_are_the_reports_protocol(preset: str, model: str, size: int, epsilon: float) -> None:
    config = composed(f"experiment=paper_{preset}")
    assert (config.model.name, config.env.size, config.evaluation.epsilon) == (model, size, epsilon)
    first, second = config.phase.values()
    assert (first.episodes, first.lr, first.sampler) == (10_000, 1e-3, "uniform")
    assert (second.episodes, second.lr, second.sampler) == (10_000, 3e-4, "top_half")
    assert to_dict(config.sampler_of("second")) == {"name": "top_half", "oversample": 2}
    science = flatten(config.science())
    assert {
        "env.id": "Atlantis-v0",
        "env.frameskip": [2, 5],
        "env.stack": 4,
        "objective.name": "dqn",
        "objective.gamma": 0.99,
        "objective.target.tau": 1e-4,
        "optimizer.name": "adamw",
        "epsilon.name": "exponential",
        "epsilon.start": 0.9,
        "epsilon.end": 0.02,
        "epsilon.decay": 0.5,
        "replay.capacity": 1_000_000,
        "training.learn_every": 10,
        "evaluation.episodes": 100,
    }.items() <= science.items()


def test_phases_take_the_chosen_sampler_and_rate_unless_they_name_their_own() -> None:
    config = composed("phase=two_phase", "sampler=top_half", "phase.second.lr=1e-4", "phase.second.sampler=uniform")
    assert [(phase.lr, phase.sampler) for phase in config.phase.values()] == [(1e-3, "uniform"), (1e-4, "uniform")]
    config = composed("sampler=top_half", "sampler.oversample=4", "optimizer.lr=0.5")
    assert config.phase["single"].lr == 0.5
    assert to_dict(config.sampler_of("single")) == {"name": "top_half", "oversample": 4}


def test_an_outputs_folder_is_made_absolute_and_a_checkout_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert composed("paths.outputs=o").paths.outputs == str(tmp_path / "o")
    assert composed().paths.outputs == str(CONF.parent / "outputs")
