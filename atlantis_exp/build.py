"""Build trainers, players and evaluators from a checked config."""

import dataclasses
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import safetensors.torch
import torch
from safetensors import SafetensorError
from torch import nn

from atlantis_exp import config as cfg
from atlantis_exp.components import Component, admitted, describe, facts_of, points_of
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.game.emulator import Emulator, check_game
from atlantis_exp.game.preprocessing import FrameStack, Preprocessing
from atlantis_exp.game.vector import Emulators, make_emulators
from atlantis_exp.games import Game
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.process import OWN_THREADS
from atlantis_exp.learning.recurrent import RecurrentLearner
from atlantis_exp.learning.values import ActionValues, Recurrent
from atlantis_exp.networks.dropout import seed_dropout
from atlantis_exp.networks.heads import DuelingHead, Head, QuantileHead
from atlantis_exp.replay.memory import ReplayMemory, Returns, Window
from atlantis_exp.runs.folder import CHECKPOINTS
from atlantis_exp.runs.journal import Journal
from atlantis_exp.training.actor import Actor, ConstantActor, EpsilonGreedy, PersonActor, RandomActor, RecurrentGreedy
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.evaluator import Evaluator
from atlantis_exp.training.plan import Cadence, Phase, Plan
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.recorder import Recorder
from atlantis_exp.training.trainer import Trainer

OPTIMIZERS: dict[str, type[torch.optim.Optimizer]] = {
    "adamw": torch.optim.AdamW,
    "adam": torch.optim.Adam,
    "rmsprop": torch.optim.RMSprop,
}


def stream(seed: int, name: str) -> np.random.SeedSequence:
    """Return the named random stream of a seed; streams of different names are independent."""
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),))


def build_game(component: Component) -> Game:
    """Return the facts of a game, with the code that splits its rewards if it has sources."""
    game = facts_of(component)
    if component.plugin is not None:
        check_game(game)
    return dataclasses.replace(game, points=points_of(component)) if game.sources else game


def make_emulator(env: cfg.EnvConfig) -> partial[Emulator]:
    """Return a factory of one emulator, which can be sent to a worker process. Raises: ConfigError."""
    if (component := env.game) is None:
        raise ConfigError(f"env.id={env.id}: its game comes from a plugin; name that with plugins=")
    return partial(
        Emulator,
        game=build_game(component),
        preprocessing=Preprocessing(env.size, env.crop),
        frameskip=env.frameskip,
        sticky=env.sticky,
        max_frames=env.max_frames,
        max_steps=env.max_steps,
        noop_max=env.noop_max,
        max_pool=env.max_pool,
    )


def choose_device(name: str) -> torch.device:
    """Return the device of that name; `auto` is the GPU if there is one. Raises: ConfigError."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if name == "mps" and not torch.backends.mps.is_available():
        raise ConfigError("device=mps: this machine has no Apple GPU; valid: auto, cpu")
    count = torch.cuda.device_count()
    if name.startswith("cuda") and int(name.partition(":")[2] or 0) >= count:
        raise ConfigError(f"device={name}: this machine has {count or 'no'} CUDA devices; valid: auto, cpu")
    return torch.device(name)


def choose_precision(name: str, device: torch.device) -> str:
    """Return the precision of that name; `auto` is bf16 if the device multiplies it faster than fp32."""
    if name != "auto":
        return name
    if device.type == "cuda":
        # Before Ampere torch only emulates bf16.
        return "bf16" if torch.version.hip or torch.cuda.get_device_capability(device) >= (8, 0) else "fp32"
    has = torch.cpu.get_capabilities()
    # Intel's AVX-512 multiplies bf16 half as fast as fp32 (docs/performance.md), its AMX faster.
    is_faster = has.get("amx_bf16") or (has.get("avx512_bf16") and "Intel" not in has.get("cpu_name", ""))
    return "bf16" if is_faster else "fp32"


def build_component(config: cfg.Config, part: cfg.ComponentConfig, *given: object) -> Any:
    """Build a component from the `given` arguments and its settings.

    Raises: ConfigError if its plugin is not named on the command line, or its code fails.
    """
    if (component := part.component) is None:
        raise ConfigError(needs(config))
    made = component.load()
    with component.blamed():
        return made(*given, **part.settings)


def described(config: cfg.Config) -> str:
    """Return a config's plugins as text: `mynet 0.3, sha 1a2b3c4d5e6f`."""
    return "; ".join(describe(name, each.version, each.sha256) for name, each in config.plugins.items())


