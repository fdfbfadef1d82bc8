"""Define the schema of an experiment: types, ranges and cross-field checks.

It knows neither Hydra nor torch: a config from a stored run passes the same checks as one from a command line.
"""

import dataclasses
import json
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, field
from functools import cache
from itertools import pairwise
from keyword import iskeyword
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, ConfigDict, Field, PlainValidator, TypeAdapter, ValidationInfo
from pydantic.dataclasses import dataclass
from pydantic_core import PydanticKnownError

from atlantis_exp.checking import check_server, check_time, digest, nearest, seconds, to_dict
from atlantis_exp.components import (
    KINDS,
    NAME,
    Component,
    Count,
    Plugin,
    Probability,
    game_ids,
    game_of,
    known,
    title_of,
)
from atlantis_exp.faults import ConfigError
from atlantis_exp.games import SCREEN

# Deferred, since the schemas of all verbs together take a tenth of a second to build.
STRICT = ConfigDict(defer_build=True, strict=True, extra="forbid", allow_inf_nan=False)

Frameskip = Annotated[int, Field(ge=1, le=256)]
_MOST_OBSERVATIONS = 16  # in a state
_Lag = Annotated[int, Field(ge=0, le=64)]  # steps; each environment keeps as many observations, also in checkpoints
_MOST_GAMES = 64  # of an evaluation, side by side
Episodes = Annotated[int, Field(ge=1, le=50_000)]  # of one evaluation, whose table can be read
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[int, Field(ge=8, le=210)]
Rate = Annotated[float, Field(ge=1e-10, le=10)]
Scale = Annotated[float, Field(ge=1e-9, le=1e9)]
Format = Literal["text", "json"]  # of a verb's output


def _check_device(device: str) -> str:
    if not re.fullmatch(r"auto|cpu|mps|cuda(:\d+)?", device):
        raise ConfigError(
            f"device={device}: no such choice; a GPU is cuda or cuda:1 (valid: auto, cpu, mps, cuda, cuda:N)"
        )
    return device


Device = Annotated[str, AfterValidator(_check_device)]

FREE = frozenset(("plugins", "resume", "device", "threads", "compile", "tracking", "budget", "paths"))
"""Keys that are not part of a run's identity; of `plugins`, those that the run uses are."""

_INDEX_BYTES = 23  # of the replay memory, per observation


def _check_stack(stack: int | tuple[int, ...]) -> int | tuple[int, ...]:
    """Return a stack by the number of its observations if it has no gaps: each state has one name."""
    if isinstance(stack, int):
        return stack
    if stack[0] != 0 or any(later <= lag for lag, later in pairwise(stack)):
        raise ConfigError(
            f"env.stack={list(stack)}: should be steps ago that ascend from 0, as in env.stack=[0,1,2,3,8,16,24]"
        )
    return len(stack) if stack[-1] == len(stack) - 1 else stack


Stack = Annotated[
    Annotated[int, Field(ge=1, le=_MOST_OBSERVATIONS)]
    | Annotated[tuple[_Lag, ...], Field(min_length=1, max_length=_MOST_OBSERVATIONS)],
    AfterValidator(_check_stack),
]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class EnvConfig:
    """One game and how its screen becomes an observation (report figure 2.3)."""

    id: Annotated[str, Field(pattern=r"^[\w/.-]{1,100}$")]  # Gymnasium's, which names the game
    frameskip: Frameskip | tuple[Frameskip, Frameskip]  # frames per step; a pair: drawn from [low, high)
    sticky: Probability
    max_frames: Annotated[int, Field(ge=1, lt=2**31)]  # frames per episode
    max_steps: Count | None  # steps per episode
    noop_max: Annotated[int, Field(ge=0, le=30)]  # frames
    max_pool: bool
    crop: tuple[int, int, int, int]  # UP, RIGHT, DOWN, LEFT: screen[UP:DOWN, LEFT:RIGHT]
    size: Size  # pixels
    stack: Stack  # observations of a state: their number, or how many steps ago each was
    num_envs: Annotated[int, Field(ge=1, le=64)]
    workers: Annotated[int, Field(ge=1, le=64)] | None  # processes; null: one per core, in evaluations one fewer

    def __post_init__(self) -> None:
        rows, columns = SCREEN
        up, right, down, left = self.crop
        if not (0 <= up < down <= rows and 0 <= left < right <= columns):
            raise ConfigError(
                f"env.crop={list(self.crop)}: should be (UP, RIGHT, DOWN, LEFT) within the screen: "
                f"0 <= UP < DOWN <= {rows} and 0 <= LEFT < RIGHT <= {columns}, as [0, {columns}, {rows}, 0]"
            )
        if isinstance(self.frameskip, tuple) and self.frameskip[0] >= self.frameskip[1]:
            raise ConfigError(
                f"env.frameskip={list(self.frameskip)}: drawn from [low, high), so low must be less than high"
            )
        if self.noop_max >= self.max_frames:
            raise ConfigError(f"env.noop_max={self.noop_max}: should be less than env.max_frames={self.max_frames}")
        if self.max_pool and (isinstance(self.frameskip, tuple) or self.frameskip < 2):
            raise ConfigError(
                "env.max_pool=true: needs one fixed env.frameskip of at least 2, as in env=atlantis_standard"
            )

    @property
    def lags(self) -> Sequence[int]:
        """How many steps ago each of a state's observations was, ascending from 0."""
        return range(self.stack) if isinstance(self.stack, int) else self.stack

    @property
    def state_shape(self) -> tuple[int, int, int]:
        """The number of a state's observations, and their rows and columns."""
        return len(self.lags), self.size, self.size

    @property
    def game(self) -> Component | None:
        """The game that the id names; None if it belongs to a plugin that the command line does not name."""
        return game_of(self.id)

    @property
    def title(self) -> str:
        return title_of(self.id)


