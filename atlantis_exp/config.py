"""The schema of a composed experiment: types, ranges and cross-field checks.

A plain nested mapping enters, a checked `Config` leaves. Knows no Hydra and no torch, so that a config read back from a
stored run passes through the same door as one typed on a command line.
"""

import dataclasses
import difflib
import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeVar

from pydantic import ConfigDict, Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass
from pydantic_core import ErrorDetails

_STRICT = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False)

Count = Annotated[int, Field(ge=1)]
Size = Annotated[int, Field(ge=8, le=210)]
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Probability = Annotated[float, Field(ge=0, le=1)]
Share = Annotated[float, Field(gt=0, lt=1)]

SCREEN = (210, 160)  # rows, columns of the emulator's screen


class ConfigError(ValueError):
    """A user's mistake in a config, in one line that names the key and the nearest valid choice."""


def nearest(word: str, choices: Iterable[str]) -> str:
    """The end of an error line: the closest of `choices`, then all of them when they are few."""
    choices = sorted(choices)
    close = difflib.get_close_matches(word, choices, n=1, cutoff=0.5)
    listed = f" (valid: {', '.join(choices)})" if len(choices) <= 12 else ""
    return (f"did you mean '{close[0]}'?" if close else "no valid choice is near") + listed


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class EnvConfig:
    """One Atlantis and how its screen becomes an observation (report figure 2.3)."""

    id: Literal["Atlantis-v0", "ALE/Atlantis-v5"]
    frameskip: Count | tuple[Count, Count]  # frames a step; a pair is drawn from [low, high)
    sticky: Probability
    max_frames: Count  # frames an episode
    max_steps: Count | None  # steps an episode
    noop_max: Annotated[int, Field(ge=0, le=30)]  # steps
    max_pool: bool
    crop: tuple[int, int, int, int]  # UP, RIGHT, DOWN, LEFT: screen[UP:DOWN, LEFT:RIGHT]
    size: Size  # pixels
    stack: Annotated[int, Field(ge=1, le=8)]  # observations
    num_envs: Annotated[int, Field(ge=1, le=64)]
    workers: Annotated[int, Field(ge=1, le=64)] | None  # processes; null: one a core


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class _NetworkConfig:
    name: str
    input_size: Size  # pixels
    head: Literal["plain", "dueling", "quantile"]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class CnnConfig(_NetworkConfig):
    """DQNCnn, report figure 2.1."""

    name: Literal["cnn"]
    smallest: ClassVar[int] = 36  # pixels that three unpadded convolutions need


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ResNetConfig(_NetworkConfig):
    """ResNetDQN, report figure 2.2."""

    name: Literal["resnet"]
    smallest: ClassVar[int] = 15  # pixels that the unpadded stem needs


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ResNetFastConfig(_NetworkConfig):
    """ResNetFast, a residual network at a tenth of ResNetDQN's cost."""

    name: Literal["resnet_fast"]
    smallest: ClassVar[int] = 8  # pixels that the unpadded stem needs


ModelConfig = Annotated[CnnConfig | ResNetConfig | ResNetFastConfig, Field(discriminator="name")]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class TargetConfig:
    """The target network: how it starts, follows and normalises."""

    tau: Annotated[float, Field(gt=0, le=1)]  # share of the policy network taken over
    every: Count  # updates
    mode: Literal["eval", "train"]
    start: Literal["copy", "independent"]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class _BootstrapConfig:
    name: str
    gamma: Annotated[float, Field(ge=0, lt=1)]
    n_step: Count  # rewards before the bootstrap
    reward_scale: Positive
    reward_clip: Positive | None  # after scaling; null: not clipped
    terminal_on_life_loss: bool
    target: TargetConfig


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class DqnConfig(_BootstrapConfig):
    """The bootstrap target of one value, and its loss."""

    name: Literal["dqn", "double_dqn"]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class QuantileConfig(_BootstrapConfig):
    """The bootstrap target of a distribution's quantiles, and its loss."""

    name: Literal["quantile", "double_quantile"]
    quantiles: Count


