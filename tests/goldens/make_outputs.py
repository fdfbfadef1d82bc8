"""Writes outputs.tar.xz next to this file: an outputs folder of an earlier version, for tests of later ones.

`python tests/goldens/make_outputs.py` was run with the package as of d3fe2fa, where `train` and `check` had other
places. Two trainings of DQNCnn that have ended, one of ResNetFast, a random player, and a training of DQNCnn that was
interrupted at step 180 with 40 updates behind it.

It is packed, and without what the tests have no use for, because weights hardly compress: of the ended trainings only
`cnn` with seed 0 keeps its last ones. The interrupted one has an optimizer of one moment and a target network that is a
copy, which the archive holds once.
"""

import shutil
import subprocess
import sys
import tarfile
from pathlib import Path

from atlantis_exp.commands.overrides import check
from atlantis_exp.config import Config
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.training import train

ARCHIVE = Path(__file__).with_name("outputs.tar.xz")
OUTPUTS = Path("/tmp/outputs")  # which the files name, at a length that the journals' offsets count on

SMALL = (  # as in test_goldens
    *("experiment=quick", "device=cpu", "threads=1", "budget.forecast=off"),
    *("tracking=none", "tracking.every_steps=20", "tracking.histogram_episodes=500"),
    *("env.size=40", "env.max_steps=120", "phase.quick.steps=360", "replay.capacity=120", "replay.max_bytes=4_194_304"),
    *("training.learn_start=20", "training.learn_every=4", "training.batch_size=4", "training.precision=fp32"),
    *("evaluation.num_envs=1", "evaluation.every_steps=180", "evaluation.video=false"),
    *("evaluation.episodes=3", "evaluation.epsilon=0.5"),  # chance scores where such a network does not
)
INTERRUPTED = (
    *("seed=2", "optimizer=rmsprop", "optimizer.centered=false", "objective.target.tau=1.0", "sampler=prioritized"),
    "evaluation.every_steps=null",
)


def finish(*words: str) -> None:
    """Run a command line to its end."""
    subprocess.run((sys.executable, "-m", "atlantis_exp", *words, f"paths.outputs={OUTPUTS}"), check=True)


def main() -> None:
    """Train, play, strip, pack."""
    # Networks so young all hold one action, with which they play the same games unless these are others.
    for number, words in enumerate(("seed=0", "seed=1", "model=resnet_fast")):
        finish(*SMALL, words, "evaluation.every_steps=null", f"evaluation.seed={number}")
    finish("baseline", "env.max_steps=120", "evaluation=quick", "evaluation.video=false", "tracking=none")
    ended = list(OUTPUTS.glob("runs/*"))
    (config,) = check("config", Config, [*SMALL, *INTERRUPTED, f"paths.outputs={OUTPUTS}"]).values()
    train(Job(config), lambda trainer: trainer.counters.steps >= 180)
    for run in ended:
        shutil.rmtree(run / "checkpoints", ignore_errors=True)
        (run / "artifacts" / "best.safetensors").unlink(missing_ok=True)
        if not run.name.startswith("cnn-uniform-s0"):
            shutil.rmtree(run / "artifacts" / "models", ignore_errors=True)
    for lock in OUTPUTS.glob("runs/*/lock"):
        lock.unlink()  # it names this machine
    with tarfile.open(ARCHIVE, "w:xz", preset=9) as archive:
        for path in sorted(OUTPUTS.rglob("*")):
            archive.add(path, path.relative_to(OUTPUTS), recursive=False, filter=anonymous)
    shutil.rmtree(OUTPUTS)


def anonymous(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    """Nobody's file."""
    entry.uid = entry.gid = 0
    entry.uname = entry.gname = ""
    return entry


if __name__ == "__main__":
    main()
