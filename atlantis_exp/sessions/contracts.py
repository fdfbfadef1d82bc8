"""Does a component keep what the rest relies on? Each promise tried on it, then what it costs, and what ours do."""

import copy
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from rich.table import Table
from torch import nn

from atlantis_exp import terminal
from atlantis_exp.build import build_component, build_learner, build_trainer, import_components, make_emulator
from atlantis_exp.config import Config
from atlantis_exp.faults import Fault
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import DQN, Quantile
from atlantis_exp.networks.dropout import seed_dropout
from atlantis_exp.networks.heads import DuelingHead, Head, QuantileHead
from atlantis_exp.networks.sizes import count_parameters
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.job import Job
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.sessions.training import expected
from atlantis_exp.sessions.verifying import fingerprints, train_and_kill
from atlantis_exp.training.checkpoint import to_safetensors
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.progress import Progress

_SIDES = (84, 159)  # pixels
_ACTIONS = 4
_QUANTILES = 5
_HEADS: dict[str, Head] = {
    "plain": nn.Linear,
    "dueling": DuelingHead,
    "quantile": partial(QuantileHead, quantiles=_QUANTILES),
}
_SECONDS = 1.0  # of a measurement


def check(job: Job, small: Job, references: Sequence[Job]) -> None:
    """Try every contract on the components of a job and, where all are kept, measure its network and the references'.

    small: the same components in a training of seconds, which is killed and continued.

    Raises:
        Fault: where a contract is broken.
    """
    config = job.config
    import_components(config)
    table, broken = Table("component", "contract", "", "because"), []
    for part, contract, trial in trials(config, small):
        try:
            with terminal.working(f"{part}: {contract}"):
                trial()
            table.add_row(part, contract, "kept", "")
        except Exception as error:
            broken.append(f"{part}: {contract}")
            reason = next((line for line in str(error).splitlines() if line.strip()), "")
            kind = "" if isinstance(error, Fault) else f"{type(error).__name__}: "
            table.add_row(part, contract, "BROKEN", kind + reason)
    terminal.console(least=120).print(table)
    if broken:
        raise Fault(f"broken: {', '.join(broken)}")
    with terminal.working("measuring what the networks cost"):
        costs = _costs([job, *references])
    terminal.console(least=120).print(costs)


def trials(config: Config, small: Job) -> Iterator[tuple[str, str, Callable[[], None]]]:
    """Every contract of a config's components: of what, what, and the call that raises where it is broken."""
    network, objective = f"model={config.model.name}", f"objective={config.objective.name}"
    for side in _SIDES:
        for head in _HEADS:
            for precision in ("fp32", "bf16"):
                yield (
                    network,
                    f"learns: {head}, {side} pixels, {precision}",
                    partial(_learns, config, head, side, precision),
                )
    yield network, "the same seed, the same weights", partial(_same_weights, config)
    yield network, "weights there and back, on meta too", partial(_there_and_back, config)
    yield network, "draws from no global stream", partial(_network_draws_nothing, config)
    if config.model.component is not None and config.model.component.facts["splits_batches"]:
        yield network, "a batch in parts is the batch", partial(_splits, config)
    yield objective, "targets and losses a sample, finite", partial(_objective_is_whole, config)
    yield objective, "discount 0: rewards alone", partial(_objective_ends, config)
    for phase, described in config.phase.items():
        sampler = f"sampler={described.sampler}"
        yield sampler, "a batch of what there is", partial(_draws, config, phase)
        yield sampler, "state there and back", partial(_sampler_continues, config, phase)
    yield f"epsilon={config.epsilon.name}", "in [0, 1], before and past the end", partial(_epsilon_holds, config)
    yield f"lr_schedule={config.lr_schedule.name}", "finite, not negative", partial(_rate_holds, config)
    yield f"env.id={config.env.id}", "actions are ALE's, points sum to rewards", partial(_pays, config)
    yield "all", "killed and continued is unbroken, bit for bit", partial(_resumes, small)


def _hold(is_kept: object, otherwise: str) -> None:
    if not is_kept:
        raise Fault(otherwise)


def _made(config: Config, side: int, head: str = "plain", seed: int = 0) -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        made: nn.Module = build_component(config, config.model, (config.env.stack, side, side), _ACTIONS, _HEADS[head])
    seed_dropout(made, seed)
    return made


