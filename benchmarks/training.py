"""Compare training speed with the peers' on the same work: `python -m benchmarks.training`.

All train Nature's network on whole 84x84 screens of ALE/Atlantis-v5 (skip 4, sticky 0.25, stack 4) with uniform
replay, Adam, a target network copied every 10,000 steps and epsilon 0.05, and learn from 8 samples a step: batches of
32 every 4 steps with one environment, of 128 every 16 steps with more. Each has its own process, learns before it is
measured, and rests during the others' turns. Stable-Baselines3 has Gymnasium's `AtariPreprocessing`, a process for each
of several environments, and `optimize_memory_usage`.
"""

import functools
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from atlantis_exp.build import build_trainer
from atlantis_exp.config import Config
from atlantis_exp.machine import here
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Trainer
from benchmarks.composition import composed
from benchmarks.contest import (
    Contestant,
    Measure,
    calls_per_second,
    medians,
    missing,
    paired_ratio,
    parser_of,
    print_rates,
    print_results,
    ratio,
    run,
    take_turns,
)
from benchmarks.replay import fill, random_play

Program = Callable[[], AbstractContextManager[Measure[float]]]

_CAPACITY = 20_000  # transitions; small, as SB3's take 28 KB each
_LEARN_START = 1_000  # transitions
_TARGET_STEPS = 10_000  # between two copies to the target network; SB3's default
_WARM_UPDATES = 20


def batch_of(num_envs: int) -> tuple[int, int]:
    """Return transitions in a batch and steps between two batches, for 8 samples a step."""
    return (32, 4) if num_envs == 1 else (128, 16)


def training_config(batch_size: int, every: int, *overrides: str) -> Config:
    """Return the common work as our config, with a batch of transitions every `every` steps."""
    return composed(
        "env=atlantis_standard",
        "optimizer=adam",
        "optimizer.lr=1e-4",
        "epsilon=constant",
        "epsilon.value=0.05",
        f"replay.capacity={_CAPACITY}",
        f"training.learn_start={_LEARN_START}",
        "phase.single.episodes=1_000_000",
        "evaluation.every_episodes=null",
        "evaluation.at_end=false",
        f"training.batch_size={batch_size}",
        f"training.learn_every={every}",
        "objective.target.tau=1",
        f"objective.target.every={_TARGET_STEPS // every}",
        *overrides,
    )


@contextmanager
def learning(config: Config, tracker_of: Callable[[Path], Journal] = Journal) -> Iterator[Trainer]:
    """A learning trainer in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        set_up_torch(config, config.device)
        trainer = build_trainer(
            config, here().cores, Path(folder), tracker_of(Path(folder)), Progress(Console(quiet=True))
        )
        stack.callback(trainer.emulators.close)
        trainer.run(lambda: trainer.learner.updates >= _WARM_UPDATES)
        yield trainer


def steps_per_second(trainer: Trainer, seconds: float) -> float:
    """Return the speed over some seconds of training, without the final commit."""
    marks: list[tuple[float, int]] = []

    def stop() -> bool:
        marks.append((time.perf_counter(), trainer.counters.steps))
        return marks[-1][0] - marks[0][0] >= seconds

    trainer.run(stop)
    (began, steps_before), (ended, steps) = marks[0], marks[-1]
    return (steps - steps_before) / (ended - began)


@contextmanager
def ours(num_envs: int, precision: str = "auto", batch: tuple[int, int] | None = None) -> Iterator[Measure[float]]:
    """Our trainer with a journal."""
    size, every = batch or batch_of(num_envs)
    config = training_config(size, every, f"env.num_envs={num_envs}", f"training.precision={precision}")
    with learning(config) as trainer:
        yield functools.partial(steps_per_second, trainer)


@contextmanager
def ours_filled(transitions: int, play_steps: int) -> Iterator[Measure[float]]:
    """Our trainer with 16 environments and a replay memory of repeated random play."""
    size, every = batch_of(16)
    config = training_config(size, every, "env.num_envs=16", "replay.capacity=1_100_000")
    with learning(config) as trainer:
        fill(trainer.memory, list(random_play(config.env, play_steps)), transitions)
        for env in range(16):  # their earlier play is too far back to continue
            trainer.memory.begin(env, trainer.stack.state[env, -1])
        yield functools.partial(steps_per_second, trainer)


@contextmanager
def stable_baselines3(num_envs: int) -> Iterator[Measure[float]]:
    """SB3's DQN as its users would set it up for this work."""
    from stable_baselines3 import DQN
    from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecFrameStack

    batch_size, every = batch_of(num_envs)
    games: list[Callable[[], Any]] = [functools.partial(_gymnasium_game, seed) for seed in range(num_envs)]
    env = VecFrameStack(DummyVecEnv(games) if num_envs == 1 else SubprocVecEnv(games, start_method="fork"), 4)
    model = DQN(
        "CnnPolicy",
        env,
        learning_rate=1e-4,
        buffer_size=_CAPACITY,
        learning_starts=_LEARN_START,
        batch_size=batch_size,
        train_freq=every // num_envs,  # of steps of all environments together
        exploration_initial_eps=0.05,
        exploration_final_eps=0.05,
        optimize_memory_usage=True,
        replay_buffer_kwargs={"handle_timeout_termination": False},  # which excludes optimize_memory_usage
    )
    model.learn(_LEARN_START + _WARM_UPDATES * every)

    def measure(seconds: float) -> float:
        began, steps_before = time.perf_counter(), model.num_timesteps
        model.learn(1_000_000_000, lambda *_: time.perf_counter() - began < seconds, reset_num_timesteps=False)
        return float(model.num_timesteps - steps_before) / (time.perf_counter() - began)

    try:
        yield measure
    finally:
        env.close()


