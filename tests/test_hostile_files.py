"""Damaged and hostile files: whatever a verb reads, it ends in one line, soon, and changes nothing that was there."""

import importlib
import io
import json
import logging
import os
import random
import shutil
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from atlantis_exp import commands
from atlantis_exp.build import build_memory
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config, PathsConfig
from atlantis_exp.faults import Fault
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.launchers import BASIC
from atlantis_exp.sessions.training import train
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.training.checkpoint import Checkpoints, _checksum
from benchmarks.composition import composed

PLAYING = ("episodes=1", "evaluation.video=false", "device=cpu")
VERBS = {
    "compare": ("compare", "by=seed", "tracking=none"),
    "report": ("report",),
    "sync": ("sync",),
    "evaluate": ("evaluate", "run=cnn-uniform-s0", "tracking=none", *PLAYING),
    "export": ("export", "run=cnn-uniform-s0", "to={outputs}/new", *PLAYING),
    "best": ("export", "run=cnn-uniform-s0", "weights=best", "to={outputs}/new", *PLAYING),
    "exported": ("evaluate", "weights={outputs}/card", "tracking=none", *PLAYING),
    "train": ("train",),  # a training that has ended
    "continue": ("train", "seed=1"),  # one that a larger budget continues
    "sweep": ("train", "-m", "seed=0,1", "budget.steps=80"),  # of the two as they are
}
OF_A_RUN = ("compare", "report", "sync", "evaluate", "export", "best", "train", "sweep")
READ_BY = {
    **{f"runs/*s0*/{name}": OF_A_RUN for name in ("config.json", "result.json", "commit.json", "journal.jsonl")},
    "runs/*s0*/artifacts/evaluation/000000160.csv": ("compare",),
    "runs/*s0*/artifacts/models/network/160.safetensors": ("best", "sync"),
    "runs/*s0*/artifacts/images/score/heatmap/0.png": ("sync",),
    "runs/*s0*/checkpoints/*/manifest.json": ("evaluate", "best"),
    "runs/*s0*/checkpoints/*/state.json": ("evaluate", "best"),
    "runs/*s0*/checkpoints/*/tensors.safetensors": ("evaluate",),
    "runs/*s0*/published.json": ("report", "sync"),
    **{f"runs/*s1*/{name}": ("continue",) for name in ("config.json", "result.json", "commit.json")},
    "runs/*s1*/journal.jsonl": ("continue", "report"),
    **{f"runs/*s1*/checkpoints/*/{name}": ("continue",) for name in ("manifest.json", "state.json")},
    **{f"runs/*s1*/checkpoints/*/{name}.safetensors": ("continue",) for name in ("tensors", "arrays")},
    **{f"runs/*s1*/checkpoints/segments/*/{name}": ("continue",) for name in ("state.json", "arrays.safetensors")},
    "evaluations/*/config.json": ("compare", "sync"),
    "evaluations/*/result.json": ("compare",),
    "evaluations/*/commit.json": ("compare", "sync"),
    "evaluations/*/artifacts/evaluation/episodes.csv": ("compare",),
    "comparisons/*/looks.json": ("compare",),
    **{f"sweeps/*/{name}": ("sweep", "sync") for name in ("commit.json", "journal.jsonl", "published.json")},
    "card/card.json": ("exported",),
    "card/weights.safetensors": ("exported",),
}
WAYS = ("pipe", "folder", "huge")  # what may be in a file's place
OWN = ("lock", "holder.txt", "published.")  # beginnings of files that verbs may write next to a run's


class Hangs(BaseException): ...


def run(*words: str) -> int:
    """A command line's exit code."""
    with pytest.MonkeyPatch.context() as patched, soon():
        patched.setattr(sys, "argv", ["atlantis_exp", *words])
        patched.setattr(logging.root, "handlers", [])  # of another command, whose output is closed
        try:
            commands.main()
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
    overrides = replaced(tiny_overrides, "tracking.histogram_episodes=2")
    training = tuple(word for word in overrides if word != "tracking=none")
    assert run("train", *training, where) == 0
    assert run("train", *training, "seed=1", "budget.steps=80", where) == 0
    assert run("evaluate", "run=cnn-uniform-s0", "evaluation.seed=1", "tracking=none", *PLAYING, where) == 0
    assert run(*VERBS["compare"], where) == 0
    assert run("export", "run=cnn-uniform-s0", f"to={outputs}/card", *PLAYING, where) == 0
    assert run(*words_of("sweep", training, outputs)) == 0
    return outputs, training


