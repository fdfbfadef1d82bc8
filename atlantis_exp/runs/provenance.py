"""Record the origin of a run: versions of code and libraries, and the command."""

import subprocess
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

_LIBRARIES = ("atlantis-exp", "ale-py", "gymnasium", "torch", "numpy", "opencv-python-headless", "hydra-core", "mlflow")


def provenance(command: str) -> dict[str, str]:
    """Return the tags for a run's code, libraries and command."""
    tags = {f"version.{name}": version(name) for name in _LIBRARIES}
    tags["version.python"] = sys.version.split()[0]
    checkout = Path(__file__).resolve().parents[2]
    if (checkout / ".git").exists():

        def git(*arguments: str) -> str:
            done = subprocess.run(("git", *arguments), cwd=checkout, capture_output=True, text=True, check=True)
            return done.stdout.strip()

        with suppress(OSError, subprocess.CalledProcessError):  # git is missing, or refuses another user's folder
            commit = git("rev-parse", "HEAD")
            dirty = str(bool(git("status", "--porcelain", "--untracked-files=no"))).lower()
            tags |= {"git.commit": commit, "git.dirty": dirty}
    tags["command"] = command
    return tags
