"""What must not change unnoticed: names, weights, journals and tables as they were recorded, under tests/goldens.

Most of it is recorded bit for bit. Processors round differently, so digests of floating-point results are kept with the
processor that they are of (`arithmetic`), and any other processor is held to the recorded values within a tolerance.

`RECORD_GOLDENS=1 pytest -n 0 -m '' tests/test_goldens.py` records what is made now: a change of results that is meant.
On another processor it adds that one's digests.
"""

import csv
import hashlib
import json
import os
import re
import tarfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import safetensors.torch
import torch
from hydra import compose, initialize_config_dir

from atlantis_exp.build import build_learner, build_plan
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.config import Config
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.sessions.job import replaced
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.training.fingerprint import history

Command = Callable[..., int]

GOLDENS = Path(__file__).parent / "goldens"
RECORDING = "RECORD_GOLDENS" in os.environ

SMALL = (  # apart from the fixtures' own, which may change: these overrides are part of what was recorded
    *("experiment=quick", "device=cpu", "threads=1", "budget.forecast=off"),
    *("tracking=none", "tracking.every_steps=20", "tracking.histogram_episodes=500"),
    *("env.size=40", "env.max_steps=120", "phase.quick.steps=360", "replay.capacity=120", "replay.max_bytes=4_194_304"),
    *("training.learn_start=20", "training.learn_every=4", "training.batch_size=4", "training.precision=fp32"),
    *("evaluation.num_envs=1", "evaluation.every_steps=180", "evaluation.video=false"),
    *("evaluation.episodes=3", "evaluation.epsilon=0.5"),  # chance scores where such a network does not
)
RUN_NAMES = (
    "",
    "seed=1",
    "seed=9223372036854775807",
    "model=resnet",
    "model=resnet_fast sampler=top_half seed=3",
    "model.head=dueling",
    "model=resnet objective=double_dqn model.head=dueling",
    "objective=quantile",
    "objective=double_quantile objective.quantiles=7",
    "sampler=prioritized sampler.alpha=0.7",
    "sampler=top_half sampler.oversample=4",
    "phase.single.sampler=top_half",
    "optimizer=adam optimizer.lr=3e-4",
    "optimizer=rmsprop",
    "lr_schedule=one_cycle",
    "lr_schedule=linear epsilon=linear_steps epsilon.steps=5_000",
    "epsilon=constant epsilon.value=0",
    "epsilon=linear env=atlantis_v5",
    "env=atlantis_standard env.num_envs=4 env.workers=2",
    "env.crop=[0,160,210,0] env.frameskip=4 env.size=50",
    "env.stack=[0,1,2,3,8,16,24]",
    "phase=two_phase sampler=top_half",
    "phase=two_phase phase.first.lr=1e-4 phase.second.sampler=prioritized phase.second.episodes=7",
    "phase=steps phase.single.steps=1000 training.ema=100",
    "phase=brief replay.capacity=5_000 training.learn_start=100",
    "experiment=fast seed=2",
    "experiment=fast model=resnet_fast objective=double_quantile",
    "experiment=quick model=cnn",
    "experiment=paper_cnn",
    "experiment=paper_resnet objective.n_step=3 objective.reward_clip=1.0",
    "experiment=ablation_10_life_loss env.sticky=0 evaluation.epsilon=0",
)
INTERRUPTED = (  # as stored in outputs.tar.xz
    *("seed=2", "optimizer=rmsprop", "optimizer.centered=false", "objective.target.tau=1.0", "sampler=prioritized"),
    "evaluation.every_steps=null",
)
NETWORKS = ("cnn", "resnet", "resnet_fast")
OBJECTIVES = ("dqn", "double_dqn", "quantile", "double_quantile")
SAMPLERS = ("uniform", "top_half", "prioritized")
LEARNERS = (
    *(f"model={network} objective={objective}" for network in NETWORKS for objective in OBJECTIVES),
    "threads=2",  # shards
    "optimizer=rmsprop objective=double_dqn model.head=dueling objective.target.start=independent",
    "model=resnet_fast optimizer=adam objective.n_step=3 objective.reward_clip=1.0 objective.target.tau=1.0 "
    "objective.target.every=5 training.ema=10",
    "model=resnet objective.target.mode=train",
)


