"""What a person sees of work that takes long."""

import io
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from rich.console import Console
from rich.table import Table

from atlantis_exp import terminal


def test_a_stored_text_keeps_its_lines_and_loses_what_a_terminal_obeys() -> None:
    assert terminal.harmless("a\x1b]52;c;cm0=\x07\r\x9b2J\u202eb\nmean ± é") == "a]52;c;cm0=2Jb\nmean ± é"


def test_a_warning_is_one_line_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    terminal.warn("left out a\nb: \x1b[2J\udcff ±")
    assert capsys.readouterr() == ("", "atlantis_exp: left out a b: [2J ±\n")


def test_whatever_is_printed_a_terminal_obeys_nothing_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.MonkeyPatch.context() as patched:
        for name in ("stdout", "stderr"):
            patched.setattr(sys, name, getattr(sys, name))  # which is put back
        terminal.guard()
        print("run \x1b[2J\u202e\udcff±")
        print("a\x9b2J", file=sys.stderr)
        table = Table("\x1b]0;x\x07name")
        table.add_row("\x1b[31mred\u202e")
        terminal.console().print(table)
        terminal.console().print("line \x1b[2J")
    printed = capsys.readouterr()
    assert not [each for each in printed.out + printed.err if each != "\n" and not each.isprintable()]
    assert printed.out.startswith("run [2J±\n")
    assert "[31mred" in printed.out


def test_closed_streams_are_written_to_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    terminal.guard()
    print("a line")
    terminal.console().print("a line")
    terminal.warn("a line")


@pytest.mark.filterwarnings("error")
def test_work_goes_on_where_its_progress_cannot_be_written(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = threading.Event()

    def full(*_: object, **__: object) -> None:
        tried.set()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(terminal, "_FIRST_SECONDS", 0.0)
    monkeypatch.setattr(Console, "print", full)
    with terminal.working("working"):
        assert tried.wait(30)


def test_a_table_has_its_names_on_the_left_and_its_numbers_on_the_right(capsys: pytest.CaptureFixture[str]) -> None:
    table = terminal.table("name", "number", title="both")
    table.add_row("a", "1")
    table.add_row("longer", "1,000,000")
    terminal.console().print(table)
    assert {"│ a      │         1 │", "│ longer │ 1,000,000 │"} <= {*capsys.readouterr().out.splitlines()}


def test_a_console_colours_with_codes_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(sys, "stdout", screen)
    terminal.guard()
    monkeypatch.setenv("FORCE_COLOR", "1")
    terminal.console().print("name", style="bold")
    assert "\x1b[" in screen.getvalue()


@pytest.fixture
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "_FIRST_SECONDS", 0.01)
    monkeypatch.setattr(terminal, "LINE_SECONDS", 0.01)


@pytest.mark.usefixtures("_quick")
def test_long_work_says_what_it_is_and_how_far_again_and_again(capsys: pytest.CaptureFixture[str]) -> None:
    asked, enough = 0, threading.Event()

    def how_far() -> str:
        nonlocal asked
        asked += 1
        if asked == 3:
            enough.set()
        return f"{asked} of 10"

    with terminal.working("drawing [b]", how_far):
        assert enough.wait(30)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["drawing [b], 1 of 10, 0 s", "drawing [b], 2 of 10, 0 s"]


def test_short_work_says_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    with terminal.working("nothing"):
        pass
    assert capsys.readouterr().out == ""


@pytest.mark.usefixtures("_quick")
def test_on_a_terminal_it_is_one_line_that_goes_away(monkeypatch: pytest.MonkeyPatch) -> None:
    screen, asked = io.StringIO(), threading.Event()
    monkeypatch.setattr(terminal, "console", lambda: Console(file=screen, force_terminal=True, width=80))

    def how_far() -> str:
        if "drawing" in screen.getvalue():
            asked.set()
        return ""

    with terminal.working("drawing", how_far):
        assert asked.wait(30)
    assert screen.getvalue().endswith("\x1b[2K")  # the line, cleared


def test_an_error_ends_the_telling() -> None:
    with pytest.raises(ZeroDivisionError), terminal.working("failing"):
        _ = 1 / 0
    assert not [thread for thread in threading.enumerate() if thread.name == "telling"]


@pytest.mark.parametrize(("brings", "program"), [((), "python -m atlantis_exp"), (("conf",), "atlantis-exp")])
def test_a_person_calls_an_installed_wheel_by_its_command(
    brings: tuple[str, ...], program: str, tmp_path: Path
) -> None:
    """A wheel is what brings the config groups in its package."""
    package = tmp_path / "atlantis_exp"
    package.mkdir()
    (package / "__init__.py").touch()
    shutil.copy(terminal.__file__, package)
    for name in brings:
        (package / name).mkdir()
    words = (sys.executable, "-c", "from atlantis_exp.terminal import PROGRAM; print(PROGRAM)")
    said = subprocess.run(words, cwd=tmp_path, env={}, capture_output=True, text=True, check=True)
    assert said.stdout == f"{program}\n"
