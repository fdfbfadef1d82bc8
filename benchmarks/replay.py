"""Measure size and sampling time of the replay memory under real play: `python -m benchmarks.replay`.

Each row records random play once and repeats it until the memory has `--transitions`, encoding every observation
again. Each row has its own process, whose resident growth includes all that the memory needs. Then sampling and the
update that it feeds take turns in one process. Stable-Baselines3's buffer is as large as its arrays, so a small one
tells the size of any.
"""

import functools
import itertools
import multiprocessing
import statistics
import time
from collections.abc import Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import psutil

from atlantis_exp import terminal
from atlantis_exp.build import build_learner, make_emulator
from atlantis_exp.config import EnvConfig
from atlantis_exp.replay.memory import ReplayMemory, Returns
from atlantis_exp.replay.samplers import UniformSampler
from atlantis_exp.sessions.processor import set_up_torch
from benchmarks.composition import composed
from benchmarks.contest import calls_per_second, missing, parser_of, print_results, print_table, run, take_turns

_SB3_TRANSITIONS = 5_000


class Case(NamedTuple):
    """A kind of observation, and the allowed cost of a memory of it."""

    name: str
    model: str
    env: str | None  # None: noise instead of play
    budget_bytes: int


CASES = (
    Case("84", "cnn", "atlantis_v0", 512 << 20),
    Case("159", "resnet", "atlantis_v0", 1 << 30),
    Case("84_whole_screen", "cnn", "atlantis_standard", 512 << 20),
    Case("84_noise", "cnn", None, 512 << 20),
)
BATCHES = {"cnn": 128, "resnet": 32}  # transitions
RETURNS = Returns(0.99)


class Arrival(NamedTuple):
    """An observation and the step that led to it; an episode's first has no action."""

    observation: npt.NDArray[np.uint8]
    action: int | None
    reward: float
    terminated: bool


def random_play(env: EnvConfig, steps: int) -> Iterator[Arrival]:
    """Yield `steps` steps of random play, each episode preceded by its first observation."""
    emulator = make_emulator(env)()
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
    """Repeat `arrivals` until the memory has `transitions` or is full."""
    for observation, action, reward, terminated in itertools.cycle(arrivals):
        if action is None:
            memory.begin(0, observation)
        else:
            memory.add(0, action, reward, observation, terminated)
        if len(memory) >= transitions or memory.oldest_id > 0:
            return