def import_components(config: cfg.Config) -> None:
    """Import the classes that a config names.

    Raises: ConfigError if a plugin is not named or cannot be imported, or if the network cannot be compiled.
    """
    parts: list[cfg.ComponentConfig] = [config.model, config.objective, config.epsilon, config.lr_schedule]
    for part in (*parts, *(config.sampler_of(phase) for phase in config.phase)):
        if part.component is None:
            raise ConfigError(needs(config))
        part.component.load()
    _refuse_to_compile_a_memory(config)
    _num_actions(config)


def _refuse_to_compile_a_memory(config: cfg.Config) -> None:
    component = config.model.component
    if config.compile and component is not None and hasattr(component.load(), "sequence"):
        raise ConfigError(f"compile=true: model={config.model.name} has a memory; only others can be compiled")


def _check_output(config: cfg.Config, network: nn.Module) -> None:
    """Raise ConfigError if a plugin's network fails on states or returns another shape than its head's."""
    component, env = config.model.component, config.env
    if component is None or component.plugin is None:
        return
    shape: tuple[int, ...] = (2, _num_actions(config))
    if config.model.head == "quantile":
        shape = (*shape, config.objective.settings["quantiles"])
    with component.blamed(), torch.no_grad():
        made = tuple(network.eval()(torch.zeros(2, *env.state_shape)).shape)
        if made != shape:
            raise TypeError(f"{component.load().__name__} returns {made} for two states; should be {shape}")
        if hasattr(network, "sequence"):
            check_memory(network, env.state_shape, shape)


def check_memory(network: nn.Module, state: tuple[int, ...], shape: tuple[int, ...]) -> None:
    """Raise TypeError unless a network with a method `sequence` has sizes, and values of two sequences as of states.

    shape: of its values of two states (2, C, H, W).
    """
    for name in ("units", "burn_in", "unroll"):
        if not isinstance(count := getattr(network, name, None), int) or count < 1:
            raise TypeError(f"{name} is {count}; a network with a method sequence needs an int of at least 1")
    assert isinstance(network, Recurrent)
    made = network.sequence(torch.zeros(2, 3, *state), torch.zeros(2, network.units), torch.zeros(2))
    shapes = tuple(tuple(each.shape) for each in made)
    if shapes != (should := ((2, 3, *shape[1:]), (2, network.units))):
        raise TypeError(f"sequence returns {shapes} for two sequences of three states; should be {should}")


def _num_actions(config: cfg.Config) -> int:
    """Return the number of actions of a config's game. Raises: ConfigError if its plugin is not named."""
    if config.game is None:
        raise ConfigError(needs(config))
    return len(facts_of(config.game).actions)


def needs(config: cfg.Config) -> str:
    """Return an error line: the plugins that a config needs, and how the named ones differ."""
    there = {each.plugin.name: each.plugin for each in admitted().values() if each.plugin}
    wanted = {name: describe(name, each.version, each.sha256) for name, each in config.plugins.items()}
    lacking = {name: text for name, text in wanted.items() if str(there.get(name)) != text}
    if not lacking:
        return f"env.id={config.env.id}: none of the plugins has this game"
    given = [f"; {there[name].shown} is {there[name]}, which makes another run" for name in lacking if name in there]
    names = [name if config.plugins[name].version else f"./{name}.py" for name in lacking]
    return f"needs plugins={','.join(names)} ({'; '.join(lacking.values())}){''.join(given)}"


def build_network(config: cfg.Config, name: str, device: torch.device | None = None) -> nn.Module:
    """Return a network with weights from the named stream; leave the global generator unchanged."""
    if config.model.component is not None:
        config.model.component.load()  # first, since a module may draw random numbers when imported
    initial, dropout = stream(config.seed, name).generate_state(2, np.uint64)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(initial >> np.uint64(1)))
        network = _architecture(config)
        _check_output(config, network)
    network.to(device)  # first, since the generator of dropout stays on its device
    seed_dropout(network, int(dropout >> np.uint64(1)))
    return network


def _architecture(config: cfg.Config) -> nn.Module:
    """Return a network with weights from the global generator."""
    env, objective = config.env, config.objective
    head: Head = DuelingHead if config.model.head == "dueling" else nn.Linear
    if objective.component is None:
        raise ConfigError(needs(config))
    if config.model.head == "quantile":
        head = partial(QuantileHead, quantiles=objective.settings["quantiles"])
    network: nn.Module = build_component(config, config.model, env.state_shape, _num_actions(config), head)
    return network


