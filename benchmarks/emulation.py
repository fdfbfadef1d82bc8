"""Compare emulation speed with the peers and with bare emulators: `python -m benchmarks.emulation`.

All play Atlantis with random actions at skip 4 and sticky 0.25, `--num-envs` environments in lock-step, and return
84x84 grey observations without a stack. `vs_` figures are for the report's preprocessing, a crop of the last frame,
which no peer supports; `_whole_screen` figures are for the peers' own, the whole screen with each pixel's maximum over
a step's last two frames. The peers have one thread a core, or two: the better one counts. Bare emulators, one process a
core, emulate frames without reading them. Each contestant has its own process and rests during the others' turns.
"""

import functools
import statistics
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import Any

import numpy as np
from ale_py import ALEInterface
from ale_py.roms import get_rom_path

from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.vector import make_emulators
from atlantis_exp.machine import here
from benchmarks.contest import (
    Contestant,
    Measure,
    calls_per_second,
    medians,
    missing,
    parser_of,
    print_rates,
    print_results,
    ratio,
    run,
    take_turns,
    together,
)

Program = Callable[[], AbstractContextManager[Measure[float]]]


@contextmanager
def ours(num_envs: int, make: Callable[[], Emulator]) -> Iterator[Measure[float]]:
    """Our emulators, several of them in worker processes."""
    rng = np.random.default_rng(0)
    with make_emulators(make, num_envs, here().cores) as emulators:
        emulators.reset(range(num_envs), list(range(num_envs)))

        def step() -> None:
            steps = emulators.step(rng.integers(4, size=num_envs))
            ended = np.flatnonzero(steps.terminated | steps.truncated)
            if len(ended):
                emulators.reset(ended)

        step()
        yield lambda seconds: num_envs * calls_per_second(step, seconds)


@contextmanager
def atari_vector(num_envs: int, threads: int) -> Iterator[Measure[float]]:
    """ale-py's own vector environment."""
    from ale_py.vector_env import AtariVectorEnv

    env = AtariVectorEnv(
        "atlantis",
        num_envs,
        num_threads=threads,
        repeat_action_probability=0.25,
        stack_num=1,
        noop_max=0,
        reward_clipping=False,
        use_fire_reset=False,
    )
    yield _play(env, num_envs, np.int64)
    env.close()


@contextmanager
def envpool(num_envs: int, threads: int) -> Iterator[Measure[float]]:
    """EnvPool, synchronous."""
    from envpool import make

    env = make(
        "Atlantis-v5",
        env_type="gymnasium",
        num_envs=num_envs,
        num_threads=threads,
        repeat_action_probability=0.25,
        stack_num=1,
        noop_max=1,  # its minimum
        use_fire_reset=False,
    )
    yield _play(env, num_envs, np.int32)
    env.close()


@contextmanager
def bare() -> Iterator[Measure[float]]:
    """An emulator whose screens nobody reads."""
    ale = ALEInterface()
    ale.setFloat("repeat_action_probability", 0.25)
    ale.loadROM(get_rom_path("atlantis"))  # type: ignore[arg-type]
    actions = ale.getMinimalActionSet()
    rng = np.random.default_rng(0)

    def step() -> None:
        action = actions[rng.integers(4)]
        for _ in range(4):
            ale.act(action)
        if ale.game_over():
            ale.reset_game()

    yield functools.partial(calls_per_second, step)


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table and the JSON line."""
    parser = parser_of("emulation", __doc__, rounds=5, seconds=5.0)
    parser.add_argument("--num-envs", type=int, default=16)
    args = parser.parse_args(arguments)

    # Here, since no contestant needs torch.
    from atlantis_exp.build import make_emulator
    from benchmarks.composition import composed

    standard = make_emulator(composed("env=atlantis_standard").env)
    cropped_84 = make_emulator(composed("env=atlantis_v5", "model=cnn").env)
    cropped_159 = make_emulator(composed("env=atlantis_v5", "model=resnet").env)
    programs: dict[str, Program] = {
        "ours": functools.partial(ours, args.num_envs, standard),
        "ours, one environment in this process": functools.partial(ours, 1, standard),
        "ours, report's crop, 84x84": functools.partial(ours, args.num_envs, cropped_84),
        "ours, report's crop, 159x159": functools.partial(ours, args.num_envs, cropped_159),
    }
    for threads in (here().cores, 2 * here().cores):
        programs[f"AtariVectorEnv, {threads} threads"] = functools.partial(atari_vector, args.num_envs, threads)
    if not missing("envpool"):
        for threads in (here().cores, 2 * here().cores):
            programs[f"EnvPool, {threads} threads"] = functools.partial(envpool, args.num_envs, threads)

    with ExitStack() as stack:
        turns: dict[str, Callable[[], float]] = {}
        for name, program in programs.items():
            turns[name] = functools.partial(stack.enter_context(Contestant(program)).measure, args.seconds)
        emulators = [stack.enter_context(Contestant(bare)) for _ in range(here().cores)]
        turns[f"bare emulators, {here().cores} processes"] = functools.partial(together, emulators, args.seconds)
        rates = take_turns(turns, args.rounds)

    print_rates(f"steps a second, {args.num_envs} environments, {here().cores} cores", "steps/s", rates)

    def best(name: str) -> list[float] | None:
        return max((rates[key] for key in rates if key.startswith(name)), key=statistics.median, default=None)

    results: dict[str, Any] = {"steps_per_second": medians(rates)}
    for suffix, name in (("", "ours, report's crop, 84x84"), ("_whole_screen", "ours")):
        results[f"vs_atari_vector{suffix}"] = ratio(rates[name], best("AtariVectorEnv"))
        results[f"vs_envpool{suffix}"] = ratio(rates[name], best("EnvPool"))
        results[f"vs_raw{suffix}"] = ratio(rates[name], best("bare"))
    print_results(results)


def _play(env: Any, num_envs: int, dtype: type[np.signedinteger[Any]]) -> Measure[float]:
    rng = np.random.default_rng(0)
    env.reset()

    def step() -> None:
        env.step(rng.integers(4, size=num_envs, dtype=dtype))

    return lambda seconds: num_envs * calls_per_second(step, seconds)


if __name__ == "__main__":
    run(main)
