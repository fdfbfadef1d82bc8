"""Measure the cost of tracking a training: `python -m benchmarks.overhead`.

Two trainings of 16 environments take turns, one with the journal and the thread that mirrors it in a new MLflow store,
one without. Both commit every `--commit-seconds`, far more often than by default, so the shares are upper bounds. The
speeds differ by less than the machine's noise. So the benchmark also times all calls of the tracker, with the files
they write, and the processor time of the mirroring thread. Once a turn it times the bookkeeping of an evaluation
(histogram, tables, weights, but not its games) and spreads it over the steps between two evaluations of the default
config.
"""

import functools
import statistics
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.runs.journal import Journal
from atlantis_exp.tracking.publishing import Publisher
from atlantis_exp.tracking.store import Store
from atlantis_exp.training.evaluation import Episode, Evaluation
from atlantis_exp.training.trainer import Trainer
from benchmarks.composition import composed
from benchmarks.contest import Contestant, Measure, paired_ratio, parser_of, print_results, print_table, run, take_turns
from benchmarks.training import batch_of, learning, steps_per_second, training_config

_NUM_ENVS = 16
_EPISODE_STEPS = 2_000  # of a random player; a good one plays many times longer


class Turn(NamedTuple):
    """A turn of a training: its speed, and its costs in seconds."""

    steps_per_second: float
    seconds: float
    tracker: float  # in calls of the tracker
    publisher: float  # processor time of the mirroring thread
    evaluation: float  # bookkeeping of one evaluation


class Untracked:
    """A tracker that forgets all records."""

    def __getattr__(self, name: str) -> Callable[..., dict[str, Any]]:
        return lambda *_, **__: {}


class Timed:
    """A tracker that adds up the time in its methods."""

    def __init__(self, tracker: Journal) -> None:
        self.tracker = tracker
        self.seconds = 0.0

    def __getattr__(self, name: str) -> Any:
        method = getattr(self.tracker, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            began = time.perf_counter()
            try:
                return method(*arguments, **options)
            finally:
                self.seconds += time.perf_counter() - began

        return timed


@contextmanager
def training(tracked: bool, commit_seconds: float) -> Iterator[Measure[Turn]]:
    """A training that measures its costs, with a run's tracker or without one."""
    size, every = batch_of(_NUM_ENVS)
    config = training_config(
        size,
        every,
        f"env.num_envs={_NUM_ENVS}",
        f"tracking.commit_seconds={commit_seconds}",
        "evaluation.at_end=true",
    )
    publishers = []

    def tracker_of(folder: Path) -> Journal:
        if not tracked:
            return cast(Journal, Untracked())
        journal = Journal(folder)
        publishers.append(Publisher(folder, Store(folder / "store", "overhead")))
        return journal

    with learning(config, tracker_of) as trainer:
        tracker = Timed(trainer.recorder.journal)
        trainer.recorder.journal = cast(Journal, tracker)
        trainer.recorder.play = lambda *_: _evaluation()
        clocks = [
            time.pthread_getcpuclockid(thread.ident)
            for thread in threading.enumerate()
            if thread.name == "publisher" and thread.ident is not None
        ]

        def measure(seconds: float) -> Turn:
            tracker.seconds, began = 0.0, time.perf_counter()
            published = sum(map(time.clock_gettime, clocks))
            speed = steps_per_second(trainer, seconds)
            return Turn(
                speed,
                time.perf_counter() - began,
                tracker.seconds,
                sum(map(time.clock_gettime, clocks)) - published,
                evaluation_seconds(trainer),
            )

        yield measure
        for publisher in publishers:
            publisher.drain(60.0)


def evaluation_seconds(trainer: Trainer) -> float:
    """Return the time of an evaluation's bookkeeping: a training's end with it, less one without."""
    trainer.max_steps = trainer.counters.steps
    marks = [time.perf_counter()]
    for _ in range(2):
        trainer.run()
        marks.append(time.perf_counter())
    trainer.max_steps = None
    return max(0.0, (marks[1] - marks[0]) - (marks[2] - marks[1]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("overhead", __doc__, rounds=5, seconds=30.0)
    parser.add_argument("--commit-seconds", type=float, default=10.0, help="time between two commits")
    args = parser.parse_args(arguments)

    with ExitStack() as stack:
        turns = {}
        for name in ("tracked", "untracked"):
            program = functools.partial(training, name == "tracked", args.commit_seconds)
            contestant = stack.enter_context(Contestant(program))
            turns[name] = functools.partial(contestant.measure, args.seconds)
        measured = take_turns(turns, args.rounds)

    tracked = measured["tracked"]
    speeds = {name: [turn.steps_per_second for turn in turns] for name, turns in measured.items()}
    relative_speed = paired_ratio(speeds["tracked"], speeds["untracked"])
    assert relative_speed is not None
    tracker = statistics.median(turn.tracker / turn.seconds for turn in tracked)
    publisher = statistics.median(turn.publisher / turn.seconds for turn in tracked)
    evaluation = statistics.median(turn.evaluation for turn in tracked)
    interval_steps = (composed().evaluation.every_episodes or 0) * _EPISODE_STEPS
    bookkeeping = evaluation * statistics.median(speeds["tracked"]) / interval_steps
    print_table(
        f"share of a training's time, a commit every {args.commit_seconds:g} s",
        ("", "share"),
        [
            ("calls of the tracker", f"{tracker:.3%}"),
            ("processor time of the mirroring thread", f"{publisher:.3%}"),
            (f"evaluations' bookkeeping ({evaluation:.2f} s each)", f"{bookkeeping:.3%}"),
            ("speed lost against no tracker", f"{1 - relative_speed:.1%}"),
        ],
    )
    print_results(
        {
            "tracking_share": tracker + publisher + bookkeeping,
            "tracker_share": tracker,
            "publisher_share": publisher,
            "evaluation_share": bookkeeping,
            "evaluation_seconds": evaluation,
            "speed_lost": 1 - relative_speed,
            "speed_lost_by_round": [1 - a / b for a, b in zip(speeds["tracked"], speeds["untracked"], strict=True)],
        }
    )


def _evaluation() -> Evaluation:
    """Return an evaluation of 100 episodes."""
    rng = np.random.default_rng()
    episodes = [
        Episode(
            index,
            float(rng.integers(300)) * 100,
            4 * _EPISODE_STEPS,
            actions=bytearray(rng.integers(4, size=_EPISODE_STEPS, dtype=np.uint8)),
            random=bytearray(rng.integers(2, size=_EPISODE_STEPS, dtype=np.uint8)),
            points=[0.0] * 5,
        )
        for index in range(100)
    ]
    return Evaluation(0.05, episodes, facts_of(game_of("Atlantis-v0")))


if __name__ == "__main__":
    run(main)
