"""The schema of a composed experiment: types, ranges and cross-field checks.

A plain nested mapping enters, a checked `Config` leaves. Knows no Hydra and no torch, so that a config read back from a
stored run passes through the same door as one typed on a command line.
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

# Built when a config is parsed: all verbs' together take a tenth of a second.
STRICT = ConfigDict(defer_build=True, strict=True, extra="forbid", allow_inf_nan=False)

Frameskip = Annotated[int, Field(ge=1, le=256)]
_MOST_OBSERVATIONS = 16  # in a state
_Lag = Annotated[int, Field(ge=0, le=64)]  # steps; each environment keeps as many observations, also in checkpoints
_MOST_GAMES = 64  # that an evaluation plays side by side
Episodes = Annotated[int, Field(ge=1, le=10**6)]  # of one evaluation
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Size = Annotated[int, Field(ge=8, le=210)]
Rate = Annotated[float, Field(ge=1e-10, le=10)]
Scale = Annotated[float, Field(ge=1e-9, le=1e9)]
Format = Literal["text", "json"]  # of what a verb prints


def _check_device(device: str) -> str:
    if not re.fullmatch(r"auto|cpu|mps|cuda(:\d+)?", device):
        raise ConfigError(
            f"device={device}: no such choice; a GPU is cuda or cuda:1 (valid: auto, cpu, mps, cuda, cuda:N)"
        )
    return device


Device = Annotated[str, AfterValidator(_check_device)]

FREE = frozenset(("plugins", "resume", "device", "threads", "compile", "tracking", "budget", "paths"))
"""Keys that say how a run is done, not what is trained; the plugins that a run uses do count."""

_INDEX_BYTES = 23  # of the replay memory, an observation
SCREEN = (210, 160)  # rows, columns of the emulator's screen


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
    frameskip: Frameskip | tuple[Frameskip, Frameskip]  # frames a step; a pair is drawn from [low, high)
    sticky: Probability
    max_frames: Annotated[int, Field(ge=1, lt=2**31)]  # frames an episode
    max_steps: Count | None  # steps an episode
    noop_max: Annotated[int, Field(ge=0, le=30)]  # frames
    max_pool: bool
    crop: tuple[int, int, int, int]  # UP, RIGHT, DOWN, LEFT: screen[UP:DOWN, LEFT:RIGHT]
    size: Size  # pixels
    stack: Stack  # observations of a state: their number, or how many steps ago each was
    num_envs: Annotated[int, Field(ge=1, le=64)]
    workers: Annotated[int, Field(ge=1, le=64)] | None  # processes; null: one a core, in evaluations one fewer

    def __post_init__(self) -> None:
        rows, columns = SCREEN
        up, right, down, left = self.crop
        if not (0 <= up < down <= rows and 0 <= left < right <= columns):
            raise ConfigError(
                f"env.crop={list(self.crop)}: (UP, RIGHT, DOWN, LEFT) leaves nothing or leaves the screen; "
                f"need 0 <= UP < DOWN <= {rows} and 0 <= LEFT < RIGHT <= {columns}, as [0, {columns}, {rows}, 0]"
            )
        if isinstance(self.frameskip, tuple) and self.frameskip[0] >= self.frameskip[1]:
            raise ConfigError(
                f"env.frameskip={list(self.frameskip)}: drawn from [low, high), so low must be under high"
            )
        if self.noop_max >= self.max_frames:
            raise ConfigError(f"env.noop_max={self.noop_max}: leaves nothing of env.max_frames={self.max_frames}")
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
    """Raise ConfigError for an unknown game, unless it may come from one of a run's plugins."""
    if env.game is None and not (info.data.get("plugins") and re.fullmatch(r"(ALE/)?[A-Z][A-Za-z0-9]*-v\d", env.id)):
        ids = [each for name in known("env") for each in game_ids(name)]
        raise ConfigError(f"env.id={env.id}: no such choice; {nearest(env.id, ids)}")
    return env


