"""Compare evaluation with its parts, and time a film: `python -m benchmarks.evaluation`.

A shipped network plays many games at once, as with `evaluate weights=...`. Its steps a second are compared with those
of bare emulators, an independent process a core, and with the states a second of the network's pass over such a batch.
`of_limit` is the time of a step's emulation plus pass, as a share of the step's actual time. The parts take turns in
their own processes. `film_seconds` is the processor time of a film of a whole game from its seed, actions and values.
"""

import functools
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

from atlantis_exp.build import build_evaluator, make_emulator
from atlantis_exp.game.vector import SerialEmulators
from atlantis_exp.machine import here
from atlantis_exp.sessions.cards import build_exported_actor, read_card
from atlantis_exp.training.actor import Actor
from atlantis_exp.training.evaluation import Stopped
from atlantis_exp.training.evaluator import Evaluator
from atlantis_exp.training.film import film_episode
from atlantis_exp.training.progress import Progress
from benchmarks.contest import (
    Contestant,
    Measure,
    calls_per_second,
    parser_of,
    print_rates,
    print_results,
    run,
    take_turns,
    together,
)

Program = Callable[[str, int], AbstractContextManager[Measure[float]]]  # of a folder of weights and a number of games

_WARM_STEPS = 40  # of half the games
_QUIET = Progress(Console(quiet=True))


def player(folder: str, num_envs: int, max_steps: int | None = None) -> tuple[Actor, Evaluator]:
    """Return a shipped network and its card's protocol, with a number of games at once."""
    card, weights = read_card(Path(folder))
    env = card.config.env if max_steps is None else replace(card.config.env, max_steps=max_steps)
    evaluation = replace(card.evaluation, num_envs=num_envs, video="all")
    return build_exported_actor(card.config, weights, "cpu"), build_evaluator(env, evaluation, here().cores)


@contextmanager
def evaluating(folder: str, num_envs: int) -> Iterator[Measure[float]]:
    """Games as `evaluate` plays them, restarted in each turn."""
    actor, evaluator = player(folder, num_envs)

    def measure(seconds: float) -> float:
        marks: list[float] = []

        def stop() -> bool:
            marks.append(time.perf_counter())
            return len(marks) > _WARM_STEPS and marks[-1] - marks[_WARM_STEPS] >= seconds

        with suppress(Stopped):
            evaluator(actor, num_envs, _QUIET, stop)
        steps = num_envs / min(2, num_envs) * (len(marks) - 1 - _WARM_STEPS)
        return steps / (marks[-1] - marks[_WARM_STEPS])

    yield measure


@contextmanager
def emulating(folder: str, num_envs: int) -> Iterator[Measure[float]]:
    """One core's share of the games, in this process, with random actions."""
    cv2.setNumThreads(1)
    card, _ = read_card(Path(folder))
    emulators, rng = SerialEmulators(make_emulator(card.config.env), num_envs), np.random.default_rng(0)
    emulators.reset(range(num_envs), list(range(num_envs)))

    def step() -> None:
        steps = emulators.step(rng.integers(len(emulators.game.actions), size=num_envs))
        if len(ended := np.flatnonzero(steps.terminated | steps.truncated)):
            emulators.reset(ended)

    yield lambda seconds: num_envs * calls_per_second(step, seconds)


@contextmanager
def passing(folder: str, num_envs: int) -> Iterator[Measure[float]]:
    """The network's pass over a batch."""
    card, weights = read_card(Path(folder))
    actor, env = build_exported_actor(card.config, weights, "cpu"), card.config.env
    states = np.random.default_rng(0).integers(256, size=(num_envs, *env.state_shape), dtype=np.uint8)
    call = functools.partial(actor.q_values, states)  # type: ignore[attr-defined]
    yield lambda seconds: num_envs * calls_per_second(call, seconds)


def film_seconds(folder: str, steps: int) -> tuple[float, int]:
    """Return the processor time of a film of one game, without playing it, and the film's bytes."""
    actor, evaluator = player(folder, 1, steps)
    (episode,) = evaluator(actor, 1, Progress()).episodes
    before = os.times()
    video = film_episode(episode, evaluator.make_emulator(), "all")
    after = os.times()
    return sum(after[:4]) - sum(before[:4]), len(video)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("evaluation", __doc__, rounds=5, seconds=5.0)
    parser.add_argument("--weights", default="pretrained/cnn_fast", help="a folder of exported weights")
    parser.add_argument("--num-envs", type=int, default=50, help="games at once")
    parser.add_argument("--film-steps", type=int, default=27_000, help="of the filmed game")
    args = parser.parse_args(arguments)
    minutes = (
        args.rounds * (3.5 * args.seconds + 0.15 * args.num_envs) + 0.3 * args.num_envs + args.film_steps / 300
    ) / 60
    print(f"about {minutes:.0f} minutes", file=sys.stderr, flush=True)
    with ExitStack() as stack:

        def contestant(program: Program, games: int) -> Contestant[float]:
            return stack.enter_context(Contestant(functools.partial(program, args.weights, games)))

        whole, batch = contestant(evaluating, args.num_envs), contestant(passing, args.num_envs)
        cores = [contestant(emulating, -(-args.num_envs // here().cores)) for _ in range(here().cores)]
        turns = {
            "evaluation": functools.partial(whole.measure, args.seconds),
            "emulators alone": functools.partial(together, cores, args.seconds),
            "network alone": functools.partial(batch.measure, args.seconds),
        }
        rates = take_turns(turns, args.rounds)
    print_rates(f"{args.num_envs} games at once", "steps/s", rates)
    of_limit = statistics.median(
        evaluated * (1 / emulated + 1 / passed) for evaluated, emulated, passed in zip(*rates.values(), strict=True)
    )
    seconds, size = film_seconds(args.weights, args.film_steps)
    print(
        f"film of a game of at most {args.film_steps:,} steps: {seconds:.1f} s of processor time, {size / 1e6:.1f} MB"
    )
    print_results({"of_limit": of_limit, "film_seconds": seconds, "num_envs": args.num_envs})


if __name__ == "__main__":
    run(main)