def composed(*words: str) -> Config:
    """The config of a command line."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(words)))


def golden(file: str, key: str, made: Any) -> Any:
    """What was recorded under a key; `made`, once it is recorded, where that is asked for."""
    path = GOLDENS / f"{file}.json"
    recorded = json.loads(path.read_bytes()) if path.exists() else {}
    if RECORDING:
        if key in recorded and isinstance(made, dict):
            made["sha256"] = recorded[key]["sha256"] | made["sha256"]  # other processors'
        recorded[key] = made
        # An entry a line: what has changed shows in a diff.
        lines = (f"{json.dumps(name)}: {json.dumps(value)}" for name, value in sorted(recorded.items()))
        path.write_text("{\n" + ",\n".join(lines) + "\n}\n")
    return recorded[key]


@cache
def arithmetic() -> str:
    """How this processor rounds: its instruction set as torch names it, and a digest of what it makes of convolutions
    and matrix products with their gradients."""
    x = torch.arange(4 * 4 * 40 * 40).remainder(251).div(251).view(4, 4, 40, 40)
    tensors = [
        torch.arange(32 * 4 * 8 * 8).remainder(83).sub(41).div(997).view(32, 4, 8, 8),
        torch.arange(64 * 32 * 3 * 3).remainder(89).sub(44).div(997).view(64, 32, 3, 3),
        torch.arange(512 * 64).remainder(79).sub(39).div(997).view(512, 64),
    ]
    for tensor in tensors:
        tensor.requires_grad_()
    first, second, dense = tensors
    y = torch.conv2d(x.contiguous(memory_format=torch.channels_last), first, stride=4)
    y = torch.conv2d(y, second).mean((2, 3)) @ dense.T
    y.square().sum().backward()  # type: ignore[no-untyped-call]
    made = [y, *(tensor.grad for tensor in tensors if tensor.grad is not None)]
    return f"{torch.backends.cpu.get_cpu_capability()} {sha256(*map(array_of, made))[:8]}"


def array_of(tensor: torch.Tensor) -> npt.NDArray[Any]:
    return tensor.detach().cpu().numpy()


def sha256(*arrays: npt.NDArray[Any]) -> str:
    hashed = hashlib.sha256()
    for array in arrays:
        hashed.update(f"{array.dtype}{array.shape}".encode() + array.tobytes())
    return hashed.hexdigest()


def assert_weights_are_as_recorded(name: str, weights: Mapping[str, torch.Tensor]) -> None:
    """Bit for bit on a processor that was recorded; on any other, each tensor's sum of magnitudes nearly."""
    arrays = [array_of(tensor) for tensor in weights.values()]
    digests = {arithmetic(): sha256(*arrays)[:16]}
    # Seven digits: more would be this processor's own.
    made = [float(f"{np.abs(array).sum(dtype=np.float64):.7g}") for array in arrays]
    recorded = golden("weights", name, {"sha256": digests, "magnitudes": made})
    if arithmetic() in recorded["sha256"]:
        assert recorded["sha256"][arithmetic()] == digests[arithmetic()]
    np.testing.assert_allclose(made, recorded["magnitudes"], rtol=1e-4, atol=2e-4)


def filled_memory() -> ReplayMemory:
    """Three environments' random observations, actions and rewards, with ends among them."""
    memory = ReplayMemory(120, (40, 40), lags=range(4), budget_bytes=2**22)
    rng = np.random.default_rng(7)

    def observation() -> npt.NDArray[np.uint8]:
        return rng.integers(0, 256, (40, 40), np.uint8)

    for env in range(3):
        memory.begin(env, observation())
    for _ in range(50):
        for env in range(3):
            is_terminal = bool(rng.integers(17) == 0)
            memory.add(env, int(rng.integers(4)), float(rng.choice([0, 0, 100, 1_200])), observation(), is_terminal)
            if is_terminal:
                memory.begin(env, observation())
    return memory


@pytest.mark.parametrize("line", RUN_NAMES)
def test_a_run_is_named_as_it_was(line: str) -> None:
    name = composed(*line.split()).run_name()
    assert name == golden("run_names", line, name)


def test_recorded_names_of_runs_differ() -> None:
    names = json.loads((GOLDENS / "run_names.json").read_bytes())
    assert len(set(names.values())) == len(RUN_NAMES) == 31


