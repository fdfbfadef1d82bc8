import csv
import dataclasses
import io
import itertools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rich.console import Console

from atlantis_exp.build import build_trainer, make_emulator
from atlantis_exp.config import Config
from atlantis_exp.game.vector import WorkerDied
from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.replay.samplers import Draw, Sampler
from atlantis_exp.tracking.journal import NOTE, Image, Journal, Metrics, Tags, read
from atlantis_exp.training.actor import ConstantActor
from atlantis_exp.training.fingerprint import fingerprint
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Diverged, Phase, Plan, Trainer

Compose = Callable[..., Config]
Start = Callable[[Config, Path], Trainer]

TWO_PHASES = (
    "phase.quick.steps=80",
    "phase.quick.sampler=uniform",
    "+phase.second={steps:60,episodes:null,lr:0.0003,sampler:top_half}",
)


def print_of(trainer: Trainer, folder: Path) -> dict[str, str]:
    return fingerprint(trainer.state_dict(), trainer.memory, folder)


def after(stops: int) -> Callable[[], bool]:
    """A stop request that comes once `stop` was asked that often."""
    asked = itertools.count()
    return lambda: next(asked) >= stops


def curve(folder: Path, key: str) -> list[tuple[int, float]]:
    records = [record for _, record in read(folder) if isinstance(record, Metrics)]
    return [(record.step, record.values[key]) for record in records if key in record.values]


@pytest.mark.parametrize(
    "overrides", [pytest.param(("env.num_envs=1",), marks=pytest.mark.slow), ("env.num_envs=3", "env.workers=2")]
)
def test_a_training_with_evaluations_is_the_same_as_one_without(
    tiny: Compose, started: Start, tmp_path: Path, overrides: tuple[str, ...]
) -> None:
    never = ("evaluation.every_steps=null", "evaluation.at_end=false")
    often = ("evaluation.every_steps=40", "evaluation.every_episodes=1")
    prints = []
    for name, chosen in (("never", never), ("often", often)):
        trainer = started(tiny(*overrides, *chosen), tmp_path / name)
        assert trainer.run() == "finished"
        prints.append(print_of(trainer, tmp_path / name))
    without, with_evaluations = prints
    differing = {part for part in without if without[part] != with_evaluations[part]}
    assert differing == {
        *("best_mean", "best_step", "evaluations", "evaluated_at", "last_report", "last_metrics", "history")
    }
    for key in ("score/episode", "learning/loss", "actions/epsilon"):
        assert curve(tmp_path / "never", key) == curve(tmp_path / "often", key) != []