def _check_game(env: EnvConfig, info: ValidationInfo) -> EnvConfig:
    """Raise ConfigError for an unknown game that cannot come from a run's plugins."""
    if env.game is None and not (info.data.get("plugins") and re.fullmatch(r"(ALE/)?[A-Z][A-Za-z0-9]*-v\d", env.id)):
        ids = [each for name in known("env") for each in game_ids(name)]
        raise ConfigError(f"env.id={env.id}: no such choice; {nearest(env.id, ids)}")
    return env


Env = Annotated[EnvConfig, AfterValidator(_check_game)]
"""An environment whose game is known, or may come from the run's plugins."""


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ComponentConfig:
    """A component by name, and its settings: the fields that a subclass adds are its constructor's arguments."""

    component: ClassVar[Component | None] = None  # None: of a plugin that the command line does not name
    own: ClassVar[tuple[str, ...]] = ()  # names of the settings

    name: str

    @property
    def settings(self) -> dict[str, Any]:
        """The keyword arguments of the component's constructor."""
        return {name: getattr(self, name) for name in self.own}


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ModelConfig(ComponentConfig):
    """A network."""

    input_size: Size  # pixels
    head: Literal["plain", "dueling", "quantile"]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class TargetConfig:
    """The target network: how it starts, follows and normalises."""

    tau: Annotated[float, Field(ge=1e-6, le=1)]  # share of the policy network; smaller ones vanish in float32
    every: Count  # updates
    mode: Literal["eval", "train"]
    start: Literal["copy", "independent"]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ObjectiveConfig(ComponentConfig):
    """The bootstrap target and its loss."""

    gamma: Annotated[float, Field(ge=0, lt=1)]
    n_step: Annotated[int, Field(ge=1, le=1_000)]  # rewards before the bootstrap
    reward_scale: Scale
    reward_exponent: Annotated[float, Field(gt=0, le=1)] = 1.0  # of the scaled reward
    reward_clip: Scale | None  # after both; null: not clipped
    terminal_on_life_loss: bool
    target: TargetConfig


@dataclass(config=STRICT, kw_only=True, frozen=True)
class AdamConfig:
    """Adam, or AdamW with decoupled weight decay."""

    name: Literal["adam", "adamw"]
    lr: Rate
    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]]
    eps: Annotated[float, Field(ge=1e-20, le=1)]
    weight_decay: Annotated[float, Field(ge=0, le=1)]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class RmsPropConfig:
    """RMSProp, optionally centred as in the DQN papers."""

    name: Literal["rmsprop"]
    lr: Rate
    alpha: Annotated[float, Field(ge=0, lt=1)]
    eps: Annotated[float, Field(ge=1e-20, le=1)]
    momentum: Annotated[float, Field(ge=0, lt=1)]
    centered: bool


OptimizerConfig = Annotated[AdamConfig | RmsPropConfig, Field(discriminator="name")]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PluginConfig:
    """A plugin, as it was when a run was trained with it."""

    version: Annotated[str, Field(pattern=r"^[\w.+!-]{1,60}$")] | None  # of the distribution; null: a file
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


Plugins = dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_][\w.-]{0,99}$")], PluginConfig]

