"""Compare scores by training time with the peers': `python -m benchmarks.time_to_score --minutes 180`.

The contestants are `experiment=fast` with DQNCnn, sb3-contrib's QR-DQN with RL Zoo's settings for Atari, and
Stable-Baselines3's DQN with those of CleanRL's `dqn_atari.py` (whose loss is squared, not Huber's). Each has its own
process, all cores in its turn, and rests during the others' turns, as in `benchmarks.training`. After each turn its
network plays a few games at the same epsilon, off the clock. All train and play the game of the peers' settings,
`AtlantisNoFrameskip-v4`: four frames a step, up to 30 no-ops first, no sticky actions. Until the last turn games are
cut after --cut steps, so marked scores are lower bounds.
"""

import functools
import itertools
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from rich.console import Console

from atlantis_exp.build import build_evaluator, build_trainer
from atlantis_exp.config import Config
from atlantis_exp.machine import here
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.training.actor import EpsilonGreedy, States
from atlantis_exp.training.progress import Progress
from benchmarks.composition import composed
from benchmarks.contest import Contestant, Measure, missing, parser_of, print_results, print_table, run, take_turns

GAME = ("env=atlantis_standard", "env.sticky=0", "env.noop_max=30")  # AtlantisNoFrameskip-v4 in SB3's AtariWrapper
GOALS = (25_240, 62_500)  # the report's best mean, and its best game

_ACTIONS = 4
_STEPS = 10_000_000  # of the peers' schedules: RL Zoo's and CleanRL's
_CAPACITY = 400_000  # transitions; theirs is 1,000,000, which no run of hours fills and few machines hold
_QUIET = Progress(Console(quiet=True))


class Turn(NamedTuple):
    """The result of a turn of training."""

    hours: float  # of training in this turn
    steps: int  # of training so far
    score: float  # mean


@dataclass
class Judge:
    """Play a few games with a network after each turn."""

    episodes: int
    cut: int  # steps of a game, except in the last turn
    turns: int
    judged: int = 0

    def __call__(self, config: Config, q_values: Callable[[States], npt.NDArray[np.float32]]) -> float:
        """Return the mean score in a config's environment, at its evaluation epsilon."""
        self.judged += 1
        env = config.env if self.judged == self.turns else replace(config.env, max_steps=self.cut)
        evaluator = build_evaluator(env, replace(config.evaluation, num_envs=self.episodes), here().cores)
        return evaluator(EpsilonGreedy(q_values, _ACTIONS), self.episodes, _QUIET).summary.mean


@contextmanager
def ours(judge: Judge) -> Iterator[Measure[Turn]]:
    """Our recipe."""
    quiet = ("evaluation.at_end=false", "evaluation.every_steps=null", "evaluation.video=false")
    config = composed("experiment=fast", *GAME, *quiet)
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        set_up_torch(config, config.device)
        trainer = build_trainer(config, here().cores, Path(folder), Journal(Path(folder)), _QUIET)
        stack.callback(trainer.emulators.close)

        def measure(seconds: float) -> Turn:
            began = time.perf_counter()
            trainer.run(lambda: time.perf_counter() - began >= seconds)
            hours = (time.perf_counter() - began) / 3600
            return Turn(hours, trainer.counters.steps, judge(config, trainer.learner.evaluated_q_values))

        yield measure


@contextmanager
def stable_baselines3(judge: Judge, make: Callable[[Any], Any]) -> Iterator[Measure[Turn]]:
    """An SB3 model in RL Zoo's environment."""
    import ale_py  # noqa: F401  # registers the environment
    import torch
    from stable_baselines3.common.env_util import make_atari_env
    from stable_baselines3.common.vec_env import VecFrameStack

    env = VecFrameStack(make_atari_env("AtlantisNoFrameskip-v4", seed=0), 4)
    model = make(env)
    config = composed(*GAME)

    network = model.quantile_net if hasattr(model, "quantile_net") else model.q_net

    def q_values(states: States) -> npt.NDArray[np.float32]:
        with torch.no_grad():
            # It scales bytes itself. (B, A), or quantiles (B, N, A).
            q = network(torch.from_numpy(states).to(model.device))
        values: npt.NDArray[np.float32] = (q if q.ndim == 2 else q.mean(1)).cpu().numpy()
        return values

    def measure(seconds: float) -> Turn:
        began = time.perf_counter()
        # SB3 adds the steps so far to the total, by which it scales its schedules.
        model.learn(
            _STEPS - model.num_timesteps,
            lambda *_: time.perf_counter() - began < seconds,
            reset_num_timesteps=not model.num_timesteps,
        )
        hours = (time.perf_counter() - began) / 3600
        model.policy.set_training_mode(False)
        return Turn(hours, model.num_timesteps, judge(config, q_values))

    try:
        yield measure
    finally:
        env.close()


def sb3_qrdqn(env: Any) -> Any:
    """All settings of RL Zoo's `hyperparams/qrdqn.yml` besides the wrapper and the stack."""
    from sb3_contrib import QRDQN

    return QRDQN("CnnPolicy", env, buffer_size=_CAPACITY, seed=0, **_THRIFTY)