def test_the_same_seed_gives_the_same_training_and_another_seed_another(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    prints = []
    for name, seed in (("first", 3), ("again", 3), ("other", 4)):
        trainer = started(tiny(f"seed={seed}"), tmp_path / name)
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
        pytest.param(("model=cnn", "env.num_envs=3", "env.workers=2", "objective=double_dqn"), marks=pytest.mark.slow),
        pytest.param(
            ("model=resnet", "env.size=16", "env.num_envs=1", "optimizer=rmsprop", "objective.target.mode=train"),
            marks=pytest.mark.slow,
        ),
        ("env.num_envs=3", "env.workers=2", "sampler=prioritized", "phase.quick.sampler=prioritized"),
        pytest.param(
            (
                *("objective=quantile", "lr_schedule=one_cycle", "objective.n_step=3"),
                *("objective.target.tau=1", "objective.target.every=3"),
            ),
            marks=pytest.mark.slow,
        ),
        pytest.param(("model=resnet", "env.size=16", "env.num_envs=8", "env.workers=2"), marks=pytest.mark.slow),
        pytest.param(("model=cnn", "env.num_envs=8", "env=atlantis_standard", "env.size=40"), marks=pytest.mark.slow),
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
    for iterations in (0, 7, 38):  # of each session, committed at its end; then some more that are lost
        session = started(config, tmp_path / "broken")
        assert session.run(after(iterations)) == "interrupted"
        session.commit = lambda: None  # type: ignore[method-assign]
        session.run(after(3))
    session = started(config, tmp_path / "broken")
    session.run()
    assert print_of(session, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


@pytest.mark.slow
def test_the_time_of_a_commit_changes_nothing(tiny: Compose, started: Start, tmp_path: Path) -> None:
    prints = []
    for name, seconds in (("every-step", "1e-9"), ("at-the-end", "1e9")):
        overrides = ("env.num_envs=2", "env.workers=1", "phase.quick.steps=90", f"tracking.commit_seconds={seconds}")
        trainer = started(tiny(*overrides), tmp_path / name)
        trainer.run()
        prints.append(print_of(trainer, tmp_path / name))
    assert prints[0] == prints[1]


@pytest.mark.slow
def test_a_commit_finds_everything_that_fell_due_at_its_step_done(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    """All three environments end their episodes at one step, at which a curve, an evaluation and a commit fall due."""
    config = tiny(
        "env.num_envs=3",
        "env.workers=1",
        "tracking.commit_episodes=1",
        "tracking.every_steps=120",
        "evaluation.every_steps=120",
        "phase.quick.steps=240",
    )
    unbroken = started(config, tmp_path / "unbroken")
    unbroken.run()
    killed = started(config, tmp_path / "broken")
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
    continued = started(config, tmp_path / "broken")
    continued.run()
    assert print_of(continued, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


def test_learning_rate_and_sampler_change_with_the_phase_and_nothing_else_does(
    tiny: Compose, started: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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

    trainer = started(tiny(*TWO_PHASES), tmp_path)
    phases = [dataclasses.replace(phase, sampler=Taped(phase.name, phase.sampler)) for phase in trainer.plan.phases]
    monkeypatch.setattr(trainer, "plan", dataclasses.replace(trainer.plan, phases=phases))
    trainer.run()
    # The step that crosses the boundary is the first phase's, and so is the update that it makes due.
    first = [(step, "quick", 4, 0.001) for step in range(24, 80, 4)]
    second = [(step, "second", 4, 0.0003) for step in range(84, 141, 4)]
    assert [entry for entry in tape if entry[0] != 80] == first + second
    assert curve(tmp_path, "learning/phase") == [(step, float(step >= 80)) for step in range(20, 141, 20)]
    assert trainer.learner.updates == len(tape) == 30


@pytest.mark.parametrize("num_envs", [1, 3])
@pytest.mark.parametrize(
    ("learn_every", "learn_start"),
    [(7, 33), *(pytest.param(*cadence, marks=pytest.mark.slow) for cadence in ((1, 0), (4, 20), (50, 49)))],
)
def test_updates_are_those_that_a_naive_loop_counts(
    tiny: Compose, started: Start, tmp_path: Path, num_envs: int, learn_every: int, learn_start: int
) -> None:
    config = tiny(
        f"env.num_envs={num_envs}",
        "env.workers=1",
        f"training.learn_every={learn_every}",
        f"training.learn_start={learn_start}",
        "training.batch_size=1",
        "phase.quick.steps=132",
        "evaluation.at_end=false",
        "evaluation.every_steps=null",
        "replay.capacity=1000",
    )
    trainer = started(config, tmp_path)
    tape = []

    def update(*_: object) -> torch.Tensor:
        tape.append(len(trainer.memory))
        return torch.zeros(1)

    trainer.learner.update = update  # type: ignore[method-assign, assignment]
    trainer.run()

    naive = []
    for step in range(1, 133):  # a step is a transition: the memory forgets none here
        if step % learn_every == 0:
            # With several environments the updates wait for the next step of all of them, which then is under way.
            known = step if num_envs == 1 else -(-step // num_envs) * num_envs
            if known > learn_start and (num_envs == 1 or known < 132):
                naive.append(known)
    assert tape == naive


@pytest.mark.slow
@pytest.mark.parametrize("num_envs", [1, 8])
def test_a_prioritized_training_is_the_same_whenever_it_is_committed(
    tiny: Compose, started: Start, tmp_path: Path, num_envs: int
) -> None:
    """With eight environments several updates fall due at once, and the memory forgets what awaits its error."""
    prints = []
    for name, seconds in (("every-step", "1e-9"), ("at-the-end", "1e9")):
        trainer = started(
            tiny(
                "sampler=prioritized",
                f"env.num_envs={num_envs}",
                "env.workers=1",
                "replay.capacity=70",
                "training.learn_every=2",
                f"tracking.commit_seconds={seconds}",
            ),
            tmp_path / name,
        )
        trainer.run()
        prints.append(print_of(trainer, tmp_path / name))
    assert prints[0] == prints[1]


def test_the_learning_rate_is_the_phase_s_times_the_schedule_s(tiny: Compose, started: Start, tmp_path: Path) -> None:
    never = ("evaluation.every_steps=null", "evaluation.at_end=false")
    trainer = started(tiny(*TWO_PHASES, *never, "lr_schedule=linear", "lr_schedule.duration=0.5"), tmp_path)
    trainer.run()
    expected = {step: (1e-3 if step <= 80 else 3e-4) * max(0.0, 1 - (step - 1) / 70) for step in range(20, 141, 20)}
    assert dict(curve(tmp_path, "learning/learning_rate")) == pytest.approx(expected)


def test_evaluations_amid_the_training_may_be_shorter_than_the_one_at_its_end(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    trainer = started(tiny("evaluation.interim_episodes=1"), tmp_path)
    trainer.run()
    assert curve(tmp_path, "evaluation/episodes") == [(80, 1), (160, 2)]


def test_a_collapsed_policy_is_tagged_and_told(tiny: Compose, tmp_path: Path) -> None:
    told = Console(record=True, file=io.StringIO(), width=200)
    config = tiny("evaluation.every_steps=null", "evaluation.epsilon=0.0", "training.learn_start=110")
    trainer = build_trainer(config, tmp_path, Journal(tmp_path), Progress(told))
    with torch.no_grad():
        for parameter in trainer.learner.network.parameters():
            parameter.zero_()
        list(trainer.learner.network.parameters())[-1][2] = 1.0
        trainer.learner._online.refresh()
    trainer.plan = dataclasses.replace(trainer.plan, learn_start=10**6)
    trainer.run()
    trainer.emulators.close()
    policy = "collapsed: RIGHTFIRE in 100.0% of the network's decisions"
    tags = {
        key: value for _, record in read(tmp_path) if isinstance(record, Tags) for key, value in record.values.items()
    }
    assert tags["policy"] == policy
    assert f"warning: the policy has {policy}" in told.export_text()


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


def test_curves_of_any_num_envs_share_their_steps_and_raw_scores_stand_where_they_happened(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    for num_envs in (1, 3):
        trainer = started(
            tiny(f"env.num_envs={num_envs}", "env.workers=1", "env.max_steps=35"), tmp_path / f"{num_envs}"
        )
        trainer.run()
        assert [step for step, _ in curve(tmp_path / f"{num_envs}", "actions/epsilon")] == list(range(20, 161, 20))
        for key in ("score/mean_20", "score/mean_100", "score/length_mean_100", "throughput/episodes"):
            assert {step % 20 for step, _ in curve(tmp_path / f"{num_envs}", key)} == {0}, key
        evaluated = [step for step, _ in curve(tmp_path / f"{num_envs}", "evaluation/mean")]
        assert evaluated == [80, 160]
        raw = curve(tmp_path / f"{num_envs}", "score/episode")
        assert [step for step, _ in raw] == [played.step for played in trainer.episodes]
        assert {step % 35 for step, _ in raw} == {0}


@pytest.mark.slow
def test_the_table_of_episodes_is_whole_after_a_kill_and_agrees_with_the_journal(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    config = tiny("env.num_envs=3", "env.workers=1", "env.max_steps=15", "evaluation.every_steps=40")
    started(config, tmp_path / "unbroken").run()
    killed = started(config, tmp_path / "broken")
    killed.run(after(20))
    killed.commit = lambda: None  # type: ignore[method-assign]
    killed.run(after(12))  # writes a table of what is then lost
    started(config, tmp_path / "broken").run()
    table = (tmp_path / "broken" / "artifacts" / "episodes.csv").read_text()
    assert table == (tmp_path / "unbroken" / "artifacts" / "episodes.csv").read_text()
    lines = list(csv.DictReader(io.StringIO(table)))
    assert list(lines[0]) == ["episode", "step", "frames", "score", "length", "env"]
    assert [int(line["episode"]) for line in lines] == list(range(1, len(lines) + 1))
    assert {line["env"] for line in lines} == {"0", "1", "2"}
    raw = curve(tmp_path / "broken", "score/episode")
    assert [(int(line["step"]), float(line["score"])) for line in lines] == raw != []


def test_pictures_count_windows_and_evaluations_so_that_runs_stand_side_by_side(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    config = tiny("env.max_steps=20", "evaluation.every_steps=40", "tracking.histogram_episodes=2")
    started(config, tmp_path).run(after(70))
    started(config, tmp_path).run()
    positions: dict[str, list[int]] = {}
    for _, record in read(tmp_path):
        if isinstance(record, Image):
            positions.setdefault(record.key, []).append(record.step)
    four = [0, 1, 2, 3]
    assert positions == {"score/histogram": four, "score/heatmap": four, "evaluation/histogram": four}


def test_the_description_says_how_the_run_stands_and_what_its_last_evaluation_was(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    def notes() -> list[str]:
        tags = [record.values for _, record in read(tmp_path) if isinstance(record, Tags)]
        return [values[NOTE] for values in tags if NOTE in values]

    trainer = started(tiny(), tmp_path)
    trainer.about = "Continue with: x"
    trainer.run(lambda: trainer.counters.steps >= 100)
    assert notes()[0].startswith("Continue with: x\n\n**running** at step 0")
    assert "**interrupted** at step 100" in notes()[-1]
    trainer.run()
    mean = trainer.last_metrics["evaluation/mean"]
    assert "**finished** at step 160" in notes()[-1]
    assert f"| 160 | {mean:,.0f} |" in notes()[-1]
    assert f"The best mean so far is {trainer.best_mean:,.0f}, at step {trainer.best_step:,}." in notes()[-1]


def test_a_plan_in_episodes_ends_with_its_last_episode(tiny: Compose, started: Start, tmp_path: Path) -> None:
    length = ("phase.quick.steps=null", "phase.quick.episodes=3")
    trainer = started(tiny(*length, "evaluation.every_steps=null", "evaluation.at_end=false"), tmp_path)
    epsilons = []
    while trainer.run(after(1)) == "interrupted":
        epsilons.append((trainer.counters.episodes, trainer.epsilon))
    assert (trainer.counters.episodes, trainer.counters.steps) == (3, 120)
    assert dict(epsilons) == {done: trainer.plan.epsilon((done + 1) / 3, 0) for done in range(3)}


def test_the_phase_at_a_boundary_is_the_one_that_begins_there() -> None:
    phases = [Phase("a", 2, 0.1, None), Phase("b", 1, 0.2, None)]  # type: ignore[arg-type]
    plan = Plan("steps", phases, lambda *_: 0.0, lambda *_: 1.0, Returns(0.9), False, 1, 0, 1)
    assert [plan.phase_at(done).name for done in (0, 1, 2, 3, 9)] == ["a", "a", "b", "b", "b"]


def test_a_loss_that_is_no_number_stops_the_run_at_its_last_good_commit(
    tiny: Compose, started: Start, tmp_path: Path
) -> None:
    config = tiny("tracking.every_steps=1000")
    trainer = started(config, tmp_path)
    trainer.run(after(100))
    good = print_of(trainer, tmp_path)
    next(trainer.learner.network.parameters()).data[:] = np.nan
    with pytest.raises(Diverged, match=f"update {trainer.learner.updates} is no finite number"):
        trainer.run()
    assert print_of(started(config, tmp_path), tmp_path) == good


@pytest.mark.parametrize(  # one amid the training, the one at its end
    "step", [80, pytest.param(120, marks=pytest.mark.slow)]
)
def test_an_evaluation_that_is_asked_to_stop_is_made_good(
    tiny: Compose, started: Start, tmp_path: Path, step: int
) -> None:
    config = tiny("phase.quick.steps=120")
    unbroken = started(config, tmp_path / "unbroken")
    unbroken.run()
    stopped = started(config, tmp_path / "broken")
    asked = after(30)
    assert stopped.run(lambda: stopped.counters.steps == step and asked()) == "interrupted"
    assert (stopped.counters.steps, stopped.owes_evaluation) == (step, True)
    assert step not in dict(curve(tmp_path / "broken", "evaluation/mean"))
    continued = started(config, tmp_path / "broken")
    assert continued.run() == "finished"
    assert print_of(continued, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


@pytest.mark.slow
def test_a_run_goes_on_after_its_worker_was_killed(tiny: Compose, started: Start, tmp_path: Path) -> None:
    config = tiny("env.num_envs=3", "env.workers=2")
    unbroken = started(config, tmp_path / "unbroken")
    unbroken.run()
    trainer = started(config, tmp_path / "broken")
    trainer.run(after(20))
    trainer.emulators._processes[1].kill()  # type: ignore[attr-defined]
    with pytest.raises(WorkerDied, match="SIGKILL"):
        trainer.run()
    continued = started(config, tmp_path / "broken")
    continued.run()
    assert print_of(continued, tmp_path / "broken") == print_of(unbroken, tmp_path / "unbroken")


def test_a_clock_that_steps_back_harms_no_metric(
    tiny: Compose, started: Start, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ticks = itertools.count(10**18, -(10**12))
    monkeypatch.setattr("time.time_ns", lambda: next(ticks))
    trainer = started(tiny(), tmp_path)
    trainer.run()
    times = [record.time for _, record in read(tmp_path) if isinstance(record, Metrics)]
    assert times == sorted(times)
    assert min(curve(tmp_path, "throughput/hours"))[1] >= 0