@pytest.mark.thinned(6)
@pytest.mark.parametrize("line", LEARNERS)
def test_twelve_updates_on_the_same_transitions_make_the_same_weights(line: str) -> None:
    config, memory = composed(*SMALL, *line.split()), filled_memory()
    for name in SAMPLERS:
        phase = replace(config.phase["quick"], sampler=name)
        set_up_torch(config, config.device)
        plan, learner = build_plan(replace(config, phase={"quick": phase})), build_learner(config)
        sampler, rng = plan.phases[0].sampler, np.random.default_rng(11)
        batches = hashlib.sha256()
        for _ in range(12):
            ids, weights = sampler.sample(memory, plan.batch_size, rng)
            batch = memory.gather(ids, plan.returns)
            batches.update(sha256(ids, *batch).encode())
            errors = learner.update(*batch, weights=weights)
            if weights is not None:
                sampler.feed_back(ids, errors.numpy())
        drawn = batches.hexdigest()[:16]
        assert drawn == golden("batches", f"{line} {name}", drawn)  # on any processor
        evaluated, target = learner.evaluated.state_dict(), learner.target.state_dict()
        weights_made = evaluated | {f"target.{key}": tensor for key, tensor in target.items()}
        assert_weights_are_as_recorded(f"{line} {name}", weights_made)


def assert_history_is_as_recorded(name: str, run: Path) -> None:
    """Bit for bit on a processor that was recorded; on any other, the same events with nearly the same values."""
    events = [{key: value for key, value in event.items() if key != "sha256"} for event in history(run)]  # not in 0.1.0
    digest = hashlib.sha256(json.dumps(events).encode()).hexdigest()[:16]
    recorded = golden("histories", name, {"sha256": {arithmetic(): digest}, "events": events})
    if arithmetic() in recorded["sha256"]:
        assert recorded["sha256"][arithmetic()] == digest
    assert len(events) == len(recorded["events"])
    for event, before in zip(events, recorded["events"], strict=True):
        assert event | {"values": None} == before | {"values": None}
        assert event["values"] == pytest.approx(before["values"], rel=1e-2, abs=1e-3)


def assert_text_is_as_recorded(name: str, text: str) -> None:
    path = GOLDENS / name
    if RECORDING:
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    assert text == path.read_text()


def weights_at(run: Path, step: int) -> dict[str, torch.Tensor]:
    """Those of a run's evaluation at a step."""
    return safetensors.torch.load_file(run / "artifacts" / "models" / "network" / f"{step}.safetensors")


def test_a_training_writes_the_journal_and_the_tables_that_it_wrote(command: Command, tmp_path: Path) -> None:
    assert command(*SMALL, "model=resnet_fast", f"paths.outputs={tmp_path}") == 0
    (run,) = (tmp_path / "runs").iterdir()
    assert_history_is_as_recorded("resnet_fast", run)
    assert_weights_are_as_recorded("resnet_fast after 360 steps", weights_at(run, 360))
    for table in ("evaluation/000000180.csv", "evaluation/000000360.csv", "evaluation/000000360.txt", "episodes.csv"):
        text = (run / "artifacts" / table).read_text()
        assert_text_is_as_recorded(f"resnet_fast/{table.replace('/', '_')}", text)


@pytest.fixture
def outputs(tmp_path: Path) -> Path:
    """A copy of what d3fe2fa left in an outputs folder; see goldens/make_outputs.py."""
    with tarfile.open(GOLDENS / "outputs.tar.xz") as archive:
        archive.extractall(tmp_path / "outputs", filter="data")
    return tmp_path / "outputs"


def run_of(outputs: Path, pattern: str) -> Path:
    (run,) = (outputs / "runs").glob(pattern)
    return run


