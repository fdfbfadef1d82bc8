"""Test each contract of the named components, then measure their cost next to that of built-in ones."""

import copy
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from rich.table import Table
from torch import nn

from atlantis_exp import documents, terminal
from atlantis_exp.build import build_component, build_memory, check_memory, import_components, make_emulator
from atlantis_exp.config import ComponentConfig, Config
from atlantis_exp.faults import Fault
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import DQN, Quantile
from atlantis_exp.learning.values import Recurrent
from atlantis_exp.networks.dropout import seed_dropout
from atlantis_exp.networks.heads import DuelingHead, Head, QuantileHead
from atlantis_exp.networks.sizes import count_parameters
from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.job import Job, replaced
from atlantis_exp.sessions.training import measure
from atlantis_exp.terminal import quoted
from atlantis_exp.tracking.store import first_line
from atlantis_exp.training.checkpoint import Checkpoints, to_safetensors
from atlantis_exp.training.fingerprint import fingerprint

Contract = tuple[str, str, Callable[[], object]]
"""A component, a contract, and a test that raises if the contract is broken."""

_SIDES = (84, 159)  # pixels
_ACTIONS = 4
_QUANTILES = 5
_HEADS: dict[str, Head] = {
    "plain": nn.Linear,
    "dueling": DuelingHead,
    "quantile": partial(QuantileHead, quantiles=_QUANTILES),
}


def check(contracts: Iterator[Contract], measured: Mapping[str, Job]) -> None:
    """Test every contract; if all are kept, measure the costs of trainings. Raises: Fault if one is broken."""
    tried, wanted, now = list[documents.Trial](), [*contracts], ""
    with terminal.working("checking", lambda: now):
        for number, (part, contract, trial) in enumerate(wanted, 1):
            now, because = f"contract {number} of {len(wanted)}: {part}: {contract}", ""
            try:
                trial()
            except Exception as error:
                because = first_line(error) or repr(error)
            tried.append(documents.Trial(component=part, contract=contract, kept=not because, because=because))
    table = Table("component", "contract", "", "because")
    for each in tried:
        table.add_row(each.component, each.contract, "kept" if each.kept else "BROKEN", each.because)
    terminal.console(least=120).print(table)
    broken = [f"{each.component}: {each.contract}" for each in tried if not each.kept]
    costs = list[documents.Cost]()
    if measured and not broken:
        for number, (name, job) in enumerate(measured.items(), 1):
            try:
                costs.append(_cost(name, job, f"measuring costs, {number} of {len(measured)}"))
            except Exception as error:
                contract, because = f"learns from batches of {job.config.training.batch_size}", first_line(error)
                tried.append(documents.Trial(component=name, contract=contract, kept=False, because=because))
                broken.append(f"{name}: {contract} ({because})")
        terminal.console(least=120).print(_table(costs))
    terminal.document(documents.Check(trials=tried, costs=costs).model_dump_json())
    if broken:
        raise Fault(f"broken: {', '.join(broken)}")


