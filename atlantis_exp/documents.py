"""The JSON documents that verbs print with `format=json`; docs/json.md has their schema.

A field that is added leaves the version as it is; one that goes, or means something else, makes it one more.
"""

from math import isfinite
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, Field, TypeAdapter

Number = Annotated[
    float | None, BeforeValidator(lambda value: value if isinstance(value, int) or isfinite(value or 0) else None)
]
"""A number, null where there is none."""
Said = Literal["better", "worse", "equivalent", "not decided"]


class Document(BaseModel):
    """What all documents have."""

    version: Literal[1] = 1


class Question(BaseModel):
    """What was asked."""

    by: list[str] = Field(description="keys that tell groups apart; of a table of scores, group")
    score: Literal["last", "training", "file"]
    window: float | None = Field(description="share of the steps that score=training is about")
    measure: str = Field(description="what a seed's score is, in words")
    seeds: int = Field(description="a group, at the last look")
    error: float = Field(description="probability of any false verdict")
    delta: float | None
    relative: bool = Field(description="whether delta is a share of a score")
    baseline: str | None


class GroupScore(BaseModel):
    """A group's score, or that of a key's value."""

    family: str = Field(description="the key, or all keys that differ")
    group: str
    score: Number
    low: Number = Field(description="95 % interval; null for fewer than five seeds")
    high: Number
    seeds: dict[int, float] = Field(description="score by seed")


class PairVerdict(BaseModel):
    """What is known of one group's mean less another's."""

    family: str
    group: str
    other: str
    said: Said = Field(description="of the group, against the other")
    difference: Number
    low: Number = Field(description="the interval that the verdict rests on")
    high: Number
    seeds: int = Field(description="of each group at that look; 0 before the first")


class Looks(BaseModel):
    """The plan of a family, and where it stands."""

    family: str
    planned: list[int] = Field(description="seeds a group")
    taken: list[int]
    next: int | None = Field(description="null after the last, or where all is decided")
    error: float
    spent: float


class Compared(Document):
    """The answer of `compare` and `decide`."""

    verb: Literal["compare", "decide"]
    question: Question
    decided: bool = Field(description="whether no pair is left undecided; false where nothing is compared")
    verdict: str
    others: list[str] = Field(description="the answers by the other keys")
    caveats: list[str]
    notes: list[str]
    verdicts: list[PairVerdict]
    scores: list[GroupScore]
    looks: list[Looks]


class Reported(BaseModel):
    """A run and its last evaluation."""

    run: str
    state: str
    steps: int = Field(description="of training; of an unfinished run, at its last evaluation")
    evaluated_at: int | None = Field(description="step of the evaluation; null where there is none")
    evaluation: dict[str, float] = Field(description="its metrics, as in MLflow")


class Report(Document):
    """The answer of `report`."""

    verb: Literal["report"] = "report"
    runs: list[Reported]


class Query(Document):
    """The answer of `query`."""

    verb: Literal["query"] = "query"
    environment: dict[str, Any] = Field(description="what Gymnasium says")
    config: dict[str, Any] = Field(description="the keys under env")


class Trial(BaseModel):
    """A contract that was tried."""

    component: str
    contract: str
    kept: bool
    because: str = Field(description="why it is broken, else empty")


class Cost(BaseModel):
    """What a training costs on this machine."""

    component: str
    pixels: int
    parameters: int
    flops_per_sample: float
    updates_per_second: float
    steps_per_second: float


class Check(Document):
    """The answer of `check`."""

    verb: Literal["check"] = "check"
    trials: list[Trial]
    costs: list[Cost] = Field(description="empty where a contract is broken")


AnyDocument: TypeAdapter[Compared | Report | Query | Check] = TypeAdapter(
    Annotated[Compared | Report | Query | Check, Field(discriminator="verb")]
)
"""Reads any document."""