_MOST_SETTINGS = 100  # of an unknown component
_Value = bool | Annotated[int, Field(ge=-(2**63), lt=2**63)] | float | str | None
_BASES: dict[str, type[ComponentConfig]] = {"model": ModelConfig, "objective": ObjectiveConfig}


@cache
def _schema(component: Component) -> TypeAdapter[ComponentConfig]:
    """Return the schema of a component whose class is known."""
    types = {each.name: each.type for each in component.settings}
    defaults = {each.name: each.default for each in component.settings if each.default is not MISSING}
    return _extended(component.kind, types, {**defaults, "component": component})


def _unknown_schema(kind: str, names: Collection[str]) -> TypeAdapter[ComponentConfig]:
    """Return the schema of a component whose class is unknown: plain values, which can be compared."""
    if len(names) > _MOST_SETTINGS or any(iskeyword(name) or not re.fullmatch(NAME, name) for name in names):
        raise ConfigError(f"{kind}: not the settings of a component, or more than {_MOST_SETTINGS}")
    return _extended(kind, dict.fromkeys(names, _Value | list[_Value]), {})


def _extended(kind: str, types: Mapping[str, Any], attributes: Mapping[str, Any]) -> TypeAdapter[ComponentConfig]:
    body = {**attributes, "own": tuple(types), "__annotations__": dict(types), "__module__": __name__}
    schema: Any = dataclass(config=STRICT, kw_only=True, frozen=True)(
        type("Settings", (_BASES.get(kind, ComponentConfig),), body)
    )
    return TypeAdapter(schema)


def _component(kind: str) -> PlainValidator:
    """Return the validator of a component's config, which checks it against the settings of the class."""
    base = _BASES.get(kind, ComponentConfig)
    common = {each.name for each in dataclasses.fields(base)}

    def read(tree: Any, info: ValidationInfo) -> ComponentConfig:
        if isinstance(tree, base):
            return tree
        if not isinstance(tree, dict):
            raise PydanticKnownError("dataclass_type", {"class_name": base.__name__})
        if not isinstance(name := tree.get("name"), str):
            raise PydanticKnownError("union_tag_not_found", {"discriminator": "'name'"})
        component, plugins = known(kind).get(name), info.data.get("plugins") or {}
        if component is not None and (component.plugin is None or _is_recorded(component.plugin, plugins)):
            schema = _schema(component)
        elif plugins and re.fullmatch(NAME, name):
            schema = _unknown_schema(kind, tree.keys() - common)
        else:
            tags = ", ".join(f"'{each}'" for each in known(kind))
            raise PydanticKnownError(
                "union_tag_invalid", {"discriminator": "'name'", "tag": name, "expected_tags": tags}
            )
        # Through JSON, as in `checking.parse`.
        return schema.validate_json(json.dumps(tree))

    return PlainValidator(read)


def _is_recorded(plugin: Plugin, plugins: Mapping[str, PluginConfig]) -> bool:
    recorded = plugins.get(plugin.name)
    return recorded is not None and (recorded.version, recorded.sha256) == (plugin.version, plugin.sha256)


def record_plugins(tree: dict[str, Any]) -> None:
    """Record in a composed config the plugins whose components it names."""
    samplers = tree["samplers"] if isinstance(tree.get("samplers"), dict) else {}
    named = [(kind, tree.get(kind)) for kind in KINDS] + [("sampler", each) for each in samplers.values()]
    found = [known(kind).get(str(part.get("name"))) for kind, part in named if isinstance(part, dict)]
    if isinstance(env := tree.get("env"), dict):
        found.append(game_of(str(env.get("id"))))
    plugins = {each.plugin.name: each.plugin for each in found if each is not None and each.plugin is not None}
    tree["plugins"] = {name: {"version": each.version, "sha256": each.sha256} for name, each in sorted(plugins.items())}


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PhaseConfig:
    """A stretch of training with its own learning rate and sampler; its length in episodes or in steps."""

    episodes: Count | None
    steps: Count | None
    lr: Rate
    sampler: str


PINNED = r"^[^\x00-\x1f]{1,1000}@[0-9a-f]{16}$"
"""A folder of weights and the first digits of their SHA-256."""


