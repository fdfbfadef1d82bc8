"""Write the caveats and notes of a comparison: one function per subject, which yields its lines, if any."""

import json
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import isclose, isfinite, nan
from statistics import fmean, variance

from atlantis_exp.comparison.account import seeds_between
from atlantis_exp.comparison.choosing import COMMIT, holders, resolve, values_in
from atlantis_exp.comparison.decision import (
    Look,
    Verdict,
    condition,
    improvement,
    may_be_best,
    modes,
    seeds_needed,
    size_found,
)
from atlantis_exp.comparison.gather import AXES, StoredRun, Training
from atlantis_exp.comparison.published import Table, random_line
from atlantis_exp.comparison.verdict import Answer, Group, Question
from atlantis_exp.comparison.words import IN_FULL, listed, margin, measure, points, spent
from atlantis_exp.components import Component, facts_of
from atlantis_exp.runs.folder import LOST
from atlantis_exp.terminal import PROGRAM

_SHARES = {"frames": "{:,.0f} frames", "hours": "{:.2f} hours", "flops": "{:.3g} FLOPs"}  # by axis


@dataclass(frozen=True)
class Facts:
    """The input of all notes."""

    game: Component | None
    groups: Mapping[str, Sequence[Training]]
    lost: Sequence[StoredRun]  # runs that should have been in the groups
    question: Question
    scored: Sequence[Group]
    answers: Sequence[Answer]
    tables: Mapping[str, Table]
    frames: float  # of the longest training
    account: Sequence[str] = ()  # remarks on other questions about the runs

    @property
    def by(self) -> Sequence[str]:
        """The keys that tell the groups apart."""
        return self.question.by

    @property
    def trainings(self) -> list[Training]:
        """All runs that are compared."""
        return [training for runs in self.groups.values() for training in runs]


Note = Callable[[Facts], Iterator[str]]


def stands(facts: Facts) -> Iterator[str]:
    """Yield the basis of each answer: score, looks, seeds, error, length of training, and other questions."""
    if facts.question.score == "training":
        yield f"The score is {measure(facts.question)}."
    length = f"; trained for up to {facts.frames:,.0f} frames" if facts.frames else ""
    for answer in facts.answers:
        yield f"By {answer.family.name}: {spent(answer)}{length}."
    yield from facts.account


def further_answers(facts: Facts) -> Iterator[str]:
    """Yield the groups that may be best; for a few pairs, how often a seed wins, and what remains possible."""
    for answer in facts.answers:
        plan, best = answer.family.plan, may_be_best(answer.decision)
        if plan.baseline is None and 1 < len(best) < len(answer.family.seeds):
            yield f"By {answer.family.name}, with {1 - plan.error:.0%} the best is one of {', '.join(best)}."
    for answer, look, verdict in _looked_at(facts):
        plan, pairs = answer.family.plan, len(answer.decision.verdicts)
        if pairs > IN_FULL:
            continue
        one, other = verdict.leading.group, verdict.leading.other
        seeds = {name: [answer.family.seeds[name][seed] for seed in look.seeds[name]] for name in (one, other)}
        low, share, high = improvement(*seeds.values())
        said = [f"A seed of {one} beats one of {other} with {share:.0%} ({low:.0%} to {high:.0%})"]
        if verdict.said == "not decided":
            base = fmean(seeds[plan.baseline] if plan.baseline else map(fmean, seeds.values()))
            delta = (plan.delta or 0.0) * (abs(base) if plan.relative else 1)
            said += [
                f"{of.group} is at most {margin(plan)} worse"
                for of in (verdict, verdict.turned)
                if delta and of.low > -delta
            ]
            if verdict.difference and (spread := fmean(map(variance, seeds.values())) ** 0.5):
                needed = seeds_needed(verdict.difference, spread, plan.error, pairs) or "more than 1,000"
                said.append(f"a difference of this size takes {needed} seeds each to be found with 80 %")
        yield f"{'; '.join(said)}."


