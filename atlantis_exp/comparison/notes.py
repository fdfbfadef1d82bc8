"""What a reader must know before believing a comparison: one small function a matter, each with its lines or none."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isclose, nan
from statistics import fmean
from typing import TypeVar

from atlantis_exp.comparison.decision import FEWEST_SEEDS, equal_scores
from atlantis_exp.comparison.gather import AXES, COMMIT, Training, resolve
from atlantis_exp.comparison.published import Table, early_dqn, random_line
from atlantis_exp.comparison.verdict import Answer
from atlantis_exp.components import Component, facts_of
from atlantis_exp.runs.folder import LOST
from atlantis_exp.terminal import PROGRAM

T = TypeVar("T")

_NAMED = 6  # runs, up to which a line names them


@dataclass(frozen=True)
class Facts:
    """All that a note may be about."""

    game: Component | None
    groups: Mapping[str, Sequence[Training]]
    by: Sequence[str]
    answers: Sequence[Answer]
    tables: Mapping[str, Table]
    frames: float  # of the longest training

    @property
    def trainings(self) -> list[Training]:
        """All runs that are compared."""
        return [training for runs in self.groups.values() for training in runs]


def collapsed(facts: Facts) -> Iterator[str]:
    """Policies of one action."""
    for label, runs in facts.groups.items():
        if names := [run.name for run in runs if run.has_collapsed]:
            yield (
                f"{len(names)} of {len(runs)} runs of {label} collapsed to one action, so their scores say little of "
                f"learning: {_listed(names)}."
            )


def equal(facts: Facts) -> Iterator[str]:
    """Equal lists of scores, which count like others."""
    label_of = {run.name: label for label, runs in facts.groups.items() for run in runs}
    alike = defaultdict(list)
    for names in equal_scores({run.name: run.episodes.scores.tolist() for run in facts.trainings}):
        alike[tuple(dict.fromkeys(label_of[name] for name in names))].extend(names)
    for labels, names in alike.items():
        has = "has" if len(labels) == 1 else "have"
        yield f"{' and '.join(labels)} {has} runs with the same score in every episode: {_listed(names)}."


def modes_found(facts: Facts) -> Iterator[str]:
    """Seeds that fall into two modes."""
    for row in facts.tables["modes"]:
        yield (
            f"{row['group']} falls into two modes: {row['upper_share']:.0%} of its seeds score "
            f"{row['upper_score']:,.0f} on average, the others {row['lower_score']:,.0f}; {row['time_cap_share']:.0%} "
            f"of its episodes reach the time cap, at {row['points_per_frame']:.3g} points per frame."
        )


def different_makers(facts: Facts) -> Iterator[str]:
    """Precisions, devices and processors, which do not enter a run's identity."""
    for tag, how in (
        ("precision", "in different precisions"),
        ("device", "on different devices"),
        ("processor", "on different processors, so that equal hours are not equal work"),
    ):
        holders = _holders((run.tags[tag], run.name) for run in facts.trainings if tag in run.tags)
        if len(holders) > 1:
            named = "; ".join(f"{value}: {_listed(names)}" for value, names in sorted(holders.items()))
            yield f"The runs were made {how}: {named}."


def different_lengths(facts: Facts) -> Iterator[str]:
    """Budgets that ended trainings, which do not enter a run's identity either."""
    budgets = ((run.config["budget.steps"], run.name) for run in facts.trainings)
    holders = _holders(("the whole plan" if most is None else f"budget.steps={most:,}", name) for most, name in budgets)
    if len(holders) > 1 and "budget.steps" not in facts.by:
        named = "; ".join(f"{length}: {_listed(names)}" for length, names in holders.items())
        yield f"The runs were not trained equally long: {named}."


def different_evaluations(facts: Facts) -> Iterator[str]:
    """Evaluations of unequal size, as a single later episode of one run."""
    holders = _holders((run.episodes.scores.size, run.name) for run in facts.trainings)
    if len(holders) > 1:
        named = "; ".join(f"{size:,}: {_listed(names)}" for size, names in sorted(holders.items()))
        yield f"The runs were evaluated by different numbers of episodes, each by its latest evaluation: {named}."


def lossy(facts: Facts) -> Iterator[str]:
    """Runs that went on without a part of their replay memory."""
    if names := [run.name for run in facts.trainings if LOST in run.tags]:
        yield f"Went on without a part of their replay memory, which was damaged: {_listed(names)}."


