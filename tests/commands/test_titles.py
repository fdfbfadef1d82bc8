"""What runs are called, for configs that differ in every way."""

import itertools
from functools import cache

import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands.app import CONF, checked
from atlantis_exp.commands.titles import colour, group, title
from atlantis_exp.config import Config


@cache
def composed(overrides: str) -> Config:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", overrides.split()))


TITLES = {
    "": "cnn uniform s0",
    "model=resnet sampler=top_half seed=1": "resnet top_half s1",
    "experiment=quick": "cnn uniform s0 quick",
    "experiment=paper_resnet seed=2": "resnet uniform top_half s2 paper_resnet",
    "experiment=ablation_05_n_step": "cnn uniform s0 adam linear_steps ablation_05_n_step",
    "experiment=ablation_09_quantile": "cnn uniform s0 quantile adam linear_steps ablation_09_quantile",
    "experiment=ablation_08_dueling": "cnn uniform s0 double_dqn adam linear_steps ablation_08_dueling",
    "experiment=fast objective=dqn objective.n_step=3": "cnn uniform s0 adam linear_steps fast n_step=3",
    "env=atlantis_v5": "cnn uniform s0 atlantis_v5",
    "env.num_envs=16": "cnn uniform s0 num_envs=16",
    "optimizer.lr=0.0001": "cnn uniform s0 lr=0.0001",
    "objective=double_dqn optimizer=adam epsilon=linear": "cnn uniform s0 double_dqn adam linear",
    "training.learn_every=4 training.batch_size=64": "cnn uniform s0 learn_every=4 batch_size=64",
}


@pytest.mark.parametrize("overrides", TITLES)
def test_a_title_says_what_differs_and_nothing_else(overrides: str) -> None:
    assert title(composed(overrides)) == TITLES[overrides]


def test_titles_differ_exactly_where_identities_do() -> None:
    many = "env.size=40 env.max_steps=40 training.learn_every=4 training.learn_start=20"
    variants = [
        *(*TITLES, "phase=two_phase", "phase=two_phase sampler=top_half", "experiment=paper_cnn ~phase.second"),
        *("optimizer.lr=0.0001 phase.single.lr=0.001", "phase.single.lr=0.0001", "evaluation.episodes=7"),
        *(f"{many} evaluation.episodes=7", f"{many} evaluation.episodes=8", f"{many} evaluation.episodes=7 seed=1"),
        *("device=cpu", "tracking=none budget.steps=5 threads=1", "phase=single", "env.workers=3"),
    ]
    configs = [composed(variant) for variant in variants]
    for one, other in itertools.combinations(configs, 2):
        assert (title(one) == title(other)) == (one.identity() == other.identity()), (title(one), title(other))


def test_runs_of_a_group_differ_only_in_their_seed() -> None:
    many = "env.size=40 env.max_steps=40 training.learn_every=4 training.learn_start=20 evaluation.episodes=7"
    for variant in ("", "optimizer.lr=0.0001", many):
        groups = {group(composed(f"{variant} seed={seed}")) for seed in range(3)}
        assert len(groups) == 1
        assert colour(composed(variant)) == colour(composed(f"{variant} seed=5"))
    assert group(composed("")) != group(composed("optimizer.lr=0.0001"))