def contents(outputs: Path) -> dict[str, bytes]:
    """The files of runs, evaluations and the card, but for those that verbs may write."""
    files = [path for place in ("runs", "evaluations", "card") for path in (outputs / place).rglob("*")]
    own = (path for path in files if path.is_file() and not path.name.startswith(OWN) and path.stat().st_size < 2**30)
    return {str(path): path.read_bytes() for path in own}


def words_of(verb: str, training: Sequence[str], outputs: Path) -> list[str]:
    """The command line of a verb."""
    words = [word.format(outputs=outputs) for word in VERBS[verb]]
    return [*words, *(training if words[0] == "train" else ()), f"paths.outputs={outputs}"]


def assert_nothing_changed(before: dict[str, bytes], after: dict[str, bytes], verb: str) -> None:
    """All is as before, but for a run that is to go on, and for the parent that a sweep gives its runs."""
    changed = [Path(name) for name, content in before.items() if after.get(name) != content]
    if verb == "sweep":
        changed = [path for path in changed if path.name != "commit.json"]
    assert not changed or verb == "continue"


def replaced_by(path: Path, how: str) -> None:
    """Put what is no file in a file's place, or one that is larger than any that is read."""
    path.unlink()
    match how:
        case "pipe":
            os.mkfifo(path)
        case "folder":
            path.mkdir()
        case _:
            path.touch()
            os.truncate(path, 2**40)  # without taking room


# Fuzzed: any change of any of these files, as Hypothesis thinks of them, and any verb that reads it.

NUMBERS = (-1, 0, 1, 2**31, 2**63, 10**400, -(2**63), 0.5, 1e308, -0.0, float("nan"), float("inf"))
TEXTS = ("", "\x00", "\ud800", "../../../etc/passwd", "/", "a\nb", "[/b]", "$\\frac{", "x" * 10_000, "RUNNING", "1e999")
VALUES = st.recursive(
    st.none() | st.booleans() | st.sampled_from((*NUMBERS, *TEXTS)) | st.text(max_size=8) | st.integers(-9, 9),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(("a", "", "kind", "name")), inner),
    max_leaves=4,
)


def prepared(name: str, *words: str) -> Callable[[], object]:
    """A verb's work, composed and checked, to be done as often as one likes."""
    verb: Verb[Any] = importlib.import_module(f"atlantis_exp.commands.{name}").VERB
    jobs = check(verb.config_name or name, verb.schema, verb.rewrite(list(words)))
    asked = [Asked(config, name, overrides, typed=words) for overrides, config in jobs.items()]
    if len(asked) > 1 and verb.sweep is not None:
        sweep = verb.sweep
        return lambda: sweep(asked, BASIC, words)
    work: Callable[[], object] = verb.work(asked[0])
    return work


@st.composite
def changed_json(draw: st.DrawFn, content: bytes) -> bytes:
    """JSON with a node replaced, left out, doubled, or buried."""
    tree = json.loads(content)
    nodes: list[tuple[Any, Any]] = []

    def walk(node: Any) -> None:
        for key, value in node.items() if isinstance(node, dict) else enumerate(node):
            nodes.append((node, key))
            if isinstance(value, dict | list):
                walk(value)

    walk(tree)
    holder, key = draw(st.sampled_from(nodes)) if nodes else ([tree], 0)
    match draw(st.sampled_from(("replace", "replace", "remove", "rename", "double", "bury", "whole"))):
        case "replace":
            holder[key] = draw(VALUES)
        case "remove":
            del holder[key]
        case "rename" if isinstance(holder, dict):
            holder[draw(st.sampled_from(TEXTS))] = holder.pop(key)
        case "double" if isinstance(holder, dict):
            holder["$twice"] = draw(VALUES)
            return json.dumps(tree).replace('"$twice"', json.dumps(key)).encode()
        case "bury":
            holder[key] = "$deep"
            depth = draw(st.sampled_from((10, 199, 200, 201, 1_000, 100_000)))
            return json.dumps(tree).replace('"$deep"', "[" * depth + "]" * depth).encode()
        case "whole":
            tree = draw(VALUES)
    return json.dumps(tree).encode()


