"""Forecast the time, memory and disk of a training from a few seconds of measurement."""

import copy
import math
import shutil
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import psutil

from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.trainer import Trainer

_WARM_MEMORY = 512 * 2**20  # bytes by which torch and its thread buffers will grow


@dataclass(frozen=True)
class Forecast:
    """The costs of a training, and the free memory and disk."""

    steps_per_second: float
    steps: int
    memory: int  # bytes by which the process will grow
    memory_available: int  # bytes
    disk: int  # bytes under the outputs folder
    disk_available: int  # bytes
    held: float = math.inf  # observations that the replay memory's bytes will hold
    learn_start: int = 0  # transitions
    updates_per_second: float = math.nan

    @property
    def hours(self) -> float:
        """Hours of training, without evaluations."""
        return self.steps / self.steps_per_second / 3600

    def __str__(self) -> str:
        return (
            f"expect about {self.steps_per_second:,.0f} steps/s, {duration(self.hours)} for {self.steps:,} steps, "
            f"{_size(self.memory)} of memory ({_size(self.memory_available)} available), "
            f"{_size(self.disk)} of disk ({_size(self.disk_available)} free)"
        )

    @property
    def shortage(self) -> str | None:
        """The resource that will not suffice and the remedy, or None."""
        if self.held <= self.learn_start:
            return (
                f"nothing would be learned: replay.max_bytes holds some {self.held:,.0f} observations, and learning "
                f"starts after {self.learn_start:,}; raise replay.max_bytes or lower training.learn_start"
            )
        if self.memory > self.memory_available:
            return (
                f"memory will not suffice: {_size(self.memory)} needed, {_size(self.memory_available)} available; "
                f"lower replay.max_bytes, replay.capacity or training.batch_size"
            )
        if self.disk > self.disk_available:
            return (
                f"disk will not suffice: {_size(self.disk)} needed, {_size(self.disk_available)} free; "
                f"lower replay.capacity, or set paths.outputs to a larger disk"
            )
        return None


def forecast(trainer: Trainer, *, capacity: int, max_bytes: int, done: Counters) -> Forecast:
    """Time emulation, acting and learning with a trainer's parts, and restore all but the emulators.

    Call it before their episodes begin or are loaded. capacity in observations, max_bytes of the replay memory.
    Assumes that future episodes are as long as past ones, or as the game's usual ones.
    """
    plan, learner, emulators = trainer.plan, trainer.learner, trainer.emulators
    num_envs, lags, size = emulators.num_envs, trainer.memory.lags, trainer.stack.state.shape[-1]
    rng = np.random.default_rng(0)
    available = psutil.virtual_memory().available  # before the updates, which keep theirs
    # The states of a batch as bytes and float32, and what the first layer makes of them.
    sequences = 12 * plan.batch_size * sum(plan.window) * len(lags) * size**2 if plan.window else 0
    share = min(1.0, available / 2 / sequences) if sequences else 1.0  # of a batch that is measured
    measured = max(1, int(share * plan.batch_size))
    memory = ReplayMemory(8_192, (size, size), lags=lags, budget_bytes=8_192 * size * size)
    for env, observation in enumerate(emulators.reset(range(num_envs), [0] * num_envs)):
        memory.begin(env, observation)
    sampler = copy.deepcopy(plan.phases[0].sampler)

    def play() -> None:
        plan.learning_rate(0.0, 0), plan.epsilon(0.0, 0)
        actions = rng.integers(len(emulators.game.actions), size=num_envs)
        steps = emulators.step(actions)
        for env in range(num_envs):
            memory.add(env, int(actions[env]), float(steps.rewards[env]), steps.observations[env], False)
        ended = np.flatnonzero(steps.terminated | steps.truncated).tolist()
        for env, observation in zip(ended, emulators.reset(ended) if ended else (), strict=True):
            memory.begin(env, observation)  # else a finished game would be measured

    def update() -> None:
        ids, weights = sampler.sample(memory, measured, rng)
        learner.update(*plan.gather(memory, ids), weights=weights).cpu()  # waits for a GPU

    with learner.restored():
        play_seconds = _median_seconds(play, at_least=8, seconds=1.0)
        states = np.zeros((num_envs, len(lags), size, size), np.uint8)
        act_seconds = _median_seconds(lambda: learner.q_values(states), at_least=3, seconds=0.5)
        update_seconds = _median_seconds(update, at_least=3, seconds=1.0) * plan.batch_size / measured
    emulators.reset(range(num_envs), [0] * num_envs)  # a fresh console

    usual = 1 if plan.unit == "steps" else emulators.game.episode_steps
    each = done.steps / plan.done(done) if plan.done(done) else usual
    length = done.steps + round((plan.length - plan.done(done)) * each)
    epsilon = statistics.fmean(plan.epsilon(progress, int(progress * length)) for progress in np.linspace(0, 1, 101))
    # The share of the iterations in which any environment asks the network.
    acts = 1.0 if plan.window else 1 - epsilon**num_envs
    seconds_a_step = (play_seconds + acts * act_seconds) / num_envs + update_seconds / plan.learn_every
    steps = max(1, (length if trainer.last_step is None else min(length, trainer.last_step)) - done.steps)
    an_observation = memory.nbytes / (memory.next_id - memory.oldest_id)  # bytes
    replay_bytes = int(min(max_bytes, min(capacity, done.steps + steps) * an_observation))
    loaded = trainer.memory.next_id - trainer.memory.oldest_id  # observations of a continued run
    more_bytes = max(0, replay_bytes - int(loaded * an_observation))
    weights = sum(tensor.nbytes for tensor in learner.network.state_dict().values())
    cadence = trainer.recorder.cadence
    evaluations = 1 + steps / (cadence.evaluate_steps or math.inf)
    evaluations += steps / emulators.game.episode_steps / (cadence.evaluate_episodes or math.inf)
    folder = next(path for path in (trainer.checkpoints.folder, *trainer.checkpoints.folder.parents) if path.exists())
    return Forecast(
        steps_per_second=1 / seconds_a_step,
        updates_per_second=1 / update_seconds,
        steps=steps,
        memory=more_bytes + _WARM_MEMORY + sequences,
        memory_available=available,
        # Two generations of all networks and two moments; each evaluation's weights, in the folder and in MLflow.
        disk=int(more_bytes + (10 if learner.ema else 8) * weights + 2 * evaluations * weights),
        disk_available=shutil.disk_usage(folder).free,
        held=max_bytes / an_observation,
        learn_start=plan.learn_start,
    )


def _median_seconds(call: Callable[[], object], at_least: int, seconds: float) -> float:
    call()
    taken: list[float] = []
    while len(taken) < at_least or sum(taken) < seconds:
        start = time.perf_counter()
        call()
        taken.append(time.perf_counter() - start)
    return statistics.median(taken)


def _size(count: float) -> str:
    return f"{count / 2**30:,.1f} GiB" if count >= 2**30 else f"{count / 2**20:,.0f} MiB"


def duration(hours: float) -> str:
    """Return a duration in words: hours, minutes or seconds."""
    if hours >= 1:
        return f"{hours:,.1f} hours"
    return f"{hours * 60:,.0f} minutes" if hours * 60 >= 2 else f"{hours * 3600:,.0f} seconds"
