"""Write a package with a component to start from: an example under a new name, with test, README and entry point."""

import re
from pathlib import Path

from atlantis_exp.checking import check_new
from atlantis_exp.components import ENTRY_POINTS
from atlantis_exp.runs.files import whole, write_file
from atlantis_exp.terminal import command_line, quoted

EXAMPLES = {
    "model": ("residual", "Network"),
    "sampler": ("paying", "Sampler"),
    "objective": ("mellow", "Objective"),
    "epsilon": ("halfway", "Schedule"),
    "lr_schedule": ("halfway", "Schedule"),
}
"""The example of each kind, and the last part of its class's name."""
_PROJECT = """[build-system]
requires = ["hatchling"]
build-backend = "hatchling.build"

[project]
name = "{distribution}"
version = "0.1.0"
description = "A component of atlantis_exp: {kind}={name}"
readme = "README.md"
requires-python = ">=3.11"
dependencies = ["atlantis-exp"]

[project.entry-points."{group}"]
{name} = "{package}.{name}"
"""
_README = """# {distribution}

    pip install -e .
    python -m atlantis_exp {kind}={name} plugins={distribution} --cfg job
    python -m atlantis_exp check {kind}={name} plugins={distribution}
    python -m atlantis_exp {kind}={name} plugins={distribution} experiment=quick

Without installing it: `plugins=./{package}/{name}.py`. Settings are the constructor's arguments.
"""
_TEST = '''"""The component keeps every contract of atlantis_exp."""

import subprocess
import sys
from pathlib import Path

SOURCE = Path(__file__).resolve().parents[1] / "{package}" / "{name}.py"


def test_it_keeps_every_contract() -> None:
    subprocess.run([sys.executable, "-m", "atlantis_exp", "check", "{kind}={name}", f"plugins={{SOURCE}}"], check=True)
'''


def begin(kind: str, name: str, folder: Path, examples: Path) -> None:
    """Write a package with a working component, whole or not at all. Raises: ConfigError, Fault."""
    check_new(folder)
    example, suffix = EXAMPLES[kind]
    source = (examples / f"{example}.py").read_text()
    source = re.sub(r"@component\(.*\)", f'@component("{name}", "{kind}")', source)
    own = "".join(part.capitalize() for part in name.split("_"))
    words = {
        "kind": kind,
        "name": name,
        "package": f"atlantis_{name}",
        "distribution": f"atlantis-{name.replace('_', '-')}",
        "group": ENTRY_POINTS,
    }
    package = Path(words["package"])
    files = {
        Path("pyproject.toml"): _PROJECT.format_map(words),
        Path("README.md"): _README.format_map(words),
        Path("tests", f"test_{name}.py"): _TEST.format_map(words),
        package / "__init__.py": f'"""A component of atlantis_exp: {kind}={name}."""\n',
        package / f"{name}.py": re.sub(rf"\b{example.title()}{suffix}\b", own + suffix, source),
    }
    with whole(folder) as aside:
        for path, text in files.items():
            write_file(aside / path, text.encode())
    print(*(folder / path for path in files), sep="\n")
    plugin = quoted(f"{folder / package / name}.py")
    print("\n" + command_line("check", f"{kind}={name}", f"plugins={plugin}"))