@contextmanager
def report() -> Iterator[Measure[float]]:
    """The report's loop."""
    import ale_py  # noqa: F401  # registers the environment
    import gymnasium

    from benchmarks.report_loop import DQNAgent, Loop

    batch_size, every = batch_of(1)
    agent = DQNAgent(buffer_size=_CAPACITY, batch_size=batch_size, learn_every=every, replay_after=_LEARN_START)
    env = gymnasium.make("ALE/Atlantis-v5", frameskip=4, repeat_action_probability=0.25)
    loop = Loop(agent, env, eps=0.05)
    for _ in range(_LEARN_START + _WARM_UPDATES * every):
        loop.step()
    yield functools.partial(calls_per_second, loop.step)
    env.close()


CONTESTANTS: dict[str, Program] = {
    "ours_16": functools.partial(ours, 16),
    "sb3_16": functools.partial(stable_baselines3, 16),
    "ours_16_fp32": functools.partial(ours, 16, "fp32"),
    "ours_1": functools.partial(ours, 1),
    "sb3_1": functools.partial(stable_baselines3, 1),
    "report": report,
}


@contextmanager
def neighbours(count: int) -> Iterator[None]:
    """Run processes that keep a core busy each."""
    busy = [subprocess.Popen((sys.executable, "-c", "while True: pass")) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def contest(programs: dict[str, Program], rounds: int, seconds: float, busy: int) -> dict[str, list[float]]:
    """Return the rates of programs that exist at once and work in turns, beside busy neighbours."""
    with ExitStack() as stack:
        contestants = {name: stack.enter_context(Contestant(program)) for name, program in programs.items()}
        turns = {name: functools.partial(one.measure, seconds) for name, one in contestants.items()}
        stack.enter_context(neighbours(busy))
        return take_turns(turns, rounds)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables and the JSON line."""
    parser = parser_of("training", __doc__, rounds=5, seconds=10.0)
    parser.add_argument("--contestants", nargs="*", choices=CONTESTANTS, default=list(CONTESTANTS))
    parser.add_argument("--num-envs", nargs="*", type=int, default=[1, 4, 8, 16, 32])
    parser.add_argument("--fills", nargs="*", type=int, default=[10_000, 100_000, 1_000_000], help="transitions")
    parser.add_argument("--neighbours", type=int, default=0, help="other programs that want a core each")
    parser.add_argument("--play-steps", type=int, default=20_000, help="random play that the fills repeat")
    args = parser.parse_args(arguments)

    def run(title: str, programs: dict[str, Program]) -> dict[str, list[float]]:
        rates = contest(programs, args.rounds, args.seconds, args.neighbours)
        if rates:
            print_rates(title, "steps/s", rates)
        return rates

    left_out = missing("stable_baselines3")
    names = [name for name in args.contestants if not (left_out and name.startswith("sb3"))]
    rates = run("the same work", {name: CONTESTANTS[name] for name in names})
    by_num_envs = run(
        "by environments, batches of 128 every 16 steps for all",
        {str(count): functools.partial(ours, count, batch=(128, 16)) for count in args.num_envs},
    )
    by_fill = run(
        "by transitions in the replay memory, 16 environments",
        {str(count): functools.partial(ours_filled, count, args.play_steps) for count in args.fills},
    )

    results: dict[str, Any] = {"neighbours": args.neighbours}
    for key, name, other in (
        ("vs_sb3_16", "ours_16", "sb3_16"),
        ("vs_sb3_1", "ours_1", "sb3_1"),
        ("vs_report", "ours_1", "report"),
        ("vs_report_16", "ours_16", "report"),
        ("vs_sb3_16_fp32", "ours_16_fp32", "sb3_16"),
    ):
        results[key] = ratio(rates.get(name), rates.get(other))
        results[f"{key}_paired"] = paired_ratio(rates.get(name), rates.get(other))
    results["steps_per_second"] = medians(rates)
    results["by_num_envs"] = medians(by_num_envs)
    results["by_fill"] = medians(by_fill)
    print_results(results)


def _gymnasium_game(seed: int) -> Any:
    import ale_py  # noqa: F401  # registers the environment
    import gymnasium

    game = gymnasium.make("ALE/Atlantis-v5", frameskip=1, repeat_action_probability=0.25)
    game = gymnasium.wrappers.AtariPreprocessing(game, noop_max=0, frame_skip=4, grayscale_newaxis=True)
    game.reset(seed=seed)
    return game


if __name__ == "__main__":
    run(main)
