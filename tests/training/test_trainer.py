import dataclasses
import itertools
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from atlantis_exp.build import make_emulator
from atlantis_exp.config import Config
from atlantis_exp.game.vector import Steps
from atlantis_exp.learning.schedules import Linear
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import Draw, PrioritizedSampler, Sampler, TopHalfSampler, UniformSampler
from atlantis_exp.runs.journal import NOTE, Metrics, Tags, read
from atlantis_exp.training.actor import ConstantActor, Decisions
from atlantis_exp.training.evaluation import Evaluation
from atlantis_exp.training.fingerprint import fingerprint
from atlantis_exp.training.plan import Phase
from atlantis_exp.training.recorder import Diverged, Played
from atlantis_exp.training.trainer import Trainer

Compose = Callable[..., Config]
Start = Callable[[Config, Path], Trainer]
Small = Callable[..., Trainer]

TWO_PHASES = (
    "phase.quick.steps=80",
    "phase.quick.sampler=uniform",
    "+phase.second={steps:60,episodes:null,lr:0.0003,sampler:top_half}",
)


PHASES = [Phase("quick", 80, 1e-3, UniformSampler()), Phase("second", 60, 3e-4, TopHalfSampler(2))]


def phases(length: int, sampler: Sampler | None = None) -> list[Phase]:
    """A single one."""
    return [Phase("quick", length, 1e-3, sampler or UniformSampler())]


def print_of(trainer: Trainer, folder: Path) -> dict[str, str]:
    return fingerprint(trainer.state_dict(), trainer.memory, folder)


def after(stops: int) -> Callable[[], bool]:
    """A stop request that comes once `stop` was asked that often."""
    asked = itertools.count()
    return lambda: next(asked) >= stops


def curve(folder: Path, key: str) -> list[tuple[int, float]]:
    records = [record for _, record in read(folder) if isinstance(record, Metrics)]
    return [(record.step, record.values[key]) for record in records if key in record.values]


NEVER: dict[str, Any] = {"evaluate_steps": None, "evaluate_at_end": False}


def assert_same_but_for_evaluations(trainers: Mapping[str, Trainer], folder: Path) -> None:
    prints = []
    for name in ("never", "often"):
        assert trainers[name].run() == "finished"
        prints.append(print_of(trainers[name], folder / name))
    without, with_evaluations = prints
    differing = {part for part in without if without[part] != with_evaluations[part]}
    assert differing == {
        *(
            "best_mean",
            "best_step",
            "best_sha256",
            "evaluations",
            "evaluated_at",
            "last_report",
            "last_metrics",
            "history",
        )
    }
    for key in ("score/episode", "learning/loss", "actions/epsilon"):
        assert curve(folder / "never", key) == curve(folder / "often", key) != []


@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_training_with_evaluations_is_the_same_as_one_without(small: Small, tmp_path: Path, num_envs: int) -> None:
    often = {"evaluate_steps": 40, "evaluate_episodes": 1}
    trainers = {
        name: small(tmp_path / name, num_envs=num_envs, **chosen)
        for name, chosen in (("never", NEVER), ("often", often))
    }
    assert_same_but_for_evaluations(trainers, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [("env.num_envs=1",), ("env.num_envs=3", "env.workers=2")])