@st.composite
def changed_lines(draw: st.DrawFn, content: bytes) -> bytes:
    """Lines of which one is changed, left out, doubled, or moved."""
    lines = content.splitlines(keepends=True)
    index, other = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    match draw(st.sampled_from(("change", "change", "remove", "double", "move", "cell"))):
        case "change" if lines[index].startswith(b"{"):
            lines[index] = draw(changed_json(lines[index])) + b"\n"
        case "remove":
            del lines[index]
        case "double":
            lines.insert(other, lines[index])
        case "move":
            lines.insert(other, lines.pop(index))
        case _:
            cells = lines[index].rstrip(b"\n").split(b",")
            cells[draw(st.integers(0, len(cells) - 1))] = str(draw(VALUES)).encode(errors="surrogatepass")
            lines[index] = b",".join(cells) + b"\n"
    return b"".join(lines)


@st.composite
def changed_bytes(draw: st.DrawFn, content: bytes) -> bytes:
    """Bytes of which some are changed, left out, or put in between."""
    start = draw(st.integers(0, len(content)))
    stop = draw(st.sampled_from((start, start + 1, start + 8, len(content))))
    return content[:start] + draw(st.binary(max_size=9)) + content[stop:]


@st.composite
def changed_tensors(draw: st.DrawFn, content: bytes) -> bytes:
    """Safetensors with another header."""
    size = int.from_bytes(content[:8], "little")
    header = draw(changed_json(content[8 : 8 + size]))
    return len(header).to_bytes(8, "little") + header + content[8 + size :]


@st.composite
def change(draw: st.DrawFn, path: Path) -> bytes | str:
    if draw(st.integers(0, 9)) == 0:
        return draw(st.sampled_from(WAYS))
    content = path.read_bytes()
    ways: list[Callable[[bytes], st.SearchStrategy[bytes]]] = [changed_bytes]
    if path.suffix in (".json", ".jsonl", ".csv", ".safetensors"):
        ways += 3 * [{".json": changed_json, ".safetensors": changed_tensors}.get(path.suffix, changed_lines)]
    return draw(draw(st.sampled_from(ways))(content))


def sealed(path: Path, content: bytes) -> None:
    """Make the checksums and lengths that speak of a file true again, as whoever forges it would."""
    with suppress(ValueError, KeyError, TypeError, AttributeError, RecursionError):  # what is sealed need have no form
        if path.name == "journal.jsonl":
            commit = json.loads((path.parent / "commit.json").read_bytes())
            (path.parent / "commit.json").write_text(json.dumps({**commit, "offset": len(content)}))
        if path.parent.name == "card":
            card = json.loads((path.parent / "card.json").read_bytes())
            digest = sha256((path.parent / "weights.safetensors").read_bytes()).hexdigest()
            (path.parent / "card.json").write_text(json.dumps({**card, "sha256": digest}))
        if (manifest := path.parent / "manifest.json").exists():
            tree = json.loads(manifest.read_bytes())
            if path != manifest:
                tree["state"][path.name] = sha256(content).hexdigest()
            tree.pop("sha256", None)
            manifest.write_text(json.dumps({**tree, "sha256": _checksum(tree)}))


