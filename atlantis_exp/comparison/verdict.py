"""Turn a question about groups of runs into families of pairs, and decide each.

`Question.score` defines the score of a seed. A group's score is the mean over its seeds; verdicts are about it alone.
"""

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import count, islice
from typing import Any, Literal

import numpy as np

from atlantis_exp.checking import nearest
from atlantis_exp.comparison.choosing import COMMIT, values_in
from atlantis_exp.comparison.decision import Decision, Look, Plan, decide, looks_up_to
from atlantis_exp.comparison.gather import Training
from atlantis_exp.faults import ConfigError

_SHORTEST_COMMIT = 4  # digits of a commit, as for git


@dataclass(frozen=True)
class Question:
    """A question about groups, and the error that the whole answer may have."""

    by: Sequence[str]  # keys
    seeds: int = 10  # per group, at the plan's last look
    error: float = 0.05  # probability of any false verdict, over all families, pairs and looks
    delta: float | None = None  # a difference that does not matter
    relative: bool = False  # whether delta is a share of a score
    baseline: str | None = None  # a value of one of the keys, or a group
    score: Literal["last", "training", "file"] = "last"  # `words.measure` defines each
    window: float = 0.2  # last share of the steps, for score=training

    @property
    def identity(self) -> dict[str, Any]:
        """The fields that identify it; without the score if it is the default, as in older comparisons."""
        unused = {"last": {"score", "window"}, "training": set[str](), "file": {"window"}}[self.score]
        return {key: value for key, value in asdict(self).items() if key not in unused}


@dataclass(frozen=True)
class Group:
    """The runs with one value for each key of `by`, one score per seed."""

    values: tuple[str, ...]
    seeds: dict[int, float]

    @property
    def label(self) -> str:
        """Its name in sentences and tables."""
        return " ".join(self.values) or "all"


@dataclass(frozen=True)
class Family:
    """Values to compare: those of one key, averaged over the groups of the other keys, or all groups."""

    name: str  # the key, or all keys that differ
    plan: Plan
    seeds: dict[str, dict[int, float]]  # by value: one score per seed
    groups: dict[str, list[Group]]  # by value: the groups it is averaged over
    left_out: list[str]  # labels of groups without a counterpart for every value


@dataclass(frozen=True)
class Answer:
    """The state of a family."""

    family: Family
    decision: Decision
    taken: Look | None  # in this call


def one_a_seed(runs: Sequence[Training], value: Callable[[Training], Any]) -> dict[int, Any]:
    """Return a value per seed; the mean if a seed has several runs, as only in a mixed group."""
    found = defaultdict(list)
    for run in runs:
        found[int(run.config["seed"])].append(value(run))
    return {seed: np.mean(values, axis=0) for seed, values in sorted(found.items())}


def group_of(runs: Sequence[Training], by: Sequence[str]) -> Group:
    """Return a group with one score per seed.

    Seeds that play identical games, such as those that collapsed alike, count like any other: replacing them would
    select seeds by their scores.
    """
    scores = one_a_seed(runs, lambda run: run.score)
    return Group(values_in(runs[0].facts, by), {seed: float(score) for seed, score in scores.items()})


def families(groups: Sequence[Group], question: Question) -> list[Family]:
    """Return the families of a question; none for a single group.

    Each key with several values is a family. Its values are averaged, seed by seed, over the groups of the other keys:
    only groups that exist for every value, and seeds that all of them have. If several keys have several values, all
    groups are a family too. The families share the question's error equally.

    Raises: ConfigError if the baseline is not one of the values or groups.
    """
    keys = [index for index in range(len(question.by)) if len({group.values[index] for group in groups}) > 1]
    if not keys:
        if question.baseline is not None:
            raise ConfigError(f"baseline={question.baseline}: there is only one group, so nothing to compare it with")
        return []
    averaged = [(question.by[index], _averaged(groups, index)) for index in keys if len(keys) > 1]
    alone = {group.label: [group] for group in groups}
    members = [(name, values) for name, values in averaged if values]
    members.append((",".join(question.by[index] for index in keys), alone))
    base = _baseline(members, groups, keys, question)
    found = []
    for name, values in members:
        error = question.error / len(members)
        plan = Plan(looks_up_to(question.seeds), error, question.delta, question.relative, base.get(name))
        seeds = {}
        for value, of in values.items():
            common = sorted(set.intersection(*(set(group.seeds) for group in of)))
            seeds[value] = {seed: float(np.mean([group.seeds[seed] for group in of])) for seed in common}
        used = {group.label for of in values.values() for group in of}
        found.append(Family(name, plan, seeds, values, [group.label for group in groups if group.label not in used]))
    return found