def _learns(config: Config, head: str, side: int, precision: Any) -> None:
    network, target = _made(config, side, head), _made(config, side, head)
    objective = Quantile(_QUANTILES) if head == "quantile" else DQN()
    learner = Learner(
        network, target, torch.optim.SGD(network.parameters(), lr=1e-3), objective, 1.0, precision=precision
    )
    states = np.random.default_rng(0).integers(0, 256, (6, config.env.stack, side, side), np.uint8)
    _hold(learner.q_values(states).shape == (6, _ACTIONS), f"values of shape {learner.q_values(states).shape}")
    before = copy.deepcopy(network.state_dict())
    rewards = np.arange(6, dtype=np.float32)
    errors = learner.update(states, np.arange(6) % _ACTIONS, rewards, states, np.full(6, 0.9, np.float32))
    _hold(errors.isfinite().all(), "an error is not finite")
    _hold(all(value.isfinite().all() for value in network.state_dict().values()), "a weight is not finite")
    unmoved = [name for name, _ in network.named_parameters() if torch.equal(before[name], network.state_dict()[name])]
    _hold(len(unmoved) < len([*network.parameters()]), "no weight has moved")


def _same_weights(config: Config) -> None:
    torch.testing.assert_close(
        _made(config, _side(config)).state_dict(), _made(config, _side(config)).state_dict(), rtol=0, atol=0
    )


def _there_and_back(config: Config) -> None:
    side = _side(config)
    stored = safetensors.torch.load(to_safetensors(_made(config, side, seed=1).state_dict()))
    with torch.device("meta"):
        build_component(config, config.model, (config.env.stack, side, side), _ACTIONS, nn.Linear).load_state_dict(
            stored, assign=True
        )
    other = _made(config, side)
    other.load_state_dict(stored)
    states = torch.rand(2, config.env.stack, side, side)
    with torch.no_grad():
        expected_values, values = (each.eval()(states) for each in (_made(config, side, seed=1), other))
    torch.testing.assert_close(values, expected_values, rtol=0, atol=0)


@contextmanager
def _no_global_stream() -> Iterator[None]:
    def streams() -> list[Any]:
        numpys: Any = np.random.get_state()  # noqa: NPY002
        return [torch.get_rng_state().tolist(), numpys[1].tolist(), random.getstate()]

    before = streams()
    yield
    moved = [name for name, a, b in zip(("torch", "numpy", "random"), before, streams(), strict=True) if a != b]
    _hold(not moved, f"draws from the global stream of {', '.join(moved)}")


def _network_draws_nothing(config: Config) -> None:
    network, states = _made(config, _side(config)), torch.zeros(2, config.env.stack, _side(config), _side(config))
    with _no_global_stream():
        network.train()(states).sum().backward()
        network.eval()(states)


def _splits(config: Config) -> None:
    side = _side(config)
    states = torch.rand(6, config.env.stack, side, side, generator=torch.Generator().manual_seed(0))
    whole, parted = (copy.deepcopy(_made(config, side)).train() for _ in range(2))
    torch.testing.assert_close(torch.cat([parted(states[:2]), parted(states[2:])]), whole(states), rtol=1e-4, atol=1e-5)


def _values(config: Config, seed: int) -> torch.Tensor:
    quantile = config.model.head == "quantile"
    shape = (6, _ACTIONS, config.objective.settings["quantiles"]) if quantile else (6, _ACTIONS)
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def _objective_is_whole(config: Config) -> None:
    objective, actions, ones = build_component(config, config.objective), torch.arange(6) % _ACTIONS, torch.ones(6)
    q = _values(config, 0).requires_grad_()
    with _no_global_stream():
        target = objective.targets(
            ones, torch.arange(6), 0.9 * ones, lambda _: _values(config, 1), lambda _: _values(config, 2)
        )
        losses = objective.losses(q, actions, target)
        losses.mean().backward()
    _hold(target.shape == (6, *q.shape[2:]), f"targets of shape {tuple(target.shape)}")
    _hold(losses.shape == (6,), f"losses of shape {tuple(losses.shape)}")
    _hold(losses.isfinite().all(), "a loss is not finite")
    _hold(q.grad is not None and bool(q.grad.abs().sum() > 0), "no gradient")


def _objective_ends(config: Config) -> None:
    objective, rewards = build_component(config, config.objective), torch.arange(6.0)
    targets = [
        objective.targets(
            rewards,
            torch.arange(6),
            torch.zeros(6),
            lambda _, s=seed: _values(config, s),
            lambda _, s=seed: _values(config, s + 9),
        )
        for seed in (1, 2)
    ]
    torch.testing.assert_close(*targets)