@pytest.fixture(scope="module")
def fuzzed(sound: tuple[Path, tuple[str, ...]], tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """Puts something in a file's place, calls a verb, and asserts that it ends well."""
    whole, training = sound
    outputs = tmp_path_factory.mktemp("fuzzed") / "outputs"
    works = {verb: prepared(*words_of(verb, training, outputs)) for verb in VERBS}
    places = ("runs", "evaluations", "comparisons", "sweeps", "card", "new")

    def call(pattern: str, verb: str, content: bytes | str, is_forged: bool) -> None:
        for place in places:
            shutil.rmtree(outputs / place, ignore_errors=True)
        shutil.copytree(whole, outputs, dirs_exist_ok=True, ignore=shutil.ignore_patterns("mlflow.db*"))
        (path, *_) = sorted(outputs.glob(pattern), reverse=True)
        if isinstance(content, str):
            replaced_by(path, content)
        else:
            path.write_bytes(content)
            if is_forged:
                sealed(path, content)
        before = contents(outputs)
        said = io.StringIO()
        with soon(), redirect_stderr(said), redirect_stdout(io.StringIO()):
            try:
                works[verb]()
            except (Fault, OSError) as fault:
                print(f"atlantis_exp: {fault}", file=sys.stderr)
        lines = said.getvalue().splitlines()
        assert not any(line.startswith((" ", "Traceback")) for line in lines), lines  # each a line of its own
        assert_nothing_changed(before, contents(outputs), verb)

    return call


FUZZED = sorted((pattern, verb) for pattern, verbs in READ_BY.items() for verb in verbs)


@pytest.mark.slow
@pytest.mark.timeout(7_200)
def test_a_changed_file_is_one_line(fuzzed: Callable[..., None], sound: tuple[Path, tuple[str, ...]]) -> None:
    @settings(
        max_examples=1_000,
        derandomize=True,
        deadline=None,
        database=None,
        phases=(Phase.explicit, Phase.generate, Phase.target),
    )
    @given(st.data())
    def changed(data: st.DataObject) -> None:
        pattern, verb = data.draw(st.sampled_from(FUZZED))
        (path, *_) = sorted(sound[0].glob(pattern), reverse=True)
        fuzzed(pattern, verb, data.draw(change(path)), data.draw(st.booleans()))

    changed()


# Forged: checkpoints whose checksums are all true, and whose contents are not what a training leaves.

State = dict[str, Any]
Forged = Callable[[Callable[[State, ReplayMemory], object]], Config]


def damage_frames(memory: ReplayMemory) -> None:
    frames = memory._frames
    for start, stop in frames._spans(np.arange(memory.oldest_id, memory.next_id)).tolist():
        frames._buffer[start:stop] = b"\xff" * (stop - start)


def of_the_optimizer(state: State, name: str) -> torch.Tensor:
    tensor: torch.Tensor = state["learner"]["optimizer"]["0"][name]
    return tensor


FORGERIES: dict[str, Callable[[State, ReplayMemory], object]] = {
    "actions that the game lacks": lambda _, memory: memory._action.fill(255),
    "observations that do not unpack": lambda _, memory: damage_frames(memory),
    "steps without an end": lambda state, _: state["counters"].update(steps=2**62),
    "steps of another type": lambda state, _: state["counters"].update(steps=[80]),
    "updates that are due for years": lambda state, _: state["counters"].update(learn_ticks=0, steps=2**50),
    "time without an end": lambda state, _: state["counters"].update(seconds=float("inf")),
    "updates beyond an int64": lambda state, _: state["learner"].update(updates=2**63 - 1),
    "an optimizer before its start": lambda state, _: of_the_optimizer(state, "step").fill_(-5),
    "an optimizer of another name": lambda state, _: state["learner"]["optimizer"]["0"].update(
        exp_avgs=state["learner"]["optimizer"]["0"].pop("exp_avg")
    ),
    "moments of another size": lambda state, _: state["learner"]["optimizer"]["0"].update(
        exp_avg=of_the_optimizer(state, "exp_avg")[1:]
    ),
    "priorities that are not numbers": lambda state, _: state["samplers"]["0"]["priorities"].fill(np.nan),
    "priorities of another memory": lambda state, _: state["samplers"]["0"].update(priorities=np.ones(7)),
    "priorities of what is to come": lambda state, _: state["samplers"]["0"].update(next_id=2**40),
    "priorities from before the beginning": lambda state, _: state["samplers"]["0"].update(oldest_id=-(2**63)),
    "a highest priority of nothing": lambda state, _: state["samplers"]["0"].update(highest=0.0),
    "a stack of another size": lambda state, _: state["stack"].update(state=state["stack"]["state"][..., 1:]),
    "a stack of another type": lambda state, _: state["stack"].update(state=state["stack"]["state"].astype(float)),
    "a score that is not a number": lambda state, _: state["scores"].fill(np.nan),
    "scores that are not numbers": lambda state, _: state["episodes"].fill(np.nan),
    "lengths of other episodes": lambda state, _: state.update(lengths=np.zeros(7, np.int64)),
    "half an evaluation": lambda state, _: state.update(last_metrics={"evaluation/mean": 1.0}),
    "an evaluation without a best mean": lambda state, _: state.update(best_mean=None),
    "a best mean in words": lambda state, _: state.update(best_mean="good"),
    "an emulator's action that the game lacks": lambda state, _: state["emulators"]["0"]["actions"].fill(99),
    "an emulator of nothing": lambda state, _: state["emulators"]["0"].update(ale=np.zeros(0, np.uint8)),
}


@pytest.fixture(scope="module")
def halfway(tmp_path_factory: pytest.TempPathFactory, tiny_overrides: tuple[str, ...]) -> tuple[Path, Config]:
    """A training that a larger budget continues, and the config that does."""
    outputs = tmp_path_factory.mktemp("halfway")
    words = replaced(tiny_overrides, "sampler=prioritized", f"paths.outputs={outputs}")
    train(Job(composed(*words, "budget.steps=70")))
    return outputs, composed(*words)


@pytest.fixture
def forged(halfway: tuple[Path, Config], tmp_path: Path) -> Forged:
    """Forges the checkpoint of a copy of it, and returns the config that continues this."""
    shutil.copytree(halfway[0], tmp_path / "outputs")
    config = replace(halfway[1], paths=PathsConfig(outputs=str(tmp_path / "outputs")))

    def forge(change: Callable[[State, ReplayMemory], object]) -> Config:
        memory, checkpoints = build_memory(config), Checkpoints(RunFolder.of(config).checkpoints, config.identity())
        state = checkpoints.load(memory)
        assert state is not None
        change(state, memory)
        checkpoints._segments = []  # written anew, and true to their checksums
        checkpoints.save(state, memory)
        return config

    return forge


@pytest.mark.parametrize("change", FORGERIES.values(), ids=FORGERIES)
def test_a_forged_checkpoint_is_one_line(change: Callable[[State, ReplayMemory], object], forged: Forged) -> None:
    config = forged(change)
    with soon(), pytest.raises(Fault) as refused:
        train(Job(config))
    assert "\n" not in str(refused.value)
    assert "resume=never" in str(refused.value) or "does not fit this training" in str(refused.value)


def test_what_training_refuses_as_forged_is_not_played_either(forged: Forged) -> None:
    config = forged(FORGERIES["steps without an end"])
    with pytest.raises(Fault, match="does not fit this training"):
        stored_weights(RunFolder.of(config), "latest")


def test_what_is_not_changed_goes_on(forged: Forged) -> None:
    train(Job(config := forged(lambda *_: None)))
    assert RunFolder.of(config).state == "done"


def anywhere(seed: int) -> Callable[[State, ReplayMemory], None]:
    """A forgery of any leaf of a state: a number or a text of a form that hurts, an array cut, retyped or filled."""

    def change(state: State, _: ReplayMemory) -> None:
        rng = random.Random(seed)
        leaves: list[tuple[Any, Any]] = []

        def walk(node: State) -> None:
            for key, value in node.items():
                if isinstance(value, dict) and value:
                    walk(value)
                else:
                    leaves.append((node, key))

        walk(state)
        node, key = rng.choice(leaves)
        if not isinstance(value := node[key], np.ndarray | torch.Tensor):
            node[key] = rng.choice((*NUMBERS, *TEXTS, None, [], {}, True))
            return
        array = np.asarray(value).copy()
        match rng.choice(("cut", "retype", "fill")):
            case "cut":
                array = array.reshape(-1)[1:]
            case "retype":
                array = array.astype(rng.choice((np.float32, np.int64, np.uint8, np.bool_)))
            case _ if array.dtype.kind == "f":
                array.fill(rng.choice((np.nan, np.inf, -1e30, 1e30, 0)))
            case _:
                array.fill(rng.choice((0, 1, 255 if array.dtype == np.uint8 else 2**40)))
        node[key] = torch.from_numpy(array) if isinstance(value, torch.Tensor) else array

    return change


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(200))
def test_a_checkpoint_forged_anywhere_goes_on_or_is_one_line(
    seed: int, forged: Forged, capsys: pytest.CaptureFixture[str]
) -> None:
    config = forged(anywhere(seed))
    with soon(), suppress(Fault):
        train(Job(config))
    assert "Warning" not in capsys.readouterr().err
