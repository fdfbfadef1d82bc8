"""What a search may draw its values from, and what is said of a command line that asks for no search."""

import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.commands.search import CLOSED
from atlantis_exp.faults import ConfigError

pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")

from optuna.distributions import (
    BaseDistribution,
    CategoricalDistribution,
    FloatDistribution,
    IntDistribution,
)

from atlantis_exp.commands.space import check_space, read_space


@pytest.mark.parametrize(
    ("text", "drawn"),
    [
        ("choice(adam, rmsprop)", CategoricalDistribution(["adam", "rmsprop"])),
        ("adam,rmsprop,adam", CategoricalDistribution(["adam", "rmsprop"])),
        ("shuffle(5,4,3,2,1,0)", CategoricalDistribution([*"543210"])),
        ("choice([1,2],[3,4])", CategoricalDistribution(["[1,2]", "[3,4]"])),
        ("interval(1, 5)", FloatDistribution(1.0, 5.0)),
        ("tag(log, interval(1e-5, 1e-3))", FloatDistribution(1e-5, 1e-3, log=True)),
        ("int(interval(1, 5))", IntDistribution(1, 5)),
        ("tag(log, int(interval(1, 64)))", IntDistribution(1, 64, log=True)),
        ("range(1, 10, 3)", IntDistribution(1, 7, step=3)),
        ("range(10, 1, -3)", IntDistribution(4, 10, step=3)),
        ("range(1, 1000000000000)", IntDistribution(1, 999_999_999_999)),
        ("range(0.25, 1.25, 0.25)", FloatDistribution(0.25, 1.0, step=0.25)),
    ],
)
def test_a_space_is_written_as_for_hydras_optuna_sweeper(text: str, drawn: BaseDistribution) -> None:
    assert read_space({"optimizer.lr": text}, set()) == {"optimizer.lr": drawn}


@pytest.mark.parametrize(
    ("overrides", "space", "hint"),
    [
        ("", "optimizer=adam,rmsprpo", "optimizer=rmsprpo: no such option in conf/optimizer; did you mean 'rmsprop'?"),
        ("", "optimizer.l=0.1,0.2", "did you mean 'optimizer.lr'?"),
        ("", "optimizer.lr=interval(-1,1)", "optimizer.lr=-1.0: should be greater than or equal to "),
        ("", "optimizer.lr=interval(2,1)", "`low <= high` must hold"),
        ("", "optimizer.lr=tag(log,interval(0,1))", "`low > 0` must hold"),
        ("", "optimizer.lr=range(1,1)", "has no numbers"),
        ("", "optimizer.lr=range(0,1,1e-9)", "more than 100,000 numbers; write interval(a, b)"),
        ("", "optimizer.lr=0.1", "not a set of values; write choice"),
        ("", "model=glob(*)", "not a set of values; write choice"),
        ("", "seed=0,1", "cannot be searched"),
        ("", "++seed=0,1", "cannot be searched; write a plain key, as in seed"),
        ("", "sampler@samplers.uniform=uniform,top_half", "cannot be searched"),
        ("++optimizer.lr=0.1", "optimizer.lr=0.1,0.2", "optimizer.lr: is both fixed and searched"),
        ("", "evaluation.epsilon=0.1,0.2", "cannot be searched"),
        ("", "trials=5,10", "cannot be searched"),
        ("optimizer=adam", "optimizer=adam,adamw", "optimizer: is both fixed and searched"),
        ("", "env.num_envs=int(interval(1,40))", "training.learn_start=20: should be less than"),
        (  # too many corners to try them all
            "",
            "env.sticky=0,2 optimizer.lr=0.1,0.2 env.stack=1,2,3,4 objective.n_step=1,2,3,4",
            "env.sticky=2: should be less than or equal to 1",
        ),
    ],
)
def test_an_impossible_space_is_refused_in_one_line_before_anything_starts(
    tiny_overrides: tuple[str, ...], overrides: str, space: str, hint: str
) -> None:
    fixed = [*tiny_overrides, *overrides.split()]
    with pytest.raises(ConfigError) as caught:
        check_space(read_space(dict(text.split("=", 1) for text in space.split(" ")), CLOSED), fixed)
    assert hint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "hint"),
    [
        ("trials=2", "nothing to search: give a key several values"),
        ("-m optimizer=adam,rmsprop", "-m: a search is not a sweep"),
        ("optimizer=adam optimizer=adam,rmsprop", "contradicts optimizer=adam"),
        ("space.optimizer=adam,rmsprop optimizer=adam,adamw", "contradicts optimizer=adam,rmsprop"),
        ("modle=cnn optimizer=adam,rmsprop", "did you mean 'model'?"),
        ("optimizer=adam,rmsprop evaluation.at_end=false", "evaluation.at_end=false: a search compares"),
        ("optimizer=adam,rmsprop seed=3", "seed=3: write 1_000 or more; decide tests the best values with seeds below"),
        ("space=optimzer", "did you mean 'optimizer'?"),
    ],
)
def test_a_mistake_ends_the_command_with_code_2(
    line: str,
    hint: str,
    command: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    assert command("search", *line.split(), f"paths.outputs={tmp_path}") == 2
    assert hint in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_without_optuna_the_extra_is_named(
    command: Callable[..., int],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    monkeypatch.delitem(sys.modules, "atlantis_exp.sessions.search", raising=False)
    monkeypatch.setitem(sys.modules, "optuna", None)
    assert command("search", "optimizer=adam,rmsprop", f"paths.outputs={tmp_path}") == 2
    assert capsys.readouterr().err == "atlantis_exp: search needs Optuna: pip install 'atlantis-exp[search]'\n"
    assert list(tmp_path.iterdir()) == []
