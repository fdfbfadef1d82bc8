"""What `new` writes works as it is."""

import json
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from atlantis_exp.commands import CHECKOUT, CONF
from atlantis_exp.commands.overrides import check
from atlantis_exp.components import ENTRY_POINTS, KINDS, admit
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.sessions.contracts import contracts_of
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.new import EXAMPLES, begin


@pytest.fixture(autouse=True)
def _nothing_is_admitted_afterwards() -> Iterator[None]:
    yield
    admit([])


@pytest.mark.thinned(len(KINDS) - 1)
@pytest.mark.parametrize("kind", [kind for kind in KINDS if kind != "env"])
def test_what_is_written_keeps_every_contract(
    kind: str,
    command: Callable[..., int],
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folder = tmp_path / "new"
    assert command("new", f"{kind}=my_own", f"to={folder}") == 0
    source = folder / "atlantis_my_own" / "my_own.py"
    assert f"check {kind}=my_own plugins={source}" in capsys.readouterr().out
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["entry-points"][ENTRY_POINTS] == {"my_own": "atlantis_my_own.my_own"}
    for path in folder.rglob("*.py"):
        compile(path.read_text(), path, "exec")

    words = [*tiny_overrides, f"{kind}=my_own", f"plugins={source}"]
    ((_, config),) = check("config", Config, words).items()
    assert getattr(config, kind).component.load().__name__.startswith("MyOwn")
    for _, contract, trial in contracts_of(config, Job(config), [kind]):
        if not contract.startswith("killed"):
            trial()

    assert command("new", f"{kind}=my_own", f"to={folder}") == 2
    assert "is not empty" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["model=mynet"], "to: missing; write to=FOLDER, as in to=./mynet"),
        (["to=x"], "new: name one component"),
        (["model=mynet", "sampler=mine", "to=x"], "new: name one component"),
        (["model=MyNet", "to=x"], "model=MyNet: a name has lowercase letters"),
        (["model=class", "to=x"], "model=class: is a Python keyword"),
        (["model=cnn", "to=x"], "model=cnn: is built in and cannot be replaced"),
    ],
)
def test_a_package_that_cannot_be_is_one_line(
    words: list[str], reason: str, command: Callable[..., int], capsys: pytest.CaptureFixture[str]
) -> None:
    assert command("new", *words) == 2
    assert reason in capsys.readouterr().err


def test_a_wheel_brings_the_examples_that_packages_are_made_of() -> None:
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text())
    brought = project["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert (brought["conf"], brought["examples"]) == ("atlantis_exp/conf", "atlantis_exp/examples")
    assert all((CHECKOUT / "examples" / f"{example}.py").is_file() for example, _ in EXAMPLES.values())


def test_what_is_written_is_whole_or_not_there(tmp_path: Path) -> None:
    with pytest.raises(
        Fault, match=r"^to=.*new: .*name too long.*; make room there, or name another folder$"
    ):  # once the first files are written
        begin("model", 300 * "x", tmp_path / "new", CONF.parent / "examples")
    assert [*tmp_path.iterdir()] == []


def test_what_is_written_removes_nothing_beside_it(tmp_path: Path) -> None:
    (tmp_path / "new.aside").mkdir()
    begin("model", "mynet", tmp_path / "new", CONF.parent / "examples")
    assert {path.name for path in tmp_path.iterdir()} == {"new", "new.aside"}


@pytest.mark.slow
@pytest.mark.timeout(300)  # seconds
def test_what_is_written_is_installed_and_chosen_by_its_name(
    command: Callable[..., int], tiny_overrides: tuple[str, ...], tmp_path: Path
) -> None:
    """Installed by pip into an environment of its own, first in place and then as a wheel, which is the same run."""
    assert command("new", "model=my_own", f"to={tmp_path / 'new'}") == 0
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "own"], check=True)
    python = tmp_path / "own" / "bin" / "python"
    (site,) = (tmp_path / "own").glob("lib/*/site-packages")
    (site / "ours.pth").write_text(f"import site; site.addsitedir({sysconfig.get_path('purelib')!r})\n")
    words = replaced(tiny_overrides, "phase.quick.steps=20", "evaluation.at_end=false", "paths.outputs=o")

    def run(*arguments: str) -> str:
        ended = subprocess.run([python, "-m", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ended.returncode == 0, ended.stdout + ended.stderr
        return ended.stdout

    for way, said in ((["-e", "./new"], "starting run my_own"), (["--force-reinstall", "./new"], "has ended")):
        run("pip", "install", "--quiet", "--no-deps", *way)
        assert "my_own" in run("atlantis_exp", "--help")
        assert said in run("atlantis_exp", *words, "model=my_own", "plugins=atlantis-my-own")
    (config,) = (tmp_path / "o" / "runs").glob("*/config.json")
    (plugin,) = json.loads(config.read_bytes())["plugins"].values()
    assert plugin["version"] == "0.1.0"
