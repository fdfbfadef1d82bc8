"""Whatever is written on a command line, it is taken, or refused in one line with an exit code."""

import importlib
import random
import re
from pathlib import Path
from typing import Any

import pytest

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.app import Verb
from atlantis_exp.commands.helping import key_names, options_of
from atlantis_exp.commands.overrides import flags_of
from atlantis_exp.faults import Fault

VALUES = (
    *("", " ", "null", "true", "nan", "-inf", "1e999", "0", "-1", "3", "0.5", "1_000", "1" * 5_000, "abc", "é", "\x00"),
    *(
        "\udcff",
        "\u202e",
        "\x1b[2J",
        "'",
        '"',
        "\\",
        "[",
        "]",
        "{a:1}",
        "[1,2]",
        "[[[]]]",
        "${x}",
        "${seed}",
        "${",
        "?",
    ),
    *("a,b", "1,2", "glob(*)", "range(0,3)", "range(3)", "range(0,1,0)", "choice(1,2)", "interval(0,1)", "sort(2,1)"),
    *("tag(log, interval(1e-5,1e-3))", "int(3)", "cast", "a=b", "~", "~x", "/", "/dev/null", "../..", "5%", "?"),
)
FLAGS = (
    *("-m", "--multirun", "--cfg job", "--cfg", "--cfg hydra", "--resolve", "--config-dir /nowhere", "--config-dir=."),
    *("--run", "--info", "--hydra-help", "--package x", "--experimental-rerun=x", "-x", "--", "-", "--help=1", "-mm"),
)
STRANGE = (
    *("=", "==", "=1", "~", "+", "++", "a", "a.b", "a.b=c", ".=1", "model@x=cnn", "sampler@samplers.uniform=top_half"),
    *("hydra.run.dir=/tmp", "hydra/launcher=joblib", "hydra.launcher.n_jobs=0", "hydra/launcher=slurm", "hydra={a:1}"),
    *("plugins=x", "plugins=[./x.py]", "plugins={a:1}", "from=x", "to=http://u:p@h", "to=."),
)


def line_of(rng: random.Random, verb: str) -> list[str]:
    """A few words of a verb's own, most of them with strange values."""
    words: list[str] = []
    for _ in range(rng.randint(0, 3)):
        kind = rng.random()
        if kind < 0.15:
            words += rng.choice(FLAGS).split(" ")
        elif kind < 0.3:
            words.append(rng.choice(STRANGE))
        else:
            key = rng.choice(key_names(verb, ()))
            values = [*options_of(key), rng.choice(VALUES)]
            value = ",".join(rng.sample(values, min(len(values), 2))) if rng.random() < 0.2 else rng.choice(values)
            words.append(f"{rng.choice(('', '', '', '', '+', '++', '~'))}{key}={value}")
    return words


def refusal_of(name: str, words: list[str]) -> str | None:
    """What a command line is refused with, None where it is taken; all but the work is done."""
    verb: Verb[Any] = importlib.import_module(f"atlantis_exp.commands.{name}").VERB
    try:
        arguments, asked = verb.read(words)
        if not flags_of(arguments).cfg:
            verb.work(asked[0])
    except Fault as fault:
        return str(fault)
    return None


@pytest.mark.parametrize(
    "lines", [pytest.param(45, id="few"), pytest.param(2_000, marks=(pytest.mark.slow, pytest.mark.timeout(6_000)))]
)
def test_any_command_line_of_any_verb_is_taken_or_refused_in_one_line(
    lines: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("optuna", reason="needs pip install 'atlantis-exp[search]'")
    monkeypatch.chdir(tmp_path)
    rng, taken = random.Random(lines), 0
    for number in range(lines):
        verb = [*VERBS][number % len(VERBS)]
        words = line_of(rng, verb)
        try:
            refusal = refusal_of(verb, words)
        except Exception as error:
            raise AssertionError(f"{verb} {words!r}: {type(error).__name__}: {error}") from error
        taken += refusal is None
        assert refusal is None or re.fullmatch(r"\S.+", refusal), (verb, words)
    assert taken > lines / 100
    assert [*tmp_path.iterdir()] == []