def uncommitted(facts: Facts) -> Iterator[str]:
    """Runs of code that no commit holds, where commits are compared."""
    names = [run.name for run in facts.trainings if run.tags.get("git.dirty") == "true"]
    if COMMIT in facts.by and names:
        yield f"Made with changes that their commit does not hold: {_listed(names)}."


def unbalanced(facts: Facts) -> Iterator[str]:
    """Groups that a key's values cannot be averaged over, and keys that are not answered by themselves."""
    for answer in facts.answers:
        family = answer.family
        if family.left_out:
            left_out = _listed(family.left_out)
            yield f"By {family.name}, some groups do not count, for not all values have their like: {left_out}."
        for value, members in family.groups.items():
            if members and (alone := set.union(*(set(group.seeds) for group in members)) - family.seeds[value].keys()):
                yield (
                    f"By {family.name}, {value} goes without seed {', '.join(map(str, sorted(alone)))}, which not all "
                    f"of its groups have."
                )
    names = [answer.family.name for answer in facts.answers]
    if facts.answers and "," in names[-1]:
        for key in set(names[-1].split(",")) - set(names):
            yield f"{key} is not answered by itself: its values share no value of the other keys."


def later_seeds(facts: Facts) -> Iterator[str]:
    """Seeds that came after the look that a verdict rests on."""
    late: dict[str, int] = {}
    for answer in facts.answers:
        counts = {value: len(seeds) for value, seeds in answer.family.seeds.items()}
        for verdict in answer.decision.verdicts:
            late |= {
                value: counts[value] for value in (verdict.group, verdict.other) if 0 < verdict.seeds < counts[value]
            }
    if late:
        yield (
            "Verdicts rest on the seeds of their looks, scores are of all seeds there are: "
            f"{_listed([f'{value} has {seeds}' for value, seeds in late.items()])}."
        )


def moved_seeds(facts: Facts) -> Iterator[str]:
    """Seeds of a look that are gone, or have other scores now."""
    for answer in facts.answers:
        stands: dict[str, bool] = {}
        for look in answer.decision.looks:
            means = {
                value: fmean(answer.family.seeds[value].get(seed, nan) for seed in seeds)
                for value, seeds in look.seeds.items()
            }
            for verdict in look.verdicts:
                now = means[verdict.group] - means[verdict.other]
                pair = f"{verdict.group} against {verdict.other}"
                stands[pair] = isclose(now, verdict.difference, abs_tol=1e-6)
        if moved := [pair for pair, is_so in stands.items() if not is_so]:
            yield (
                f"By {answer.family.name}, runs of past looks are gone or have other scores now, and what was said "
                f"stays: {_listed(moved)}."
            )


def unplanned(facts: Facts) -> Iterator[str]:
    """Looks at other numbers of seeds than the planned ones."""
    for answer in facts.answers:
        before, planned = 0, answer.family.plan.looks
        for look in answer.decision.looks:
            if look.size not in planned:
                late = [size for size in planned if before < size < look.size]
                taken = (
                    f"the look planned at {late[-1]} seeds was taken at {look.size}"
                    if late
                    else f"a look was taken at {look.size} seeds, where none was planned"
                )
                yield f"By {answer.family.name}, {taken}: it spent {look.error:.2%} of the error."
            before = look.size


def few_seeds(facts: Facts) -> Iterator[str]:
    """Groups that can decide nothing."""
    for label, runs in facts.groups.items():
        seeds = len({run.config["seed"] for run in runs})
        if seeds < FEWEST_SEEDS:
            yield f"{label} has {seeds} of the {FEWEST_SEEDS} seeds without which nothing is decided."


def mixed(facts: Facts) -> Iterator[str]:
    """Differences within a group, and between groups beyond the question."""
    varied = {label: _differing([run.science for run in runs]) for label, runs in facts.groups.items()}
    for label, keys in varied.items():
        if keys := {key: values for key, values in keys.items() if key != "seed"}:
            yield f"{label} mixes runs that differ in more than their seed: {_values(keys)}; by= can tell them apart."
    within = {key for keys in varied.values() for key in keys}
    firsts = [runs[0] for runs in facts.groups.values()]
    asked = {resolve(key, run.config) for key in facts.by for run in firsts}
    between = {
        key: values
        for key, values in _differing([run.science for run in firsts]).items()
        if key not in within | asked and not set(facts.by) & set(key.split("."))
    }
    if between:
        yield f"The groups also differ in {_values(between)}."


