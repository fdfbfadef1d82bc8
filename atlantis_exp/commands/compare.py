"""`python -m atlantis_exp compare by=model,sampler`: decide which group of runs is better."""

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp import terminal
from atlantis_exp.checking import absolute, share
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.components import Probability
from atlantis_exp.config import STRICT, Format, PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError

if TYPE_CHECKING:
    from atlantis_exp.comparison.tables import Comparison
    from atlantis_exp.comparison.verdict import Question


@dataclass(config=STRICT, kw_only=True, frozen=True)
class QuestionConfig:
    """A question about groups, but for the keys that they differ in."""

    score: Literal["last", "training"]
    window: str | float  # of score=training, a share of the steps
    baseline: str | None  # a value of one of the keys, or a group; null: all pairs
    delta: str | float | None  # a difference that does not matter: 5% of a score, or points
    seeds: Annotated[int, Field(ge=5, le=10_000)]  # a group, at the last look
    error: Annotated[float, Field(ge=1e-6, lt=1)]  # probability of any false verdict
    format: Format

    def __post_init__(self) -> None:
        margin(self.delta)
        share("window", self.window)

    def question(self, by: Iterable[str]) -> "Question":
        """Return the question about groups that differ in these keys."""
        from atlantis_exp.comparison.verdict import Question

        delta, relative = margin(self.delta)
        window = share("window", self.window)
        return Question(tuple(by), self.seeds, self.error, delta, relative, self.baseline, self.score, window)


@dataclass(config=STRICT, kw_only=True, frozen=True)
class CompareConfig(QuestionConfig):
    """Groups of finished runs, and the question about them."""

    by: list[str]  # config keys
    runs: list[str]  # names, starts of names or patterns; none: all
    where: list[str]  # KEY=VALUE; none: all
    at_epsilon: Probability | None  # of the evaluations; null: each run's latest
    scores: Annotated[str, Field(min_length=1)] | None  # a CSV file in place of runs
    columns: list[str]  # group=NAME, seed=NAME, score=NAME, of that file
    look: Literal["due", "now"]
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        super().__post_init__()
        of_runs = {"by": ["model"], "score": "last", "at_epsilon": None, "runs": [], "where": []}  # defaults
        for key, value in of_runs.items():
            if self.scores is not None and getattr(self, key) != value:
                raise ConfigError(f"{key}: applies to runs, not to scores={self.scores}; use columns=group=NAME")
        named(self.columns)


def margin(delta: str | float | None) -> tuple[float | None, bool]:
    """Parse the difference that does not matter; return it and whether it is a share. Raises: ConfigError."""
    if delta is None:
        return None, False
    text = delta if isinstance(delta, str) else f"{delta:.15g}"
    try:
        value = float(text.removesuffix("%")) / (100 if text.endswith("%") else 1)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise ConfigError(f"delta={text}: write a share of a score, as in delta=5%, or points, as in delta=500")
    return value, text.endswith("%")


def named(columns: Iterable[str]) -> dict[str, str]:
    """Parse the names of a table's columns for group, seed and score. Raises: ConfigError."""
    names: dict[str, str] = {}
    for key, _, name in (text.partition("=") for text in columns):
        if key not in ("group", "seed", "score") or not name or names.setdefault(key, name) != name:
            raise ConfigError(f"columns={key}={name}: write group=NAME, seed=NAME and score=NAME, each at most once")
    return names


def list_out(arguments: Iterable[str], keys: str = "by|columns|runs|where") -> list[str]:
    """Allow lists without brackets, as in `by=model,sampler`, and quote the baseline."""
    # Hydra would read the commas as a sweep, a second `=` as a mistake, some commits as numbers; it refuses `lr=0.001`.
    quoted = (re.sub(r"^baseline=(?!null$)([^'\"]+)$", r"baseline='\1'", argument) for argument in arguments)
    return [re.sub(rf"^({keys})=([^\[].*)$", listed, argument) for argument in quoted]


def listed(match: re.Match[str]) -> str:
    """Rewrite a match of KEY=a,b as KEY=['a','b']."""
    items = (f"'{item}'" for item in re.split(r",(?![^\[]*\])", match[2].replace("'", "")))
    return f"{match[1]}=[{','.join(items)}]"


def _work(asked: Asked[CompareConfig]) -> Callable[[], object]:
    from atlantis_exp.sessions.comparing import Choice, compare, refuse_worse_commits

    config = asked.config
    scores = None if config.scores is None else absolute("scores", config.scores)
    choice = Choice(
        *(Path(config.paths.outputs), config.runs, config.where, config.at_epsilon), scores, named(config.columns)
    )

    def call() -> "Comparison":
        now = config.look == "now"
        comparison = compare(config.question(config.by), choice, config.tracking, asked.command, look_now=now)
        terminal.document(comparison.document("compare").model_dump_json())
        refuse_worse_commits(comparison, config.baseline)
        return comparison

    return call


VERB = Verb("compare", CompareConfig, _work, rewrite=list_out)
