"""Keep one account of the error spent on runs, however questions about them are put.

It is read from the folders of all comparisons under an outputs folder: `config.json` has the groups compared,
`looks.json` the looks with their findings and error. A question continues the looks of an earlier one that compared its
pairs of groups, alone or among others. It also says how much other questions about its runs have spent.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

from pydantic import Field, TypeAdapter

from atlantis_exp.comparison.decision import Look
from atlantis_exp.comparison.gather import UNREADABLE
from atlantis_exp.comparison.looks import RECORD, Record, read_looks
from atlantis_exp.comparison.verdict import Family
from atlantis_exp.comparison.words import listed
from atlantis_exp.runs.files import SMALL, read_file
from atlantis_exp.runs.folder import LOOKS, RunFolder


@dataclass(frozen=True)
class Asked:
    """A question about runs, as its folder keeps it."""

    by: list[str]
    error: Annotated[float, Field(gt=0, lt=1)]
    delta: float | None
    relative: bool
    baseline: str | None
    # A label, and hashes of its runs without their seeds.
    groups: Sequence[Annotated[list[str], Field(min_length=1)] | str]
    compared: list[str]  # all runs that it was ever asked about
    account: str = ""  # the comparison whose looks it continues; empty for its own
    errors: dict[str, float] = field(default_factory=dict)  # of the families that continue one
    score: str = "last"  # as in `Question`
    window: float | None = None
    scores: str = ""  # the table of groups without recipes
    columns: dict[str, str] = field(default_factory=dict)  # of that table, by group, seed and score
    name: str = ""
    record: Record = field(default_factory=dict)

    @property
    def identities(self) -> dict[str, tuple[str, ...]]:
        """The identity of each group, whatever its label; groups of one recipe have their labels, too."""
        rows = [[each, self.scores] if isinstance(each, str) else each for each in self.groups]
        recipes = {label: tuple(recipes) for label, *recipes in rows}
        if len({*recipes.values()}) == len(recipes):
            return recipes
        return {label: (*of, label) for label, of in recipes.items()}

    @property
    def root(self) -> str:
        """The comparison that keeps its account."""
        return self.account or self.name

    @property
    def measure(self) -> tuple[object, ...]:
        """The score with its columns, and the difference that does not matter."""
        renamed = sorted((key, name) for key, name in self.columns.items() if key != name)
        return self.score, renamed, self.window, self.delta, self.relative, self.relative and self.baseline

    @property
    def spent(self) -> float:
        """The error that its looks spent."""
        return sum(look.error for looks in self.record.values() for look in looks)

    def shares_runs(self, other: "Asked") -> bool:
        """Return whether both are about a common run or table."""
        return bool({*self.compared} & {*other.compared}) or bool(self.scores and self.scores == other.scores)


@dataclass(frozen=True)
class Account:
    """The error that a question may still spend, and remarks on it."""

    record: Mapping[str, Sequence[Look]] = field(default_factory=dict)
    errors: Mapping[str, float] = field(default_factory=dict)  # of families that continue an earlier one
    root: str = ""  # the comparison that was continued
    compared: Sequence[str] = ()  # all runs that it was ever asked about
    lines: Sequence[str] = ()
    is_warned: bool = False  # whether the lines name other questions or missing runs

    def limit(self, asked: Sequence[Family]) -> list[Family]:
        """Return the families with the error that the account leaves them."""
        return [
            replace(each, plan=replace(each.plan, error=self.errors.get(each.name, each.plan.error))) for each in asked
        ]

    @property
    def kept(self) -> dict[str, Any]:
        """The part that the comparison's folder keeps."""
        continued = {"account": self.root, "errors": dict(self.errors)} if self.errors else {}
        return {"compared": list(self.compared), **continued}


def read_account(
    folder: RunFolder, asked: Sequence[Family], question: Mapping[str, Any], runs: Sequence[str]
) -> Account:
    """Return the account of a question, read from all comparisons next to its folder.

    Other comparisons that cannot be read count as if they had spent nothing, and a line names them.

    Raises: Fault if the folder's own looks are damaged or gone.
    """
    others, damaged = [], []
    for path in sorted(folder.path.parent.glob(f"*/{LOOKS}")):
        if path.parent != folder.path:
            try:
                other = _read(RunFolder(path.parent))
                others.append(replace(other, record=RECORD.validate_json(read_file(path, SMALL), strict=True)))
            except UNREADABLE:
                damaged.append(path.parent.name)
    try:
        before = _read(folder)
        loose: Collection[str] = before.errors
    except UNREADABLE:  # before its first look, or killed while it wrote
        before, loose = _ASKED.validate_python({**question, "compared": []}), {family.name for family in asked}
    compared, record = sorted({*before.compared, *runs}), read_looks(folder.path, asked, loose)
    mine = replace(before, name=folder.name, compared=compared, record=record)
    found = open_account(asked, mine, others, runs)
    if damaged:
        line = f"What these comparisons spent is unknown, since they cannot be read: {listed(damaged)}."
        found = replace(found, lines=[*found.lines, line])
    return found


