"""What `make` does."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

MAKEFILE = Path(__file__).parents[1] / "Makefile"


def test_an_older_python_is_one_line_before_anything_is_made(tmp_path: Path) -> None:
    (tmp_path / "pyproject.toml").touch()
    old = tmp_path / "python3.10"  # this one, in disguise
    disguise = "import sys; code = sys.argv[2]; sys.version_info = (3, 10, 9); exec(code)"
    old.write_text(f'#!/bin/sh\nexec {sys.executable} -c "{disguise}" "$@"\n')
    old.chmod(0o700)
    command = ["make", "-f", str(MAKEFILE), "setup", f"PYTHON={old}"]
    asked = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert asked.returncode == 2
    assert "make: Python 3.11 or newer is needed, as in PYTHON=python3.12\n" in asked.stderr
    assert "Traceback" not in asked.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"pyproject.toml", "python3.10"}


@pytest.mark.slow
def test_run_ends_with_the_kept_verdict_apart_from_the_short_trainings(
    tmp_path: Path, recorded: Callable[..., Path]
) -> None:
    (tmp_path / "results").symlink_to(MAKEFILE.parent / "results")
    outputs = tmp_path / "outputs"
    for model, score in (("cnn", 3_540.0), ("resnet", 1_200.0)):
        recorded(f"model={model}", "phase.quick.steps=1500", f"paths.outputs={outputs}", scores=(score,))
    python = tmp_path / "python"  # which neither trains nor plays nor needs MLflow
    python.write_text(
        f"""#!/bin/sh
        case "$2 $3" in
            'atlantis_exp compare') exec {sys.executable} "$@" tracking=none "paths.outputs=$PWD/outputs" ;;
            atlantis_exp*) ;;
            *) exec {sys.executable} "$@" ;;
        esac
        """
    )
    python.chmod(0o700)
    command = ["make", "-f", str(MAKEFILE), "--old-file=setup", "run", f"BIN={tmp_path}"]
    environment = os.environ | {"PYTHONPATH": str(MAKEFILE.parent)}
    for _ in range(2):  # the second time the copies are there
        ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
        assert ran.returncode == 0, ran.stderr
        verdict = ran.stdout.index("cnn plays better than resnet_fast by 13,813 points")
        line = "\nyour two short trainings: 3,540 and 1,200 points: too short to say anything\n"
        assert ran.stdout.index(line) > verdict
