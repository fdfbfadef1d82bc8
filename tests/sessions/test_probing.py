"""Networks asked themselves: alike where they are the same, apart where a naive loop says so, and filmed from there."""

import csv
import io
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import pytest
import safetensors.numpy

from atlantis_exp.build import make_emulator
from atlantis_exp.comparison.export_tables import to_latex, to_parquet, with_units
from atlantis_exp.comparison.gather import Training, gather
from atlantis_exp.components import facts_of, known
from atlantis_exp.config import Config
from atlantis_exp.game.archive import read_archive
from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions import probing
from atlantis_exp.sessions.cards import build_exported_actor, read_card
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.probing import Network, asked, median_run, part, probe_groups, probed
from atlantis_exp.sessions.training import train
from atlantis_exp.training.actor import EpsilonGreedy

pytestmark = pytest.mark.slow

Compose = Callable[..., Config]
PRETRAINED = Path(__file__).resolve().parents[2] / "pretrained"
GAME = known("env")["atlantis"]
ATLANTIS = facts_of(GAME)
STATES = GAME.data_path("states.npz")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("trained")


@pytest.fixture
def trained(tiny: Compose, folder: Path) -> list[Training]:
    """Three seeds, the last of which plays another game and sees more than the archive shows."""
    several = (("seed=0",), ("seed=1",), ("seed=2", "env.frameskip=6", "env.stack=8"))
    configs = [tiny(f"paths.outputs={folder}", *overrides) for overrides in several]
    if not (folder / "runs").exists():
        for config in configs:
            train(Job(config))
    runs = {run.name: run for run in gather(folder).trainings}
    return [runs[config.run_name()] for config in configs]


def network_of(name: str, noise: float = 0.0) -> Network:
    """A network of the repository, or one whose weights are a little off."""
    card, weights = read_card(PRETRAINED / name)
    generator = np.random.default_rng(0)
    arrays = {
        key: array * (1 + noise * generator.standard_normal(array.shape, np.float32))
        for key, array in sorted(safetensors.numpy.load(weights).items())  # in an order that is no process's own
    }
    actor = build_exported_actor(card.config, safetensors.numpy.save(arrays), "cpu")
    assert isinstance(actor, EpsilonGreedy)
    return Network(f"{name} {noise}", name, card.config.env, actor.q_values)


@pytest.fixture(scope="module")
def unlike() -> tuple[Network, Network]:
    """Networks that see different parts of the screen in different sizes."""
    return network_of("cnn_fast"), network_of("resnet_fast")


@pytest.fixture(scope="module")
def nearly_alike() -> tuple[Network, Network]:
    """Networks that play the same game for some steps."""
    return network_of("cnn_fast"), network_of("cnn_fast", 0.005)


class Found(NamedTuple):
    """The first step at which actions differ, and how both games end."""

    step: int
    frame: int
    score: float
    actions: list[int]
    lasts: list[int]  # steps
    scores: list[float]


def naive(networks: tuple[Network, Network], most: int) -> Found:
    emulators = [make_emulator(each.env)() for each in networks]
    stacks = [FrameStack(1, each.env.size, each.env.stack) for each in networks]
    for emulator, stack in zip(emulators, stacks, strict=True):
        stack.reset([0], emulator.reset(probing.SEED)[np.newaxis])
    found: tuple[int, int, float, list[int]] | None = None
    frame, scores, lasts, over = 0, [0.0, 0.0], [0, 0], [False, False]
    for step in range(most):
        actions = [int(each.q_values(stack.state)[0].argmax()) for each, stack in zip(networks, stacks, strict=True)]
        if found is None and actions[0] != actions[1]:
            found = step, frame, scores[0], actions
        for index, action in enumerate(actions):
            if over[index]:
                continue
            made = emulators[index].step(action)
            stacks[index].push(made.observation[np.newaxis])
            lasts[index] += 1
            scores[index] += made.reward
            over[index] = made.terminated or made.truncated
            frame += made.frames if index == 0 else 0
        if all(over):
            break
    assert found is not None
    return Found(*found, lasts, scores)


def frames_of(film: bytes) -> int:
    with av.open(io.BytesIO(film), "r") as container:
        pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert pictures[0].shape == (420, 1120, 3)
    return len(pictures)