def conditions(facts: Facts) -> Iterator[str]:
    """Yield how much a look overstates each difference, and which collapse would undo its verdict."""
    for answer, look, verdict in _looked_at(facts):
        if verdict.said in ("better", "worse"):
            one, other = verdict.leading.group, verdict.leading.other
            found = condition(verdict, look, answer.family.seeds)
            sharing = look.verdicts if answer.family.plan.delta is None else answer.decision.verdicts
            size = points(abs(size_found(verdict, look, len(sharing))))
            times = f"{found.spreads:.1f} times as much in one group"
            here = times if isfinite(found.spreads) else "those of one group do not vary"
            yield (
                f"{one} against {other}: a look overstates the difference that it finds; the corrected estimate is "
                f"{size} points. The verdict assumes that seeds vary alike (here {here}). It would not hold if "
                f"{found.undone_by:.0%} of the seeds of {one} collapsed; {verdict.seeds} seeds "
                f"cannot exclude up to {found.unseen:.0%}."
            )


def _looked_at(facts: Facts) -> Iterator[tuple[Answer, Look, Verdict]]:
    """Yield the last verdict of each pair with its look, if the look's seeds are there."""
    for answer in facts.answers:
        last = {(of.group, of.other): (look, of) for look in answer.decision.looks for of in look.verdicts}
        for pair, (look, verdict) in last.items():
            if all({*look.seeds[name]} <= answer.family.seeds[name].keys() for name in pair):
                yield answer, look, verdict


def unusual_runs(facts: Facts) -> Iterator[str]:
    """Name runs whose policy, replay memory or code makes scores less meaningful, and runs that play alike."""
    for label, runs in facts.groups.items():
        if names := [run.name for run in runs if run.policy.startswith("collapsed")]:
            yield (
                f"{len(names)} of {len(runs)} runs of {label} collapsed to one action, so their scores say little "
                f"about learning: {listed(names)}."
            )
    if alike := [f"{row['run']} as {row['same_as']}" for row in facts.tables["runs"] if row["same_as"]]:
        yield f"The same score in every episode: {listed(alike)}."
    if names := [run.name for run in facts.trainings if LOST in run.tags]:
        yield f"Continued without a damaged part of their replay memory: {listed(names)}."
    if COMMIT in facts.by and (names := [run.name for run in facts.trainings if run.tags.get("git.dirty") == "true"]):
        yield f"Made with uncommitted changes: {listed(names)}."


def missing_seeds(facts: Facts) -> Iterator[str]:
    """Name the seeds that a group lacks: unfinished, damaged, or left out, perhaps for their scores."""
    seeds, names, lost = {each.label: {*each.seeds} for each in facts.scored}, defaultdict(list), defaultdict(set)
    for run in facts.lost:
        label = " ".join(values_in(run.facts, facts.by)) or "all"
        lost[label].add(run.config["seed"])
        if run.config["seed"] not in seeds.get(label, ()):
            names[label].append(run.name)
    for label, missing in names.items():
        yield (
            f"{label} lacks {len(missing)} {'seed' if len(missing) == 1 else 'seeds'}, unfinished or unusable: "
            f"{listed(missing)}. If scores are the reason, the other seeds are not representative."
        )
    for label, left_out in seeds_between(seeds, lost).items():
        yield (
            f"{label} lacks seed {listed([*map(str, left_out)])}, which others have. If its score is the "
            "reason, the error does not hold."
        )


def modes_found(facts: Facts) -> Iterator[str]:
    """Describe seeds that fall into two modes, whose mean is the score of neither."""
    played = {row["group"]: row for row in facts.tables["evaluation"]}
    for group in facts.scored:
        if (found := modes(list(group.seeds.values()))) is not None:
            row = played.get(group.label)
            episodes = row and (
                f"; {row['time_cap_share']:.0%} of its episodes reach the time cap, at {row['points_per_frame']:.3g} "
                "points per frame"
            )
            yield (
                f"{group.label} falls into two modes: {found.share:.0%} of its seeds score {points(found.upper)} on "
                f"average, the others {points(found.lower)}{episodes or ''}."
            )