@dataclass(config=STRICT, kw_only=True, frozen=True)
class TrainingConfig:
    """When the learner learns, and from how much."""

    learn_every: Count  # steps
    learn_start: Annotated[int, Field(ge=0, le=10**12)]  # transitions in the memory
    batch_size: Annotated[int, Field(ge=1, le=2**24)]  # transitions
    precision: Literal["auto", "fp32", "bf16"]
    ema: Annotated[int, Field(ge=10, le=10**7)] | None = None  # updates to average for an evaluation; null: latest
    weights: Annotated[str, Field(pattern=PINNED)] | None = None  # FOLDER@DIGEST of exported weights; null: random

    @property
    def pinned(self) -> tuple[str, str] | None:
        """The folder of the initial weights, and the first digits of their SHA-256."""
        folder, _, digits = (self.weights or "").rpartition("@")
        return (folder, digits) if folder else None


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ReplayConfig:
    """The two bounds of the replay memory."""

    capacity: Annotated[int, Field(ge=16, le=10**9)]  # observations
    max_bytes: Annotated[int, Field(ge=2**20, le=2**50)]  # bytes, everything included


@dataclass(config=STRICT, kw_only=True, frozen=True)
class EvaluationConfig:
    """Episodes at a fixed epsilon, played without touching the training."""

    episodes: Episodes
    interim_episodes: Episodes | None  # of an evaluation during training; null: as many as at the end
    epsilon: Probability
    every_episodes: Count | None  # training episodes between evaluations; null: none
    every_steps: Count | None  # training steps between evaluations; null: none
    at_end: bool
    num_envs: Annotated[int, Field(ge=1, le=_MOST_GAMES)] | None  # episodes side by side; null: `at_once` chooses
    seed: Seed
    video: Literal["first_minute", "best_minute", "all"] | bool  # of the best episode; true: its first minute

    @property
    def at_once(self) -> int:
        """Episodes to play side by side: many, in equal rounds so that no emulator is idle."""
        return self.num_envs or math.ceil(self.episodes / math.ceil(self.episodes / _MOST_GAMES))


@dataclass(config=STRICT, kw_only=True, frozen=True)
class TrackingConfig:
    """Where and how densely a run is recorded."""

    name: Literal["mlflow", "server", "none"]
    uri: str | None  # of an MLflow server; null: the outputs folder's own database
    experiment: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,99}$")]
    every_steps: Count  # steps between two points of a curve
    histogram_episodes: Count  # episodes in a window's score histogram
    commit_episodes: Count  # episodes between two checkpoints
    commit_seconds: Annotated[float, Field(gt=0, le=1e9)]  # most seconds between two checkpoints

    def __post_init__(self) -> None:
        check_server("tracking.uri", self.uri)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class BudgetConfig:
    """Limits of this command, which do not change the experiment."""

    steps: Count | None
    flops: Annotated[float, Field(gt=0)] | None = None  # of updates; missing in older runs and cards
    wall_clock: str | Count | None  # a number alone is in seconds
    forecast: Literal["refuse", "warn", "off"]

    def __post_init__(self) -> None:
        check_time("budget.wall_clock", self.wall_clock, "90s, 10min or 3h")

    @property
    def limits(self) -> dict[str, float]:
        """The limits that end a training, by key."""
        limits = {"budget.steps": self.steps, "budget.flops": self.flops}
        return {key: limit for key, limit in limits.items() if limit is not None}

    @property
    def seconds(self) -> int | None:
        return None if self.wall_clock is None else seconds(self.wall_clock)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PathsConfig:
    """The folder that a command writes to."""

    outputs: Annotated[str, Field(min_length=1)]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class BaselineAgentConfig:
    """A player without a network."""

    name: Literal["random", "constant"]
    action: Annotated[int, Field(ge=0, le=17)]  # of the constant player, by index