ObjectiveConfig = Annotated[DqnConfig | QuantileConfig, Field(discriminator="name")]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class AdamConfig:
    """Adam, or AdamW with decoupled weight decay."""

    name: Literal["adam", "adamw"]
    lr: Positive
    betas: tuple[Annotated[float, Field(ge=0, lt=1)], Annotated[float, Field(ge=0, lt=1)]]
    eps: Positive
    weight_decay: NonNegative


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class RmsPropConfig:
    """RMSProp, centred as in the DQN papers when asked."""

    name: Literal["rmsprop"]
    lr: Positive
    alpha: Annotated[float, Field(ge=0, lt=1)]
    eps: Positive
    momentum: Annotated[float, Field(ge=0, lt=1)]
    centered: bool


OptimizerConfig = Annotated[AdamConfig | RmsPropConfig, Field(discriminator="name")]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ExponentialConfig:
    """Exponential decay of epsilon, report figure 4.1."""

    name: Literal["exponential"]
    start: Probability
    end: Probability
    decay: Positive  # share of the training


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class LinearConfig:
    """Linear decay."""

    name: Literal["linear"]
    start: Probability
    end: Probability
    duration: Positive  # share of the training


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class LinearStepsConfig:
    """Linear decay of epsilon over a number of steps."""

    name: Literal["linear_steps"]
    start: Probability
    end: Probability
    steps: Count


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ConstantConfig:
    """The same value throughout."""

    name: Literal["constant"]
    value: Probability


EpsilonConfig = Annotated[
    ExponentialConfig | LinearConfig | LinearStepsConfig | ConstantConfig, Field(discriminator="name")
]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class OneCycleConfig:
    """1Cycle (Smith and Topin 2018)."""

    name: Literal["one_cycle"]
    start: Probability
    end: Probability
    rise: Share


LrScheduleConfig = Annotated[ConstantConfig | LinearConfig | OneCycleConfig, Field(discriminator="name")]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class UniformConfig:
    """Every stored transition alike."""

    name: Literal["uniform"]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class TopHalfConfig:
    """Draw `oversample` batches, keep the one with the highest rewards (report section 4)."""

    name: Literal["top_half"]
    oversample: Annotated[int, Field(ge=2, le=64)]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class PrioritizedConfig:
    """Likelier where the last error was larger (Schaul et al. 2016, proportional)."""

    name: Literal["prioritized"]
    alpha: Probability
    beta: Probability