def measure(case: Case, steps: int, transitions: int) -> dict[str, float]:
    """Fill a memory and sample from it; sizes in bytes, times in seconds."""
    env = composed(f"model={case.model}", f"env={case.env or 'atlantis_v0'}").env
    arrivals = list(random_play(env, steps) if case.env else noise(env.size, steps))
    process = psutil.Process()
    resident_before = process.memory_info().rss
    # Room for the observations that end an episode, which begin no transition.
    memory = ReplayMemory(transitions + transitions // 100 + 5, (env.size, env.size), budget_bytes=case.budget_bytes)
    began = time.perf_counter()
    fill(memory, arrivals, transitions)
    add_s = (time.perf_counter() - began) / memory.next_id
    resident = process.memory_info().rss - resident_before

    rng = np.random.default_rng(1)
    sample_s = []
    for _ in range(200):
        began = time.perf_counter()
        memory.gather(UniformSampler().sample(memory, BATCHES[case.model], rng).ids, RETURNS)
        sample_s.append(time.perf_counter() - began)
    return {
        "transitions": len(memory),
        "resident": resident,
        "resident_per_transition": resident / len(memory),
        "account_per_transition": memory.nbytes / len(memory),
        "add_s": add_s,
        "sample_s": statistics.median(sample_s),
    }


def measure_share(model: str, steps: int, transitions: int, rounds: int, seconds: float) -> dict[str, list[float]]:
    """Return samples and updates a second, in turns; updates have a run's precision."""
    config = composed(f"model={model}")
    size = config.env.size
    memory = ReplayMemory(transitions + transitions // 100 + 5, (size, size), budget_bytes=config.replay.max_bytes)
    with terminal.working(f"filling the memory of {model}"):
        fill(memory, list(random_play(config.env, steps)), transitions)
    set_up_torch(config, config.device)
    learner = build_learner(config)
    rng = np.random.default_rng(1)
    batch = memory.gather(memory.draw(BATCHES[model], rng), RETURNS)
    learner.update(*batch)  # the first one allocates
    return take_turns(
        {
            "sample": functools.partial(
                calls_per_second, lambda: memory.gather(memory.draw(BATCHES[model], rng), RETURNS), seconds
            ),
            "update": functools.partial(calls_per_second, lambda: learner.update(*batch).cpu(), seconds),
        },
        rounds,
    )


def measure_sb3(size: int, batch_size: int, *, optimized: bool) -> tuple[float, float]:
    """Return bytes a transition of SB3's buffer and seconds a batch."""
    from gymnasium.spaces import Box, Discrete
    from stable_baselines3.common.buffers import ReplayBuffer

    buffer = ReplayBuffer(
        _SB3_TRANSITIONS,
        Box(0, 255, (4, size, size), np.uint8),
        Discrete(4),
        device="cpu",
        optimize_memory_usage=optimized,
        handle_timeout_termination=not optimized,  # the two exclude each other
    )
    allocated = sum(array.nbytes for array in vars(buffer).values() if isinstance(array, np.ndarray))
    state = np.ones((1, 4, size, size), np.uint8)
    for _ in range(_SB3_TRANSITIONS):
        buffer.add(state, state, np.zeros(1), np.zeros(1), np.zeros(1), [{}])
    sample_s = []
    for _ in range(50):
        began = time.perf_counter()
        buffer.sample(batch_size)
        sample_s.append(time.perf_counter() - began)
    return allocated / _SB3_TRANSITIONS, statistics.median(sample_s)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables and the JSON line."""
    parser = parser_of("replay", __doc__, rounds=7, seconds=1.0)
    names = [case.name for case in CASES]
    parser.add_argument("--cases", nargs="*", choices=names, default=names, help="rows of the first table")
    parser.add_argument("--steps", type=int, default=20_000, help="steps of play to record for each size")
    parser.add_argument("--transitions", type=int, default=1_000_000, help="transitions to fill the memory with")
    args = parser.parse_args(arguments)
    results: dict[str, Any] = {}
    rows: list[tuple[str, ...]] = []

    for case in (case for case in CASES if case.name in args.cases):
        filling = terminal.working(f"filling the memory of {case.name}")
        with filling, multiprocessing.get_context("spawn").Pool(1) as fresh_process:
            row = fresh_process.apply(measure, (case, args.steps, args.transitions))
        rows.append(
            (
                case.name,
                f"{row['transitions']:,}",
                f"{row['resident'] / 2**20:,.0f} MiB",
                f"{row['resident'] / case.budget_bytes:.0%}",
                f"{row['resident_per_transition']:,.0f} B",
                f"{row['account_per_transition']:,.0f} B",
                f"{row['add_s'] * 1e6:.1f} us",
                f"{BATCHES[case.model]}",
                f"{row['sample_s'] * 1e3:.2f} ms",
            )
        )
        results[f"bytes_per_transition_{case.name}"] = row["resident_per_transition"]
        results[f"transitions_{case.name}"] = row["transitions"]
        results[f"sample_seconds_{case.name}"] = row["sample_s"]
    columns = ("", "transitions", "resident", "of budget", "a transition", "account", "add", "batch", "sample")
    print_table(f"ours, {args.steps:,} steps of play repeated", columns, rows)

    rows = []
    for model, batch_size in BATCHES.items():
        rates = measure_share(model, args.steps, min(args.transitions, 100_000), args.rounds, args.seconds)
        shares = [update / sample for sample, update in zip(rates["sample"], rates["update"], strict=True)]
        results[f"sample_share_{model}"] = statistics.median(shares)
        rows.append(
            (
                model,
                f"{batch_size}",
                f"{1e3 / statistics.median(rates['sample']):.2f} ms",
                f"{1e3 / statistics.median(rates['update']):.1f} ms",
                f"{statistics.median(shares):.1%} ({min(shares):.1%}-{max(shares):.1%})",
            )
        )
    print_table("sampling against the update it feeds", ("", "batch", "sample", "update", "share"), rows)

    if not missing("stable_baselines3"):
        rows = []
        for (model, batch_size), optimized in itertools.product(BATCHES.items(), (True, False)):
            size = composed(f"model={model}").env.size
            allocated, sample_s = measure_sb3(size, batch_size, optimized=optimized)
            kind = "optimized" if optimized else "default"
            results[f"sb3_bytes_per_transition_{size}_{kind}"] = allocated
            results[f"sb3_sample_seconds_{size}_{kind}"] = sample_s
            rows.append(
                (
                    f"{size}, {kind}",
                    f"{allocated:,.0f} B",
                    f"{allocated * 1_000_000 / 2**30:,.1f} GiB",
                    f"{batch_size}",
                    f"{sample_s * 1e3:.2f} ms",
                )
            )
        print_table("Stable-Baselines3", ("", "a transition", "a million", "batch", "sample"), rows)
    print_results(results)


if __name__ == "__main__":
    run(main)
