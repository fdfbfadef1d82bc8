"""Each benchmark, at its smallest: it ends in one line of JSON with the figures that others read."""

import csv
import itertools
import json
import math
import signal
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from atlantis_exp.build import make_emulator
from atlantis_exp.sessions.cards import read_card
from benchmarks import (
    captured,
    contest,
    emulation,
    evaluation,
    kills,
    learner,
    overhead,
    pace,
    replay,
    side_by_side,
    startup,
    store,
    time_to_score,
    training,
)
from benchmarks.composition import composed
from benchmarks.contest import paired_ratio, ratio, take_turns
from benchmarks.time_to_score import Turn, hours_of, hours_to, sooner

DOCS = Path(__file__).resolve().parents[2] / "docs"
LOG = DOCS.parent / "lab" / "performance.md"
Main = Callable[[Sequence[str]], None]

needs_sb3 = pytest.mark.skipif(find_spec("stable_baselines3") is None, reason="stable-baselines3: extra `peers`")
needs_envpool = pytest.mark.skipif(find_spec("envpool") is None, reason="envpool: extra `peers`")


def results_of(main: Main, arguments: str, capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    main(arguments.split())
    results = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert isinstance(results, dict)
    return results


def test_turns_alternate() -> None:
    clock = itertools.count()
    assert take_turns(dict.fromkeys("ab", lambda: next(clock)), rounds=3) == {"a": [0, 2, 4], "b": [1, 3, 5]}


def test_a_paired_ratio_cancels_what_slows_a_whole_round() -> None:
    assert paired_ratio([20.0, 2.0, 40.0], [10.0, 1.0, 20.0]) == 2
    assert ratio([4.0, 1.0, 9.0], [2.0, 3.0, 1.0]) == 2


def test_a_ratio_with_one_side_left_out_is_none() -> None:
    assert ratio([1.0], None) is None
    assert paired_ratio(None, [1.0]) is None


@pytest.mark.slow
def test_training_leaves_out_what_it_was_not_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(training.main, "--contestants ours_1 --num-envs --fills --rounds 1 --seconds 0.1", capsys)
    assert {"vs_sb3_16", "vs_sb3_1", "vs_report", "vs_sb3_16_fp32"} <= results.keys()
    assert results["vs_sb3_1"] is None
    assert results["steps_per_second"]["ours_1"] > 0
    assert results["by_num_envs"] == results["by_fill"] == {}


@pytest.mark.slow
@needs_sb3
def test_training_measures_every_contestant(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "--num-envs 4 --fills 1500 --play-steps 300 --rounds 1 --seconds 1"
    results = results_of(training.main, arguments, capsys)
    assert results["by_num_envs"]["4"] > 0
    assert results["by_fill"]["1500"] > 0
    for key in ("vs_sb3_16", "vs_sb3_1", "vs_report", "vs_report_16", "vs_sb3_16_fp32"):
        assert results[key] > 0, key


@needs_envpool
@pytest.mark.slow
def test_emulation_measures_every_contestant(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(emulation.main, "--num-envs 2 --rounds 1 --seconds 0.1", capsys)
    for key in ("vs_atari_vector", "vs_envpool", "vs_raw"):
        assert results[key] > 0, key


@pytest.mark.slow
def test_evaluation_is_related_to_emulation_and_pass_and_a_film_to_its_processor_time(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rates: dict[str, list[float]] = {}

    def kept(*arguments: Any) -> dict[str, list[float]]:
        rates.update(take_turns(*arguments))
        return rates

    monkeypatch.setattr(evaluation, "take_turns", kept)
    arguments = "--num-envs 4 --rounds 1 --seconds 0.2 --film-steps 100"
    results = results_of(evaluation.main, arguments, capsys)
    ((evaluated,), (emulated,), (passed,)) = rates.values()
    assert results["of_limit"] == pytest.approx(evaluated / emulated + evaluated / passed)
    assert results["film_seconds"] > 0


@pytest.mark.slow
def test_replay_measures_memory_and_sampling(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(replay.main, "--cases 84 --steps 200 --transitions 400 --rounds 1 --seconds 0.05", capsys)
    assert results["transitions_84"] == 400
    assert results["bytes_per_transition_84"] > 0
    assert 0 < results["sample_share_cnn"] < 1
    assert 0 < results["sample_share_resnet"] < 1


@needs_sb3
def test_sb3_stores_the_bytes_of_its_arrays() -> None:
    state = 4 * 84 * 84
    optimized, _ = replay.measure_sb3(84, 32, optimized=True)
    default, _ = replay.measure_sb3(84, 32, optimized=False)
    assert state < optimized < state + 100
    assert 2 * state < default < 2 * state + 100


@pytest.mark.slow
def test_learner_relates_its_arithmetic_to_the_machines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rates = itertools.cycle((4.0, 2.0, 6.0))  # of the matrices, an update, and one with the overrides
    monkeypatch.setattr(learner, "calls_per_second", lambda *_: next(rates))
    results = results_of(learner.main, "--cases cnn_fp32 --rounds 1 --against training.ema=10", capsys)
    flops = 128 * results["flops_a_sample_cnn"]
    assert results["gemm_share_cnn_fp32"] == pytest.approx(2 * flops / (4 * 2 * 2_048**3))
    assert (results["update_seconds_cnn_fp32"], results["against_cnn_fp32"]) == (0.5, 3.0)


def test_bfloat16_is_measured_where_it_is_faster_or_asked_for(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learner, "choose_precision", lambda *_: "bf16")
    assert learner.chosen(None) == [*learner.CASES]
    monkeypatch.setattr(learner, "choose_precision", lambda *_: "fp32")
    assert {case.precision for case in learner.chosen(["cnn_bf16"])} == {"bf16"}
    assert capsys.readouterr().out == ""
    assert {case.name for case in learner.chosen(None)} == {"cnn_fp32", "resnet_fp32"}
    assert "bfloat16 is slower than float32 here" in capsys.readouterr().out


def test_a_mistaken_override_of_a_learner_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"):
        contest.run(lambda: learner.main(["--against", "traning.ema=10"]))
    assert "did you mean 'training.ema'?" in capsys.readouterr().err


def test_the_flops_of_an_update_are_those_of_its_layers() -> None:
    # multiply-adds of the forward pass by layer; the first convolution has no gradient with regard to its input
    first, others = 20 * 20 * 32 * 4 * 64, 9 * 9 * 64 * 32 * 16 + 7 * 7 * 64 * 64 * 9 + 3136 * 512 + 512 * 4
    assert learner.flops_of(learner.Case("cnn", 2, "fp32").config()) == 2 * 2 * (3 * first + 4 * others)


_SMALL = ("training.batch_size=4", "env.size=40", "training.ema=20", "objective.target.every=5", "threads=1")


@pytest.mark.parametrize("words", [("model=cnn_small", "objective=double_dqn"), ("model=resnet",)], ids=" ".join)
def test_a_graph_is_given_all_that_changes_from_update_to_update(words: Sequence[str]) -> None:
    def once(_: object, work: captured.Work) -> captured.Work:
        result = work()
        return lambda: result

    assert captured.are_equal(lambda _, work: work, *words, *_SMALL, updates=12)
    assert not captured.are_equal(once, *words, *_SMALL, updates=12)


@pytest.mark.slow
def test_captured_rehearses_without_a_gpu(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = f"--rehearse --models cnn_small --rounds 1 --seconds 0.1 {' '.join(_SMALL)}"
    results = results_of(captured.main, arguments, capsys)["cnn_small"]
    assert results.pop("equal") is True
    assert all(results[name] > 0 for name in ("plain", "captured", "captured_alone"))


@pytest.mark.slow
@pytest.mark.timeout(1_200)  # two trainings of 16 environments, and MLflow
def test_overhead_tells_the_share_of_tracking(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(overhead.main, "--rounds 1 --seconds 1 --commit-seconds 0.5", capsys)
    assert 0 < results["tracking_share"] < 1


@pytest.mark.slow
@pytest.mark.timeout(1_200)
def test_side_by_side_tells_how_many_more_seeds_an_hour_are_trained(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(side_by_side.main, "--rounds 1 --seconds 1 --seeds 2 model=cnn_small", capsys)
    assert results["at_once"] in (1, 2)
    assert results["seeds_an_hour"] > 0


@pytest.mark.slow
def test_store_measures_every_command_over_many_runs(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    results = results_of(store.main, "--runs 4 --episodes 20 --distinct 2", capsys)
    for command in ("compare", "sweep", "report", "sync"):
        assert results[f"{command}_s"] > 0, command
        assert results[f"{command}_mib"] > 0, command
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("number", "end"), [(signal.SIGINT, KeyboardInterrupt), (signal.SIGTERM, SystemExit)])
def test_a_session_does_not_outlive_the_one_who_would_kill_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, end: type[BaseException]
) -> None:
    sessions: list[kills.Session] = []

    def start_one(said: Path) -> kills.Session:
        sessions.append(kills.start(("sleep", "60"), said))
        return sessions[0]

    looks = iter([0])

    def generations(*_: object) -> int:
        for look in looks:
            return look
        signal.raise_signal(number)
        return 0

    monkeypatch.setattr(kills, "generations", generations)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in what a shell runs in the background
    try:
        with pytest.raises(end):
            kills.run_and_kill(start_one, tmp_path, "*", 1)
    finally:
        signal.signal(signal.SIGINT, before)
    assert sessions[0].wait() == -signal.SIGKILL


@pytest.mark.slow
def test_kills_counts_them_and_finds_no_difference(capsys: pytest.CaptureFixture[str]) -> None:
    assert results_of(kills.main, "--kills 2 --only prioritized", capsys) == {"kills": 2, "differences": []}


@pytest.mark.slow
@pytest.mark.timeout(1_200)  # twelve trainings before it begins
def test_startup_relates_each_command_to_importing_torch(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(startup.main, "--rounds 1", capsys)
    assert {*startup.TARGETS} < {*results}
    assert all(share > 0 for share in results.values())
    assert results["help"] < 1


def test_the_time_to_a_score_is_that_of_the_first_turn_that_has_it() -> None:
    turns = {
        "ours": [Turn(0.5, 10, 100.0), Turn(0.25, 20, 300.0), Turn(0.5, 30, 200.0)],
        "slow": [Turn(1.0, 10, 100.0), Turn(2.0, 20, 150.0), Turn(4.5, 30, 200.0)],
        "slower": [Turn(9.0, 10, 120.0)],
    }
    assert [hours_to(goal, turns["ours"]) for goal in (100, 101, 200, 301)] == [0.5, 0.75, 0.75, math.inf]
    assert sooner(100, turns) == (2.0, False)
    assert sooner(200, turns) == (10.0, False)
    assert sooner(201, turns) == (12.0, True)  # the longest that a peer tried
    assert sooner(301, turns) is None
    assert sooner(100, {"ours": turns["ours"]}) is None


def test_ours_trains_in_the_game_of_the_peers() -> None:
    ours, theirs = (composed(*recipe, *time_to_score.GAME).env for recipe in (("experiment=fast",), ()))
    assert (theirs.frameskip, theirs.sticky, theirs.noop_max, theirs.max_steps) == (4, 0, 30, None)
    assert replace(ours, crop=theirs.crop, num_envs=theirs.num_envs) == theirs


@pytest.mark.slow
def test_the_time_to_score_trains_in_turns_and_plays_after_each(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = "--contestants ours --minutes 0.1 --turn 0.05 --episodes 2 --cut 40"
    time_to_score.main(arguments.split())
    printed = capsys.readouterr()
    results = json.loads(printed.out.splitlines()[-1])
    first, second = results["curves"]["ours"]
    assert first[1] < second[1]
    assert results["hours"]["62500"]["ours"] is None
    for _, steps, score in (first, second):  # an interrupted run has said what its turns led to
        assert f"ours: {score:,.0f} after {steps:,} steps" in printed.err


def kept_turns(table: str) -> dict[str, list[Turn]]:
    """The turns of each program in a table of docs/data."""
    with (DOCS / "data" / f"{table}.csv").open() as file:
        rows = list(csv.DictReader(file))
    turns = {}
    for program, points in itertools.groupby(rows, key=lambda row: row["program"]):
        hours, steps, scores = np.array([[float(row[key]) for key in ("hours", "steps", "score")] for row in points]).T
        turns[program] = [Turn(*turn) for turn in zip(np.diff(hours, prepend=0), steps, scores, strict=True)]
    return turns


def as_a_row(turns: Sequence[Turn]) -> str:
    """Steps, steps a second, last mean, highest mean before and goals, as the tables of the page have them."""
    *earlier, last = turns
    reached = [60 * hours_to(goal, turns) for goal in time_to_score.GOALS]
    told = ["not reached" if math.isinf(value) else f"{value:.0f} minutes" for value in reached]
    highest = max(turn.score for turn in earlier)
    rate = last.steps / (3600 * hours_of(turns))
    return f"{last.steps:,.0f} | {rate:.0f} | {last.score:,.0f} | {highest:,.0f} | {' | '.join(told)} |"


def test_how_much_sooner_ours_scores_is_said_as_the_kept_turns_say_it() -> None:
    text = LOG.read_text()
    turns = kept_turns("time_to_score")
    for each in turns.values():
        assert f"after {60 * hours_of(each):.0f} minutes" in text
        assert f"| {as_a_row(each)}" in text
    for goal in time_to_score.GOALS:
        times, at_least = sooner(goal, turns) or (math.nan, False)
        assert at_least
        assert f"at least {times:.1f} times" in text


def test_how_much_sooner_it_is_than_either_peer_is_said_as_the_longer_turns_say_it() -> None:
    text = LOG.read_text()
    turns = kept_turns("time_to_score_longer")
    assert turns.keys() == {"ours", "sb3_qrdqn", "cleanrl_dqn"}
    for each in turns.values():
        assert f"| {60 * hours_of(each):.0f} minutes | {as_a_row(each)}" in text
    times, at_least = sooner(time_to_score.GOALS[0], turns) or (math.nan, False)
    assert at_least
    assert f"at least {times:.1f} times" in text
    peers = [turns["sb3_qrdqn"], turns["cleanrl_dqn"]]
    (minutes,) = {round(60 * hours_of(peer)) for peer in peers}
    first_goal = 60 * hours_to(time_to_score.GOALS[0], turns["ours"])
    page = (DOCS / "performance.md").read_text()
    for number in (f"after {first_goal:.0f} minutes", f"{minutes} minutes"):
        assert number in page
    for peer in peers:
        assert f" {100 * peer[-1].steps / time_to_score._STEPS:.0f} " in text


def test_a_ship_is_seen_in_its_lane_and_a_shot_is_none() -> None:
    screen = np.zeros((210, 160, 3), np.uint8)
    screen[40:48, 70:78] = 90
    for shot in ((20, 5), (24, 130), (62, 8)):
        screen[shot] = 200
    assert pace.ships(screen) == [False, True, False, False]
    screen[:] = 128  # the flash of a loss
    assert pace.ships(screen) == [False] * 4


def test_the_pace_of_a_game_is_that_of_its_points(capsys: pytest.CaptureFixture[str]) -> None:
    results = results_of(pace.main, "--steps 300 --epsilon 1", capsys)
    assert 0 <= results["bonus_a_frame"] < results["points_a_frame"]
    assert results["hits_a_thousand_frames"] > 0
    assert results["share_of_steps_in_lane"][0] > results["share_of_steps_in_lane"][3]
    assert 0 < results["share_of_steps_without_a_ship"] < 1


def test_a_gap_belongs_to_the_dearest_hit_of_the_step_before_it() -> None:
    points = [[0, 0, 0, 0, 0], [100, 0, 0, 0, 0], [0, 200, 1_000, 0, 0], [0, 0, 0, 0, 500], [0, 0, 0, 2_000, 0]]
    hits = {"centre_vessel": [3], "side_vessel": [], "centre_bomber": [8], "side_bomber": []}
    assert pace.gaps([4, 4, 3, 4, 4], points) == hits


def test_a_ship_comes_so_many_frames_after_one_of_its_wave() -> None:
    ships_and_bombers = [(3, 1), (2, 0), (2, 0), (1, 0), (1, 0), (0, 0), (12, 2), (11, 2), (10, 1), (10, 1), (9, 1)]
    frames = [24, 34, 30, 34, 40, 60, 300, 22, 64, 90, 6]
    assert pace.spacings(frames, ships_and_bombers) == {"vessel": {64: 1, 96: 1}, "bomber": {64: 1, 96: 1}}


def test_the_oracle_changes_nothing_by_looking_ahead_and_hits_more_than_chance(
    capsys: pytest.CaptureFixture[str],
) -> None:
    card, _ = read_card(DOCS.parent / "pretrained" / "cnn_annealed")
    plain = make_emulator(card.config.env)
    oracle, blind = pace.Oracle(**plain.keywords), plain()
    oracle.reset(5)
    blind.reset(5)
    for action in (1, 0, 2, 3, 0):
        assert 0 <= oracle.choose(None) < 4
        np.testing.assert_equal(oracle.step(action), blind.step(action))
    hits = [results_of(pace.main, f"--steps 60 {who}", capsys)["hits"] for who in ("--oracle", "--epsilon 1")]
    assert sum(hits[0].values()) > sum(hits[1].values())