SamplerConfig = Annotated[UniformConfig | TopHalfConfig | PrioritizedConfig, Field(discriminator="name")]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class PhaseConfig:
    """A stretch of training with its own learning rate and sampler; its length in episodes or in steps."""

    episodes: Count | None
    steps: Count | None
    lr: Positive
    sampler: str


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class TrainingConfig:
    """When and on how much the learner learns."""

    learn_every: Count  # steps
    learn_start: Annotated[int, Field(ge=0)]  # transitions in the memory
    batch_size: Count  # transitions
    precision: Literal["auto", "fp32", "bf16"]
    ema: Annotated[int, Field(ge=10)] | None = None  # updates over which evaluated weights are averaged; null: latest


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ReplayConfig:
    """The replay memory's two bounds."""

    capacity: Annotated[int, Field(ge=16)]  # observations
    max_bytes: Annotated[int, Field(ge=2**20)]  # bytes, everything included


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class EvaluationConfig:
    """Episodes at a fixed epsilon, beside the training and without touching it."""

    episodes: Count
    interim_episodes: Count | None  # of an evaluation amid the training; null: as many as at its end
    epsilon: Probability
    every_episodes: Count | None  # training episodes between evaluations; null: none of them
    every_steps: Count | None  # training steps between evaluations; null: none of them
    at_end: bool
    num_envs: Annotated[int, Field(ge=1, le=64)]
    seed: Annotated[int, Field(ge=0)]
    video: bool


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class TrackingConfig:
    """Where and how densely a run is recorded."""

    name: Literal["mlflow", "server", "none"]
    uri: str | None  # of an MLflow server; null: the outputs folder's own database
    experiment: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9 _.-]{0,99}$")]
    every_steps: Count  # steps between two points of a curve
    histogram_episodes: Count  # episodes in a window's score histogram
    commit_episodes: Count  # episodes between two checkpoints
    commit_seconds: Positive  # seconds between two checkpoints at the most

    def __post_init__(self) -> None:
        _check_server("tracking.uri", self.uri)


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class BudgetConfig:
    """Limits of this command that are no part of the experiment."""

    steps: Count | None
    wall_clock: str | Count | None  # a number alone is in seconds
    forecast: Literal["refuse", "warn", "off"]

    def __post_init__(self) -> None:
        if self.seconds == 0:
            raise ConfigError(f"budget.wall_clock={self.wall_clock}: no time; write it as in 90s, 10min, 3h or 1h30m")

    @property
    def seconds(self) -> int | None:
        """`wall_clock` in seconds, 0 where it is not readable."""
        return None if self.wall_clock is None else _seconds(self.wall_clock)


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class PathsConfig:
    """Where everything that a command writes goes."""

    outputs: Annotated[str, Field(min_length=1)]


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class BaselineAgentConfig:
    """A player without a network."""

    name: Literal["random", "constant"]
    action: Annotated[int, Field(ge=0, le=3)]  # of the constant player


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class Config:
    """One training experiment."""

    seed: Annotated[int, Field(ge=0, lt=2**63)]
    resume: Literal["auto", "never", "must"]
    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
    threads: Annotated[int, Field(ge=1, le=256)] | None
    compile: bool = False  # as in runs and cards from before there was the key
    training: TrainingConfig
    replay: ReplayConfig
    env: EnvConfig
    model: ModelConfig
    objective: ObjectiveConfig
    optimizer: OptimizerConfig
    lr_schedule: LrScheduleConfig
    epsilon: EpsilonConfig
    samplers: dict[str, SamplerConfig]
    sampler: SamplerConfig
    phase: dict[str, PhaseConfig]
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    budget: BudgetConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        _check_env(self.env)
        if self.env.size < self.model.smallest:
            raise ConfigError(
                f"env.size={self.env.size}: model '{self.model.name}' needs at least {self.model.smallest} pixels; "
                f"it is made for {self.model.input_size}"
            )
        if isinstance(self.objective, QuantileConfig) != (self.model.head == "quantile"):
            raise ConfigError(
                f"model.head={self.model.head}: does not go with objective.name={self.objective.name}; "
                "model.head=quantile and objective=quantile or double_quantile need each other"
            )
        if self.training.batch_size > self.replay.capacity:
            raise ConfigError(
                f"training.batch_size={self.training.batch_size}: larger than replay.capacity={self.replay.capacity}; "
                f"at most {self.replay.capacity}"
            )
        # An environment's newest observation has no successor yet, and its oldest have no whole stack any more.
        most = self.replay.capacity - self.env.num_envs * (self.env.stack + 1)
        if self.training.learn_start >= most:
            raise ConfigError(
                f"training.learn_start={self.training.learn_start}: nothing would be learned, since the memory of "
                f"replay.capacity={self.replay.capacity} holds no more transitions; need less than {most}"
            )
        if not self.phase:
            raise ConfigError("phase: at least one phase is needed, as in conf/phase/single.yaml")
        for name, phase in self.phase.items():
            if (phase.episodes is None) == (phase.steps is None):
                raise ConfigError(f"phase.{name}: set either episodes or steps, the other to null")
            if phase.sampler not in self.samplers and phase.sampler != self.sampler.name:
                raise ConfigError(
                    f"phase.{name}.sampler={phase.sampler}: no such sampler; {nearest(phase.sampler, self.samplers)}"
                )
        if len({phase.steps is None for phase in self.phase.values()}) > 1:
            raise ConfigError("phase: all phases must have their length in the same unit, episodes or steps")

    def sampler_of(self, phase: str) -> UniformConfig | TopHalfConfig | PrioritizedConfig:
        """The sampler that a phase names; the chosen `sampler` goes before the library's of the same name."""
        name = self.phase[phase].sampler
        return self.sampler if name == self.sampler.name else self.samplers[name]

    def science(self) -> dict[str, Any]:
        """What decides the run's numbers: all but tracking, budget, places, devices and process counts."""
        tree = to_dict(self)
        for key in ("resume", "device", "threads", "compile", "tracking", "budget", "paths", "samplers", "sampler"):
            del tree[key]
        del tree["env"]["workers"]
        if tree["training"]["ema"] is None:  # a run from before there was the key stays itself
            del tree["training"]["ema"]
        # A list, since the order of phases counts and their names do not.
        tree["phase"] = [{**phase, "sampler": to_dict(self.sampler_of(name))} for name, phase in tree["phase"].items()]
        return tree

    def identity(self) -> str:
        """Ten hexadecimal digits that are equal exactly for runs with the same `science`."""
        return digest(self.science())

    def run_name(self) -> str:
        """What differs, readably, and the identity, which alone decides."""
        samplers = [phase.sampler for phase in self.phase.values()]
        return f"{self.model.name}-{'-'.join(dict.fromkeys(samplers))}-s{self.seed}-{self.identity()}"


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class PruningConfig:
    """When a trial is cut short: below the median of the others' at the same evaluation."""

    trials: Count | None  # that have ended before any is cut short; null: none ever is
    evaluations: Annotated[int, Field(ge=0)]  # of its own that a trial is spared


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class SearchConfig(Config):
    """A search for the best values of some keys of a training's config, which is the rest of this one."""

    trials: Count
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,59}$")] | None
    startup: Annotated[int, Field(ge=0)]  # trials drawn at random
    pruning: PruningConfig
    space: dict[str, str]  # what is searched of a key, in Hydra's words: `tag(log, interval(1e-5, 1e-3))`

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.evaluation.at_end:
            raise ConfigError("evaluation.at_end=false: a search compares its trials by the evaluation at their end")


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class EvaluateConfig:
    """Evaluation of a stored run, or of exported weights."""

    run: str
    weights: str  # latest, best or a folder
    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        if self.weights not in ("latest", "best") and "/" not in self.weights:
            raise ConfigError(
                f"weights={self.weights}: neither a run's nor a folder, as in pretrained/NAME; "
                f"{nearest(self.weights, ('latest', 'best'))}"
            )


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ExportConfig:
    """A stored run's network as a folder to hand on."""

    run: str
    weights: Literal["latest", "best"]
    to: Annotated[str, Field(min_length=1)] | None
    device: Annotated[str, Field(pattern=r"^(auto|cpu|cuda(:\d+)?)$")]
    evaluation: EvaluationConfig
    paths: PathsConfig


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class CardConfig:
    """What stands beside exported weights: which training they are of, and what they score."""

    format: Literal[1]
    run: str
    weights: Literal["latest", "best"]
    step: Annotated[int, Field(ge=0)]  # of the training
    reached: dict[str, float]  # episodes, frames, updates and hours, at the last point of the curve until then
    made: dict[str, str]  # command, commit and versions of the training's last session
    precision: Literal["float32", "float16"]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]  # of weights.safetensors
    config: Config
    evaluation: EvaluationConfig  # that gave the scores
    scores: Annotated[list[float], Field(min_length=1)]  # an episode


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class BaselineConfig:
    """A tracked run of a player without a network."""

    agent: BaselineAgentConfig
    env: EnvConfig
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        _check_env(self.env)

    def identity(self) -> str:
        """Ten hexadecimal digits that are equal exactly for baselines with the same numbers."""
        env = to_dict(self.env)
        del env["workers"]
        return digest({"agent": to_dict(self.agent), "env": env, "evaluation": to_dict(self.evaluation)})

    def run_name(self) -> str:
        """The player, its action where it has one, and the identity."""
        action = f"{self.agent.action}" if self.agent.name == "constant" else ""
        return f"{self.agent.name}{action}-{self.env.id.rsplit('/')[-1]}-{self.identity()}"


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class PlayConfig:
    """A tracked run of a person."""

    player: Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,40}$")]
    scale: Annotated[int, Field(ge=1, le=10)]  # window pixels a screen pixel
    env: EnvConfig
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        _check_env(self.env)


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class QueryConfig:
    """The environment query of report figures 1.1 to 1.3."""

    env: EnvConfig

    def __post_init__(self) -> None:
        _check_env(self.env)


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class UiConfig:
    """The MLflow UI on the local store."""

    port: Annotated[int, Field(ge=1024, le=65535)]
    paths: PathsConfig


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class SyncConfig:
    """Run folders and an MLflow store or server, brought up to each other."""

    every: str | Count | None  # time between two looks, a number alone in seconds; null: one look
    to: str | None  # a server's address: this one instead of the store that `tracking` names
    from_: Annotated[str | None, Field(alias="from")]  # a server's address: its runs come here
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        _check_server("to", self.to)
        _check_server("from", self.from_)
        if self.to and self.from_:
            raise ConfigError(f"from={self.from_}: goes the other way than to={self.to}; choose one")
        if self.tracking.name == "none":
            raise ConfigError("tracking=none: names no store to bring up to date; choose tracking=mlflow or server")
        if self.seconds == 0:
            raise ConfigError(f"every={self.every}: no time; write it as in 30s, 10min or 1h30m")

    @property
    def seconds(self) -> int | None:
        """`every` in seconds, 0 where it is not readable."""
        return None if self.every is None else _seconds(self.every)


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class ReportConfig:
    """The table of what a store holds."""

    paths: PathsConfig