Env = Annotated[EnvConfig, AfterValidator(_check_game)]
"""An environment whose game is known, or a plugin's that the run was trained with."""


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

    tau: Annotated[float, Field(ge=1e-6, le=1)]  # share of the policy network taken over; less is lost in float32
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
    """RMSProp, centred as in the DQN papers when asked."""

    name: Literal["rmsprop"]
    lr: Rate
    alpha: Annotated[float, Field(ge=0, lt=1)]
    eps: Annotated[float, Field(ge=1e-20, le=1)]
    momentum: Annotated[float, Field(ge=0, lt=1)]
    centered: bool


OptimizerConfig = Annotated[AdamConfig | RmsPropConfig, Field(discriminator="name")]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PluginConfig:
    """A plugin that a run was trained with, as it was then."""

    version: Annotated[str, Field(pattern=r"^[\w.+!-]{1,60}$")] | None  # of the distribution; null: a file
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


Plugins = dict[Annotated[str, Field(pattern=r"^[A-Za-z0-9_][\w.-]{0,99}$")], PluginConfig]

_MOST_SETTINGS = 100  # of a component that is not known here
_Value = bool | Annotated[int, Field(ge=-(2**63), lt=2**63)] | float | str | None
_BASES: dict[str, type[ComponentConfig]] = {"model": ModelConfig, "objective": ObjectiveConfig}


@cache
def _schema(component: Component) -> TypeAdapter[ComponentConfig]:
    """Return the schema of a component whose class is known."""
    types = {each.name: each.type for each in component.settings}
    defaults = {each.name: each.default for each in component.settings if each.default is not MISSING}
    return _extended(component.kind, types, {**defaults, "component": component})


def _unknown_schema(kind: str, names: Collection[str]) -> TypeAdapter[ComponentConfig]:
    """Return the schema of a component whose class is not known here: plain values, which can be compared."""
    if len(names) > _MOST_SETTINGS or any(iskeyword(name) or not re.fullmatch(NAME, name) for name in names):
        raise ConfigError(f"{kind}: has no settings of a component, or more than {_MOST_SETTINGS}")
    return _extended(kind, dict.fromkeys(names, _Value | list[_Value]), {})


def _extended(kind: str, types: Mapping[str, Any], attributes: Mapping[str, Any]) -> TypeAdapter[ComponentConfig]:
    body = {**attributes, "own": tuple(types), "__annotations__": dict(types), "__module__": __name__}
    schema: Any = dataclass(config=STRICT, kw_only=True, frozen=True)(
        type("Settings", (_BASES.get(kind, ComponentConfig),), body)
    )
    return TypeAdapter(schema)


def _component(kind: str) -> PlainValidator:
    """Return the validator of a component's config, which checks it by the settings of the component's class."""
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
    """Write the admitted plugins whose components a composed config names into it."""
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
    """When and on how much the learner learns."""

    learn_every: Count  # steps
    learn_start: Annotated[int, Field(ge=0, le=10**12)]  # transitions in the memory
    batch_size: Annotated[int, Field(ge=1, le=2**24)]  # transitions
    precision: Literal["auto", "fp32", "bf16"]
    ema: Annotated[int, Field(ge=10, le=10**7)] | None = None  # updates averaged for an evaluation; null: the latest
    weights: Annotated[str, Field(pattern=PINNED)] | None = None  # FOLDER@DIGEST of exported ones; null: random ones

    @property
    def pinned(self) -> tuple[str, str] | None:
        """The folder of the initial weights, and the first digits of their SHA-256."""
        folder, _, digits = (self.weights or "").rpartition("@")
        return (folder, digits) if folder else None


@dataclass(config=STRICT, kw_only=True, frozen=True)
class ReplayConfig:
    """The replay memory's two bounds."""

    capacity: Annotated[int, Field(ge=16, le=10**9)]  # observations
    max_bytes: Annotated[int, Field(ge=2**20, le=2**50)]  # bytes, everything included