def cleanrl_dqn(env: Any) -> Any:
    """The settings of CleanRL's `dqn_atari.py`."""
    from stable_baselines3 import DQN

    return DQN(
        "CnnPolicy",
        env,
        learning_rate=1e-4,
        buffer_size=_CAPACITY,
        learning_starts=80_000,
        batch_size=32,
        gamma=0.99,
        train_freq=4,
        target_update_interval=1_000,
        exploration_fraction=0.1,
        exploration_initial_eps=1.0,
        exploration_final_eps=0.01,
        max_grad_norm=0.5,
        seed=0,
        **_THRIFTY,
    )


_THRIFTY: Any = {
    "optimize_memory_usage": True,
    "replay_buffer_kwargs": {"handle_timeout_termination": False},  # which excludes optimize_memory_usage
}
PROGRAMS: dict[str, Callable[[Judge], AbstractContextManager[Measure[Turn]]]] = {
    "ours": ours,
    "sb3_qrdqn": functools.partial(stable_baselines3, make=sb3_qrdqn),
    "cleanrl_dqn": functools.partial(stable_baselines3, make=cleanrl_dqn),
}


def turn_of(name: str, contestant: Contestant[Turn], seconds: float) -> Turn:
    """Train for a turn and print its result, since hours of turns may be interrupted."""
    turn = contestant.measure(seconds)
    print(f"{name}: {turn.score:,.0f} after {turn.steps:,} steps, {turn.hours:.3f} h more", file=sys.stderr, flush=True)
    return turn


def hours_of(turns: Sequence[Turn]) -> float:
    """Return the hours of all turns."""
    return sum(turn.hours for turn in turns)


def hours_to(goal: float, turns: Sequence[Turn]) -> float:
    """Return the hours until a score was first reached, or infinity."""
    hours = itertools.accumulate(turn.hours for turn in turns)
    return next((now for now, turn in zip(hours, turns, strict=True) if turn.score >= goal), math.inf)


def sooner(goal: float, turns: dict[str, list[Turn]]) -> tuple[float, bool] | None:
    """Return how many times sooner ours reached a score than the best peer, and whether that is a lower bound, since no
    peer has reached it; None if ours has not, or without peers."""
    reached = {name: hours_to(goal, each) for name, each in turns.items()}
    own = reached.pop("ours", math.inf)
    if math.isinf(own) or not reached:
        return None
    best = min(reached.values())
    longest = max(hours_of(turns[name]) for name in reached)
    return min(best, longest) / own, math.isinf(best)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train in turns and print."""
    parser = parser_of("time_to_score", __doc__)
    parser.add_argument("--contestants", nargs="*", choices=PROGRAMS, default=list(PROGRAMS))
    parser.add_argument("--minutes", type=float, default=6.0, help="training of each; for a result: 180")
    parser.add_argument("--turn", type=float, default=2.0, help="minutes of a turn; for a result: 10")
    parser.add_argument("--episodes", type=int, default=5, help="games after a turn")
    parser.add_argument("--cut", type=int, default=8_000, help="steps of such a game, until the last turn")
    args = parser.parse_args(arguments)
    peers = [name for name in args.contestants if name != "ours"]
    left_out = bool(peers) and (missing("stable_baselines3") | missing("sb3_contrib"))
    names = [name for name in args.contestants if not (left_out and name in peers)]
    rounds = max(1, round(args.minutes / args.turn))
    print(f"some {1.2 * args.minutes * len(names):.0f} minutes", file=sys.stderr, flush=True)
    with ExitStack() as stack:
        judge = Judge(args.episodes, args.cut, rounds)
        contestants = {
            name: stack.enter_context(Contestant(functools.partial(PROGRAMS[name], judge))) for name in names
        }
        calls = {name: functools.partial(turn_of, name, one, 60 * args.turn) for name, one in contestants.items()}
        turns = take_turns(calls, rounds)
    print_table(
        f"mean of {args.episodes} games after hours of training; * cut after {args.cut:,} steps",
        ("", *(f"{number * args.turn / 60:.2f} h" for number in range(1, rounds + 1))),
        [
            (name, *(f"{turn.score:,.0f}{'*' * (turn is not each[-1])}" for turn in each))
            for name, each in turns.items()
        ],
    )
    results: dict[str, Any] = {"hours": {}, "curves": turns}
    for goal in GOALS:
        hours = {name: hours_to(goal, each) for name, each in turns.items()}
        results["hours"][goal] = {name: None if math.isinf(value) else value for name, value in hours.items()}
        told = ", ".join(f"{name} {'not' if math.isinf(value) else f'{value:.2f} h'}" for name, value in hours.items())
        print(f"to {goal:,}: {told}")
        if found := sooner(goal, turns):
            times, at_least = found
            print(f"  ours {'at least ' if at_least else ''}{times:.1f} times sooner than the best of the others")
            results[f"sooner_{goal}"] = times
    print_results(results)


if __name__ == "__main__":
    run(main)