def contracts_of(config: Config, small: Job, kinds: Collection[str]) -> Iterator[Contract]:
    """Yield the contracts of a config's components of these kinds; `small` is a training that takes seconds."""
    import_components(config)
    if "model" in kinds:
        network = f"model={config.model.name}"
        for side in _SIDES:
            for head in _HEADS:
                for precision in ("fp32", "bf16"):
                    trial = partial(_learns, config, head, side, precision)
                    yield network, f"learns: {head}, {side} pixels, {precision}", trial
        yield network, "same seed, same weights", partial(_same_weights, config)
        yield network, "loads its saved weights, also on meta", partial(_weights_return, config)
        yield network, "draws no global random numbers", partial(_network_draws_nothing, config)
        component = config.model.component
        if component is not None and component.facts["splits_batches"]:
            yield network, "a split batch gives the same values", partial(_splits, config)
        if component is not None and hasattr(component.load(), "sequence"):
            yield network, "a sequence is its steps, without memory before its first", partial(_remembers, config)
    if "objective" in kinds:
        objective = f"objective={config.objective.name}"
        yield objective, "one finite target and loss per sample", partial(_objective_is_whole, config)
        yield objective, "at discount 0 only rewards count", partial(_objective_ends, config)
    if "sampler" in kinds:
        for name, part in {part.name: part for part in map(config.sampler_of, config.phase)}.items():
            yield f"sampler={name}", "draws available transitions", partial(_draws, config, part)
            yield f"sampler={name}", "continues from its saved state", partial(_sampler_continues, config, part)
    if "epsilon" in kinds:
        trial = partial(_schedule_holds, config, config.epsilon, 1.0)
        yield f"epsilon={config.epsilon.name}", "in [0, 1], before and past the end", trial
    if "lr_schedule" in kinds:
        trial = partial(_schedule_holds, config, config.lr_schedule, sys.float_info.max)
        yield f"lr_schedule={config.lr_schedule.name}", "finite, not negative", trial
    if "env" in kinds:
        yield f"env.id={config.env.id}", "actions are ALE's, points sum to rewards", partial(_pays, config)
    yield "all", "killed and continued equals unbroken, bit for bit", partial(_resumes, small)


def _require(is_kept: object, otherwise: str) -> None:
    if not is_kept:
        raise Fault(otherwise)


def _made(config: Config, side: int, head: str = "plain", seed: int = 0) -> nn.Module:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        shape = len(config.env.lags), side, side
        made: nn.Module = build_component(config, config.model, shape, _ACTIONS, _HEADS[head])
    seed_dropout(made, seed)
    return made


def _states(config: Config, count: int) -> torch.Tensor:
    return torch.rand(count, *config.env.state_shape, generator=torch.Generator().manual_seed(0))


def _learns(config: Config, head: str, side: int, precision: Any) -> None:
    network, target = _made(config, side, head), _made(config, side, head)
    objective = Quantile(_QUANTILES) if head == "quantile" else DQN()
    optimizer = torch.optim.SGD(network.parameters(), lr=1e-3)
    learner = Learner(network, target, optimizer, objective, 1.0, precision=precision)
    states = np.random.default_rng(0).integers(0, 256, (6, len(config.env.lags), side, side), np.uint8)
    _require(learner.q_values(states).shape == (6, _ACTIONS), f"values of shape {learner.q_values(states).shape}")
    before = copy.deepcopy(network.state_dict())
    rewards = np.arange(6, dtype=np.float32)
    errors = learner.update(states, np.arange(6) % _ACTIONS, rewards, states, np.full(6, 0.9, np.float32))
    after = network.state_dict()
    _require(errors.isfinite().all(), "an error is not finite")
    _require(all(value.isfinite().all() for value in after.values()), "a weight is not finite")
    _require(
        any(not torch.equal(before[name], after[name]) for name, _ in network.named_parameters()), "no weight moved"
    )


def _same_weights(config: Config) -> None:
    one, other = (_made(config, config.env.size).state_dict() for _ in range(2))
    torch.testing.assert_close(one, other, rtol=0, atol=0)


def _weights_return(config: Config) -> None:
    side = config.env.size
    network, other = _made(config, side, seed=1), _made(config, side)
    stored = safetensors.torch.load(to_safetensors(network.state_dict()))
    with torch.device("meta"):
        shape = config.env.state_shape
        build_component(config, config.model, shape, _ACTIONS, nn.Linear).load_state_dict(stored, assign=True)
    other.load_state_dict(stored)
    states = _states(config, 2)
    with torch.no_grad():
        torch.testing.assert_close(other.eval()(states), network.eval()(states), rtol=0, atol=0)


@contextmanager
def _no_global_stream() -> Iterator[None]:
    def streams() -> list[Any]:
        numpys: Any = np.random.get_state()  # noqa: NPY002
        return [torch.get_rng_state().tolist(), numpys[1].tolist(), random.getstate()]

    before = streams()
    yield
    moved = [name for name, a, b in zip(("torch", "numpy", "random"), before, streams(), strict=True) if a != b]
    _require(not moved, f"draws from the global generator of {', '.join(moved)}")


