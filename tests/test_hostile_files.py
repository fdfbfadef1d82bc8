"""Damaged and hostile files: whatever a verb reads, it ends in one line, soon, and changes nothing that was there."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from atlantis_exp.commands import main

PLAYING = ("episodes=1", "evaluation.video=false", "device=cpu")
VERBS = {
    "compare": ("compare", "tracking=none"),
    "report": ("report",),
    "sync": ("sync",),
    "evaluate": ("evaluate", "run=cnn", "tracking=none", *PLAYING),
    "export": ("export", "run=cnn", "to={outputs}/new", *PLAYING),
    "exported": ("evaluate", "weights={outputs}/card", "tracking=none", *PLAYING),
    "train": (),  # the training itself, again
}
OF_A_RUN = ("compare", "report", "sync", "evaluate", "export", "train")
READ_BY = {
    **{f"runs/*/{name}": OF_A_RUN for name in ("config.json", "result.json", "commit.json", "journal.jsonl")},
    "runs/*/artifacts/evaluation/000000160.csv": ("compare",),
    "runs/*/artifacts/models/network/160.safetensors": ("export", "sync"),
    "runs/*/checkpoints/*/manifest.json": ("evaluate", "export"),
    "runs/*/checkpoints/*/state.json": ("evaluate", "export"),
    "runs/*/checkpoints/*/tensors.safetensors": ("evaluate", "export"),
    "runs/*/published.json": ("report", "sync"),
    "evaluations/*/config.json": ("compare", "sync"),
    "evaluations/*/result.json": ("compare",),
    "evaluations/*/commit.json": ("compare", "sync"),
    "evaluations/*/artifacts/evaluation/episodes.csv": ("compare",),
    "card/card.json": ("exported",),
    "card/weights.safetensors": ("exported",),
}
WAYS = ("deep", "pipe", "folder", "huge", "cut", "", "5", "[]", "{}", "null", '{"kind":"metrics"}', "\x00")
OWN = ("lock", "holder.txt", "published.json", "published.lock")  # files that verbs may write beside a run's


class Hangs(BaseException): ...


def run(*words: str) -> int:
    """A command line's exit code."""
    with pytest.MonkeyPatch.context() as patched, soon():
        patched.setattr(sys, "argv", ["atlantis_exp", *words])
        try:
            main()
        except SystemExit as ended:
            return int(str(ended.code))
    return 0


@contextmanager
def soon(seconds: int = 60) -> Iterator[None]:
    """Raise Hangs where the block takes longer."""

    def raise_hangs(*_: object) -> None:
        raise Hangs

    before = signal.signal(signal.SIGALRM, raise_hangs)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture(scope="module")
def sound(
    tmp_path_factory: pytest.TempPathFactory, tiny_overrides: tuple[str, ...], mlflow_tables: Callable[[Path], None]
) -> tuple[Path, tuple[str, ...]]:
    """An outputs folder with a trained run, an evaluation of it, and its weights exported; and the run's command."""
    outputs = tmp_path_factory.mktemp("sound") / "outputs"
    mlflow_tables(outputs)
    where = f"paths.outputs={outputs}"
    training = tuple(word for word in tiny_overrides if word != "tracking=none")
    assert run(*training, where) == 0
    assert run("evaluate", "run=cnn", "epsilon=0.5", "tracking=none", *PLAYING, where) == 0
    assert run("export", "run=cnn", f"to={outputs}/card", *PLAYING, where) == 0
    return outputs, training


@pytest.fixture
def outputs(sound: tuple[Path, tuple[str, ...]], tmp_path: Path) -> Path:
    """A copy of it."""
    copy = tmp_path / "outputs"
    shutil.copytree(sound[0], copy)
    return copy


def contents(outputs: Path) -> dict[str, bytes]:
    """The files of runs, evaluations and the card, but for those that verbs may write."""
    files = [path for place in ("runs", "evaluations", "card") for path in (outputs / place).rglob("*")]
    own = (path for path in files if path.is_file() and path.name not in OWN and path.stat().st_size < 2**30)
    return {str(path): path.read_bytes() for path in own}


def assert_it_ends_in_one_line(
    outputs: Path, training: tuple[str, ...], verb: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = contents(outputs)
    capsys.readouterr()
    words = VERBS[verb] or training
    code = run(*(word.format(outputs=outputs) for word in words), f"paths.outputs={outputs}")
    said = capsys.readouterr().err
    assert code in (0, 1, 2, 75), said
    assert "Traceback" not in said
    assert code == 0 or len([line for line in said.splitlines() if line.startswith("atlantis_exp:")]) >= 1, said
    after = contents(outputs)
    assert {name: after.get(name) for name in before} == before or verb == "train"


def damaged(path: Path, how: str) -> None:
    """Put something else in a file's place."""
    content = path.read_bytes()
    path.unlink()
    match how:
        case "deep":
            path.write_bytes(b'{"a":' * 20_000 + b"1" + b"}" * 20_000 + b"\n")
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case "huge":
            path.touch()
            os.truncate(path, 2**40)  # without taking room
        case "cut":
            path.write_bytes(content[: len(content) // 2])
        case _:
            path.write_bytes(how.encode() + b"\n")


def hostile(pattern: str, verb: str, how: str) -> object:
    # Of all, a quick choice: nested JSON for one verb that reads the file.
    is_quick = how == "deep" and verb == READ_BY[pattern][0] and not pattern.startswith("evaluations/")
    return pytest.param(pattern, verb, how, marks=() if is_quick else pytest.mark.slow)


@pytest.mark.parametrize(
    ("pattern", "verb", "how"),
    [hostile(pattern, verb, how) for pattern, verbs in READ_BY.items() for verb in verbs for how in WAYS],
)
def test_a_hostile_file_is_one_line(
    pattern: str,
    verb: str,
    how: str,
    outputs: Path,
    sound: tuple[Path, tuple[str, ...]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    (path, *_) = sorted(outputs.glob(pattern), reverse=True)
    damaged(path, how)
    assert_it_ends_in_one_line(outputs, sound[1], verb, capsys)
