"""The JSON documents that verbs print with `format=json`; docs/json.md has their schema.

They write NaN, which stands for a number that does not exist, as null.

A new field keeps the version; removing a field or changing its meaning increments it.
"""

from typing import Any, Literal

from pydantic import BaseModel, Field

Said = Literal["better", "worse", "equivalent", "not decided"]


class Document(BaseModel):
    """The fields of all documents."""

    version: Literal[1] = 1


class Question(BaseModel):
    """The question that the groups answer."""

    by: list[str] = Field(description="keys that tell groups apart; `group` for a table of scores")
    score: Literal["last", "training", "file"]
    window: float | None = Field(description="share of the steps, the last ones, that score=training covers")
    measure: str = Field(description="definition of a seed's score")
    seeds: int = Field(description="per group, at the last look")
    error: float = Field(description="probability of any false verdict")
    delta: float | None
    relative: bool = Field(description="whether delta is a share of a score")
    baseline: str | None


class GroupScore(BaseModel):
    """The score of a group, or of one value of a key."""

    family: str = Field(description="the key, or all keys that differ")
    group: str
    score: float | None
    low: float | None = Field(description="95 % interval; null for fewer than five seeds")
    high: float | None
    seeds: dict[int, float] = Field(description="score by seed")


class PairVerdict(BaseModel):
    """The verdict on the difference between the means of two groups."""

    family: str
    group: str
    other: str
    said: Said = Field(description="verdict on the group, against the other")
    difference: float | None
    low: float | None = Field(description="the interval that the verdict rests on")
    high: float | None
    seeds: int = Field(description="per group at that look; 0 before the first")


class Looks(BaseModel):
    """The looks of a family, planned and taken."""

    family: str
    planned: list[int] = Field(description="seeds per group")
    taken: list[int]
    next: int | None = Field(description="null after the last look, or once all is decided")
    error: float
    spent: float


class Compared(Document):
    """The answer of `compare` and `decide`."""

    verb: Literal["compare", "decide"]
    question: Question
    decided: bool = Field(description="whether all pairs are decided; false if nothing is compared")
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
    evaluated_at: int | None = Field(description="step of the evaluation; null without one")
    evaluation: dict[str, float] = Field(description="its metrics, as in MLflow")


class Report(Document):
    """The answer of `report`."""

    verb: Literal["report"] = "report"
    runs: list[Reported]


class Query(Document):
    """The answer of `query`."""

    verb: Literal["query"] = "query"
    environment: dict[str, Any] = Field(description="Gymnasium's description")
    config: dict[str, Any] = Field(description="the keys under env")


class Trial(BaseModel):
    """A contract that was tested."""

    component: str
    contract: str
    kept: bool
    because: str = Field(description="why it is broken; empty if it is kept")


class Cost(BaseModel):
    """The cost of a training on this machine."""

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
    costs: list[Cost] = Field(description="empty if a contract is broken")
