"""The verb decide: what it refuses before anything is written, each in one line."""

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.commands import decide, search
from atlantis_exp.commands.decide import VERB
from atlantis_exp.faults import ConfigError

Command = Callable[..., int]


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("model=cnn",), "nothing to decide between: give a key several values, as in model=cnn,resnet_fast"),
        (("-m", "model=cnn,resnet"), "-m: decide plans its own sweeps; drop -m"),
        (("model=cnn,resnet", "seed=3"), "seed=3: decide trains seeds from 0 on, as many as it needs; drop it"),
        (("model=cnn,resnet", "resume=never"), "resume=never: decide continues the existing runs; drop it"),
        (
            ("budget.steps=100,200",),
            "budget.steps: all contenders are trained and measured alike; write one value",
        ),
        (("model=cnn,resnet", "seeds=5,10"), "seeds: all contenders are trained and measured alike"),
        (("experiment=fast,quick",), "experiment: a preset sets many keys; name those that differ"),
        (("phase=single,two_phase",), "phase: is not a single key; name those that differ"),
        (("optimizer.lr=0.001,1e-3",), "optimizer.lr=0.001: the same contender as optimizer.lr=0.001"),
        (("env.workers=1,2",), "env.workers=2: makes the same run as env.workers=1"),
        (("samplers.prioritized.alpha=0.4,0.6",), "samplers.prioritized.alpha=0.6: makes the same run as samplers.p"),
        (("optimizer.lr=0.001,0.002", "baseline=lr=0.003"), "baseline=lr=0.003: no such group; did you mean 'lr=0.00"),
        (("model=cnn,resnet", "baseline=resnte"), "baseline=resnte: no such group; did you mean 'resnet'?"),
        (
            ("env=atlantis_v0,atlantis_v5",),
            "env.frameskip differs, so the scores do not mean the same: 4 in ALE/Atlantis-v5; [2, 5] in Atlantis-v0; "
            "give that key itself several values, or train them under one protocol",
        ),
        (("model=cnn,resnet", "delta=5pt"), "delta=5pt: write a share of a score, as in delta=5%, or points"),
        (("model=cnn,resnet", "seeds=4"), "seeds=4: should be greater than or equal to 5"),
        (("model=cnn,resnet", "error=0"), "error=0: should be greater than or equal to 1e-06"),
        (("model=cnn,resnet", "look=now"), "look=now: no such key"),
        (("model=cnn,resnet", "evaluation.at_end=false"), "evaluation.at_end=false: contenders are compared by the "),
        (
            ("model=cnn,resnet", "hydra/launcher=joblb"),
            "hydra/launcher=joblb: no such launcher; did you mean",
        ),
        (("model=cnn,resnet", "against=env.stack=2"), "model=cnn,resnet: write several values or against=, not both"),
        (("against=seed=3,model=cnn",), "seed: all contenders are trained and measured alike; write"),
        (("against=model=cnn",), "model=cnn: the same contender as the config without it"),
        (("against=model=rsenet",), "model=rsenet: no such option in conf/model; did you mean 'resnet'?"),
        (("model=glob(x*)",), "model=glob(x*): not a list of values; write them out"),
    ],
)
def test_a_question_that_cannot_be_decided_is_one_line_and_code_2_and_leaves_nothing_behind(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], line: str
) -> None:
    assert command("decide", *words, f"paths.outputs={tmp_path / 'o'}") == 2
    error = capsys.readouterr().err
    assert error.startswith(f"atlantis_exp: {line}")
    assert error.count("\n") == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("model=cnn model=cnn,resnet", "model=cnn,resnet: contradicts model=cnn"),
        ("model=cnn,resnet ++seed=3", "seed=3: decide trains seeds from 0 on"),
        ("model=cnn,resnet ++resume=never", "resume=never: decide continues"),
        ("optimizer.lr=interval(0,1)", "optimizer.lr=interval(0,1): not a list of values; write them out"),
    ],
)
def test_a_key_is_refused_however_it_is_written(words: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(reason)):
        VERB.rewrite(words.split())


@pytest.mark.parametrize(
    ("words", "first"),
    [
        (("objective=quantile,double_quantile", "objective.quantiles=11"), "objective=quantile"),
        (("lr_schedule=linear,one_cycle", "lr_schedule.end=0.1"), "lr_schedule=linear"),
    ],
)
def test_contenders_may_share_a_key_that_the_default_option_lacks(words: tuple[str, ...], first: str) -> None:
    (asked,) = decide.VERB.asked(decide.VERB.rewrite([*words]), words)
    one, other = decide.contest_of(asked).contenders.values()
    assert first in one.overrides
    assert other.overrides[0] == words[1]


def test_a_value_that_follows_from_the_seed_in_a_file_of_the_users_does_so_for_each_seed(tmp_path: Path) -> None:
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text('# @package _global_\nevaluation: {seed: "${seed}"}\n')
    words = [f"--config-dir={tmp_path}", "experiment=mine", "model=cnn,resnet"]
    (asked,) = decide.VERB.asked(decide.VERB.rewrite([*words]), words)
    contest = decide.contest_of(asked)
    assert [contest.job("cnn", seed).config.evaluation.seed for seed in (0, 3)] == [0, 3]


def test_a_search_composes_from_a_folder_of_the_users(tmp_path: Path) -> None:
    pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")
    (tmp_path / "experiment").mkdir()
    (tmp_path / "experiment" / "mine.yaml").write_text("# @package _global_\ntraining: {batch_size: 17}\n")
    words = [
        f"--config-dir={tmp_path}",
        "experiment=mine",
        "optimizer=adam,rmsprop",
        "training.learn_start=range(1,19999)",
    ]
    (asked,) = search.VERB.asked(search.VERB.rewrite(list(words)), words)
    found = search.search_of(asked)
    assert found.corner.config.training.batch_size == 17
    assert found.job_of([*found.overrides, "optimizer=rmsprop"]).config.training.batch_size == 17
    assert {*found.space} == {"optimizer", "training.learn_start"}


def test_a_search_may_set_a_key_that_all_searched_options_have() -> None:
    pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")
    words = [
        "objective=quantile,double_quantile",
        "objective.quantiles=11",
        "optimizer.lr=interval(1e-4,1e-3)",
        "trials=2",
    ]
    (asked,) = search.VERB.asked(search.VERB.rewrite(list(words)), words)
    found = search.search_of(asked)
    assert {*found.space} == {"objective", "optimizer.lr"}
    assert found.overrides == ["objective.quantiles=11", "seed=1000"]
