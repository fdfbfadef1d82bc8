"""Measure the gain of training seeds at the same time: `python -m benchmarks.side_by_side`.

One training on all cores takes turns with several at a time, as many and with as many cores each as `decide` and sweeps
choose here. Evaluations are left out. Seeds an hour are proportional to steps a second, summed over the trainings.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial

from atlantis_exp.machine import here
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.launchers.joblib import fitting
from benchmarks.composition import composed
from benchmarks.contest import (
    Contestant,
    Measure,
    paired_ratio,
    parser_of,
    print_rates,
    print_results,
    run,
    take_turns,
    together,
)
from benchmarks.training import learning, steps_per_second

_WORK = (  # experiment=fast in mid-training
    *("experiment=fast", "training.learn_start=1_000", "epsilon=constant", "epsilon.value=0.05"),
    *("evaluation.every_steps=null", "evaluation.at_end=false"),
)


@contextmanager
def training(cores: int, overrides: Sequence[str]) -> Iterator[Measure[float]]:
    """A training on some cores."""
    with learning(composed(*_WORK, f"threads={cores}", f"env.workers={cores}", *overrides)) as trainer:
        yield partial(steps_per_second, trainer)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("side_by_side", __doc__, rounds=3, seconds=20.0)
    parser.add_argument("--seeds", type=int, default=10, help="trainings there are to do")
    parser.add_argument("overrides", nargs="*", help="of the training, as model=resnet")
    args = parser.parse_args(arguments)
    settings = fitting([Job(composed(*_WORK, *args.overrides))], args.seeds).settings
    at_once, cores = settings.get("n_jobs", 1), settings.get("cores", here().cores)
    with ExitStack() as stack:

        def turn(count: int, each: int) -> Callable[[], float]:
            program = partial(training, each, args.overrides)
            contestants = [stack.enter_context(Contestant(program)) for _ in range(count)]
            return partial(together, contestants, args.seconds)

        names = "one after the other", f"{at_once} at a time"
        rates = take_turns(dict(zip(names, (turn(1, here().cores), turn(at_once, cores)), strict=True)), args.rounds)
    print_rates(f"all trainings, {at_once} at a time on {cores} cores each", "steps/s", rates)
    gain = paired_ratio(rates[names[1]], rates[names[0]])
    print_results({"at_once": at_once, "cores_each": cores, "seeds_an_hour": gain})


if __name__ == "__main__":
    run(main)