def _memory() -> ReplayMemory:
    memory, rng = ReplayMemory(64, (8, 8), stack=4, budget_bytes=2**20), np.random.default_rng(0)
    memory.begin(0, rng.integers(0, 256, (8, 8), np.uint8))
    for step in range(40):
        memory.add(0, step % _ACTIONS, float(step % 3), rng.integers(0, 256, (8, 8), np.uint8), False)
    return memory


def _draws(config: Config, phase: str) -> None:
    memory, sampler = _memory(), build_component(config, config.sampler_of(phase))
    with _no_global_stream():
        drawn = sampler.sample(memory, 16, np.random.default_rng(0))
        if drawn.weights is not None:
            sampler.feed_back(drawn.ids, np.ones(16, np.float32))
    _hold(drawn.ids.shape == (16,), f"{drawn.ids.shape} transitions for a batch of 16")
    _hold(memory.available(drawn.ids).all(), "a transition that is not available")


def _sampler_continues(config: Config, phase: str) -> None:
    memory = _memory()
    sampler, other = (build_component(config, config.sampler_of(phase)) for _ in range(2))
    rng = np.random.default_rng(0)
    for _ in range(3):
        drawn = sampler.sample(memory, 8, rng)
        if drawn.weights is not None:
            sampler.feed_back(drawn.ids, rng.random(8).astype(np.float32))
    other.load_state_dict(copy.deepcopy(sampler.state_dict()))
    for seed in range(3):
        ids = [each.sample(memory, 8, np.random.default_rng(seed)).ids for each in (sampler, other)]
        _hold((ids[0] == ids[1]).all(), "it draws others than before")


def _epsilon_holds(config: Config) -> None:
    values = _scheduled(build_component(config, config.epsilon))
    _hold(all(0 <= value <= 1 for value in values), f"{min(values)} to {max(values)}")


def _rate_holds(config: Config) -> None:
    values = _scheduled(build_component(config, config.lr_schedule))
    _hold(all(0 <= value < float("inf") for value in values), f"{min(values)} to {max(values)}")


def _scheduled(schedule: Any) -> list[float]:
    with _no_global_stream():
        return [float(schedule(step / 100, 1_000 * step)) for step in range(151)]


def _pays(config: Config) -> None:
    emulator, rng = make_emulator(config.env)(), np.random.default_rng(0)
    emulator.reset(seed=0)
    for _ in range(500):
        step = emulator.step(int(rng.integers(len(emulator.game.actions))))
        is_split = bool(emulator.game.sources)
        _hold(not is_split or sum(step.points) == step.reward, f"{step.points} for a reward of {step.reward}")
        if step.terminated or step.truncated:
            emulator.reset()


def _resumes(small: Job) -> None:
    with tempfile.TemporaryDirectory() as folder:
        places = Path(folder) / "unbroken", Path(folder) / "killed"
        train_and_kill(small.config, small.overrides, places[0], 0)
        kills = train_and_kill(small.config, small.overrides, places[1], 1)
        whole, killed = (fingerprints(small.config, place) for place in places)
    _hold(kills, "the training was too short to be killed")
    _hold(whole == killed, f"{', '.join(part for part in whole if whole[part] != killed[part])} differ")


def _costs(jobs: Sequence[Job]) -> Table:
    """What networks cost here, as their jobs would train them."""
    table = Table("network", "pixels", "parameters", "FLOPs a sample", "updates/s", "steps/s")
    for column in table.columns[1:]:
        column.justify = "right"
    for job in jobs:
        config = job.config
        set_up_torch(config, config.device)
        learner, size, stack = build_learner(config), config.env.size, config.env.stack
        batch = config.training.batch_size
        states = np.random.default_rng(0).integers(0, 256, (batch, stack, size, size), np.uint8)
        numbers = np.zeros(batch, np.float32)
        flops = learner.update_flops((stack, size, size), batch) / batch
        updates, started = 0, time.perf_counter()
        while (passed := time.perf_counter() - started) < _SECONDS or updates < 2:
            learner.update(states, np.zeros(batch, np.int64), numbers, states, numbers).cpu()
            updates += 1
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder)
            trainer = build_trainer(config, job.machine.cores, path, Journal(path), Progress(terminal.console()))
            with trainer.emulators:
                steps = expected(trainer, config, Counters()).steps_per_second
        counts = f"{count_parameters(learner.network):,}", f"{flops / 1e6:,.0f} M"
        table.add_row(config.model.name, str(size), *counts, f"{updates / passed:,.1f}", f"{steps:,.0f}")
    return table


def _side(config: Config) -> int:
    return config.env.size