@dataclass(config=STRICT, kw_only=True, frozen=True)
class Config:
    """One training experiment."""

    plugins: Plugins = field(default_factory=dict)  # of its components; first, since the others need it
    seed: Seed
    resume: Literal["auto", "never", "must"]
    device: Device
    threads: Annotated[int, Field(ge=1, le=256)] | None
    compile: bool = False  # older runs and cards lack the key
    training: TrainingConfig
    replay: ReplayConfig
    env: Env
    model: Annotated[ModelConfig, _component("model")]
    objective: Annotated[ObjectiveConfig, _component("objective")]
    optimizer: OptimizerConfig
    lr_schedule: Annotated[ComponentConfig, _component("lr_schedule")]
    epsilon: Annotated[ComponentConfig, _component("epsilon")]
    samplers: dict[str, Annotated[ComponentConfig, _component("sampler")]]
    sampler: Annotated[ComponentConfig, _component("sampler")]
    phase: dict[str, PhaseConfig]
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    budget: BudgetConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        network, objective = self.model.component, self.objective.component
        if network is not None and self.env.size < (smallest := network.facts["smallest_side"]):
            raise ConfigError(
                f"env.size={self.env.size}: model '{self.model.name}' needs at least {smallest} pixels; "
                f"it is made for {self.model.input_size}"
            )
        if objective is not None and (objective.facts["head"] == "quantile") != (self.model.head == "quantile"):
            names = [name for name, each in known("objective").items() if each.facts["head"] == "quantile"]
            raise ConfigError(
                f"model.head={self.model.head}: does not go with objective.name={self.objective.name}; "
                f"model.head=quantile and objective={' or '.join(names)} need each other"
            )
        if self.training.batch_size > self.replay.capacity:
            raise ConfigError(
                f"training.batch_size={self.training.batch_size}: larger than replay.capacity={self.replay.capacity}; "
                f"at most {self.replay.capacity}"
            )
        # An environment's newest observation has no successor yet, and its oldest no longer have a whole stack.
        most = self.replay.capacity - self.env.num_envs * (self.env.lags[-1] + 2)
        if self.training.learn_start >= most:
            raise ConfigError(
                f"training.learn_start={self.training.learn_start}: should be less than {most}, the transitions that "
                f"replay.capacity={self.replay.capacity} holds; else nothing would be learned"
            )
        frame = self.env.size**2
        least = _INDEX_BYTES * self.replay.capacity + 9 * (frame + frame // 255 + 16)  # LZ4's bound for noise
        if self.replay.max_bytes < least:
            raise ConfigError(
                f"replay.max_bytes={self.replay.max_bytes}: should be at least {least}, for the index of "
                f"replay.capacity={self.replay.capacity} observations and nine that do not compress"
            )
        if not self.phase:
            raise ConfigError("phase: at least one phase is needed, as in conf/phase/single.yaml")
        for key in (*(f"phase.{name}" for name in self.phase), *(f"samplers.{name}" for name in self.samplers)):
            if not re.fullmatch(r"\w+\.[\w. -]{1,100}", key, re.ASCII):
                raise ConfigError(f"{key!a}: a name has at most 100 characters, a to z, A to Z, 0 to 9, and '_. -'")
        for name, phase in self.phase.items():
            if (phase.episodes is None) == (phase.steps is None):
                raise ConfigError(f"phase.{name}: set either episodes or steps, the other to null")
            if phase.sampler not in self.samplers and phase.sampler != self.sampler.name:
                raise ConfigError(
                    f"phase.{name}.sampler={phase.sampler}: no such sampler; {nearest(phase.sampler, self.samplers)}"
                )
        if len({phase.steps is None for phase in self.phase.values()}) > 1:
            raise ConfigError("phase: set episodes in all phases, or steps in all")

    @property
    def game(self) -> Component | None:
        """The game; None if it belongs to a plugin that is not named, or has changed since."""
        game = self.env.game
        return game if game is None or game.plugin is None or _is_recorded(game.plugin, self.plugins) else None

    def sampler_of(self, phase: str) -> ComponentConfig:
        """Return the sampler that a phase names; `sampler` takes precedence over one of `samplers` of the same name."""
        name = self.phase[phase].sampler
        return self.sampler if name == self.sampler.name else self.samplers[name]

    def science(self) -> dict[str, Any]:
        """Return the keys that decide the run's numbers: all but tracking, budget, places, devices, processes."""
        tree = to_dict(self)
        for key in (FREE - {"plugins"}) | {"samplers", "sampler"}:
            del tree[key]
        del tree["env"]["workers"]
        tree["evaluation"]["video"] = bool(tree["evaluation"]["video"])  # the filmed part does not matter
        if self.training.pinned is not None:
            _, tree["training"]["weights"] = self.training.pinned  # their folder does not matter
        # Newer keys are left out at their defaults, so that older runs keep their identity.
        for part, key, default in (
            *((tree["training"], "ema", None), (tree["training"], "weights", None)),
            *((tree["objective"], "reward_exponent", 1), (tree, "plugins", {})),
        ):
            if part[key] == default:
                del part[key]
        # A list, since the order of phases counts and their names do not.
        tree["phase"] = [{**phase, "sampler": to_dict(self.sampler_of(name))} for name, phase in tree["phase"].items()]
        return tree

    def identity(self) -> str:
        """Return ten hexadecimal digits of the hash of `science`."""
        return digest(self.science())

    def run_name(self) -> str:
        """Return a readable name that ends in the identity."""
        samplers = [phase.sampler for phase in self.phase.values()]
        return f"{self.model.name}-{'-'.join(dict.fromkeys(samplers))}-s{self.seed}-{self.identity()}"