def unlike(facts: Facts) -> Iterator[str]:
    """Name differences between runs that their identity ignores; a missing tag counts as a difference."""
    subjects: dict[str, Callable[[Training], str]] = {
        "made in different precisions": lambda run: run.tags.get("precision", "not recorded"),
        "made on different devices": lambda run: run.tags.get("device", "not recorded"),
        "made on different processors, so equal hours are not equal work": (
            lambda run: run.tags.get("processor", "not recorded")
        ),
        "evaluated by different numbers of episodes": lambda run: f"{run.episodes.scores.size:,}",
    }
    if not {"budget.steps", "budget.flops"} & set(facts.by):
        subjects["not trained equally long"] = _ended_by
    for how, value in subjects.items():
        values = {run.name: value(run) for run in facts.trainings}
        if len({*values.values()}) > 1:
            yield f"The runs were {how}: {holders(values)}."


def _ended_by(run: Training) -> str:
    """Return the limits that ended a training, as a user writes them."""
    steps, flops = run.config["budget.steps"], run.config.get("budget.flops")
    limits = [f"budget.steps={steps:,}"] if steps else []
    return " ".join([*limits, f"budget.flops={flops:g}"] if flops else limits) or "the whole plan"


def unbalanced(facts: Facts) -> Iterator[str]:
    """Name groups and seeds that an average leaves out, and keys without an answer of their own."""
    for answer in facts.answers:
        family = answer.family
        if family.left_out:
            left_out = listed(family.left_out)
            yield f"By {family.name}, groups without a counterpart for every value are left out: {left_out}."
        for value, members in family.groups.items():
            if members and (alone := set.union(*(set(group.seeds) for group in members)) - family.seeds[value].keys()):
                seeds = listed([*map(str, sorted(alone))])
                yield f"By {family.name}, {value} is averaged without seed {seeds}, which not all of its groups have."
    names = [answer.family.name for answer in facts.answers]
    if facts.answers and "," in names[-1]:
        for key in set(names[-1].split(",")) - set(names):
            yield f"{key} is not answered by itself: its values share no value of the other keys."


def moved_seeds(facts: Facts) -> Iterator[str]:
    """Name groups with more seeds than their verdict's look, and pairs whose seeds have changed since a look."""
    late: dict[str, int] = {}
    for answer in facts.answers:
        for verdict in answer.decision.verdicts:
            for value in (verdict.group, verdict.other):
                if 0 < verdict.seeds < (there := len(answer.family.seeds[value])):
                    late[value] = there
    if late:
        yield (
            "Verdicts use the seeds of their looks, scores all existing seeds: "
            f"{listed([f'{value} has {seeds}' for value, seeds in late.items()])}."
        )
    for answer in facts.answers:
        moved: dict[str, bool] = {}
        for look in answer.decision.looks:
            means = {
                value: fmean(answer.family.seeds[value].get(seed, nan) for seed in seeds)
                for value, seeds in look.seeds.items()
            }
            for verdict in look.verdicts:
                now = means[verdict.group] - means[verdict.other]
                moved[f"{verdict.group} against {verdict.other}"] = not isclose(now, verdict.difference, abs_tol=1e-6)
        if pairs := [pair for pair, is_so in moved.items() if is_so]:
            yield (
                f"By {answer.family.name}, runs of past looks are gone or have new scores, but their verdicts stay: "
                f"{listed(pairs)}."
            )


def mixed(facts: Facts) -> Iterator[str]:
    """Name differences within a group, and between groups beyond the question."""
    varied = {label: _differing([run.science for run in runs]) for label, runs in facts.groups.items()}
    for label, keys in varied.items():
        if keys := {key: values for key, values in keys.items() if key != "seed"}:
            yield f"{label} mixes runs that differ in more than their seed: {_values(keys)}; by= can separate them."
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