@dataclass(config=_STRICT, kw_only=True, frozen=True)
class CompareConfig:
    """Finished runs as groups, and what tells them apart."""

    by: list[str]  # config keys
    runs: list[str]  # names, starts of names or patterns; none: all
    where: list[str]  # KEY=VALUE; none: all
    at_epsilon: Probability | None  # of the evaluations; null: each run's latest
    resamples: Annotated[int, Field(ge=100, le=1_000_000)]  # bootstrap samples
    seed: Annotated[int, Field(ge=0)]  # of the bootstrap
    tracking: TrackingConfig
    paths: PathsConfig


def _seconds(text: str | int) -> int:
    """Seconds of a time such as 90, 90s, 10min, 3h or 1h30m, 0 where it is not readable."""
    parts = re.fullmatch(r"(?:(\d+)h)?(?:(\d+)m(?:in)?)?(?:(\d+)s?)?", str(text))
    hours, minutes, seconds = (int(part or 0) for part in parts.groups()) if parts else (0, 0, 0)
    return 3600 * hours + 60 * minutes + seconds


def _check_server(key: str, uri: str | None) -> None:
    # It is written into files, which is no place for a password.
    if uri is not None and not re.fullmatch(r"https?://[^\s@?#]+", uri):
        raise ConfigError(
            f"{key}: should be null or a server's address, as in http://127.0.0.1:5000; user and password "
            "belong into the environment, as MLFLOW_TRACKING_USERNAME and MLFLOW_TRACKING_PASSWORD"
        )


