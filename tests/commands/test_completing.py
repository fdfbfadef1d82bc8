"""What a shell offers after a Tab."""

import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.completing import SCRIPTS, candidates


def test_verbs_groups_and_keys_are_offered_and_after_a_verb_its_own() -> None:
    assert {*VERBS, "model=", "optimizer.lr="} <= {*candidates([""])}
    assert candidates(["deci"]) == ["decide"]
    assert candidates(["compare", "at_"]) == ["at_epsilon="]
    assert "decide" not in candidates(["compare", ""])
    assert candidates(["objective.quan"]) == []
    assert candidates(["objective=quantile", "objective.quan"]) == ["objective.quantiles="]


def test_options_are_offered_one_after_the_other_of_a_sweep() -> None:
    assert candidates(["model=res"]) == ["model=resnet", "model=resnet_fast"]
    assert candidates(["train", "-m", "model=cnn,resnet_f"]) == ["model=cnn,resnet_fast"]
    assert candidates(["seed="]) == candidates(["../conf="]) == []


def test_run_names_are_offered_but_for_those_that_no_terminal_shows(tmp_path: Path) -> None:
    for name in ("cnn-1", "cnn-2", "resnet-1", "cnn-\x1b[2J"):
        (tmp_path / "runs" / name).mkdir(parents=True)
    assert candidates(["evaluate", f"paths.outputs={tmp_path}", "run=cnn"]) == ["run=cnn-1", "run=cnn-2"]
    for verb in ("compare", "report"):
        assert candidates([verb, f"paths.outputs={tmp_path}", "runs=cnn-1,res"]) == ["runs=cnn-1,resnet-1"]
    assert candidates(["evaluate", "paths.outputs=~no-one-s/", "run=cnn"]) == []


@pytest.mark.skipif(shutil.which("bash") is None, reason="no bash")
@pytest.mark.parametrize(
    ("line", "replies"),
    [
        ("atlantis-exp deci", ["decide"]),
        ("atlantis-exp model=res", ["resnet", "resnet_fast"]),
        ("atlantis-exp -m model=cnn,resnet_f", ["cnn,resnet_fast"]),
        ("atlantis-exp compare at_", ["at_epsilon="]),
    ],
)
def test_bash_completes_the_word_under_the_cursor(tmp_path: Path, line: str, replies: list[str]) -> None:
    (tmp_path / "atlantis-exp").write_text(f'#!/bin/sh\nexec {sys.executable} -m atlantis_exp "$@"\n')
    (tmp_path / "atlantis-exp").chmod(0o755)
    program = (
        f"PATH={tmp_path}:$PATH; compopt() {{ :; }}\n{SCRIPTS['bash']}\n"
        f"COMP_LINE='{line}'; COMP_POINT={len(line)}; _atlantis_exp; printf '%s\\n' \"${{COMPREPLY[@]}}\""
    )
    done = subprocess.run(["bash", "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == replies


def test_each_shell_gets_its_script_and_another_one_a_line(
    command: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    for shell, script in SCRIPTS.items():
        assert command("--completion", shell) == 0
        assert capsys.readouterr().out == f"{script}\n"
    assert command("--completion", "fsh") == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert "--completion=fsh: no such shell; did you mean 'fish'?" in printed.err
