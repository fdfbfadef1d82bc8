"""Trainings that are killed again and again, against unbroken ones: `python -m benchmarks.kills --kills 1000`.

Each of the trainings below is made once unbroken. Then its copies are killed by SIGKILL at random moments within a
second of a commit, until there have been as many kills as were asked for, and every copy is continued to its end. A
copy must have the fingerprint of the unbroken one: weights, replay memory, random streams, emulators, and all that its
journal holds. The last of them is a sweep of two seeds on joblib, which is killed with all its processes.
"""

import argparse
import itertools
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import Progress

from atlantis_exp.sessions.job import replaced
from atlantis_exp.sessions.verifying import fingerprints, run_and_kill, train_and_kill
from benchmarks.composition import composed
from benchmarks.contest import print_results, print_table

SMALL = (
    *(
        "experiment=quick",
        "device=cpu",
        "threads=1",
        "budget.forecast=off",
        "tracking=none",
        "tracking.every_steps=100",
    ),
    *("env.size=40", "env.max_steps=200", "phase.quick.steps=6_000", "replay.capacity=2_000"),
    *("training.learn_start=200", "training.batch_size=8", "training.precision=fp32"),
    *("evaluation.episodes=2", "evaluation.num_envs=2", "evaluation.every_steps=2_000", "evaluation.video=false"),
)
TRAININGS = {
    "cnn": ("model=cnn",),
    "resnet": ("model=resnet", "env.size=16", "env.num_envs=8", "env.workers=2"),
    "resnet_fast": ("model=resnet_fast", "env.num_envs=4", "env.workers=2", "objective=quantile", "training.ema=20"),
    "prioritized": ("sampler=prioritized", "env.num_envs=3", "env.workers=2"),
}
SWEEP = "sweep"
_KILLS_OF_ONE = 8  # copies of a training are given up no sooner, so that many commits have been continued from


def main(arguments: Sequence[str] | None = None) -> None:
    """Kill, compare, print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kills")
    parser.add_argument("--kills", type=int, default=1_000)
    parser.add_argument("--only", choices=[*TRAININGS, SWEEP], action="append")
    options = parser.parse_args(arguments)
    names = options.only or [*TRAININGS, SWEEP]
    differences: list[str] = []
    struck = dict.fromkeys(names, 0)
    with tempfile.TemporaryDirectory() as folder, Progress(console=Console(stderr=True)) as progress:
        bar = progress.add_task("kills", total=options.kills)
        unbroken = {name: _killed(name, Path(folder, name), 0)[1] for name in names}
        for copy, name in enumerate(itertools.cycle(names)):
            if (left := options.kills - sum(struck.values())) <= 0:
                break
            place = Path(folder, f"{name}-{copy}")
            kills, prints = _killed(name, place, min(left, _KILLS_OF_ONE))
            struck[name] += kills
            progress.console.print(f"copy {copy}: {name}, killed {kills} times", highlight=False)
            progress.advance(bar, kills)
            parts = sorted(part for part in prints if prints[part] != unbroken[name].get(part))
            differences += [f"{name}, copy {copy}: {part}" for part in parts]
            if not parts:
                shutil.rmtree(place)
    print_table("kills", ("training", "kills"), [(name, f"{kills:,}") for name, kills in struck.items()])
    for difference in differences:
        print(f"DIFFERENT {difference}")
    print_results({"kills": sum(struck.values()), "differences": differences})


def _killed(name: str, outputs: Path, kills: int) -> tuple[int, dict[str, str]]:
    """Train one of them to its end, with kills on the way; how many struck, and its fingerprints."""
    if name == SWEEP:
        configs = [composed(*replaced(SMALL, f"seed={seed}")) for seed in (0, 1)]
        struck = _sweep_and_kill(outputs, kills)
        prints = [fingerprints(config, outputs) for config in configs]
        return struck, {
            f"seed {seed}: {part}": value for seed, each in enumerate(prints) for part, value in each.items()
        }
    words = replaced(SMALL, *TRAININGS[name])
    config = composed(*words)
    return train_and_kill(config, words, outputs, kills), fingerprints(config, outputs)


def _sweep_and_kill(outputs: Path, kills: int) -> int:
    """Run the sweep under `outputs` to its end, with all its processes killed on the way; returns how many times."""
    own = ("seed=0,1", f"paths.outputs={outputs}", "tracking.commit_seconds=1.0")
    launcher = ("hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
    command = (sys.executable, "-m", "atlantis_exp", "train", "-m", *launcher, *replaced(SMALL, *own))
    return run_and_kill(command, outputs, lambda: _commits(outputs), kills, with_children=True)


def _commits(outputs: Path) -> int:
    """The generations of all runs' checkpoints so far."""
    newest: dict[Path, int] = {}
    for path in outputs.glob("runs/*/checkpoints/0*/manifest.json"):
        run, generation = path.parents[2], int(path.parent.name)
        newest[run] = max(newest.get(run, 0), generation)
    return sum(newest.values())


if __name__ == "__main__":
    main()