def _check_env(env: EnvConfig) -> None:
    rows, columns = SCREEN
    up, right, down, left = env.crop
    if not (0 <= up < down <= rows and 0 <= left < right <= columns):
        raise ConfigError(
            f"env.crop={list(env.crop)}: (UP, RIGHT, DOWN, LEFT) leaves nothing or leaves the screen; "
            f"need 0 <= UP < DOWN <= {rows} and 0 <= LEFT < RIGHT <= {columns}, as [0, {columns}, {rows}, 0]"
        )
    if isinstance(env.frameskip, tuple) and env.frameskip[0] >= env.frameskip[1]:
        raise ConfigError(f"env.frameskip={list(env.frameskip)}: drawn from [low, high), so low must be under high")
    if env.max_pool and (isinstance(env.frameskip, tuple) or env.frameskip < 2):
        raise ConfigError("env.max_pool=true: needs one fixed env.frameskip of at least 2, as in env=atlantis_standard")


T = TypeVar("T")


def parse(schema: type[T], tree: Mapping[str, Any]) -> T:
    """Check a plain nested mapping against a schema class of this module.

    Raises:
        ConfigError: one line for the first fault, with its dotted key and the nearest valid choice.
    """
    try:
        # Through JSON: its strict mode takes a list for a tuple, which is all that YAML can write.
        return TypeAdapter(schema).validate_json(json.dumps(tree))
    except ValidationError as error:
        raise ConfigError(_explain(error.errors(include_url=False), tree)) from None


