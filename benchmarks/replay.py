"""Memory and sampling cost of the replay memory under real play: `python -m benchmarks.replay`.

Random play is recorded once per row and repeated until the memory holds `--transitions`; every observation is encoded
anew. Each row has a process of its own, whose resident growth counts everything the memory needs.
"""

import argparse
import itertools
import json
import multiprocessing
import time
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import psutil  # type: ignore[import-untyped]

from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.replay.samplers import UniformSampler

FLYING_AREA = (14, 160, 94, 0)  # UP, RIGHT, DOWN, LEFT
WHOLE_SCREEN = (0, 160, 210, 0)


class Case(NamedTuple):
    """A kind of observation and what the memory may cost with it."""

    name: str
    size: int
    crop: tuple[int, int, int, int] | None  # None: noise instead of play
    batch_size: int
    budget_bytes: int


CASES = (
    Case("84", 84, FLYING_AREA, 128, 512 << 20),
    Case("159", 159, FLYING_AREA, 32, 1 << 30),
    Case("84_whole_screen", 84, WHOLE_SCREEN, 128, 512 << 20),
    Case("159_whole_screen", 159, WHOLE_SCREEN, 32, 1 << 30),
    Case("84_noise", 84, None, 128, 512 << 20),
)


class Arrival(NamedTuple):
    """An observation and the step that led to it; no action: an episode's first."""

    observation: npt.NDArray[np.uint8]
    action: int | None
    reward: float
    terminated: bool


def random_play(size: int, crop: tuple[int, int, int, int], steps: int) -> Iterator[Arrival]:
    """Yield `steps` steps of the report's environment, each episode preceded by its first observation."""
    emulator = Emulator(
        preprocessing=Preprocessing(size=size, crop=crop),
        frameskip=(2, 5),
        sticky=0.25,
        max_frames=108_000,
        max_steps=27_000,
        noop_max=0,
        max_pool=False,
    )
    rng = np.random.default_rng(0)
    yield Arrival(emulator.reset(seed=0), None, 0.0, False)
    for _ in range(steps):
        action = int(rng.integers(4))
        step = emulator.step(action)
        yield Arrival(step.observation, action, step.reward, step.terminated)
        if step.terminated or step.truncated:
            yield Arrival(emulator.reset(), None, 0.0, False)


def noise(size: int, steps: int) -> Iterator[Arrival]:
    """Yield one episode of incompressible observations."""
    rng = np.random.default_rng(0)
    for step in range(steps):
        observation = rng.integers(0, 256, (size, size), np.uint8)
        yield Arrival(observation, 0 if step else None, 0.0, False)


def fill(memory: ReplayMemory, arrivals: Iterable[Arrival], transitions: int) -> None:
    """Repeat `arrivals` until the memory holds `transitions` or has no more room."""
    for observation, action, reward, terminated in itertools.cycle(arrivals):
        if action is None:
            memory.begin(0, observation)
        else:
            memory.add(0, action, reward, observation, terminated)
        if len(memory) == transitions or memory.oldest_id > 0:
            return


def measure(case: Case, steps: int, transitions: int) -> dict[str, float]:
    """Fill a memory and sample from it; sizes in bytes, times in seconds."""
    arrivals = list(random_play(case.size, case.crop, steps) if case.crop else noise(case.size, steps))
    process = psutil.Process()
    resident_before = process.memory_info().rss
    # Room for the observations that end an episode and are no transition's state.
    memory = ReplayMemory(transitions + transitions // 100, (case.size, case.size), budget_bytes=case.budget_bytes)
    began = time.perf_counter()
    fill(memory, arrivals, transitions)
    add_s = (time.perf_counter() - began) / memory.next_id
    resident = process.memory_info().rss - resident_before

    rng = np.random.default_rng(1)
    sample_s = []
    for _ in range(200):
        began = time.perf_counter()
        memory.gather(UniformSampler().sample(memory, case.batch_size, rng))
        sample_s.append(time.perf_counter() - began)
    return {
        "transitions": len(memory),
        "resident": resident,
        "resident_per_transition": resident / len(memory),
        "account_per_transition": memory.nbytes / len(memory),
        "add_s": add_s,
        "sample_s": float(np.median(sample_s)),
    }


def main() -> None:
    """Print the table and the JSON line."""
    parser = argparse.ArgumentParser(description="memory and sampling cost of the replay memory under real play")
    parser.add_argument("--steps", type=int, default=20_000, help="steps of play to record for each size")
    parser.add_argument("--transitions", type=int, default=1_000_000, help="transitions to fill the memory with")
    args = parser.parse_args()

    print(f"{args.steps:,} steps of random play recorded for each row, then repeated until the memory is full.")
    print(f"{'observation':18}{'transitions':>12}{'resident':>11}{'of budget':>10}{'per transition':>15}{'account':>9}"
          f"{'add':>9}{'batch':>7}{'sample':>9}")  # fmt: skip
    results: dict[str, float] = {}
    for case in CASES:
        with multiprocessing.get_context("spawn").Pool(1) as fresh_process:
            row = fresh_process.apply(measure, (case, args.steps, args.transitions))
        print(
            f"{case.name:18}{row['transitions']:12,}{row['resident'] / 2**20:7,.0f} MiB"
            f"{row['resident'] / case.budget_bytes:10.1%}{row['resident_per_transition']:13,.0f} B"
            f"{row['account_per_transition']:7,.0f} B{row['add_s'] * 1e6:6.1f} us"
            f"{case.batch_size:7}{row['sample_s'] * 1e3:6.2f} ms",
            flush=True,
        )
        results[f"bytes_per_transition_{case.name}"] = row["resident_per_transition"]
        results[f"transitions_{case.name}"] = row["transitions"]
        results[f"sample_seconds_{case.name}"] = row["sample_s"]
    print(json.dumps(results))


if __name__ == "__main__":
    main()
