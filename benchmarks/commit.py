"""Time commits with a full memory of a million observations, and loading one: `python -m benchmarks.commit`."""

import json
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from atlantis_exp import terminal
from atlantis_exp.components import facts_of, game_of
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.networks.resnet import ResNetDQN
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.training.checkpoint import Checkpoints

CAPACITY = 1_000_000  # observations
SIZE = 159  # pixels
EVERY_SECONDS = 120.0
EVERY_STEPS = 20_000  # of a fast training in that time
COMMITS = 8
BUDGET = 2**30  # bytes


def main() -> None:
    """Fill a memory with random play, commit it as a training would, load it, and print the figures."""
    emulator = Emulator(
        game=facts_of(game_of("Atlantis-v0")),
        preprocessing=Preprocessing(SIZE, (16, 160, 96, 0)),
        frameskip=(2, 5),
        sticky=0.25,
        max_frames=108_000,
        max_steps=None,
        noop_max=0,
        max_pool=False,
    )
    rng = np.random.default_rng(0)
    observations = [emulator.reset(0)] + [emulator.step(int(rng.integers(4))).observation for _ in range(5_000)]
    memory = ReplayMemory(CAPACITY, (SIZE, SIZE), budget_bytes=BUDGET)
    memory.begin(0, observations[0])

    def play(steps: int) -> None:
        for _ in range(steps):
            memory.add(0, 1, 0.0, observations[memory.next_id % len(observations)], False)

    with terminal.working("filling the memory", lambda: f"{memory.next_id:,} of {CAPACITY:,} transitions"):
        play(CAPACITY)
    network = ResNetDQN((4, SIZE, SIZE), 4)
    # Network, target, and the two moments of the optimizer.
    parts = ("network", "target", "first", "second")
    state = {part: {name: tensor.clone() for name, tensor in network.state_dict().items()} for part in parts}
    folder = Path(tempfile.mkdtemp(prefix="commit-", dir="."))
    try:
        checkpoints = Checkpoints(folder, "benchmark")
        seconds = []
        for commit in range(COMMITS + 1):
            start = time.perf_counter()
            checkpoints.save(state, memory)
            seconds.append(time.perf_counter() - start)
            print(f"commit {commit}: {1000 * seconds[-1]:6.0f} ms{'  (the first writes everything)' * (commit == 0)}")
            play(EVERY_STEPS)
        size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
        start = time.perf_counter()
        Checkpoints(folder, "benchmark").load(ReplayMemory(CAPACITY, (SIZE, SIZE), budget_bytes=BUDGET))
        load = time.perf_counter() - start
    finally:
        shutil.rmtree(folder)
    commit_seconds = float(np.median(seconds[1:]))
    figures = {
        "commit_ms": round(1000 * commit_seconds, 1),
        "commit_ms_first": round(1000 * seconds[0], 1),
        "commit_ms_worst": round(1000 * max(seconds[1:]), 1),
        "commit_share": round(commit_seconds / EVERY_SECONDS, 5),
        "load_s": round(load, 2),
        "disk_mib": round(size / 2**20),
        "observations": len(memory),
        "threads": torch.get_num_threads(),
    }
    for name, value in figures.items():
        print(f"{name:18}{value}")
    print(json.dumps(figures))


if __name__ == "__main__":
    main()