def test_an_interrupted_training_of_an_earlier_version_ends_as_it_would_have_unbroken(
    outputs: Path, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(outputs, "cnn-prioritized-s2-*")
    if RECORDING:  # what is recorded has never been interrupted
        assert command(*replaced(SMALL, *INTERRUPTED, f"paths.outputs={outputs}/unbroken")) == 0
        run = run_of(outputs / "unbroken", run.name)
    else:
        assert command(*replaced(SMALL, *INTERRUPTED, "resume=must", f"paths.outputs={outputs}")) == 0
        assert f"continuing run {run.name} at step 180" in capsys.readouterr().out
    assert_history_is_as_recorded("interrupted", run)
    assert_weights_are_as_recorded("interrupted after 360 steps", weights_at(run, 360))
    assert_text_is_as_recorded("interrupted/episodes.csv", (run / "artifacts" / "episodes.csv").read_text())


@pytest.mark.slow
def test_runs_of_an_earlier_version_compare_as_they_did(outputs: Path, command: Command) -> None:
    assert command("compare", f"paths.outputs={outputs}", "tracking=none") == 0
    (tables,) = outputs.glob("comparisons/*/artifacts/tables")
    # What is decided of them, and how, has changed since; what was read of them has not.
    read = ("actions", "episodes", "published_curves", "references", "runs", "skipped")
    made = {name: (tables / f"{name}.csv").read_text() for name in read}
    for name, text in made.items():
        path = GOLDENS / "compare" / f"{name}.csv"
        if RECORDING:
            path.parent.mkdir(exist_ok=True)
            path.write_text(text)
        for row, before in zip(rows_of(text), rows_of(path.read_text()), strict=True):
            near = {
                key: pytest.approx(cell, rel=1e-9, nan_ok=True) if isinstance(cell, float) else cell
                for key, cell in before.items()
                if key in row
            }
            assert {key: row[key] for key in near} == near, name
            assert len(near) >= 2
    assert set(made) == {path.stem for path in (GOLDENS / "compare").iterdir()}
    sources = facts_of(game_of("Atlantis-v0")).sources
    for with_units in rows_of((tables / "why.csv").read_text()):
        row = {name.partition(" (")[0]: cell for name, cell in with_units.items()}
        mean, frames, rate, *split = (
            float(row[key]) for key in ("mean", "frames_mean", "points_per_1000_frames", *sources)
        )
        assert mean == pytest.approx(frames * rate / 1_000)
        assert np.isnan(split).all()  # it recorded none, which is not zero
    page = (tables.parent / "comparison.html").read_text()
    assert "points per 1,000 frames" in page
    assert "nan" not in re.sub(r"<[^>]*>", " ", page).split()


def rows_of(text: str) -> list[dict[str, float | str]]:
    """A table's rows, with numbers for what is one."""

    def value(cell: str) -> float | str:
        try:
            return float(cell)
        except ValueError:
            return cell

    return [{key: value(cell) for key, cell in row.items()} for row in csv.DictReader(text.splitlines())]


def test_a_finished_run_of_an_earlier_version_plays_the_scores_that_it_recorded(
    outputs: Path, command: Command
) -> None:
    run = run_of(outputs, "cnn-uniform-s0-*")
    protocol = ("episodes=3", "epsilon=0.5", "evaluation.seed=0", "evaluation.num_envs=1", "evaluation.video=false")
    assert command("evaluate", f"run={run.name}", *protocol, "tracking=none", f"paths.outputs={outputs}") == 0
    (table,) = outputs.glob("evaluations/*/artifacts/evaluation/episodes.csv")
    played, recorded = (
        rows_of(path.read_text()) for path in (table, run / "artifacts" / "evaluation" / "000000360.csv")
    )
    for row, before in zip(played, recorded, strict=True):
        assert {key: row[key] for key in before} == before
    assert len({row["score"] for row in played}) > 1


@pytest.mark.slow
def test_a_run_of_an_earlier_version_is_exported_and_the_export_plays_its_card_s_scores(
    outputs: Path, command: Command
) -> None:
    run, folder = run_of(outputs, "cnn-uniform-s0-*"), outputs / "pretrained" / "cnn"
    here = (f"paths.outputs={outputs}", "device=cpu")
    assert command("export", f"run={run.name}", f"to={folder}", "episodes=2", "evaluation.num_envs=1", *here) == 0
    exported, stored = safetensors.torch.load_file(folder / "weights.safetensors"), weights_at(run, 360)
    assert exported.keys() == stored.keys()
    assert all(torch.equal(exported[name], stored[name]) for name in stored)
    scores = json.loads((folder / "card.json").read_bytes())["scores"]
    assert command("evaluate", f"weights={folder}", "evaluation.video=false", "tracking=none", *here) == 0
    (table,) = outputs.glob("evaluations/*/artifacts/evaluation/episodes.csv")
    assert [row["score"] for row in rows_of(table.read_text())] == scores