def test_a_network_agrees_with_itself_and_never_parts(trained: list[Training], folder: Path) -> None:
    run = trained[0]
    result = probe_groups(folder, {"a": [run], "b": [run]}, None)
    (row,) = result.tables["probes"]
    assert (row["run"], row["other_run"], row["states"]) == (run.name, run.name, 128)
    assert row["equal_actions"] == 1
    assert row["advantage_distance"] == 0
    assert row["state_value_correlation"] == pytest.approx(1)
    (row,) = result.tables["partings"]
    assert row["outcome"] == "never, a game was over after 40 steps"
    assert result.films == {}
    assert result.facts == {"networks asked about": f"128 archived states, SHA-256 {read_archive(STATES).sha256}"}


def test_the_same_runs_give_the_same_tables_words_and_films(trained: list[Training], folder: Path) -> None:
    groups = {"../../a": [trained[0]], "<b>": [trained[1]]}
    first = probe_groups(folder, groups, None)
    assert first.tables["probes"][0]["equal_actions"] < 1
    assert [*first.films] == ["films/01-a-vs-b.mp4"]
    assert probe_groups(folder, groups, None) == first
    for name, table in first.tables.items():
        assert to_latex(name, table).count(r"\\") == 2  # header and row
        assert to_parquet(name, table)
    assert [*with_units("partings", first.tables["partings"])[0]][:6] == [
        *("group", "other", "seed", "outcome", "step (steps)", "frame (frames)")
    ]


def test_the_search_for_a_parting_ends(trained: list[Training], folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probing, "MOST_STEPS", 12)
    network = probing._network("a", RunFolder(folder / "runs" / trained[0].name))
    row, film = part(network, network)
    assert (row["outcome"], film) == ("never within 12 steps", None)


