"""Measure the start-up time of commands: `python -m benchmarks.startup`.

It is the processor time of each command with all its processes, as a share of `python -c "import torch"`: help, a
printed config, a misspelt key, `report` and `compare` of twelve runs, and `evaluate` up to the first step of a game.
The commands take turns; shares are medians over rounds. Install all extras first, since Hydra searches for plugins.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from functools import partial

from atlantis_exp.commands import CHECKOUT
from benchmarks.contest import paired_ratio, parser_of, print_results, print_table, run, take_turns

TARGETS = {"help": 0.25, "cfg": 0.25, "bad_input": 0.25, "report": 0.6, "evaluate": 1.5, "compare": 2.0}

_RUNS = (  # twelve trainings of a second each
    *("-m", "model=cnn,resnet", "seed=0,1,2,3,4,5", "experiment=quick", "device=cpu", "threads=1"),
    *("budget.forecast=off", "tracking=none", "env.size=40", "env.max_steps=40", "phase.quick.steps=160"),
    *("replay.capacity=120", "training.learn_start=20", "training.batch_size=4", "evaluation.episodes=5"),
    *("evaluation.num_envs=1", "evaluation.video=false"),
)
_CODES = {"modl=cnn": 2}  # expected exit codes other than 0
_UP_TO_A_STEP = """
import sys
from atlantis_exp import commands
from atlantis_exp.game.vector import Emulators

def reached(*_):
    raise SystemExit(3)

Emulators.send = reached
commands.main()
"""


def main(arguments: Sequence[str] | None = None) -> None:
    """Start, measure and print."""
    parser = parser_of("startup", __doc__, rounds=5)
    options = parser.parse_args(arguments)
    print(f"twelve small runs: a minute; {options.rounds} rounds: half a minute each", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory() as folder:
        place = f"paths.outputs={folder}"
        verb = ("-m", "atlantis_exp")
        _seconds(*verb, *_RUNS, place)
        turns = {
            "torch": ("-c", "import torch"),
            "help": (*verb, "--help"),
            "cfg": (*verb, "--cfg", "job"),
            "bad_input": (*verb, "modl=cnn"),
            "report": (*verb, "report", place),
            "compare": (*verb, "compare", "by=model", "tracking=none", place),
            "evaluate": ("-c", _UP_TO_A_STEP, "evaluate", "weights=pretrained/cnn_fast", "tracking=none", place),
        }
        took = take_turns({name: partial(_seconds, *words) for name, words in turns.items()}, options.rounds)
    shares = {name: paired_ratio(took[name], took["torch"]) for name in TARGETS}
    print_table(
        "processor time as a share of importing torch",
        ("command", "share", "target"),
        [(name, f"{shares[name]:.2f}", f"{target:.2f}") for name, target in TARGETS.items()],
    )
    print_results({**shares, "torch_seconds": sorted(took["torch"])[options.rounds // 2]})


def _seconds(*arguments: str) -> float:
    """Return the processor time of a Python process and its children. Raises: RuntimeError if it failed."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    before = os.times()
    done = subprocess.run([sys.executable, *arguments], cwd=CHECKOUT, env=environment, capture_output=True, check=False)
    after = os.times()
    if done.returncode != _CODES.get(arguments[-1], 3 if _UP_TO_A_STEP in arguments else 0):
        raise RuntimeError(f"{' '.join(arguments)} ended with {done.returncode}: {done.stderr.decode()[-500:]}")
    return after.children_user + after.children_system - before.children_user - before.children_system


if __name__ == "__main__":
    run(main)
