"""What is expected of a training: measured on its own parts, which are as before afterwards."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import PrioritizedSampler
from atlantis_exp.training import forecast as forecast_module
from atlantis_exp.training.fingerprint import fingerprint, history
from atlantis_exp.training.forecast import Forecast, forecast
from atlantis_exp.training.plan import Counters, Phase, Plan
from atlantis_exp.training.trainer import Trainer

GIB = 2**30


@pytest.fixture(autouse=True)
def timed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, float]]:
    """Each measurement is as often as it must be, and said to take a millisecond; returns what was asked for."""
    asked = []

    def median_seconds(call: Callable[[], object], at_least: int, seconds: float) -> float:
        for _ in range(at_least):
            call()
        asked.append((at_least, seconds))
        return 1e-3

    monkeypatch.setattr(forecast_module, "_median_seconds", median_seconds)
    return asked


def expected_of(trainer: Trainer, **chosen: Any) -> Forecast:
    asked = {"capacity": 120, "max_bytes": 2**22, "done": trainer.counters}
    return forecast(trainer, **{**asked, **chosen})


@pytest.mark.parametrize(("num_envs", "remembers"), [(1, False), (3, False), (2, True)])
def test_a_training_with_a_forecast_is_bit_for_bit_the_one_without(
    small: Callable[..., Trainer], tmp_path: Path, num_envs: int, remembers: bool, timed: list[tuple[int, float]]
) -> None:
    prints, histories = [], []
    for name in ("without", "with"):
        phases = [Phase("quick", 160, 1e-3, PrioritizedSampler(0.5, 0.5))]
        trainer = small(tmp_path / name, num_envs=num_envs, remembers=remembers, phases=phases)
        if name == "with":
            assert trainer.learner.update_flops((4, 8, 8), 4) > 0
            expected_of(trainer)
        trainer.run()
        prints.append(fingerprint(trainer.state_dict(), trainer.memory, tmp_path / name))
        histories.append(history(tmp_path / name))
    assert len(timed) == 3
    assert prints[0] == prints[1]
    assert histories[0] == histories[1] != []


@pytest.mark.parametrize("schedule", ["epsilon", "learning_rate"])
def test_a_step_is_measured_with_its_schedules(
    small: Callable[..., Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, schedule: str
) -> None:
    trainer, calls = small(tmp_path), []

    def counting(*_: float) -> float:
        calls.append(schedule)
        return 0.5

    changed: dict[str, Any] = {schedule: counting}
    trainer.plan = replace(trainer.plan, **changed)
    during = []

    def median_seconds(call: Callable[[], object], **_: float) -> float:
        before = len(calls)
        call()
        during.append(len(calls) - before)
        return 1e-3

    monkeypatch.setattr(forecast_module, "_median_seconds", median_seconds)
    expected_of(trainer)
    assert during == [1, 0, 0]  # to play, to act, to learn


def test_a_network_with_a_memory_sees_every_state_and_needs_room_for_sequences(
    small: Callable[..., Trainer], tmp_path: Path
) -> None:
    trainer = small(tmp_path, num_envs=2, epsilon=lambda *_: 0.5, learn_every=4, remembers=True)
    expected = expected_of(trainer, max_bytes=1_000)
    assert expected.steps_per_second == pytest.approx(1 / ((1e-3 + 1e-3) / 2 + 1e-3 / 4))
    assert expected.memory == 1_000 + 2**29 + 12 * 4 * (2 + 16 + 1) * 4 * 8 * 8


def test_sequences_that_do_not_fit_are_measured_by_a_part_of_them(
    small: Callable[..., Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, sizes = small(tmp_path, remembers=True, epsilon=lambda *_: 0.5, learn_every=4), []
    a_sequence = 12 * (2 + 16 + 1) * 4 * 8 * 8
    gather = type(trainer.plan).gather

    def counted(plan: Plan, memory: ReplayMemory, ids: npt.NDArray[np.int64]) -> Any:
        sizes.append(len(ids))
        return gather(plan, memory, ids)

    monkeypatch.setattr(type(trainer.plan), "gather", counted)
    monkeypatch.setattr("psutil.virtual_memory", lambda: SimpleNamespace(available=5 * a_sequence))
    expected = expected_of(trainer)
    assert {*sizes} == {2}  # of four: they take at most half of the memory
    assert expected.updates_per_second == pytest.approx(1 / 2e-3)
    assert (expected.shortage or "").startswith("memory will not suffice")


def test_what_is_left_is_expected_of_a_training(small: Callable[..., Trainer], tmp_path: Path) -> None:
    trainer = small(tmp_path, num_envs=2, epsilon=lambda *_: 0.5, learn_every=4, evaluate_steps=None)
    whole = expected_of(trainer)
    seconds_a_step = (1e-3 + 0.75 * 1e-3) / 2 + 1e-3 / 4
    assert whole.steps == 160
    assert whole.steps_per_second == pytest.approx(1 / seconds_a_step)
    assert whole.hours == pytest.approx(160 * seconds_a_step / 3600)
    assert expected_of(trainer, done=Counters(steps=100)).steps == 60
    assert expected_of(small(tmp_path, max_steps=50), done=Counters(steps=20)).steps == 30
    assert expected_of(small(tmp_path, max_updates=5), done=Counters(steps=30)).steps == 20 + 5 * 4 - 30
    assert expected_of(small(tmp_path, max_updates=5, max_steps=35)).steps == 35
    assert expected_of(trainer, done=Counters(steps=500)).steps == 1
    trainer.plan = replace(trainer.plan, unit="episodes")
    assert expected_of(trainer).steps == 160 * trainer.emulators.game.episode_steps
    for episodes, left in ((40, 120), (159, 1), (160, 0)):  # which have been longer than the game's usual ones
        done = Counters(steps=5_000 * episodes, episodes=episodes)
        assert expected_of(trainer, done=done).steps == max(1, 5_000 * left)
    trainer.plan = replace(trainer.plan, unit="steps")
    assert expected_of(trainer, max_bytes=1_000).memory == 1_000 + 2**29
    weights = sum(tensor.nbytes for tensor in trainer.learner.network.state_dict().values())
    for due, evaluations in (
        ({"evaluate_steps": 2}, 80),
        ({"evaluate_steps": None, "evaluate_episodes": 1}, 160 / 2_000),
    ):
        more = expected_of(small(tmp_path, num_envs=2, **due))
        assert more.disk - whole.disk == pytest.approx(2 * weights * evaluations, abs=1)


@pytest.mark.parametrize(
    ("memory", "disk", "said"),
    [
        (GIB, GIB, None),
        (3 * GIB, GIB, "memory will not suffice: 3.0 GiB needed, 2.0 GiB available; lower replay.max_bytes"),
        (GIB, 3 * GIB, "disk will not suffice: 3.0 GiB needed, 2.0 GiB free; lower replay.capacity"),
    ],
)
def test_a_shortage_is_named_with_what_to_do_about_it(memory: int, disk: int, said: str | None) -> None:
    expected = Forecast(100.0, 3_600_000, memory, 2 * GIB, disk, 2 * GIB)
    assert (expected.shortage or "").startswith(said or "")
    assert (expected.shortage is None) == (said is None)
    assert str(Forecast(100.0, 3_600_000, GIB, 2 * GIB, 2**20, 2 * GIB)) == (
        "expect about 100 steps/s, 10.0 hours for 3,600,000 steps, 1.0 GiB of memory (2.0 GiB available), "
        "1 MiB of disk (2.0 GiB free)"
    )


def test_a_memory_that_never_holds_enough_to_learn_from_is_named() -> None:
    expected = Forecast(100.0, 3_600_000, GIB, 2 * GIB, GIB, 2 * GIB, held=3_800.4, learn_start=10_000)
    assert (expected.shortage or "").startswith("nothing would be learned: replay.max_bytes holds some 3,800 observ")


def test_a_screen_that_stands_still_after_a_game_is_not_measured_and_what_is_there_already_is_not_asked_for(
    small: Callable[..., Trainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = small(tmp_path, num_envs=2)
    resets: list[list[int]] = []
    reset = trainer.emulators.reset

    def counted(envs: Any, *seeds: Any) -> Any:
        resets.append(list(envs))
        return reset(envs, *seeds)

    def many(call: Callable[[], object], at_least: int, **__: float) -> float:
        for _ in range(200 if at_least == 8 else at_least):
            call()
        return 1e-3

    monkeypatch.setattr(trainer.emulators, "reset", counted)
    monkeypatch.setattr(forecast_module, "_median_seconds", many)
    fresh = expected_of(trainer, max_bytes=2**30, capacity=10**9)
    assert len(resets) == 200 // 40 + 2
    assert resets[0] == resets[-1] == [0, 1]
    trainer.run(lambda: trainer.counters.steps >= 100)
    half = expected_of(trainer, max_bytes=2**30, capacity=10**9)
    assert 2**29 < half.memory < fresh.memory
    assert half.disk < fresh.disk
