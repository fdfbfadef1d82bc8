"""What `make` does on a machine where it cannot go on."""

import subprocess
import sys
from pathlib import Path

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