@dataclass(config=STRICT, kw_only=True, frozen=True)
class EvaluationConfig:
    """Episodes at a fixed epsilon, played without touching the training."""

    episodes: Episodes
    interim_episodes: Episodes | None  # of an evaluation amid the training; null: as many as at its end
    epsilon: Probability
    every_episodes: Count | None  # training episodes between evaluations; null: none of them
    every_steps: Count | None  # training steps between evaluations; null: none of them
    at_end: bool
    num_envs: Annotated[int, Field(ge=1, le=_MOST_GAMES)] | None  # episodes side by side; null: `at_once` chooses
    seed: Seed
    video: Literal["first_minute", "best_minute", "all"] | bool  # of the best episode; true is its first minute

    @property
    def at_once(self) -> int:
        """Episodes played side by side: many, in rounds of one length that leave no emulator idle."""
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
    commit_seconds: Annotated[float, Field(gt=0, le=1e9)]  # seconds between two checkpoints at the most

    def __post_init__(self) -> None:
        check_server("tracking.uri", self.uri)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class BudgetConfig:
    """Limits of this command, which do not change the experiment."""

    steps: Count | None
    flops: Annotated[float, Field(gt=0)] | None = None  # of updates; no key of older runs and cards
    wall_clock: str | Count | None  # a number alone is in seconds
    forecast: Literal["refuse", "warn", "off"]

    def __post_init__(self) -> None:
        check_time("budget.wall_clock", self.wall_clock, "90s, 10min or 3h")

    @property
    def limits(self) -> dict[str, float]:
        """What ends a training, by key."""
        limits = {"budget.steps": self.steps, "budget.flops": self.flops}
        return {key: limit for key, limit in limits.items() if limit is not None}

    @property
    def seconds(self) -> int | None:
        return None if self.wall_clock is None else seconds(self.wall_clock)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class PathsConfig:
    """Where everything that a command writes goes."""

    outputs: Annotated[str, Field(min_length=1)]


@dataclass(config=STRICT, kw_only=True, frozen=True)
class BaselineAgentConfig:
    """A player without a network."""

    name: Literal["random", "constant"]
    action: Annotated[int, Field(ge=0, le=17)]  # of the constant player, by its place among the game's


@dataclass(config=STRICT, kw_only=True, frozen=True)
class Config:
    """One training experiment."""

    plugins: Plugins = field(default_factory=dict)  # that its components are of; first, since the others need it
    seed: Seed
    resume: Literal["auto", "never", "must"]
    device: Device
    threads: Annotated[int, Field(ge=1, le=256)] | None
    compile: bool = False  # as in runs and cards from before there was the key
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
        # An environment's newest observation has no successor yet, and its oldest have no whole stack any more.
        most = self.replay.capacity - self.env.num_envs * (self.env.lags[-1] + 2)
        if self.training.learn_start >= most:
            raise ConfigError(
                f"training.learn_start={self.training.learn_start}: nothing would be learned, since the memory of "
                f"replay.capacity={self.replay.capacity} holds no more transitions; need less than {most}"
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
            raise ConfigError("phase: all phases must have their length in the same unit, episodes or steps")

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
        tree["evaluation"]["video"] = bool(tree["evaluation"]["video"])  # whichever part is filmed
        if self.training.pinned is not None:
            _, tree["training"]["weights"] = self.training.pinned  # wherever they lie
        # Keys at their defaults are left out: a run from before there was the key stays itself.
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
        """Return ten hexadecimal digits that are equal exactly for runs with the same `science`."""
        return digest(self.science())

    def run_name(self) -> str:
        """Return a readable name that ends in the identity."""
        samplers = [phase.sampler for phase in self.phase.values()]
        return f"{self.model.name}-{'-'.join(dict.fromkeys(samplers))}-s{self.seed}-{self.identity()}"