def build_optimizer(optimizer: cfg.AdamConfig | cfg.RmsPropConfig, network: nn.Module) -> torch.optim.Optimizer:
    """Return an optimizer of all parameters of a network."""
    settings = dataclasses.asdict(optimizer)
    name = settings.pop("name")
    settings["fused" if isinstance(optimizer, cfg.AdamConfig) else "foreach"] = True
    return OPTIMIZERS[name](network.parameters(), **settings)


def build_learner(config: cfg.Config) -> Learner:
    """Return the learner: both networks, the optimizer and the objective."""
    _refuse_to_compile_a_memory(config)
    device, target = choose_device(config.device), config.objective.target
    network = build_network(config, "network", device)
    target_network = build_network(config, "target", device)
    if target.start == "copy":
        target_network.load_state_dict(network.state_dict())
    make: Callable[..., Learner] = Learner
    if isinstance(network, Recurrent):
        make = partial(RecurrentLearner, ahead=config.objective.n_step)
    return make(
        network,
        target_network,
        build_optimizer(config.optimizer, network),
        build_component(config, config.objective),
        target.tau,
        target_every=target.every,
        precision=choose_precision(config.training.precision, device),
        target_mode=target.mode,
        shards=choose_shards(config, device),
        ema=config.training.ema,
        compile=_compiled if config.compile else None,
    )


def choose_shards(config: cfg.Config, device: torch.device) -> int:
    """Return the number of parts to split a batch into: one per thread on a CPU, if the network allows it."""
    component = config.model.component
    is_split = device.type == "cpu" and component is not None and component.facts["splits_batches"]
    return (config.threads or OWN_THREADS) if is_split else 1


def _compiled(network: nn.Module) -> nn.Module:
    """Compile a network for batches of one size, on a GPU with CUDA graphs."""
    on_gpu = next(network.parameters()).is_cuda
    return cast(nn.Module, torch.compile(network, dynamic=False, mode="reduce-overhead" if on_gpu else None))


def build_plan(config: cfg.Config) -> Plan:
    """Return the phases, schedules and learning cadence."""
    objective = config.objective
    phases = []
    for name, phase in config.phase.items():
        sampler = build_component(config, config.sampler_of(name))
        phases.append(Phase(name, phase.episodes or phase.steps or 0, phase.lr, sampler))
    return Plan(
        unit="episodes" if next(iter(config.phase.values())).episodes else "steps",
        phases=phases,
        epsilon=build_component(config, config.epsilon),
        learning_rate=build_component(config, config.lr_schedule),
        returns=Returns(
            objective.gamma,
            objective.n_step,
            objective.reward_scale,
            objective.reward_exponent,
            objective.reward_clip,
        ),
        terminal_on_life_loss=objective.terminal_on_life_loss,
        learn_every=config.training.learn_every,
        learn_start=config.training.learn_start,
        batch_size=config.training.batch_size,
    )


def build_trained_network(config: cfg.Config, weights: bytes) -> nn.Module:
    """Return a trained network from its weights as safetensors. Raises: Fault if they are damaged or do not fit."""
    try:
        tensors = safetensors.torch.load(weights)
        with torch.device("meta"):  # check shapes first: a card may claim a network too large for memory
            _architecture(config).load_state_dict(tensors, assign=True)
        network = build_network(config, "network")
        network.load_state_dict(tensors)
        if not all(tensor.isfinite().all() for tensor in tensors.values()):
            raise Fault("the weights are not all finite numbers: their training diverged, or they are damaged")
    except Fault:  # from a plugin
        raise
    except (SafetensorError, RuntimeError) as error:
        raise Fault(f"the weights are damaged or another network's: {' '.join(str(error).split())}") from error
    return network


def build_network_actor(config: cfg.Config, weights: bytes, device: str) -> Actor:
    """Return the player of a trained network, from its weights as safetensors. Raises: Fault."""
    where = choose_device(device)
    network = build_trained_network(config, weights).to(where)
    precision = choose_precision(config.training.precision, where)
    values = ActionValues(network, precision=precision, shards=choose_shards(config, where))  # type: ignore[arg-type]
    if isinstance(network, Recurrent):
        return RecurrentGreedy(network.units, values.step, _num_actions(config))
    return EpsilonGreedy(values.q_values, _num_actions(config), watches=True)


def build_person(env: cfg.EnvConfig, choose: Callable[[npt.NDArray[np.uint8]], int]) -> tuple[PersonActor, Emulators]:
    """Return the actor of a person at the keyboard, and the emulator whose screen they see."""
    emulator = make_emulator(env)()
    return PersonActor(emulator.screen_rgb, choose), make_emulators(lambda: emulator, 1, 1)