@pytest.mark.parametrize("which", ["unlike", "nearly_alike"])
def test_networks_part_where_a_naive_loop_finds_it(
    which: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    networks: tuple[Network, Network] = request.getfixturevalue(which)
    monkeypatch.setattr(probing, "FILM_SECONDS", 2)
    row, film = part(*networks)
    found = naive(networks, 200)
    assert (found.step > 5) == (which == "nearly_alike")
    assert (row["outcome"], row["step"], row["frame"], row["score"]) == ("parted", *found[:3])
    assert [row["action"], row["other_action"]] == [ATLANTIS.actions[action] for action in found.actions]
    for name in ("", "other_"):
        values = {text.split()[0]: float(text.split()[1]) for text in row[f"{name}values"].split(", ")}
        assert max(values, key=lambda action: values[action]) == row[f"{name}action"]
    assert film is not None
    assert frames_of(film) == 2 * 20  # three frames a step


@pytest.mark.parametrize("early", [0, 1])
def test_the_last_picture_of_the_game_that_ends_first_stays(
    nearly_alike: tuple[Network, Network], early: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Not of a full film: from five steps before the parting to the end of the longer game, and its last picture."""
    monkeypatch.setattr(probing, "BEFORE_SECONDS", 0.25)
    most = [60, 60]
    most[early] = 45
    one, other = (replace(each, env=replace(each.env, max_steps=most[i])) for i, each in enumerate(nearly_alike))
    row, film = part(one, other)
    found = naive((one, other), 100)
    assert found.lasts == most
    assert [row["later_score"], row["other_later_score"]] == found.scores
    assert 5 < row["step"] == found.step < 45
    assert film is not None
    assert frames_of(film) == 60 + 1 - (row["step"] - 5)


def test_scales_of_values_do_not_count_but_signs_do(unlike: tuple[Network, Network]) -> None:
    one, other = unlike
    values = np.random.default_rng(0).normal(size=(2_000, 4)).astype(np.float32)
    scaled = probed(one, other, values, 7 * values + 3)
    assert scaled["equal_actions"] == scaled["equal_where_clear"] == 1
    assert scaled["advantage_distance"] == pytest.approx(0, abs=1e-5)
    assert scaled["state_value_correlation"] == pytest.approx(1)
    apart = probed(one, other, values, np.random.default_rng(1).normal(size=(2_000, 4)).astype(np.float32))
    assert apart["equal_actions"] == pytest.approx(0.25, abs=0.04)
    assert apart["equal_by_chance"] == pytest.approx(0.25, abs=0.01)
    assert apart["advantage_distance"] == pytest.approx(1.13, abs=0.05)
    assert apart["state_value_correlation"] == pytest.approx(0, abs=0.1)
    flat = probed(one, other, values, np.zeros_like(values))
    assert all(np.isnan(flat[name]) for name in ("advantage_distance", "state_value_correlation", "equal_where_clear"))


def test_the_asked_states_are_what_each_network_sees(unlike: tuple[Network, Network]) -> None:
    states = read_archive(STATES)
    few = states._replace(frames=states.frames[:20])
    values, other_values = (asked(network, few) for network in unlike)
    assert values.shape == other_values.shape == (20, 4)
    assert not np.array_equal(values, other_values)


def test_the_run_of_the_median_score_speaks_for_a_group(recorded: Callable[..., Path], tmp_path: Path) -> None:
    for seed, score in enumerate((5_000.0, 1_000.0, 3_000.0, 9_000.0)):
        recorded(f"seed={seed}", scores=(score, score + seed, score))
    runs = gather(tmp_path).trainings
    assert median_run(runs).config["seed"] == 2
    assert median_run([run for run in runs if run.config["seed"] != 2]).config["seed"] == 0


@pytest.mark.parametrize(("baseline", "first"), [(None, "a x"), ("d", "d x")])
def test_of_many_groups_each_is_compared_with_one(
    trained: list[Training], folder: Path, monkeypatch: pytest.MonkeyPatch, baseline: str | None, first: str
) -> None:
    archive = read_archive(STATES)
    few = archive._replace(frames=archive.frames[:4])
    monkeypatch.setattr(probing, "read_archive", lambda _: few)
    groups = {f"{letter} x": [trained[0]] for letter in "abcde"}
    result = probe_groups(folder, groups, baseline)
    others = [label for label in groups if label != first]
    for table in ("probes", "partings"):
        assert [(row["group"], row["other"]) for row in result.tables[table]] == [(first, other) for other in others]
    assert f"Of 5 groups, networks are compared with that of {first} only." in result.notes


def test_compare_asks_why_and_keeps_page_tables_and_films(
    trained: list[Training],
    folder: Path,
    recorded: Callable[..., Path],
    command: Callable[..., int],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Of four seeds one plays another game and sees too much, and one has no weights: what remains is one pair."""
    recorded("seed=3", f"paths.outputs={folder}")
    words = ("by=seed,env.frameskip", "why=true", f"paths.outputs={folder}", "tracking=none")
    assert command("compare", *words) == 0
    page = Path(capsys.readouterr().out.rstrip().splitlines()[-1])
    probes, partings = (
        list(csv.DictReader(io.StringIO((page.parent / f"tables/{name}.csv").read_text())))
        for name in ("probes", "partings")
    )
    text = page.read_text()
    assert [(row["run"], row["other_run"]) for row in probes] == [(trained[0].name, trained[1].name)]
    assert [row["outcome"] for row in partings[:2]] == [
        "cannot be told, since they play different games (env.frameskip)"
    ] * 2
    assert text.count(" was not asked about the archived states: ") == 2
    assert "8 observations that are 6 frames apart need 43 frames." in text
    assert "has neither a checkpoint nor an evaluation yet." in text
    assert read_archive(STATES).sha256 in text
    sources = re.findall(r'<video controls preload="metadata" src="([^"]*)"', text)
    assert sources == [row["film"] for row in partings if row["film"]]
    assert sources == ["films/01-frameskip-2-5-seed-0-vs-frameskip-2-5-seed-1.mp4"]
    assert frames_of((page.parent / sources[0]).read_bytes()) > 1


def test_compare_alone_loads_no_torch(recorded: Callable[..., Path], tmp_path: Path) -> None:
    recorded()
    code = (
        "import sys; from atlantis_exp.commands.compare import VERB; "
        f"VERB.run(['paths.outputs={tmp_path}', 'tracking=none']); "
        "assert not {'torch', 'ale_py', 'av'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.DEVNULL)