def to_dict(config: Any) -> dict[str, Any]:
    """A config as plain JSON-able containers."""
    tree: dict[str, Any] = json.loads(json.dumps(dataclasses.asdict(config)))
    return tree


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Dotted keys to leaves; lists are leaves."""
    leaves: dict[str, Any] = {}
    for key, value in tree.items():
        if isinstance(value, Mapping):
            leaves |= flatten(value, f"{prefix}{key}.")
        else:
            leaves[f"{prefix}{key}"] = value
    return leaves


def digest(tree: Mapping[str, Any]) -> str:
    """Ten hexadecimal digits of a mapping's canonical JSON."""
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:10]


def _explain(faults: list[ErrorDetails], tree: Mapping[str, Any]) -> str:
    """One line for the first fault of a tree, or for an unknown key if there is one."""
    if isinstance(cause := faults[0].get("ctx", {}).get("error"), ConfigError):
        return str(cause)
    # A misspelt key shows twice, as one missing and one extra: the extra one is the user's.
    fault = min(faults, key=lambda fault: fault["type"] != "unexpected_keyword_argument")
    path, siblings, node = _locate(fault, tree)
    key, kind = ".".join(path), fault["type"]
    if kind == "unexpected_keyword_argument":
        return f"{key}: no such key; {nearest(path[-1], set(siblings) - {path[-1]})}"
    if kind in ("missing_argument", "missing"):
        return f"{key}: missing, and it has no default"
    if kind == "union_tag_invalid":
        tags = str(fault["ctx"]["expected_tags"]).replace("'", "").split(", ")
        given = str(fault["ctx"]["tag"])
        return f"{key}.name={given}: no such choice; {nearest(given, tags)}"
    if kind == "literal_error":
        choices = str(fault["ctx"]["expected"]).replace("'", "").replace(" or ", ", ").split(", ")
        return f"{key}={node}: no such choice; {nearest(str(node), choices)}"
    # A key that may hold one type or another has a fault for each.
    messages = [other["msg"] for other in faults if _locate(other, tree)[0] == path]
    alternatives = dict.fromkeys(re.sub(r"^\w+ should ", "", message) for message in messages)
    return f"{key}={json.dumps(node)}: should {' or '.join(alternatives)}"


def _locate(fault: ErrorDetails, tree: Mapping[str, Any]) -> tuple[list[str], Mapping[str, Any], Any]:
    """A fault's key as the user knows it, the mapping it stands in, and its value."""
    path: list[str] = []
    node: Any = tree
    siblings: Mapping[str, Any] = tree
    for part in fault["loc"]:
        # Pydantic puts the name of a union's member into the path; only what the tree really holds is a key.
        if isinstance(node, Mapping):
            siblings = node
            if part in node:
                node = node[str(part)]
                path.append(str(part))
            elif fault["type"] in ("missing_argument", "missing") and part == fault["loc"][-1]:
                path.append(str(part))
        elif isinstance(node, list) and isinstance(part, int):
            node = node[part] if part < len(node) else None
            path.append(str(part))
    return path, siblings, node
