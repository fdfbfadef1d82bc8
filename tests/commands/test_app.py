"""The edge: exit codes, what is printed where, and what a command line may leave behind."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig, OmegaConf

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import replaced

REPOSITORY = Path(__file__).parents[2]
Command = Callable[..., int]


HAS_MPS = torch.backends.mps.is_available()


@pytest.mark.parametrize(
    "line",
    [
        "optimizer.lr=-1 paths.outputs=o",
        "-m seed=0,-1 paths.outputs=o",
        "--cfg job model=cnm paths.outputs=o",
        "trian seed=1",
        "--cfg job -m seed=0,1 paths.outputs=o",
        "seed=1 seed=2 paths.outputs=o",
        "replay.capacity=1000000000000000000 paths.outputs=o",
        "device=cuda:99 paths.outputs=o",
        pytest.param("device=mps paths.outputs=o", marks=pytest.mark.skipif(HAS_MPS, reason="this machine has one")),
        "new to=o",
        "new model=mynet",
        "query -m hydra/launcher=joblib env=atlantis_v0,atlantis_v5",
    ],
)
def test_a_mistake_ends_with_code_2_and_one_line_and_leaves_nothing_behind(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], line: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*line.split()) == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    assert re.fullmatch(r"atlantis_exp: .+\n", printed.err)
    assert list(tmp_path.iterdir()) == []


def test_a_process_ends_as_its_command_line_does(tmp_path: Path) -> None:
    words = ("-m", "atlantis_exp", "-m", "seed=0,-1", "paths.outputs=o")
    done = subprocess.run(
        (sys.executable, *words),
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert re.fullmatch(r"atlantis_exp: seed=-1: .+\n", done.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "verb",
    [pytest.param(verb, marks=() if verb in ("", "compare") else pytest.mark.slow) for verb in ("", *VERBS)],
)
def test_help_says_what_a_verb_does_and_without_one_which_there_are(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], verb: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert command(*([verb] if verb else []), "--help") == 0
    first, second, *others = capfd.readouterr().out.splitlines()
    assert first == f"python -m atlantis_exp {verb or '[VERB]'} KEY=VALUE ..."
    if verb:
        assert second == VERBS[verb]
        assert command("--help", verb) == 0
        assert capfd.readouterr().out.splitlines() == [first, second, *others]
    else:
        assert all(any(purpose in line for line in others) for purpose in VERBS.values())
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_a_sweep_runs_the_configs_that_were_checked(
    command: Command, tiny_overrides: tuple[str, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The default objective has no quantiles, so that no config of the sweep as a whole could be composed."""
    short = ("phase.quick.steps=20", "evaluation.at_end=false", "evaluation.every_steps=null")
    words = replaced(tiny_overrides, *short, f"paths.outputs={tmp_path}")
    assert command("-m", *words, "objective=quantile,double_quantile", "objective.quantiles=11") == 0
    assert capfd.readouterr().out.splitlines()[-1] == "sweep of 2 runs: 2 done"


def test_help_that_nobody_reads_to_its_end_is_no_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)  # as `| head` does
    with open(writer, "wb") as pipe:
        asked = subprocess.run(
            (sys.executable, "-m", "atlantis_exp", "--help"),
            cwd=REPOSITORY,
            stdout=pipe,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=120,
        )
    assert (asked.returncode, asked.stderr) == (0, "")


def test_showing_the_config_prints_one_that_is_valid_and_leaves_nothing_behind(
    command: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    overrides = ("model=resnet", f"paths.outputs={tmp_path}/o")
    assert command(*overrides, "--cfg", "job", "--resolve") == 0
    tree = OmegaConf.create(capfd.readouterr().out)
    assert isinstance(tree, DictConfig)
    shown = checked(Config, tree)
    assert [shown] == [*check("config", Config, overrides).values()]
    assert list(tmp_path.iterdir()) == []


def test_nothing_heavy_is_loaded_before_the_config_is_checked() -> None:
    program = (
        "import sys; from importlib import import_module; from atlantis_exp import config; "
        f"[import_module(f'atlantis_exp.commands.{{verb}}') for verb in {[*VERBS]}]; "
        "from atlantis_exp.commands.overrides import check; "
        "check('config', config.Config, ['model=resnet']); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    heavy = {"torch", "mlflow", "ale_py", "gymnasium", "cv2", "matplotlib", "scipy", "av", "numpy"}
    assert heavy & set(done.stdout.split()) == set()


@pytest.mark.slow
@pytest.mark.timeout(6_000)
def test_an_interrupt_at_any_moment_of_the_start_ends_a_training(
    tiny_overrides: tuple[str, ...], tmp_path: Path
) -> None:
    """Some libraries swallow a KeyboardInterrupt, as pydantic does where it builds a schema."""
    heard = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"  # a shell's `&` ignores it
    program = f"{heard}; from atlantis_exp.commands import main; print('up', flush=True); main()"
    words = replaced(tiny_overrides, "phase.quick.steps=100_000")
    rng, longest = random.Random(0), 0.0
    for moment in range(-1, 300):
        training = subprocess.Popen(
            (sys.executable, "-c", program, *words, f"paths.outputs={tmp_path / str(moment)}"),
            cwd=REPOSITORY,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert training.stdout is not None
        assert training.stdout.readline() == "up\n"
        began = time.monotonic()
        if moment < 0:  # how long a start takes here
            while not training.stdout.readline().startswith("starting run"):
                assert training.poll() is None
            longest = time.monotonic() - began
        else:
            time.sleep(rng.uniform(0, longest))
        training.send_signal(signal.SIGINT)
        _, error = training.communicate(timeout=120)
        assert training.returncode in (130, -signal.SIGINT), error  # the latter before there is a handler
        if training.returncode == 130:
            assert "Traceback" not in error
            assert re.search("atlantis_exp: (interrupted|SIGINT: run .* is committed)", error)


def test_an_interrupt_while_a_verb_is_imported_is_one_line(
    command: Command, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("atlantis_exp.commands.importlib.import_module", interrupted)
    assert command("report") == 130
    assert capsys.readouterr().err == "atlantis_exp: interrupted\n"