def _network_draws_nothing(config: Config) -> None:
    network, states = _made(config, config.env.size), _states(config, 2)
    with _no_global_stream():
        network.train()(states).sum().backward()
        network.eval()(states)


def _splits(config: Config) -> None:
    states = _states(config, 6)
    whole, parted = (_made(config, config.env.size).train() for _ in range(2))
    torch.testing.assert_close(torch.cat([parted(states[:2]), parted(states[2:])]), whole(states), rtol=1e-4, atol=1e-5)


def _remembers(config: Config) -> None:
    network = _made(config, config.env.size).eval()
    with torch.no_grad():
        check_memory(network, config.env.state_shape, (2, _ACTIONS))
    assert isinstance(network, Recurrent)
    x, nothing = _states(config, 6).unflatten(0, (2, 3)), torch.zeros(2, network.units)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        whole, _ = network.sequence(x, nothing, torch.tensor([0, 1]))
        h = torch.ones_like(nothing)
        for t in range(3):
            step, h = network.sequence(x[:, t : t + 1], h, torch.tensor([0 - t, 1 - t]))
            torch.testing.assert_close(step[:, 0], whole[:, t], rtol=1e-4, atol=1e-5)


def _values(config: Config, seed: int) -> torch.Tensor:
    quantile = config.model.head == "quantile"
    shape = (6, _ACTIONS, config.objective.settings["quantiles"]) if quantile else (6, _ACTIONS)
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def _targets(config: Config, discount: float, seed: int) -> torch.Tensor:
    batch = torch.arange(6.0), torch.arange(6), torch.full((6,), discount)  # rewards, stand-ins for states, discounts
    q_functions = (lambda _: _values(config, seed)), (lambda _: _values(config, seed + 9))
    targets: torch.Tensor = build_component(config, config.objective).targets(*batch, *q_functions)
    return targets


def _objective_is_whole(config: Config) -> None:
    q = _values(config, 0).requires_grad_()
    with _no_global_stream():
        target = _targets(config, 0.9, 1)
        losses = build_component(config, config.objective).losses(q, torch.arange(6) % _ACTIONS, target)
        losses.mean().backward()
    _require(target.shape == (6, *q.shape[2:]), f"targets of shape {tuple(target.shape)}")
    _require(losses.shape == (6,), f"losses of shape {tuple(losses.shape)}")
    _require(losses.isfinite().all(), "a loss is not finite")
    _require(q.grad is not None and bool(q.grad.abs().sum() > 0), "no gradient")


def _objective_ends(config: Config) -> None:
    torch.testing.assert_close(_targets(config, 0.0, 1), _targets(config, 0.0, 2))


def _memory() -> ReplayMemory:
    memory, rng = ReplayMemory(64, (8, 8), lags=range(4), budget_bytes=2**20), np.random.default_rng(0)
    memory.begin(0, rng.integers(0, 256, (8, 8), np.uint8))
    for step in range(40):
        memory.add(0, step % _ACTIONS, float(step % 3), rng.integers(0, 256, (8, 8), np.uint8), False)
    return memory


def _draws(config: Config, part: ComponentConfig) -> None:
    memory, sampler = _memory(), build_component(config, part)
    with _no_global_stream():
        drawn = sampler.sample(memory, 16, np.random.default_rng(0))
        if drawn.weights is not None:
            sampler.feed_back(drawn.ids, np.ones(16, np.float32))
    _require(drawn.ids.shape == (16,), f"{drawn.ids.shape} transitions for a batch of 16")
    _require(memory.available(drawn.ids).all(), "a transition that is not available")


def _sampler_continues(config: Config, part: ComponentConfig) -> None:
    memory = _memory()
    sampler, other = (build_component(config, part) for _ in range(2))
    rng = np.random.default_rng(0)
    for _ in range(3):
        drawn = sampler.sample(memory, 8, rng)
        if drawn.weights is not None:
            sampler.feed_back(drawn.ids, rng.random(8).astype(np.float32))
    other.load_state_dict(copy.deepcopy(sampler.state_dict()))
    for seed in range(3):
        ids = [each.sample(memory, 8, np.random.default_rng(seed)).ids for each in (sampler, other)]
        _require((ids[0] == ids[1]).all(), "draws other transitions than before")


