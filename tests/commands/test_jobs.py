"""What runs are called, for trainings that are asked for in every way."""

import itertools
import re
from collections.abc import Sequence
from functools import cache, partial

import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.check import _work
from atlantis_exp.commands.jobs import job_of, words_of
from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import Job, replaced


@cache
def jobs(line: str) -> tuple[Job, ...]:
    """The trainings that a command line asks for, several with -m."""
    checked = check("config", Config, line.split())
    return tuple(job_of(Asked(config, "train", texts)) for texts, config in checked.items())


def by_hydra(line: str) -> list[Sequence[str]]:
    """The overrides of each job, as Hydra passes them to a sweep's jobs."""
    (batch,) = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(line.split()), None)
    return list(batch)


MANY = "env.size=40 env.max_steps=40 training.learn_every=4 training.learn_start=20"
TITLES = {
    "": "cnn uniform s0",
    "model=resnet sampler=top_half seed=1": "resnet top_half s1",
    "experiment=paper_resnet seed=2": "resnet uniform top_half s2 paper_resnet",
    "experiment=fast objective=dqn objective.n_step=3": "cnn uniform s0 fast dqn n_step=3",
    "phase=two_phase ~phase.second": "cnn uniform s0 phase=two_phase ~phase.second",
}
WORDS = {
    "experiment=none": "",
    "experiment=quick": "quick",
    "experiment=ablation_05_n_step": "ablation_05_n_step",
    "experiment=ablation_09_quantile": "ablation_09_quantile",
    "experiment=ablation_08_dueling": "ablation_08_dueling",
    "env=atlantis_v5": "atlantis_v5",
    "objective=double_dqn optimizer=adam epsilon=linear": "double_dqn adam linear",
    "env.num_envs=16": "num_envs=16",
    "optimizer.lr=0.0001": "lr=0.0001",
    "optimizer.lr=0.0001 +phase.single.lr=0.001": "optimizer.lr=0.0001 phase.single.lr=0.001",
    "training.learn_every=4 training.batch_size=64": "learn_every=4 batch_size=64",
    "evaluation.video=false env.crop=[30,160,190,0]": "video=false crop=[30, 160, 190, 0]",
    "sampler@samplers.uniform=prioritized": "sampler@samplers.uniform=prioritized",
    "lr_schedule=linear evaluation=quick": "lr_schedule=linear evaluation=quick",
    "device=cpu tracking=none budget.steps=5 threads=1 compile=true resume=must paths.outputs=a env.workers=3": "",
    "objective=dqn objective.n_step=1 objective=double_dqn objective.n_step=2": "double_dqn n_step=2",
}


@pytest.mark.parametrize("overrides", TITLES)
def test_a_title_says_what_was_asked_for_and_nothing_else(overrides: str) -> None:
    (job,) = jobs(overrides)
    assert job.title == TITLES[overrides]


@pytest.mark.parametrize("overrides", WORDS)
def test_the_words_of_a_title_follow_from_what_was_typed(overrides: str) -> None:
    assert " ".join(words_of(overrides.split())) == WORDS[overrides]


def test_more_than_four_values_become_a_few_digits_that_tell_runs_apart() -> None:
    assert words_of(MANY.split()) == ("size=40", "max_steps=40", "learn_every=4", "learn_start=20")
    options, seven, eight = "experiment=quick env=atlantis_v5", "evaluation.episodes=7", "evaluation.episodes=8"
    words = words_of(f"{options} {MANY} {seven}".split())
    assert words[:2] == ("quick", "atlantis_v5")
    assert re.fullmatch("[0-9a-f]{6}", words[2])
    assert len(words) == 3
    assert words_of(f"{options} {MANY} {eight}".split()) != words
    assert words_of(f"{seven} {MANY} {options} seed=3 device=cpu".split()) == words  # in any order


@pytest.mark.parametrize(
    "line",
    [
        "optimizer.lr=0.0001,0.001 phase=single,two_phase objective.n_step=1,3",
        "seed=0,1 model=cnn,resnet experiment=none,quick",
        f"{MANY} evaluation.episodes=7,8 sampler=uniform,top_half",
        "seed=0,1 threads=1,2 env.workers=2,3",
    ],
)
@pytest.mark.slow
def test_titles_of_a_sweep_differ_exactly_where_what_is_trained_does(line: str) -> None:
    asked = jobs(f"-m {line}")
    assert len({job.config.identity() for job in asked}) > 1
    for one, other in itertools.combinations(asked, 2):
        is_same = one.config.identity() == other.config.identity()
        assert (one.title == other.title) == is_same, (one.title, other.title)


def test_an_override_takes_the_place_of_its_key() -> None:
    assert replaced(["seed=1", "a=2", "env.id=x", "seed=3"], "seed=4", "a=5") == ["env.id=x", "seed=4", "a=5"]


def test_a_job_of_a_sweep_is_called_what_its_sweep_calls_it_however_a_value_was_written() -> None:
    for line in ("env.max_steps=1_000 optimizer.lr=1e-4,1.0e-3", f"{MANY} training.batch_size=3_2 seed=0,1"):
        asked = jobs(f"-m {line} evaluation.video=false phase=two_phase ~phase.second")
        overrides = by_hydra(f"{line} evaluation.video=false phase=two_phase ~phase.second")
        assert [job.words for job in asked] == [words_of(each) for each in overrides]
        assert [job.overrides for job in asked] != [tuple(each) for each in overrides]


def test_runs_of_a_group_differ_only_in_their_seed() -> None:
    for variant in ("optimizer.lr=0.0001", f"{MANY} evaluation.episodes=7"):
        one, other = jobs(f"-m {variant} seed=0,5")
        assert one.group == other.group
        assert one.colour == other.colour
        assert one.title != other.title
        assert one.group != jobs("")[0].group
    assert jobs("")[0].group == "cnn uniform"


def test_a_check_does_without_references_that_its_settings_do_not_fit() -> None:
    for size, others in ((20, []), (84, ["model=cnn"])):
        ((overrides, config),) = check("config", Config, ["model=resnet", f"env.size={size}"]).items()
        call = _work(Asked(config, "check", overrides))
        assert isinstance(call, partial)
        assert [name for name in call.args[1] if name != "model=resnet"] == others