def build_baseline(agent: cfg.BaselineAgentConfig, env: cfg.EnvConfig) -> Actor:
    """Return a player without a network."""
    return RandomActor(len(facts_of(env.game).actions)) if agent.name == "random" else ConstantActor(agent.action)


def build_evaluator(env: cfg.EnvConfig, evaluation: cfg.EvaluationConfig, cores: int) -> Evaluator:
    """Return the evaluator of this protocol, for any actor."""
    make = make_emulator(env)
    workers = env.workers or max(1, cores - 1)  # leave one core to the network
    return Evaluator(
        make_emulators=lambda num_envs: make_emulators(make, num_envs, workers),
        make_emulator=make,
        epsilon=evaluation.epsilon,
        seed=evaluation.seed,
        num_envs=evaluation.at_once,
        size=env.size,
        lags=env.lags,
        most_frames=env.max_frames,
        video="first_minute" if evaluation.video is True else evaluation.video or None,
    )


def build_memory(config: cfg.Config) -> ReplayMemory:
    """Return an empty replay memory. Raises: ConfigError if this machine cannot reserve it."""
    env, replay = config.env, config.replay
    try:
        return ReplayMemory(replay.capacity, (env.size, env.size), lags=env.lags, budget_bytes=replay.max_bytes)
    except MemoryError:
        raise ConfigError(f"replay.max_bytes={replay.max_bytes}: more than this machine can reserve") from None


def build_cadence(evaluation: cfg.EvaluationConfig, tracking: cfg.TrackingConfig) -> Cadence:
    """Return how often a training is recorded, evaluated and committed."""
    return Cadence(
        curve_steps=tracking.every_steps,
        histogram_episodes=tracking.histogram_episodes,
        commit_episodes=tracking.commit_episodes,
        commit_seconds=tracking.commit_seconds,
        evaluate_episodes=evaluation.every_episodes,
        evaluate_steps=evaluation.every_steps,
        evaluate_at_end=evaluation.at_end,
        interim_episodes=evaluation.interim_episodes or evaluation.episodes,
        final_episodes=evaluation.episodes,
    )


def build_trainer(
    config: cfg.Config, cores: int, folder: Path, journal: Journal, progress: Progress, about: str = ""
) -> Trainer:
    """Return a trainer that writes under `folder` only; `about` is part of the run's description, in markdown."""
    env = config.env
    plan, learner, memory = build_plan(config), build_learner(config), build_memory(config)
    evaluator = build_evaluator(env, config.evaluation, cores)
    cadence, game = build_cadence(config.evaluation, config.tracking), facts_of(config.game)
    actor: Actor = EpsilonGreedy(learner.q_values, len(game.actions))
    watched: Actor = EpsilonGreedy(learner.evaluated_q_values, len(game.actions), watches=True)
    if isinstance(learner, RecurrentLearner):
        core = learner.core
        actor = RecurrentGreedy(core.units, learner.step, len(game.actions))
        watched = RecurrentGreedy(core.units, learner.evaluated_step, len(game.actions))
        plan = dataclasses.replace(plan, window=Window(core.burn_in, core.unroll, config.objective.n_step))
    trainer = Trainer(
        plan=plan,
        emulators=make_emulators(evaluator.make_emulator, env.num_envs, env.workers or cores),
        stack=FrameStack(env.num_envs, env.size, env.lags, actor.units),
        actor=actor,
        memory=memory,
        learner=learner,
        exploration=[np.random.default_rng(child) for child in stream(config.seed, "exploration").spawn(env.num_envs)],
        sampling=np.random.default_rng(stream(config.seed, "sampling")),
        seeds=stream(config.seed, "emulators").generate_state(env.num_envs).tolist(),
        recorder=Recorder(
            plan=plan,
            cadence=cadence,
            learner=learner,
            memory=memory,
            journal=journal,
            progress=progress,
            play=partial(evaluator, watched),
            film=evaluator.film,
            score_range=game.score_range,
            about=about,
        ),
        checkpoints=Checkpoints(folder / CHECKPOINTS, config.identity()),
        max_steps=config.budget.steps,
        max_flops=config.budget.flops,
    )
    if config.budget.flops is not None and not trainer.flops_per_update:
        raise ConfigError(f"budget.flops: the FLOPs of model={config.model.name} cannot be counted; use budget.steps")
    return trainer
