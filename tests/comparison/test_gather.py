"""Which runs are compared, and why others are not."""

import json
import re
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from atlantis_exp.comparison.choosing import group, plays_alike, refuse_mixed_protocols, select
from atlantis_exp.comparison.gather import Player, gather, named_by
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.training.evaluation import Episode, Evaluation

Recorded = Callable[..., Path]


def evaluated(outputs: Path, run: Path, score: float, epsilon: float, step: int = 160) -> Path:
    """What the verb `evaluate` leaves, as far as it is read."""
    folder = outputs / "evaluations" / f"{run.name}-at-{step}-{score}"
    journal = Journal(folder)
    facts = {"run": run.name, "step": step, "evaluation": {"epsilon": epsilon}}
    (folder / "config.json").write_text(json.dumps(facts))
    episode = Episode(0, score, 9, False, bytearray([1, 1, 1]), bytearray([0, 0, 1]), points=[0.0] * 5)
    journal.artifact(
        "evaluation/episodes.csv",
        Evaluation(epsilon, [episode], facts_of(game_of("Atlantis-v0"))).table().to_csv().encode(),
    )
    journal.finish()
    (folder / "result.json").write_text("{}")
    return folder


def test_a_run_is_read_from_its_journal_its_table_and_its_config(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded(
        "seed=7", scores=(300.0, 100.0), curve=((3, 0.1, 0, 50), (6, 0.3, 2, 70)), flops=1_000, truncated=1
    )
    gathered = gather(tmp_path)
    assert gathered.skipped == {}
    (run,) = gathered.trainings
    assert (run.name, run.config["seed"], run.config["model.name"]) == (folder.name, 7, "cnn")
    assert {axis: values.tolist() for axis, values in run.curve.items()} == {
        "frames": [3, 6],
        "hours": [0.1, 0.3],
        "flops": [0, 2_000],
        "epsilon": [0.5, 0.5],
        "score": [50, 70],
    }
    assert run.episodes.scores.tolist() == [300, 100]
    assert run.episodes.steps.tolist() == [4, 4]
    assert run.episodes.truncated.tolist() == [1, 0]
    assert run.episodes.actions == ("NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE")
    assert run.episodes.counts.tolist() == [[[1, 0], [1, 0], [1, 0], [0, 1]]] * 2


def test_only_what_is_committed_counts(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded()
    with open(folder / "journal.jsonl", "ab") as file:
        file.write(b'{"kind":"metrics","step":99,"time":1,"values":{"throughput/frames":9e9,"score/mean_100":1}}\n')
    (run,) = gather(tmp_path).trainings
    assert run.curve["frames"].tolist() == [0, 600]


def fail_before_it_starts(run: Path) -> None:
    (run / "config.json").unlink()
    Journal(run).status("FAILED", "of its network")


def test_broken_unfinished_foreign_and_put_aside_runs_are_named_and_do_not_count(
    recorded: Recorded, tmp_path: Path
) -> None:
    good = recorded()
    damage: dict[str, Callable[[Path], object]] = {
        "unfinished": lambda run: (run / "result.json").unlink(),
        "broken: .*journal.jsonl ends": lambda run: (run / "journal.jsonl").write_bytes(b"{"),
        "broken: .*commit.json is damaged": lambda run: (run / "commit.json").write_text("{"),
        "broken: seed: missing": lambda run: (run / "config.json").write_text('{"model": {"name": "cnn"}}'),
        "broken: ": lambda run: (run / "config.json").write_text('{"mod'),
        "foreign: its config.json is not one of ours": lambda run: (run / "config.json").write_text('{"lr": 1}'),
        "foreign: it has no config.json": lambda run: (run / "config.json").unlink(),
        "failed: of its network": fail_before_it_starts,
        "no evaluation after its last step: evaluate run=": lambda run: shutil.rmtree(run / "artifacts"),
        "broken: .*it has none": lambda run: next(run.rglob("*.csv")).write_text("score,steps\n"),
        "broken: .*result.json is damaged": lambda run: (run / "result.json").write_text("[1]"),
        "does not say who chose": lambda run: next(run.rglob("*.csv")).write_text("score,steps,truncated\n1,1,0\n"),
    }
    for index, strike in enumerate(damage.values()):
        strike(shutil.copytree(good, good.with_name(f"run-{index}")))
    shutil.copytree(good, good.with_name("cnn~1"))
    (tmp_path / "runs" / "notes.txt").write_text("not a run")
    gathered = gather(tmp_path)
    assert [run.name for run in gathered.trainings] == [good.name]
    assert gathered.skipped.pop("cnn~1") == "put aside by resume=never"
    assert len(gathered.skipped) == len(damage)
    for index, reason in enumerate(damage):
        assert re.search(reason, gathered.skipped[f"run-{index}"])


@pytest.mark.parametrize(("column", "value"), [("steps", "nan"), ("truncated", "inf"), ("NOOP", "inf")])
def test_a_table_with_counts_that_are_no_numbers_is_named(
    recorded: Recorded, tmp_path: Path, column: str, value: str
) -> None:
    run = recorded()
    table = next(run.rglob("*.csv"))
    header, first, *others = table.read_text().splitlines()
    cells = dict(zip(header.split(","), first.split(","), strict=True)) | {column: value}
    table.write_text("\n".join([header, ",".join(cells.values()), *others]))
    assert "it has numbers beyond 1e15" in gather(tmp_path).skipped[run.name]


def test_a_table_of_other_actions_is_named(recorded: Recorded, tmp_path: Path) -> None:
    run = recorded()
    table = next(run.rglob("*.csv"))
    table.write_text(table.read_text().replace("RIGHTFIRE", "UPFIRE"))
    assert "has other actions than the game" in gather(tmp_path).skipped[run.name]


@pytest.mark.parametrize(
    "facts", ['{"step": 1e400, "run": "x", "evaluation": {"epsilon": 0.1}}', '{"run": "x"}', "null"]
)
def test_a_damaged_evaluation_is_named_and_harms_no_run(recorded: Recorded, tmp_path: Path, facts: str) -> None:
    run = recorded()
    (evaluated(tmp_path, run, 2.0, 0.1) / "config.json").write_text(facts)
    gathered = gather(tmp_path)
    assert len(gathered.trainings) == 1
    assert "broken: " in " ".join(gathered.skipped.values()) or facts == "null"


def test_an_evaluation_of_a_run_that_was_put_aside_is_not_the_new_ones(recorded: Recorded, tmp_path: Path) -> None:
    old = recorded(scores=(9_000.0,))
    evaluated(tmp_path, old, 9_151.0, 0.05)
    old.rename(old.with_name(f"{old.name}~1"))
    time.sleep(0.01)
    new = recorded(scores=(1_000.0,))
    assert new == old
    assert gather(tmp_path).trainings[0].episodes.scores.tolist() == [1_000]
    evaluated(tmp_path, new, 1_150.0, 0.05)
    assert gather(tmp_path).trainings[0].episodes.scores.tolist() == [1_150]


def test_a_decision_is_named_by_its_start(tmp_path: Path) -> None:
    for name in ("decide-311d", "decide-4"):
        (tmp_path / "decisions" / name).mkdir(parents=True)
        (tmp_path / "decisions" / name / "config.json").write_text(f'{{"runs": ["of-{name}"]}}')
    assert named_by(tmp_path, ["decide-3", "cnn"]) == ["of-decide-311d", "cnn"]
    assert named_by(tmp_path, ["decide-", "*"]) == ["of-decide-311d", "of-decide-4", "*"]
    assert named_by(tmp_path, ["decide-5"]) == ["decide-5"]


@pytest.mark.parametrize("runs", ["5", "null", "[1, {}]"])
def test_a_decision_whose_runs_are_no_names_has_none(recorded: Recorded, tmp_path: Path, runs: str) -> None:
    recorded()
    folder = tmp_path / "decisions" / "decide-x"
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(f'{{"runs": {runs}}}')
    assert gather(tmp_path, ["decide-x"]).trainings == []


def test_the_latest_evaluation_after_the_last_step_counts_and_epsilon_chooses_among_them(
    recorded: Recorded, tmp_path: Path
) -> None:
    run = recorded("evaluation.epsilon=0.05", scores=(1.0,))
    assert gather(tmp_path).trainings[0].episodes.scores.tolist() == [1]
    evaluated(tmp_path, run, 2.0, 0.1)
    evaluated(tmp_path, run, 3.0, 0.2, step=80)  # of other weights
    unfinished = evaluated(tmp_path, run, 4.0, 0.1)
    (unfinished / "result.json").unlink()
    (training,) = gather(tmp_path).trainings
    assert (training.episodes.scores.tolist(), training.config["evaluation.epsilon"]) == ([2], 0.1)
    assert gather(tmp_path, epsilon=0.05).trainings[0].episodes.scores.tolist() == [1]
    none = gather(tmp_path, epsilon=0.3)
    assert none.trainings == []
    assert none.skipped[run.name].startswith("no evaluation at epsilon 0.3")


def test_only_a_budget_that_ended_its_training_is_one_of_the_run(recorded: Recorded, tmp_path: Path) -> None:
    recorded("model=cnn", "budget.steps=160", outcome="budget")
    recorded("model=resnet", "budget.steps=900")
    assert [run.config["budget.steps"] for run in gather(tmp_path).trainings] == [160, None]
    recorded("model=cnn_small", "budget.flops=3e3", "budget.steps=900", outcome="budget", updates=30)
    ends = [(run.config["budget.steps"], run.config["budget.flops"]) for run in gather(tmp_path).trainings]
    assert ends == [(160, None), (None, 3_000), (None, None)]


def test_a_run_without_flops_has_no_such_curve(recorded: Recorded, tmp_path: Path) -> None:
    recorded(flops=None)
    assert set(gather(tmp_path).trainings[0].curve) == {"frames", "hours", "epsilon", "score"}


def test_groups_are_made_by_any_config_key(recorded: Recorded, tmp_path: Path) -> None:
    for model in ("cnn", "resnet"):
        for seed in (0, 1):
            recorded(f"model={model}", f"seed={seed}", f"optimizer.lr={0.1 if seed else 0.2}")
    trainings = gather(tmp_path).trainings
    assert {label: len(runs) for label, runs in group(trainings, ["model"]).items()} == {"cnn": 2, "resnet": 2}
    assert list(group(trainings, ["model", "optimizer.lr"])) == [
        "cnn lr=0.1",
        "cnn lr=0.2",
        "resnet lr=0.1",
        "resnet lr=0.2",
    ]
    assert list(group(trainings, [])) == ["all"]
    with pytest.raises(ConfigError, match=r"by=optimiser.lr: no such key; did you mean 'optimizer.lr'"):
        group(trainings, ["optimiser.lr"])


def test_a_run_that_is_being_made_longer_does_not_count(recorded: Recorded, tmp_path: Path) -> None:
    folder = RunFolder(recorded("budget.steps=160", outcome="budget"))
    assert gather(tmp_path).trainings[0].config["budget.steps"] == 160
    tree = folder.config
    folder.write_config({**tree, "budget": {**tree["budget"], "steps": 320}})
    gathered = gather(tmp_path)
    assert gathered.trainings == []
    assert gathered.skipped[folder.name].startswith("unfinished: its limits were raised")


def test_a_run_that_ended_before_its_arithmetic_was_spent_does_not_count(recorded: Recorded, tmp_path: Path) -> None:
    folder = RunFolder(recorded("budget.flops=3001", outcome="budget", updates=30))  # of 100 FLOPs each
    assert gather(tmp_path).skipped[folder.name].startswith("unfinished: its limits were raised")


def test_players_are_there_whichever_trainings_are_asked_for(recorded: Recorded, tmp_path: Path) -> None:
    recorded()
    player = evaluated(tmp_path, tmp_path / "x", 2.0, 0.1).rename(tmp_path / "runs" / "random-Atlantis-v0")
    (player / "config.json").write_text('{"agent": {"name": "random"}}')
    result = {"outcome": "finished", "steps": 0, "counts": {}, "evaluation": {}, "report": ""}
    (player / "result.json").write_text(json.dumps(result))
    assert len(gather(tmp_path, ["nothing"]).players) == 1
    assert gather(tmp_path, ["nothing"]).trainings == []


def test_a_player_is_shown_next_to_runs_whose_game_is_its_own_alone(recorded: Recorded, tmp_path: Path) -> None:
    still, sticky = (RunFolder(recorded(f"env.sticky={share}")).trained_config.env.sticky for share in ("0.0", "0.25"))
    gathered = gather(tmp_path)
    players = [
        Player("random", {**gathered.trainings[0].config, "env.sticky": each}, {}, gathered.trainings[0].episodes)
        for each in (still, sticky)
    ]
    for player in players:
        alike = [plays_alike(player, [training]) for training in gathered.trainings]
        assert sorted(alike) == [False, True]
        assert not plays_alike(player, gathered.trainings)


def test_a_film_is_of_the_episodes_that_count(recorded: Recorded, tmp_path: Path) -> None:
    folder = recorded(scores=(1.0,))
    own, film = RunFolder(folder), folder / "artifacts" / "best_episode.mp4"
    film.write_bytes(b"film")
    assert gather(tmp_path).trainings[0].film is None  # nobody says of which evaluation it is
    for step, shown in ((80, None), (160, film)):
        journal = Journal(own.path)
        journal.resume()
        journal.tags({"best_evaluation": f"mean 1 at step {step}"})
        journal.finish()
        assert gather(tmp_path).trainings[0].film == shown
    later = evaluated(tmp_path, folder, 2.0, 0.1)
    assert gather(tmp_path).trainings[0].film == later / "artifacts" / "best_episode.mp4"


def test_runs_are_chosen_by_name_and_by_config(recorded: Recorded, tmp_path: Path) -> None:
    for model in ("cnn", "resnet"):
        for seed in (0, 1):
            recorded(f"model={model}", f"seed={seed}")
    everything = gather(tmp_path).trainings
    assert len(everything) == 4
    assert {run.config["model.name"] for run in gather(tmp_path, ["res"]).trainings} == {"resnet"}
    assert {run.config["seed"] for run in gather(tmp_path, ["*-s1-*"]).trainings} == {1}
    assert [run.name for run in gather(tmp_path, [everything[2].name]).trainings] == [everything[2].name]
    assert [run.name for run in gather(tmp_path, [everything[2].name[:-3]]).trainings] == [everything[2].name]
    (one,) = select(everything, ["model=cnn", "seed=1"])
    assert (one.config["model.name"], one.config["seed"]) == ("cnn", 1)
    assert len(select(everything, ["replay.capacity=120", "env.max_pool=false"])) == 4
    assert select(everything, ["seed=2"]) == []
    rate = everything[0].config["optimizer.lr"]
    assert (
        len(select(everything, [f"optimizer.lr={rate:.9f}", f"optimizer.lr={rate:.9e}", "replay.capacity=1_20"])) == 4
    )
    crop = everything[0].config["env.crop"]
    for text in (str(crop), json.dumps(crop, separators=(",", ":"))):
        assert len(select(everything, [f"env.crop={text}"])) == 4
    with pytest.raises(ConfigError, match="where=modle: no such key"):
        select(everything, ["modle=cnn"])
    with pytest.raises(ConfigError, match="write KEY=VALUE"):
        select(everything, ["model"])


@pytest.mark.parametrize(
    ("pattern", "seeds"),
    [("cnn-uniform-s1", {1}), ("*s1", {1}), ("cnn-uniform-s1*", {1, 10, 12}), ("cnn-uniform-s", {0, 1, 10, 12})],
)
def test_a_seed_in_a_runs_name_is_not_the_start_of_a_longer_one(
    recorded: Recorded, tmp_path: Path, pattern: str, seeds: set[int]
) -> None:
    for seed in (0, 1, 10, 12):
        recorded(f"seed={seed}")
    assert {run.config["seed"] for run in gather(tmp_path, [pattern]).trainings} == seeds


def test_trainings_that_cannot_be_compared_are_lost_with_their_configs(recorded: Recorded, tmp_path: Path) -> None:
    recorded("seed=0")
    unfinished = recorded("seed=1")
    (unfinished / "result.json").unlink()
    Journal(unfinished).status("FAILED", "out of memory")
    gathered = gather(tmp_path)
    assert [run.config["seed"] for run in gathered.lost] == [1]
    assert gathered.skipped == {unfinished.name: "failed: out of memory: the command that started it continues it"}


@pytest.mark.parametrize(
    "override",
    [
        *("env.id=ALE/Atlantis-v5", "env.frameskip=4", "env.sticky=0.0", "env.max_frames=1000", "env.max_steps=41"),
        *("env.noop_max=30", "env.max_pool=true", "env.crop=[0,160,210,0]", "evaluation.epsilon=0.1"),
    ],
)
def test_runs_of_different_protocols_are_refused_with_the_difference_named_unless_it_is_the_question(
    recorded: Recorded, tmp_path: Path, override: str
) -> None:
    shared = ("env.frameskip=4",) if "max_pool" in override else ()  # which pools the last two frames
    first, second = recorded(*shared), recorded(*shared, override)
    trainings = gather(tmp_path).trainings
    key = override.split("=")[0]
    with pytest.raises(ConfigError, match=rf"^{key} differs") as refused:
        refuse_mixed_protocols(trainings, ["model"])
    assert first.name in str(refused.value)
    assert second.name in str(refused.value)
    assert "\n" not in str(refused.value)
    refuse_mixed_protocols(trainings, [key])


def test_another_network_size_or_number_of_environments_is_no_other_protocol(
    recorded: Recorded, tmp_path: Path, tiny: Callable[..., Config]
) -> None:
    recorded()
    recorded("model=resnet", "env.size=48", "env.num_envs=2", "optimizer.lr=1", "env.stack=2")
    refuse_mixed_protocols(gather(tmp_path).trainings, ["model"])
    assert tiny().env.size == 40