def shares(facts: Facts) -> Iterator[str]:
    """Yield the limit that ended all runs, and the mean cost of a run."""
    ended = {*map(_ended_by, facts.trainings)}
    if len(ended) != 1 or len(facts.groups) < 2:
        return
    took = []
    for label, trained in facts.groups.items():
        ends = {axis: [run.curve[axis][-1] for run in trained if axis in run.curve] for axis in AXES}
        each = [_SHARES[axis].format(fmean(values)) for axis, values in ends.items() if values]
        took.append(f"{label} {', '.join(each)}")
    yield f"All runs were trained for {ended.pop()}. On average a run took: {'; '.join(took)}."


def begun(facts: Facts) -> Iterator[str]:
    """Name the weights that trainings began with."""
    for label, runs in facts.groups.items():
        if weights := dict.fromkeys(str(run.config[key]) for run in runs if run.config.get(key := "training.weights")):
            yield f"{label} began with {listed([*weights])}; frames, hours and FLOPs do not include their training."


def survival_and_rate(facts: Facts) -> Iterator[str]:
    """Split the difference between two means into survival and rate."""
    if len(facts.tables["why"]) != 2:
        return
    one, other = facts.tables["why"]
    (frames, rate), (other_frames, other_rate) = (
        (row["frames_mean"], row["points_per_1000_frames"]) for row in (one, other)
    )
    survival = (frames - other_frames) * (rate + other_rate) / 2 / 1_000
    pace = (rate - other_rate) * (frames + other_frames) / 2 / 1_000
    yield (
        f"The mean of {one['group']} minus that of {other['group']} is {one['mean'] - other['mean']:+,.0f} points: "
        f"{survival:+,.0f} by survival ({frames:,.0f} against {other_frames:,.0f} frames an episode) and "
        f"{pace:+,.0f} by rate ({rate:,.0f} against {other_rate:,.0f} points per 1,000 frames). This describes the "
        f"episodes; it is not a verdict."
    )


def time_cap(facts: Facts) -> Iterator[str]:
    """Name groups whose scores the time cap decides."""
    if shares := [
        f"{row['time_cap_share']:.0%} of {row['group']}" for row in facts.tables["evaluation"] if row["time_cap_share"]
    ]:
        yield f"The time cap ended episodes and so decides their scores: {', '.join(shares)}; see the points per frame."


def other_players(facts: Facts) -> Iterator[str]:
    """Name players of the same game, the source of the random player's score, and why early scores are below it."""
    references = facts.tables["references"]
    if players := [row for row in references if row["name"].endswith(", measured")]:
        scores = [f"{row['name'].removesuffix(', measured')} {row['score']:,.0f}" for row in players]
        yield f"In the same game, on average: {', '.join(scores)}."
    if (random := random_line(references)) is None:
        return
    if random["protocol"].startswith("published"):
        yield (
            "No random player was measured under these settings, so a published score stands in; "
            f"{PROGRAM} baseline with the same env measures one."
        )
    game, is_below = facts_of(facts.game), any(row["mean"] < random["score"] for row in facts.tables["evaluation"])
    if is_below and facts.frames <= game.early_frames:
        yield f"Scores below the random player's are normal this early: {game.early_scores}."


CAVEATS: Sequence[Note] = (
    *(stands, further_answers, conditions, unusual_runs, missing_seeds, modes_found),
    *(mixed, unlike, unbalanced, moved_seeds),
)
"""The notes that may change the meaning of a verdict."""

NOTES: Sequence[Note] = (shares, begun, survival_and_rate, time_cap, other_players)
"""The other notes."""


def _values(keys: Mapping[str, Sequence[str]]) -> str:
    return ", ".join(f"{key} ({' or '.join(values)})" for key, values in keys.items())


def _differing(configs: Sequence[Mapping[str, object]]) -> dict[str, list[str]]:
    """Return the keys in which configs differ, with their values."""
    keys = dict.fromkeys(key for config in configs for key in config)
    values = {key: list(dict.fromkeys(json.dumps(config.get(key)) for config in configs)) for key in keys}
    return {key: found for key, found in values.items() if len(found) > 1}