def _averaged(groups: Sequence[Group], index: int) -> dict[str, list[Group]]:
    """Return the groups to average over, by value of a key; empty if none exists for every value."""
    by_value: dict[str, dict[tuple[str, ...], Group]] = defaultdict(dict)
    for group in groups:
        by_value[group.values[index]][group.values[:index] + group.values[index + 1 :]] = group
    shared = sorted(set.intersection(*(set(others) for others in by_value.values())))
    return {value: [by_value[value][other] for other in shared] for value in sorted(by_value)} if shared else {}


def _baseline(
    members: Sequence[tuple[str, Mapping[str, list[Group]]]],
    groups: Sequence[Group],
    keys: Sequence[int],
    question: Question,
) -> dict[str, str]:
    """Return the baseline's family and its name there."""
    asked = question.baseline
    if asked is None:
        return {}
    if len(keys) == 1:  # its groups have full labels
        (name, _), (index,) = members[0], keys
        named = {group.values[index]: group.label for group in groups} | {group.label: group.label for group in groups}
        choices = [(name, value, label) for value, label in named.items()]
    else:
        choices = [(name, value, value) for name, values in members for value in values]
    exact = {(name, label): value for name, value, label in choices if asked in (value, *value.split("=", 1)[1:])}
    started = {
        (name, label): value
        for name, value, label in choices
        if name == COMMIT and len(asked) >= _SHORTEST_COMMIT and (value.startswith(asked) or asked.startswith(value))
    }
    if len(found := exact or started) == 1:
        return dict([*found])
    if found:
        raise ConfigError(f"baseline={asked}: could be any of {', '.join(found.values())}")
    raise ConfigError(f"baseline={asked}: no such group; {nearest(asked, {value for _, value, _ in choices})}")


def answer(asked: Sequence[Family], record: Mapping[str, Sequence[Look]], now: bool = False) -> list[Answer]:
    """Take the looks that are due in each family, or with `now` one at the existing seeds.

    After a look decides some pairs, the others may already have the seeds for the next look. `record` has the earlier
    looks by family.
    """
    answers = []
    for family in asked:
        before = record.get(family.name, ())
        decision = decide(family.seeds, family.plan, before, now=now)
        while len((further := decide(family.seeds, family.plan, decision.looks)).looks) > len(decision.looks):
            decision = further
        taken = decision.looks[-1] if len(decision.looks) > len(before) else None
        answers.append(Answer(family, decision, taken))
    return answers


def wanted(answers: Sequence[Answer]) -> dict[str, list[int]]:
    """Return the seeds that each group lacks for the next looks; empty if all families are decided.

    They are the lowest missing ones, so that contenders share seeds.
    """
    lacking: dict[str, set[int]] = defaultdict(set)
    for family, decision in ((each.family, each.decision) for each in answers):
        for value in decision.contenders if decision.next_look is not None else ():
            members = family.groups[value]
            there = family.seeds[value].keys()
            missing = max(0, (decision.next_look or 0) - len(there))
            for seed in islice((seed for seed in count() if seed not in there), missing):
                for group in members:
                    lacking[group.label] |= {seed} - group.seeds.keys()
    return {label: sorted(seeds) for label, seeds in sorted(lacking.items()) if seeds}


def worse_than_baseline(answers: Sequence[Answer], by: Sequence[str]) -> list[str]:
    """Return the groups that differ from the baseline only in their commit and are worse, and by how much."""
    place = list(by).index(COMMIT)

    def split(answer: Answer, value: str) -> tuple[set[str], set[tuple[str, ...]]]:
        """Return the commits of a value's groups, and their values of the other keys."""
        values = [group.values for group in answer.family.groups[value]]
        return {each[place] for each in values}, {each[:place] + each[place + 1 :] for each in values}

    base = {commit for each in answers if (name := each.family.plan.baseline) for commit in split(each, name)[0]}
    lines = []
    for each in answers:  # also families without the baseline, such as all groups
        for of in (verdict.leading for verdict in each.decision.verdicts if verdict.said in ("better", "worse")):
            (better, rest), (worse, other_rest) = split(each, of.group), split(each, of.other)
            if better == base != worse and rest == other_rest:
                interval = f"{of.low:,.0f} to {of.high:,.0f}, {of.seeds} seeds each"
                lines.append(f"{of.other} by {of.difference:,.0f} points ({interval})")
    return lines