def begun(facts: Facts) -> Iterator[str]:
    """Trainings before those that are compared."""
    for label, runs in facts.groups.items():
        if weights := dict.fromkeys(str(run.config[key]) for run in runs if run.config.get(key := "training.weights")):
            yield f"{label} began with {_listed([*weights])}; what that took counts in no frames, hours or arithmetic."


def survival_and_rate(facts: Facts) -> Iterator[str]:
    """Which part of the difference between two means is survival, and which is rate."""
    if len(facts.tables["why"]) != 2:
        return
    one, other = facts.tables["why"]
    (frames, rate), (other_frames, other_rate) = (
        (row["frames_mean"], row["points_per_1000_frames"]) for row in (one, other)
    )
    survival = (frames - other_frames) * (rate + other_rate) / 2 / 1_000
    pace = (rate - other_rate) * (frames + other_frames) / 2 / 1_000
    yield (
        f"The mean of {one['group']} less that of {other['group']} is {one['mean'] - other['mean']:+,.0f} points: "
        f"{survival:+,.0f} by survival ({frames:,.0f} against {other_frames:,.0f} frames an episode) and "
        f"{pace:+,.0f} by rate ({rate:,.0f} against {other_rate:,.0f} points per 1,000 frames). This describes the "
        f"episodes; nothing is decided by it."
    )


def missing_views(facts: Facts) -> Iterator[str]:
    """Views of the training that cannot be had."""
    shown = {row["view"] for row in facts.tables["views"]}
    missing = [name for name in AXES.values() if len(facts.groups) > 1 and name not in shown]
    if missing:
        yield f"Nothing is said of {' and '.join(missing)}: a run has no such learning curve, or one too short."


def capped(facts: Facts) -> Iterator[str]:
    """Scores that the time cap decides."""
    if shares := [
        f"{row['time_cap_share']:.0%} of {row['group']}" for row in facts.tables["evaluation"] if row["time_cap_share"]
    ]:
        yield (
            f"The time cap ended episodes and so decides their scores: {', '.join(shares)}; "
            f"look at the points per frame."
        )


def measured_players(facts: Facts) -> Iterator[str]:
    """What was not trained here and played the same game."""
    if players := [row for row in facts.tables["references"] if row["name"].endswith(", measured")]:
        scores = [f"{row['name'].removesuffix(', measured')} {row['score']:,.0f}" for row in players]
        yield f"In the same game, on average: {', '.join(scores)}."


def other_players(facts: Facts) -> Iterator[str]:
    """What the random player's line is worth."""
    if (random_player := random_line(facts.tables["references"])) is None:
        return
    if random_player["protocol"].startswith("published"):
        yield (
            "No random player was measured under these settings, so a published one takes its place; "
            f"{PROGRAM} baseline with the same env measures one."
        )
    scores = [row["mean"] for row in facts.tables["evaluation"]]  # as the player's
    is_early = facts.frames <= facts_of(facts.game).early_frames
    if is_early and any(score < random_player["score"] for score in scores) and (why := early_dqn(facts.game)):
        yield why


CAVEATS: Sequence[Callable[[Facts], Iterator[str]]] = (
    collapsed,
    equal,
    modes_found,
    different_makers,
    different_lengths,
    different_evaluations,
    lossy,
    uncommitted,
    unbalanced,
    later_seeds,
    moved_seeds,
    unplanned,
)
"""What can make a verdict mean something else."""

NOTES: Sequence[Callable[[Facts], Iterator[str]]] = (
    few_seeds,
    mixed,
    begun,
    survival_and_rate,
    missing_views,
    capped,
    measured_players,
    other_players,
)
"""What is said after it."""


def _holders(values: Iterable[tuple[T, str]]) -> dict[T, list[str]]:
    """Whose value is which: from pairs of a value and a run's name."""
    holders = defaultdict(list)
    for value, name in values:
        holders[value].append(name)
    return holders


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _values(keys: Mapping[str, Sequence[str]]) -> str:
    return ", ".join(f"{key} ({' or '.join(values)})" for key, values in keys.items())


def _differing(configs: Sequence[Mapping[str, object]]) -> dict[str, list[str]]:
    """The keys in which configs differ, with their values."""
    keys = dict.fromkeys(key for config in configs for key in config)
    values = {key: list(dict.fromkeys(json.dumps(config.get(key)) for config in configs)) for key in keys}
    return {key: found for key, found in values.items() if len(found) > 1}
