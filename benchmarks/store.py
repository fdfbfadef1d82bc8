"""Measure commands over many long runs: compare, a sweep's table, report, sync: `python -m benchmarks.store`."""

import dataclasses
import json
import os
import shutil
import tempfile
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from atlantis_exp import terminal
from atlantis_exp.checking import to_dict
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.commands.compare import VERB as COMPARE
from atlantis_exp.commands.overrides import check
from atlantis_exp.commands.report import VERB as REPORT
from atlantis_exp.commands.sync import VERB as SYNC
from atlantis_exp.components import facts_of
from atlantis_exp.runs.folder import Result, RunFolder, evaluation_at
from atlantis_exp.runs.journal import Commit, commit_bytes, read_commit
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.sweep import ledger
from atlantis_exp.tracking.mirror import PRIMARY, Cursor, digest
from atlantis_exp.tracking.store import Store
from atlantis_exp.training.evaluation import Episode, Evaluation
from benchmarks.composition import composed
from benchmarks.contest import parser_of, run

STEPS_PER_EPISODE = 1_600  # of random play; every 1,000 steps a journal has a line of 17 metrics
MODELS = ("cnn", "resnet")


def write_runs(outputs: Path, runs: int, episodes: int, distinct: int) -> list[Job]:
    """Write folders of finished trainings, with `distinct` journals, to which the others link."""
    jobs = []
    journals: list[Path] = []
    bases = [composed(f"model={model}", f"paths.outputs={outputs}") for model in MODELS]
    for number in range(runs):
        rng = np.random.default_rng(number)
        config = dataclasses.replace(bases[number % len(bases)], seed=number // len(bases))
        jobs.append(Job(config))
        folder = RunFolder.of(config)
        folder.write_config(to_dict(config))
        journal = folder.path / "journal.jsonl"
        if number < distinct:
            write_journal(journal, episodes, rng)
            journals.append(journal)
        else:
            os.link(journals[number % distinct], journal)
        commit = Commit(f"{number:032x}", 1, 2, journal.stat().st_size, "FINISHED")
        (folder.path / "commit.json").write_bytes(commit_bytes(commit))
        steps = episodes * STEPS_PER_EPISODE
        played = [
            Episode(
                index,
                score,
                800,
                False,
                bytearray([0, 1, 2, 3] * 200),
                bytearray([0, 0, 0, 1] * 200),
                points=[score, *[0.0] * 4],
            )
            for index, score in enumerate(100.0 * rng.integers(50, 500, size=100))
        ]
        evaluation = Evaluation(config.evaluation.epsilon, played, facts_of(config.game))
        table = folder.artifact(evaluation_at(steps))
        table.parent.mkdir(parents=True)
        table.write_text(evaluation.table().to_csv())
        counts = {"episodes": episodes, "frames": 3.0 * steps, "updates": steps / 16, "hours": 20.0}
        folder.write_result(Result("finished", steps, counts, evaluation.metrics(), evaluation.report()))
    return jobs


def write_journal(path: Path, episodes: int, rng: np.random.Generator) -> None:
    """Write a journal like a training's."""
    scores = 100.0 * rng.integers(20, 300, size=episodes) * np.linspace(0.5, 2.0, episodes)
    with open(path, "w") as file:

        def line(**fields: object) -> None:
            file.write(json.dumps(fields, separators=(",", ":")) + "\n")

        line(kind="tags", values={"flops_per_update": "8835301376"})
        ended = 0
        for step in range(1_000, episodes * STEPS_PER_EPISODE + 1, 1_000):
            now = 1_700_000_000_000 + 10 * step
            while (ended + 1) * STEPS_PER_EPISODE <= step:
                values = {"score/episode": scores[ended], "score/length": float(STEPS_PER_EPISODE)}
                line(kind="metrics", step=step, time=now, values=values)
                ended += 1
            if not ended:
                continue
            means = {f"score/{name}": scores[max(ended - last, 0) : ended].mean() for name, last in _MEANS.items()}
            measured = {
                "throughput/frames": 3.0 * step,
                "throughput/hours": step / 1.6e6,
                "learning/updates": step / 16,
                "actions/epsilon": max(0.01, 1 - step / 1e6),
                **{f"learning/more_{index}": float(value) for index, value in enumerate(rng.random(10))},
            }
            line(kind="metrics", step=step, time=now, values={**means, **measured})
        line(kind="artifact", path=evaluation_at(episodes * STEPS_PER_EPISODE))


_MEANS = {"mean_20": 20, "mean_100": 100, "best_100": 100}


def work_of(verb: Verb[Any], *overrides: str) -> Callable[[], object]:
    """Return the work of a verb's command line, without Hydra."""
    (config,) = check(verb.name, verb.schema, overrides).values()
    return verb.work(Asked(config, verb.name, overrides))


def publish_nothing(outputs: Path) -> None:
    """Mark every run's folder as published to the local store, in which its run has no points."""
    store = Store(outputs)
    for path in outputs.glob("runs/*/commit.json"):
        folder = path.parent
        if (commit := read_commit(folder)) is not None:
            run_id = store.open_run(folder, commit).info.run_id
            Cursor(store.address, commit.identity, run_id, commit.offset, digest(commit)).save(folder / PRIMARY)


def measure(command: Callable[[], object]) -> tuple[float, float, float]:
    """Return seconds, processor seconds and peak resident MiB of a command in a process forked after the imports."""
    start = time.perf_counter()
    child = os.fork()
    if child == 0:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        status = 1
        try:
            command()
            status = 0
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(status)
    _, status, usage = os.wait4(child, 0)
    if status:
        raise SystemExit("the command failed")
    return time.perf_counter() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def measure_publishing(runs: Path, outputs: Path) -> None:
    """Publish copies of run folders to a new store; print the cost as a table and one line of JSON."""

    def sync() -> None:
        work_of(SYNC, f"paths.outputs={outputs}")()

    Store(outputs / "another").runs()  # the imports
    measure(sync)  # the tables
    copies = [shutil.copytree(run, outputs / "runs" / run.name) for run in sorted(runs.iterdir())]
    seconds, processor, _ = measure(sync)
    print(f"sync of {len(copies)} runs: {seconds:.1f} s, {processor / len(copies):.3f} s of processor time a run")
    print(json.dumps({"runs": len(copies), "sync_s": round(seconds, 2), "processor_s": round(processor, 2)}))


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the runs, measure the commands and print a table and one line of JSON."""
    parser = parser_of("store", __doc__)
    parser.add_argument("--runs", type=int, default=1_000)
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--distinct", type=int, default=20, help="journals; the other runs link to them")
    parser.add_argument("--publish", type=Path, help="a folder of runs: measure only publishing copies of them")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="store-", dir=".") as place:
        outputs = Path(place).resolve()
        if options.publish:
            measure_publishing(options.publish, outputs)
            return
        with terminal.working("writing the runs"):
            jobs = write_runs(outputs, options.runs, options.episodes, options.distinct)
        size = (RunFolder.of(jobs[0].config).path / "journal.jsonl").stat().st_size
        of = f"paths.outputs={outputs}"

        def table() -> None:
            with ledger(jobs, ["seed=0,1"]):
                pass

        commands: dict[str, Callable[[], object]] = {
            "compare": lambda: work_of(COMPARE, of, "tracking=none")(),
            "sweep": table,
            "report": lambda: work_of(REPORT, of)(),
            "sync": lambda: work_of(SYNC, of)(),
        }
        measure(table)  # gives the runs their parent
        publish_nothing(outputs)
        results = {name: measure(command) for name, command in commands.items()}
    print(f"{options.runs:,} runs of {options.episodes:,} episodes, journals of {size / 2**20:.1f} MiB\n")
    print(f"{'command':12}{'seconds':>10}{'peak MiB':>10}")
    for name, (seconds, _, peak) in results.items():
        print(f"{name:12}{seconds:>10.1f}{peak:>10.0f}")
    figures = {f"{name}_s": round(seconds, 2) for name, (seconds, _, _) in results.items()}
    peaks = {f"{name}_mib": round(peak) for name, (_, _, peak) in results.items()}
    print(json.dumps({"runs": options.runs, "episodes": options.episodes, "journal_bytes": size, **figures, **peaks}))


if __name__ == "__main__":
    run(main)