def test_a_real_training_with_evaluations_is_the_same_as_one_without(
    tiny: Compose, started: Start, tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    never = ("evaluation.every_steps=null", "evaluation.at_end=false")
    often = ("evaluation.every_steps=40", "evaluation.every_episodes=1")
    trainers = {
        name: started(tiny(*overrides, *chosen), tmp_path / name)
        for name, chosen in (("never", never), ("often", often))
    }
    assert_same_but_for_evaluations(trainers, tmp_path)


def test_the_same_seed_gives_the_same_training_and_another_seed_another(small: Small, tmp_path: Path) -> None:
    prints = []
    for name, seed in (("first", 3), ("again", 3), ("other", 4)):
        trainer = small(tmp_path / name, seed=seed)
        trainer.run()
        prints.append(print_of(trainer, tmp_path / name))
    first, again, other = prints
    assert first == again
    for part in ("weights", "replay", "emulators", "exploration", "sampling", "history"):
        assert first[part] != other[part]


@pytest.mark.parametrize(
    "overrides",
    [
        ("model=cnn", "env.num_envs=1"),
        (
            *("model=cnn_gru", "model.units=16", "model.burn_in=3", "model.unroll=4", "env.num_envs=3"),
            *("sampler=prioritized", "phase.quick.sampler=prioritized", "phase.second.sampler=prioritized"),
        ),
        pytest.param(
            (
                *("model=resnet", "env.size=16", "env.num_envs=3", "env.workers=2", "optimizer=rmsprop"),
                *("objective.target.mode=train", "objective=double_dqn", "sampler=prioritized"),
                *("phase.quick.sampler=prioritized", "phase.second.sampler=prioritized", "env.stack=[0,1,5,9]"),
            ),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            (
                *("env=atlantis_standard", "env.size=40", "env.num_envs=8", "objective=quantile"),
                *("lr_schedule=one_cycle", "objective.n_step=3", "objective.target.tau=1", "objective.target.every=3"),
            ),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("model=cnn", "env.num_envs=3", "env.workers=2", "compile=true"),
            marks=[pytest.mark.slow, pytest.mark.skipif(shutil.which("g++") is None, reason="torch.compile needs it")],
        ),
    ],
)
def test_a_training_killed_in_every_phase_is_the_unbroken_one_bit_for_bit(
    tiny: Compose, started: Start, tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    config = tiny(*TWO_PHASES, *overrides)
    unbroken = started(config, tmp_path / "unbroken")
    unbroken.run()
    for goal, phase in ((0, "quick"), (7, "quick"), (45, "quick"), (110, "second")):  # steps, committed; the next lost
        session = started(config, tmp_path / "broken")
        assert session.run(lambda: session.counters.steps >= goal) == "interrupted"  # noqa: B023
        assert session.plan.phase_at(session.counters).name == phase
        session.commit = lambda: None  # type: ignore[method-assign]
        session.run(after(3))
    session = started(config, tmp_path / "broken")
    session.run()
    assert print_of(session, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


def test_the_time_of_a_commit_changes_nothing(small: Small, tmp_path: Path) -> None:
    prints = []
    for name, seconds in (("every-step", 0.0), ("at-the-end", 1e9)):
        trainer = small(tmp_path / name, num_envs=2, phases=phases(90), commit_seconds=seconds)
        trainer.run()
        prints.append(print_of(trainer, tmp_path / name))
    assert prints[0] == prints[1]


def test_a_commit_finds_everything_that_fell_due_at_its_step_done(small: Small, tmp_path: Path) -> None:
    """All three environments end their episodes at one step, at which a curve, an evaluation and a commit fall due."""
    due = {"commit_episodes": 1, "curve_steps": 120, "evaluate_steps": 120}

    def begun(name: str) -> Trainer:
        return small(tmp_path / name, num_envs=3, phases=phases(240), **due)

    unbroken = begun("unbroken")
    unbroken.run()
    killed = begun("broken")
    commits = []
    save = killed.checkpoints.save

    def die_after(state: dict[str, Any], memory: ReplayMemory) -> None:
        save(state, memory)
        commits.append(killed.counters.steps)
        raise KeyboardInterrupt

    killed.checkpoints.save = die_after  # type: ignore[method-assign, assignment]
    with pytest.raises(KeyboardInterrupt):
        killed.run()
    assert commits == [120]
    continued = begun("broken")
    continued.run()
    assert print_of(continued, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


def test_learning_rate_and_sampler_change_with_the_phase_and_nothing_else_does(small: Small, tmp_path: Path) -> None:
    tape: list[tuple[Any, ...]] = []

    @dataclasses.dataclass(frozen=True)
    class Taped:
        name: str
        sampler: Sampler

        def __getattr__(self, name: str) -> Any:
            return getattr(self.sampler, name)

        def sample(self, memory: ReplayMemory, count: int, rng: np.random.Generator) -> Draw:
            tape.append((trainer.counters.steps, self.name, count, trainer.learner.learning_rate))
            return self.sampler.sample(memory, count, rng)

    taped = [dataclasses.replace(phase, sampler=Taped(phase.name, phase.sampler)) for phase in PHASES]
    trainer = small(tmp_path, phases=taped)
    trainer.run()
    # The step that crosses the boundary is the first phase's, and so is the update that it makes due.
    first = [(step, "quick", 4, 0.001) for step in range(24, 81, 4)]
    second = [(step, "second", 4, 0.0003) for step in range(84, 141, 4)]
    assert tape == first + second
    assert curve(tmp_path, "learning/phase") == [(step, float(step >= 80)) for step in range(20, 141, 20)]
    assert trainer.learner.updates == len(tape) == 30


@pytest.mark.parametrize("num_envs", [1, 2])
@pytest.mark.parametrize(
    ("learn_every", "learn_start"),
    [(7, 33), (1, 0), (4, 20), (50, 49)],
)
def test_updates_are_those_that_a_naive_loop_counts(
    small: Small, tmp_path: Path, num_envs: int, learn_every: int, learn_start: int
) -> None:
    trainer = small(
        tmp_path,
        num_envs=num_envs,
        learn_every=learn_every,
        learn_start=learn_start,
        batch_size=1,
        phases=phases(132),
        capacity=1_000,
        **NEVER,
    )
    tape = []

    def update(*_: object, **__: object) -> torch.Tensor:
        tape.append(len(trainer.memory))
        return torch.zeros(1)

    trainer.learner.update = update  # type: ignore[method-assign]
    trainer.run()

    naive = []
    for step in range(1, 133):  # a step is a transition: the memory forgets none here
        if step % learn_every == 0:
            # With several environments the updates wait for the next step of all of them, which then is under way.
            known = step if num_envs == 1 else -(-step // num_envs) * num_envs
            if known > learn_start and (num_envs == 1 or known < 132):
                naive.append(known)
    assert tape == naive


@pytest.mark.parametrize("num_envs", [1, 8])
def test_each_error_is_fed_back_to_its_sampler_once_before_the_next_batch_is_drawn(
    small: Small, tmp_path: Path, num_envs: int
) -> None:
    tape: list[tuple[str, list[int]]] = []

    class Taped(PrioritizedSampler):
        def sample(self, memory: ReplayMemory, batch_size: int, rng: np.random.Generator) -> Draw:
            draw = super().sample(memory, batch_size, rng)
            tape.append(("drawn", draw.ids.tolist()))
            return draw

        def feed_back(self, ids: npt.NDArray[np.int64], errors: npt.NDArray[np.float32]) -> None:
            tape.append(("fed back", ids.tolist()))
            assert errors.shape == ids.shape
            assert (errors >= 0).all()
            super().feed_back(ids, errors)

    trainer = small(
        *(tmp_path,), num_envs=num_envs, phases=phases(160, Taped(0.5, 0.5)), capacity=400, learn_every=2, **NEVER
    )
    trainer.run()
    drawn, back = ([ids for kind, ids in tape if kind == each] for each in ("drawn", "fed back"))
    assert drawn == back
    assert len(drawn) == trainer.learner.updates > 60
    waiting = 0
    for kind, _ in tape:  # with eight environments the updates of a step are drawn together
        waiting += 1 if kind == "drawn" else -1
        assert 0 <= waiting <= max(1, num_envs // 2)


def test_a_checkpoint_with_scores_or_actions_that_cannot_be_is_refused(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, phases=phases(40), **NEVER)
    trainer.run()
    state = trainer.state_dict()
    trainer.load_state_dict(state)
    for score in (np.inf, np.nan):
        with pytest.raises(ValueError, match="scores are not finite"):
            trainer.load_state_dict({**state, "scores": np.full_like(state["scores"], score)})
    trainer.memory.add(0, len(trainer.emulators.game.actions), 0.0, trainer.stack.state[0, -1], False)
    with pytest.raises(ValueError, match="holds action 4, which the game lacks"):
        trainer.load_state_dict(state)


@pytest.mark.parametrize(("num_envs", "few"), [(1, 37), (8, 7)])
def test_a_prioritized_training_continued_every_few_steps_is_the_unbroken_one(
    small: Small, tmp_path: Path, num_envs: int, few: int
) -> None:
    """With eight environments several updates fall due at once, and the memory forgets what awaits its error."""
    prints = []
    for name, steps in (("unbroken", 1_000), ("broken", few)):
        outcome = ""
        while outcome != "finished":
            prioritized = phases(160, PrioritizedSampler(0.5, 0.5))
            trainer = small(
                *(tmp_path / name,), num_envs=num_envs, phases=prioritized, capacity=70, learn_every=2, **NEVER
            )
            outcome = trainer.run(after(steps))
        prints.append(print_of(trainer, tmp_path / name))
    assert prints[0] == prints[1]


def test_the_learning_rate_is_the_phase_s_times_the_schedule_s(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, phases=PHASES, learning_rate=Linear(1.0, 0.0, 0.5), **NEVER)
    trainer.run()
    expected = {step: (1e-3 if step <= 80 else 3e-4) * max(0.0, 1 - (step - 1) / 70) for step in range(20, 141, 20)}
    assert dict(curve(tmp_path, "learning/learning_rate")) == pytest.approx(expected)


def test_evaluations_amid_the_training_may_be_shorter_than_the_one_at_its_end(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, interim_episodes=1)
    trainer.run()
    assert curve(tmp_path, "evaluation/episodes") == [(80, 1), (160, 2)]


def test_a_truncated_episode_bootstraps_and_a_terminated_one_does_not(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    game = (
        "env=atlantis_v5",
        "env.size=40",
        "env.max_steps=430",
        "training.learn_start=990",
        "phase.quick.steps=900",
        "replay.capacity=1000",
        "evaluation.at_end=false",
        "evaluation.every_steps=null",
    )
    trainer = started(tiny(*game), tmp_path)
    trainer.actor = ConstantActor(0)  # a game of NOOPs lasts 423 steps
    trainer.run(after(423))
    assert [score for _, score in curve(tmp_path, "score/episode")] == [2_000]
    ends = trainer.memory.state_dict()["terminal"]
    assert np.flatnonzero(ends).tolist() == [423]

    mortal = started(tiny(*game, "objective.terminal_on_life_loss=true"), tmp_path / "lives")
    mortal.actor = ConstantActor(0)
    emulator = make_emulator(tiny(*game).env)()
    emulator.reset(mortal.seeds[0])
    losses = [step for step in range(1, 424) if emulator.step(0).life_lost]
    mortal.run(after(423))
    assert len(losses) > 3
    assert np.flatnonzero(mortal.memory.state_dict()["terminal"]).tolist() == [*losses, 423]  # the game is over later

    truncated = started(tiny("env.max_steps=40", "training.learn_start=114"), tmp_path / "truncated")
    truncated.run(after(100))
    assert [length for _, length in curve(tmp_path / "truncated", "score/length")] == [40, 40]
    state = truncated.memory.state_dict()
    assert not state["terminal"].any()
    assert np.flatnonzero(state["back"] == 0).tolist() == [0, 41, 82]  # observations that begin an episode


def test_a_plan_in_episodes_ends_with_its_last_episode(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, unit="episodes", phases=phases(3), **NEVER)
    epsilons = []
    while trainer.run(after(7)) == "interrupted":
        epsilons.append((trainer.counters.episodes, trainer.plan.epsilon_at(trainer.counters)))
    assert (trainer.counters.episodes, trainer.counters.steps) == (3, 120)
    assert dict(epsilons) == {done: trainer.plan.epsilon((done + 1) / 3, 0) for done in range(3)}


def test_a_loss_that_is_no_number_stops_the_run_at_its_last_good_commit(small: Small, tmp_path: Path) -> None:
    quiet = {"curve_steps": 1_000, **NEVER}  # nothing but the commit asks for the loss
    trainer = small(tmp_path, **quiet)
    trainer.run(after(100))
    good = print_of(trainer, tmp_path)
    next(trainer.learner.network.parameters()).data[:] = np.nan
    with pytest.raises(Diverged, match=f"update {trainer.learner.updates} is not finite"):
        trainer.run()
    assert print_of(small(tmp_path, **quiet), tmp_path) == good


def test_a_network_that_has_diverged_is_not_evaluated(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, curve_steps=1_000)
    trainer.run(after(10))
    next(trainer.learner.network.parameters()).data[:] = np.nan
    with pytest.raises(Diverged):
        trainer.run()
    assert (trainer.counters.steps, trainer.recorder.done.evaluations) == (80, 0)


def test_a_run_that_ends_where_it_was_evaluated_in_passing_is_evaluated_in_full(small: Small, tmp_path: Path) -> None:
    trainer = small(tmp_path, interim_episodes=1)
    assert trainer.run(lambda: trainer.recorder.done.evaluations == 1) == "interrupted"
    ended = small(tmp_path, interim_episodes=1, max_steps=80)
    assert ended.run() == "budget"
    assert ended.recorder.done.last_metrics["evaluation/episodes"] == 2
    assert small(tmp_path, interim_episodes=1, max_steps=80).run() == "budget"
    assert curve(tmp_path, "evaluation/episodes") == [(80, 1), (80, 2)]


@pytest.mark.parametrize(("num_envs", "lags"), [(1, range(4)), (3, (0, 2, 9))])
def test_a_training_ends_at_the_first_step_at_which_its_updates_are_made_and_is_resumed_bit_for_bit(
    small: Small, tmp_path: Path, num_envs: int, lags: Sequence[int]
) -> None:
    asked = {"num_envs": num_envs, "lags": lags, "max_updates": 11}
    unbroken = small(tmp_path / "unbroken", **asked)
    before: dict[int, int] = {}  # updates made when a step begins
    assert unbroken.run(lambda: before.setdefault(unbroken.counters.steps, unbroken.learner.updates) < 0) == "budget"
    assert before.pop(unbroken.counters.steps, 11) == 11 == unbroken.learner.updates
    assert max(before.values()) == 10
    assert unbroken.recorder.done.evaluated_at == unbroken.counters.steps
    assert unbroken.last_step is not None
    assert abs(unbroken.last_step - unbroken.counters.steps) <= 2 * max(num_envs, 4)

    assert small(tmp_path / "broken", **asked).run(after(15)) == "interrupted"
    assert small(tmp_path / "broken", **{**asked, "max_updates": 5}).run() == "budget"
    larger = small(tmp_path / "broken", **asked)
    assert larger.run() == "budget"
    assert larger.counters.steps == unbroken.counters.steps
    weights = [print_of(trainer, tmp_path / "broken")["weights"] for trainer in (larger, unbroken)]
    assert weights[0] == weights[1]

    for stop in (after(15), lambda: False):
        continued = small(tmp_path / "again", **asked)
        continued.run(stop)
    assert print_of(continued, tmp_path / "again") == print_of(unbroken, tmp_path / "unbroken")


@pytest.mark.parametrize("step", [80, 120])  # one amid the training, the one at its end
def test_an_evaluation_that_is_asked_to_stop_is_made_good(small: Small, tmp_path: Path, step: int) -> None:
    unbroken = small(tmp_path / "unbroken", phases=phases(120))
    unbroken.run()
    stopped = small(tmp_path / "broken", phases=phases(120))
    asked = after(30)
    assert stopped.run(lambda: stopped.counters.steps == step and asked()) == "interrupted"
    assert (stopped.counters.steps, stopped.recorder.done.owes_evaluation) == (step, True)
    assert step not in dict(curve(tmp_path / "broken", "evaluation/mean"))
    continued = small(tmp_path / "broken", phases=phases(120))
    assert continued.run() == "finished"
    assert print_of(continued, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


@pytest.mark.parametrize("num_envs", [1, 3])
def test_what_is_counted_is_what_a_naive_loop_counts(small: Small, tmp_path: Path, num_envs: int) -> None:
    trainer = small(tmp_path, num_envs=num_envs, **NEVER)
    receive, act, decided, shown = trainer.emulators.receive, trainer.actor.act, list[Decisions](), list[Steps]()

    def acted(*asked: Any) -> Decisions:
        decided.append(act(*asked))
        return decided[-1]

    def received(*asked: Any) -> Steps:
        shown.append(receive(*asked))
        return shown[-1]

    trainer.actor = SimpleNamespace(act=acted)
    trainer.emulators.receive = received  # type: ignore[method-assign]
    assert trainer.run() == "finished"
    steps = frames = 0
    scores, lengths = [0.0] * num_envs, [0] * num_envs
    episodes: list[Played] = []
    for each in shown:
        steps, frames = steps + num_envs, frames + sum(each.frames.tolist())
        for env in range(num_envs):
            scores[env], lengths[env] = scores[env] + each.rewards[env], lengths[env] + 1
            if each.terminated[env] or each.truncated[env]:
                episodes.append(Played(len(episodes) + 1, steps, frames, scores[env], lengths[env], env))
                scores[env], lengths[env] = 0.0, 0
    assert trainer.recorder.episodes == episodes != []
    counted = trainer.counters
    assert (counted.steps, counted.frames, counted.episodes) == (steps, frames, len(episodes))
    assert counted.random == sum(each.random.sum() for each in decided)
    assert 0 < counted.random < steps


def test_a_commit_is_due_after_its_seconds_and_a_training_has_the_seconds_of_all_its_sessions(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, commits = 1_000.0, []
    monkeypatch.setattr("time.monotonic", lambda: now)

    def session(last: int) -> None:
        trainer = small(tmp_path, commit_seconds=10.0, **NEVER)
        save = trainer.checkpoints.save

        def saved(state: dict[str, Any], memory: ReplayMemory) -> None:
            commits.append((state["counters"]["steps"], state["counters"]["seconds"]))
            save(state, memory)

        def a_second_later() -> bool:
            nonlocal now
            now += 1
            return trainer.counters.steps == last

        trainer.checkpoints.save = saved  # type: ignore[method-assign, assignment]
        trainer.run(a_second_later)

    session(25)
    now += 1_000_000
    session(48)
    assert commits == [(10, 10), (20, 20), (25, 26), (35, 36), (45, 46), (48, 50)]
    notes = [record.values[NOTE] for _, record in read(tmp_path) if isinstance(record, Tags) and NOTE in record.values]
    assert [note.partition(":")[0] for note in notes] == [
        *("**running** at step 0", "**interrupted** at step 25", "**running** at step 25", "**interrupted** at step 48")
    ]


def test_a_training_whose_replay_memory_is_lost_goes_on_from_what_is_on_the_screen(
    small: Small, tmp_path: Path
) -> None:
    begun = small(tmp_path, num_envs=2, **NEVER)
    begun.run(after(30))
    for path in tmp_path.glob("checkpoints/segments/*/*"):
        path.write_bytes(b"")
    goes_on = small(tmp_path, num_envs=2, **NEVER)
    assert (goes_on.memory.oldest_id, goes_on.memory.next_id) == (62, 64)
    shown = goes_on.stack.state[:, -1].copy()
    goes_on.run(after(1))
    first = goes_on.memory.gather(np.array([62, 63]), goes_on.plan.returns).s_t
    assert np.array_equal(first, np.repeat(shown[:, None], 4, axis=1))
    assert goes_on.run() == "finished"


def test_the_description_counts_the_hours_of_the_last_evaluation_too(
    small: Small, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = small(tmp_path, evaluate_steps=None, evaluate_episodes=None, evaluate_at_end=True, max_steps=80)
    played, late, clock = trainer.recorder.play, 0.0, time.monotonic

    def an_hour(*asked: Any) -> Evaluation:
        nonlocal late
        late += 3600
        return played(*asked)

    monkeypatch.setattr("time.monotonic", lambda: clock() + late)
    trainer.recorder.play = an_hour
    assert trainer.run() == "budget"
    tags = [record.values for _, record in read(tmp_path) if isinstance(record, Tags)]
    assert " 1.00 hours" in [values[NOTE] for values in tags if NOTE in values][-1]
    assert round(trainer.counters.seconds / 3600, 2) == 1