def open_account(asked: Sequence[Family], mine: Asked, others: Sequence[Asked], runs: Collection[str]) -> Account:
    """Return the account of a question.

    Each family takes over the longest looks of an earlier question with the same measure and all its pairs, if they
    begin with its own. Of that question's remaining error it may spend the share of its open pairs.

    Args:
        mine: the question, with its own looks so far and all runs that it was ever asked about.
        runs: the runs that it is asked about now.
    """
    if not asked:
        return Account(compared=mine.compared)
    record, errors, roots, lines = dict(mine.record), dict(mine.errors), [], []
    for family in asked:
        own = mine.record.get(family.name, [])
        parts = [(part, other) for other in others if (part := _part(family, asked, mine, other))]
        parts = [(part, other) for part, other in parts if part.looks[: len(own)] == own]
        if not parts:
            roots.append(mine.root if family.name in errors else mine.name)
            continue
        part, other = max(parts, key=lambda found: len(found[0].looks))
        record[family.name], errors[family.name] = part.looks, part.error
        roots.append(other.root)
        if other.root != mine.name:
            of = "" if part.of == 1 else f", which has {part.of} pairs in all"
            is_spent = part.error - sum(look.error for look in part.looks) < 1e-9
            left = "; to look further, allow a larger error=" if is_spent and _open(part.looks[-1]) else ""
            lines.append(f"By {family.name}, this continues the looks of {other.name}{of}{left}.")
    root = roots[0] if len({*roots}) == 1 else mine.name
    sizes = _sizes(record)  # and those of the looks to come
    sizes |= {size for family in asked for size in family.plan.looks if size > max(sizes, default=0)}
    told: dict[str, float] = {}  # error spent, by account
    groups = {*mine.identities.values()}
    for other in others:
        is_mine = other.root == root and _sizes(other.record) <= sizes
        is_near = mine.shares_runs(other) or len({*other.identities.values()} & groups) > 1
        if other.spent and is_near and not is_mine:
            told[other.root] = max(told.get(other.root, 0.0), other.spent)
    if told:
        questions = "1 other question" if len(told) == 1 else f"{len(told)} other questions"
        spent = f"{sum(told.values()):.2%}"
        lines.append(
            f"{questions} about these runs spent {spent} of error; the error of this question is on top of it."
        )
    same = [other for other in others if {*other.identities.values()} == groups and mine.shares_runs(other)]
    if gone := sorted({*mine.compared}.union(*(other.compared for other in same)) - {*runs}):
        lines.append(
            f"Compared before, and gone or left out now: {listed(gone)}. If their scores are the reason, the error "
            f"does not hold."
        )
    return Account(record, errors, root, mine.compared, lines, is_warned=bool(told or gone))


def seeds_between(seeds: Mapping[str, Collection[int]], lost: Mapping[str, Collection[int]]) -> dict[str, list[int]]:
    """Return the seeds that a group lacks below its last one, though another group has them, without its lost ones."""
    every = {seed for own in seeds.values() for seed in own}
    missing = {
        label: sorted(seed for seed in every - {*own, *lost.get(label, ())} if seed < max(own))
        for label, own in seeds.items()
    }
    return {label: found for label, found in missing.items() if found}


_ASKED = TypeAdapter(Asked)


def _read(folder: RunFolder) -> Asked:
    return replace(_ASKED.validate_python(folder.config), name=folder.name)


def _sizes(record: Mapping[str, Sequence[Look]]) -> set[int]:
    return {look.size for looks in record.values() for look in looks}


def _open(look: Look) -> int:
    """Return how many pairs a look left open."""
    return sum(verdict.said == "not decided" for verdict in look.verdicts)


class _Part(NamedTuple):
    """Another question's looks at a family's pairs."""

    looks: list[Look]
    error: float  # of the family, spent and left
    of: int  # pairs of the other question; 1 if it has the same ones


def _part(family: Family, asked: Sequence[Family], mine: Asked, other: Asked) -> _Part | None:
    """Return another question's looks at all pairs of a family; None if the family cannot continue them."""
    if not other.record or mine.measure != other.measure or not mine.shares_runs(other):
        return None
    if family is asked[-1]:  # all groups
        source, own = [*other.record][-1], {identity: label for label, identity in mine.identities.items()}
        labels = {label: own[identity] for label, identity in other.identities.items() if identity in own}
    elif mine.by == other.by and mine.identities == other.identities:
        source, labels = family.name, {name: name for name in family.seeds}
    else:
        return None
    if not (whole := other.record.get(source)):
        return None
    pairs, every = family.plan.pairs(family.seeds), len(whole[0].verdicts)
    looks: list[Look] = []
    for look in whole:
        renamed = [
            replace(each, group=labels[each.group], other=labels[each.other])
            for each in look.verdicts
            if {each.group, each.other} <= labels.keys()
        ]
        ordered = [each if (each.group, each.other) in pairs else each.turned for each in renamed]
        verdicts = [each for each in ordered if (each.group, each.other) in pairs]
        if not looks and len(verdicts) < len(pairs):
            return None
        if verdicts:
            names = {name for verdict in verdicts for name in (verdict.group, verdict.other)}
            seeds = {labels[name]: chosen for name, chosen in look.seeds.items() if labels.get(name) in names}
            share = len(verdicts) / len(look.verdicts) if mine.delta is None else len(pairs) / every
            looks.append(Look(seeds, share * look.error, verdicts))
    # The families of either question share its error; if the other one is itself a part, it has a share of that.
    allowed = family.plan.error * len(asked) / max(len(asked), len(other.record))
    allowed *= min(1.0, other.errors.get(source, 1.0) * len(other.record) / other.error)
    left = allowed - sum(look.error for look in whole)
    if left < -1e-9:
        return None
    # As at the other question's next look, its open pairs share the rest; with delta all of its pairs do.
    share = len(pairs) / every
    if mine.delta is None and every > len(pairs):
        share = _open(looks[-1]) / max(_open(whole[-1]), 1)
    error = sum(look.error for look in looks) + share * max(left, 0.0)
    return _Part(looks, error, every if every > len(pairs) else 1)