def _schedule_holds(config: Config, part: ComponentConfig, highest: float) -> None:
    schedule = build_component(config, part)
    with _no_global_stream():
        values = [float(schedule(step / 100, 1_000 * step)) for step in range(151)]
    _require(all(0 <= value <= highest for value in values), f"{min(values)} to {max(values)}")


def _pays(config: Config) -> None:
    emulator, rng = make_emulator(config.env)(), np.random.default_rng(0)
    emulator.reset(seed=0)
    for _ in range(500):
        step = emulator.step(int(rng.integers(len(emulator.game.actions))))
        is_split = bool(emulator.game.sources)
        _require(not is_split or sum(step.points) == step.reward, f"{step.points} for a reward of {step.reward}")
        if step.terminated or step.truncated:
            emulator.reset()


def _resumes(small: Job) -> None:
    with tempfile.TemporaryDirectory() as folder:
        whole, killed = Path(folder, "unbroken"), Path(folder, "killed")
        _train(small, whole)
        _require(_train(small, killed, kill=True), "the training was too short to be killed")
        _train(small, killed)
        one, other = fingerprints(small.config, whole), fingerprints(small.config, killed)
    _require(one == other, f"{', '.join(part for part in one if one[part] != other[part])} differ")


def _train(small: Job, outputs: Path, kill: bool = False) -> bool:
    """Train in a new process; with `kill`, kill it at the first commit. Return whether it was killed. Raises: Fault."""
    own = replaced(small.overrides, f"paths.outputs={quoted(outputs)}", "tracking.commit_seconds=1.0", "resume=auto")
    command = (sys.executable, "-m", "atlantis_exp", "train", *own)
    with (
        tempfile.TemporaryFile("w+") as said,
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said) as process,
    ):
        try:
            while kill and process.poll() is None and not [*outputs.glob("runs/*/checkpoints/0*/manifest.json")]:
                time.sleep(0.01)
            if kill:
                process.kill()
            code = process.wait()
        finally:
            process.kill()
        if code not in (0, -signal.SIGKILL):
            said.seek(0)
            raise Fault(f"a session failed: {(said.read().splitlines() or ['it printed nothing'])[-1]}")
    return code != 0


def fingerprints(config: Config, outputs: Path) -> dict[str, str]:
    """Return the hashes of an ended training under `outputs`. Raises: Fault."""
    memory = build_memory(config)
    folder = RunFolder(outputs / "runs" / config.run_name())
    state = Checkpoints(folder.checkpoints, config.identity()).load(memory)
    if state is None:
        raise Fault(f"{folder.path} has no checkpoint")
    return fingerprint(state, memory, folder.path)


def _cost(name: str, job: Job, said: str) -> documents.Cost:
    """Measure a training on this machine; an update includes drawing its batch."""
    trainer, speed = measure(job, said=said)
    batch, window = job.config.training.batch_size, trainer.plan.window
    samples = batch * (window.unroll if window else 1)
    return documents.Cost(
        component=name,
        pixels=job.config.env.size,
        parameters=count_parameters(trainer.learner.network),
        flops_per_sample=trainer.learner.update_flops(job.config.env.state_shape, batch) / samples,
        updates_per_second=speed.updates_per_second,
        steps_per_second=speed.steps_per_second,
    )


def _table(costs: Sequence[documents.Cost]) -> Table:
    table = terminal.table("component", "pixels", "parameters", "FLOPs a sample", "updates/s", "steps/s")
    for each in costs:
        counts = f"{each.parameters:,}", f"{each.flops_per_sample / 1e6:,.0f} M"
        speeds = f"{each.updates_per_second:,.1f}", f"{each.steps_per_second:,.0f}"
        table.add_row(each.component, str(each.pixels), *counts, *speeds)
    return table
