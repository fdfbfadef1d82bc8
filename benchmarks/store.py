"""`python -m benchmarks.store`: what the commands over many long runs cost: compare, a sweep's table, report, sync."""

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from atlantis_exp.commands.app import check
from atlantis_exp.commands.compare import compare
from atlantis_exp.commands.report import report
from atlantis_exp.commands.runs import Result, RunFolder
from atlantis_exp.commands.sweeps import ledger
from atlantis_exp.commands.sync import sync
from atlantis_exp.config import CompareConfig, Config, ReportConfig, SyncConfig, to_dict
from atlantis_exp.tracking.journal import Commit, commit_bytes, read_commit, write_file
from atlantis_exp.tracking.store import Cursor, Store, small_files, standing
from atlantis_exp.training.evaluation import Episode, Evaluation

STEPS_PER_EPISODE = 1_600  # of random play; every 1,000 steps a journal has a line of 17 metrics
MODELS = ("cnn", "resnet")


def write_runs(outputs: Path, runs: int, episodes: int, distinct: int) -> list[Config]:
    """Write the folders of finished trainings, with `distinct` journals among them that the others share by links."""
    configs = []
    journals: list[Path] = []
    bases = [check("config", Config, [f"model={model}", f"paths.outputs={outputs}"])[0] for model in MODELS]
    for number in range(runs):
        rng = np.random.default_rng(number)
        config = dataclasses.replace(bases[number % len(bases)], seed=number // len(bases))
        configs.append(config)
        folder = RunFolder(outputs / "runs" / config.run_name())
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
            Episode(index, score, 800, False, bytearray([0, 1, 2, 3] * 200), bytearray([0, 0, 0, 1] * 200))
            for index, score in enumerate(100.0 * rng.integers(50, 500, size=100))
        ]
        evaluation = Evaluation(config.evaluation.epsilon, played)
        table = folder.path / f"artifacts/evaluation/{steps:09d}.csv"
        table.parent.mkdir(parents=True)
        table.write_text(evaluation.table())
        counts = {"episodes": episodes, "frames": 3.0 * steps, "updates": steps / 16, "hours": 20.0}
        folder.write_result(Result("finished", steps, counts, evaluation.metrics(), evaluation.report()))
    return configs


def write_journal(path: Path, episodes: int, rng: np.random.Generator) -> None:
    """Write a journal with the lines that a training writes."""
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


_MEANS = {"mean_20": 20, "mean_100": 100, "best_100": 100}


def publish_nothing(outputs: Path) -> None:
    """Note in every run's folder that the local store has it."""
    address = Store(outputs).address
    for path in outputs.glob("runs/*/commit.json"):
        folder = path.parent
        if (commit := read_commit(folder)) is not None:
            state = standing(small_files(folder, commit, is_server=False))
            note = Cursor(address, commit.identity, "0" * 32, commit.offset, state)
            write_file(folder / "published.json", json.dumps(dataclasses.asdict(note)).encode())


def measure(command: Callable[[], None]) -> tuple[float, float]:
    """Seconds and peak resident MiB of a command in a process of its own, which is forked after the imports."""
    start = time.perf_counter()
    child = os.fork()
    if child == 0:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), 1)
        status = 1
        try:
            command()
            status = 0
        finally:
            os._exit(status)
    _, status, usage = os.wait4(child, 0)
    if status:
        raise SystemExit("the command failed")
    return time.perf_counter() - start, usage.ru_maxrss / 1024


def main(arguments: Sequence[str] = ()) -> None:
    """Write the runs, measure the commands and print a table and one line of JSON."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.store", description=__doc__)
    parser.add_argument("--runs", type=int, default=1_000)
    parser.add_argument("--episodes", type=int, default=20_000)
    parser.add_argument("--distinct", type=int, default=20, help="journals; the other runs link to them")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="store-", dir=".") as place:
        outputs = Path(place).resolve()
        configs = write_runs(outputs, options.runs, options.episodes, options.distinct)
        size = (outputs / "runs" / configs[0].run_name() / "journal.jsonl").stat().st_size
        of = f"paths.outputs={outputs}"

        def table() -> None:
            with ledger(configs, ["seed=0,1"]):
                pass

        commands: dict[str, Callable[[], None]] = {
            "compare": lambda: compare(check("compare", CompareConfig, [of, "tracking=none"])[0]),
            "sweep": table,
            "report": lambda: report(check("report", ReportConfig, [of])[0]),
            "sync": lambda: sync(check("sync", SyncConfig, [of])[0]),
        }
        measure(table)  # which gives the runs their parent
        publish_nothing(outputs)
        results = {name: measure(command) for name, command in commands.items()}
    print(f"{options.runs:,} runs of {options.episodes:,} episodes, journals of {size / 2**20:.1f} MiB\n")
    print(f"{'command':12}{'seconds':>10}{'peak MiB':>10}")
    for name, (seconds, peak) in results.items():
        print(f"{name:12}{seconds:>10.1f}{peak:>10.0f}")
    figures = {f"{name}_s": round(seconds, 2) for name, (seconds, _) in results.items()}
    peaks = {f"{name}_mib": round(peak) for name, (_, peak) in results.items()}
    print(json.dumps({"runs": options.runs, "episodes": options.episodes, "journal_bytes": size, **figures, **peaks}))


if __name__ == "__main__":
    main(sys.argv[1:])
