"""Say what a reader must know before believing a comparison: a function a subject, which yields its lines or none."""

import json
import re
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose, nan
from statistics import fmean, variance

from atlantis_exp.comparison.account import seeds_between
from atlantis_exp.comparison.choosing import COMMIT, resolve, values_in
from atlantis_exp.comparison.decision import (
    Look,
    Verdict,
    condition,
    equal_scores,
    improvement,
    may_be_best,
    modes,
    no_worse,
    seeds_needed,
    size_found,
)
from atlantis_exp.comparison.gather import AXES, StoredRun, Training
from atlantis_exp.comparison.published import Table, early_dqn, random_line
from atlantis_exp.comparison.verdict import Answer, Group, Question
from atlantis_exp.comparison.words import IN_FULL, listed, margin, measure, spent
from atlantis_exp.components import Component, facts_of
from atlantis_exp.runs.folder import LOST
from atlantis_exp.terminal import PROGRAM

_LENGTH = re.compile(r"phase\.\d+\.(episodes|steps)")
_SHARES = {"frames": "{:,.0f} frames", "hours": "{:.2f} hours", "flops": "{:.3g} FLOPs"}  # by axis
_NAMED = 6  # runs, up to which a line names them


@dataclass(frozen=True)
class Facts:
    """All that a note may be about."""

    game: Component | None
    groups: Mapping[str, Sequence[Training]]
    lost: Sequence[StoredRun]  # runs that should have been in the groups
    question: Question
    scored: Sequence[Group]
    answers: Sequence[Answer]
    tables: Mapping[str, Table]
    frames: float  # of the longest training
    account: Sequence[str] = ()  # what other questions about the runs mean for this one

    @property
    def by(self) -> Sequence[str]:
        """The keys that tell the groups apart."""
        return self.question.by

    @property
    def trainings(self) -> list[Training]:
        """All runs that are compared."""
        return [training for runs in self.groups.values() for training in runs]


Note = Callable[[Facts], Iterator[str]]


def by_training(facts: Facts) -> Iterator[str]:
    """Say what a training score is."""
    if facts.question.score == "training":
        yield f"The score is {measure(facts.question)}."


def stands(facts: Facts) -> Iterator[str]:
    """Say what each answer rests on: looks, seeds, error, length of training, and other questions."""
    length = f"; trained for up to {facts.frames:,.0f} frames" if facts.frames else ""
    for answer in facts.answers:
        yield f"By {answer.family.name}: {spent(answer)}{length}."
    yield from facts.account


def conditions(facts: Facts) -> Iterator[str]:
    """Say how much each verdict leans on its condition, and how much its difference is overstated."""
    for _, look, verdict, values in _looked_at(facts):
        if verdict.said in ("better", "worse"):
            one, other = _better_first(verdict)
            found = condition(verdict, look, values)
            yield (
                f"{one} against {other}: looks find large differences first; the true one is rather "
                f"{abs(size_found(verdict, look)):,.0f} points. The error holds for groups whose seeds are spread "
                f"alike: here by {found.spreads:.1f} times as much in one as in the other, and if "
                f"{found.undone_by:.0%} of the seeds of {one} collapsed, it would be no better; "
                f"{verdict.seeds} seeds without a collapse leave up to {found.unseen:.0%} possible."
            )


def further_answers(facts: Facts) -> Iterator[str]:
    """Say which groups may be best, and of a few pairs how often a seed wins, and what remains possible."""
    for answer in facts.answers:
        plan, verdicts = answer.family.plan, answer.decision.verdicts
        best = may_be_best(answer.decision)
        if plan.baseline is None and 1 < len(best) < len(answer.family.seeds):
            yield f"By {answer.family.name}, with {1 - plan.error:.0%} the best is one of {listed(best)}."
    for answer, look, verdict, values in _looked_at(facts):
        plan, verdicts = answer.family.plan, answer.decision.verdicts
        if len(verdicts) > IN_FULL:
            continue
        one, other = _better_first(verdict)
        seeds = [[values[name][seed] for seed in look.seeds[name]] for name in (one, other)]
        low, share, high = improvement(*seeds)
        said = [f"A seed of {one} beats one of {other} with {share:.0%} ({low:.0%} to {high:.0%})"]
        if verdict.said == "not decided":
            delta = (plan.delta or 0.0) * (
                abs(fmean(seeds[1] if plan.baseline == other else map(fmean, seeds))) if plan.relative else 1
            )
            turned = replace(verdict, low=-verdict.high)
            said += [
                f"{name} is no worse by more than {margin(plan)}"
                for name, of in ((verdict.group, verdict), (verdict.other, turned))
                if delta and no_worse(of, delta)
            ]
            spread = fmean(map(variance, seeds)) ** 0.5
            if spread and verdict.difference:
                needed = seeds_needed(verdict.difference, spread, plan.error, len(verdicts))
                said.append(
                    f"a difference of this size takes {needed or 'more than 1,000'} seeds each to be found with 80 %"
                )
        yield f"{'; '.join(said)}."


def _looked_at(facts: Facts) -> Iterator[tuple[Answer, Look, Verdict, dict[str, dict[int, float]]]]:
    """Yield the last verdict of each pair with its look and the families' values, where the look's seeds are there."""
    for answer in facts.answers:
        last = {(of.group, of.other): (look, of) for look in answer.decision.looks for of in look.verdicts}
        for pair, (look, verdict) in last.items():
            if all({*look.seeds[name]} <= answer.family.seeds[name].keys() for name in pair):
                yield answer, look, verdict, answer.family.seeds


def _better_first(verdict: Verdict) -> tuple[str, str]:
    pair = verdict.group, verdict.other
    return pair if verdict.difference > 0 else pair[::-1]


def collapsed(facts: Facts) -> Iterator[str]:
    """Name policies of one action."""
    for label, runs in facts.groups.items():
        if names := [run.name for run in runs if run.has_collapsed]:
            yield (
                f"{len(names)} of {len(runs)} runs of {label} collapsed to one action, so their scores say little of "
                f"learning: {listed(names)}."
            )


def lost_seeds(facts: Facts) -> Iterator[str]:
    """Name seeds of a group whose runs are unfinished, failed or damaged."""
    names = defaultdict(list)
    for run in facts.lost:
        label = " ".join(values_in(run.facts, facts.by)) or "all"
        if run.config["seed"] not in {there.config["seed"] for there in facts.groups.get(label, ())}:
            names[label].append(run.name)
    for label, missing in names.items():
        yield (
            f"{label} lacks {len(missing)} {'seed' if len(missing) == 1 else 'seeds'}, unfinished or unusable: "
            f"{listed(missing)}. If how it played is the reason, the others do not stand for it."
        )


def gaps(facts: Facts) -> Iterator[str]:
    """Name seeds that a group lacks though others have them and it has later ones: left out, perhaps, for a score."""
    seeds = {label: {run.config["seed"] for run in runs} for label, runs in facts.groups.items()}
    for label, missing in seeds_between(seeds, {run.config["seed"] for run in facts.lost}).items():
        yield (
            f"{label} goes without seed {listed([*map(str, missing)])}, which others have. If its score is the reason, "
            f"the error does not hold."
        )


def equal(facts: Facts) -> Iterator[str]:
    """Name equal lists of scores, which count like others."""
    label_of = {run.name: label for label, runs in facts.groups.items() for run in runs}
    alike = defaultdict(list)
    for names in equal_scores({run.name: run.episodes.scores.tolist() for run in facts.trainings}):
        alike[tuple(dict.fromkeys(label_of[name] for name in names))].extend(names)
    for labels, names in alike.items():
        has = "has" if len(labels) == 1 else "have"
        yield f"{' and '.join(labels)} {has} runs with the same score in every episode: {listed(names)}."


def modes_found(facts: Facts) -> Iterator[str]:
    """Describe seeds that fall into two modes: their mean is no score of either."""
    played = {row["group"]: row for row in facts.tables["evaluation"]}
    for group in facts.scored:
        if (found := modes(list(group.seeds.values()))) is not None:
            row = played.get(group.label)
            yield (
                f"{group.label} falls into two modes: {found.share:.0%} of its seeds score {found.upper:,.0f} on "
                f"average, the others {found.lower:,.0f}"
            ) + (
                f"; {row['time_cap_share']:.0%} of its episodes reach the time cap, at {row['points_per_frame']:.3g} "
                "points per frame."
                if row
                else "."
            )


def unlike(facts: Facts) -> Iterator[str]:
    """Name differences between runs that their identity leaves out; a tag that some lack may differ there."""
    runs = facts.trainings
    subjects: dict[str, Callable[[Training], str]] = {
        "made in different precisions": lambda run: run.tags.get("precision", "not recorded"),
        "made on different devices": lambda run: run.tags.get("device", "not recorded"),
        "made on different processors, so that equal hours are not equal work": (
            lambda run: run.tags.get("processor", "not recorded")
        ),
        "evaluated by different numbers of episodes, each by its latest evaluation": (
            lambda run: f"{run.episodes.scores.size:,}"
        ),
    }
    if not {"budget.steps", "budget.flops"} & set(facts.by):
        subjects["not trained equally long"] = _ended_by
    for how, value in subjects.items():
        holders = defaultdict(list)
        for run in runs:
            holders[value(run)].append(run.name)
        if len(holders) > 1:
            named = "; ".join(f"{value}: {listed(names)}" for value, names in sorted(holders.items()))
            yield f"The runs were {how}: {named}."


def _ended_by(run: Training) -> str:
    """Return what ended a training, as a user writes it."""
    steps, flops = run.config["budget.steps"], run.config.get("budget.flops")
    limits = [f"budget.steps={steps:,}"] if steps else []
    return " ".join([*limits, f"budget.flops={flops:g}"] if flops else limits) or "the whole plan"


def lossy(facts: Facts) -> Iterator[str]:
    """Name runs that went on without a part of their replay memory."""
    if names := [run.name for run in facts.trainings if LOST in run.tags]:
        yield f"Went on without a part of their replay memory, which was damaged: {listed(names)}."


def uncommitted(facts: Facts) -> Iterator[str]:
    """Name runs of code that no commit holds, if commits are compared."""
    names = [run.name for run in facts.trainings if run.tags.get("git.dirty") == "true"]
    if COMMIT in facts.by and names:
        yield f"Made with changes that their commit does not hold: {listed(names)}."


def unbalanced(facts: Facts) -> Iterator[str]:
    """Name groups that a key's values cannot be averaged over, and keys that are not answered by themselves."""
    for answer in facts.answers:
        family = answer.family
        if family.left_out:
            yield (
                f"By {family.name}, groups without a counterpart for every value are left out: "
                f"{listed(family.left_out)}."
            )
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
    """Name groups with more seeds than the look that a verdict rests on."""
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
            f"{listed([f'{value} has {seeds}' for value, seeds in late.items()])}."
        )


def moved_seeds(facts: Facts) -> Iterator[str]:
    """Name pairs whose seeds at a look are gone, or have other scores now."""
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
                f"By {answer.family.name}, runs of past looks are gone or have other scores now, and their verdicts "
                f"stay: {listed(moved)}."
            )


def in_training(facts: Facts) -> Iterator[str]:
    """Name the group that leads in each view, if the intervals of its differences leave out zero."""
    outcomes: dict[str, list[str]] = defaultdict(list)
    views = facts.tables["views"]
    shown = dict.fromkeys(row["view"] for row in views)
    for view in shown:
        rows = [row for row in views if row["view"] == view]
        if all(row["low"] > 0 for row in rows):
            outcomes[f"{rows[0]['leader']} leads at {{}}"].append(view)
        elif any(row["low"] <= 0 for row in rows):
            outcomes["no lead is clear at {}, where an interval includes zero"].append(view)
        else:
            outcomes["nothing can be said of {}, for want of seeds"].append(view)
    if len(facts.groups) > 1 and (missing := [view for view in AXES.values() if view not in shown]):
        outcomes["nothing is known of {}, since a run has no such curve or too short a one"] = missing
    if outcomes:
        said = "; ".join(text.format(" and ".join(at)) for text, at in outcomes.items())
        yield f"In training, {said}: descriptions, not verdicts."


def mixed(facts: Facts) -> Iterator[str]:
    """Name differences within a group, and between groups beyond the question."""
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


def equal_shares(facts: Facts) -> Iterator[str]:
    """Say whether all runs were trained for equal steps, episodes or arithmetic, and what a run took of the others."""
    if not (runs := facts.trainings):
        return
    (ended, *others) = dict.fromkeys(map(_ended_by, runs))
    phases = {tuple((key, run.science[key]) for key in sorted(run.science) if _LENGTH.fullmatch(key)) for run in runs}
    if others or len(facts.groups) < 2 or (ended == "the whole plan" and len(phases) > 1):
        return
    share = "arithmetic" if "budget.flops" in ended else "steps"
    if "budget" not in ended and any(key.endswith("episodes") and value for key, value in phases.pop()):
        share = "episodes"
    took = []
    for label, trained in facts.groups.items():
        ends = {axis: [run.curve[axis][-1] for run in trained if axis in run.curve] for axis in AXES}
        each = [_SHARES[axis].format(fmean(values)) for axis, values in ends.items() if values]
        took.append(f"{label} {', '.join(each)}")
    yield f"The runs were trained for equal {share} ({ended}). On average a run took: {'; '.join(took)}."


def begun(facts: Facts) -> Iterator[str]:
    """Name the weights that trainings began with."""
    for label, runs in facts.groups.items():
        if weights := dict.fromkeys(str(run.config[key]) for run in runs if run.config.get(key := "training.weights")):
            yield f"{label} began with {listed([*weights])}; what that took counts in no frames, hours or arithmetic."


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
        f"The mean of {one['group']} less that of {other['group']} is {one['mean'] - other['mean']:+,.0f} points: "
        f"{survival:+,.0f} by survival ({frames:,.0f} against {other_frames:,.0f} frames an episode) and "
        f"{pace:+,.0f} by rate ({rate:,.0f} against {other_rate:,.0f} points per 1,000 frames). This describes the "
        f"episodes; it is not a verdict."
    )


def capped(facts: Facts) -> Iterator[str]:
    """Name groups whose scores the time cap decides."""
    if shares := [
        f"{row['time_cap_share']:.0%} of {row['group']}" for row in facts.tables["evaluation"] if row["time_cap_share"]
    ]:
        yield (
            f"The time cap ended episodes and so decides their scores: {', '.join(shares)}; "
            f"look at the points per frame."
        )


def measured_players(facts: Facts) -> Iterator[str]:
    """Name players of the same game that were not trained here."""
    if players := [row for row in facts.tables["references"] if row["name"].endswith(", measured")]:
        scores = [f"{row['name'].removesuffix(', measured')} {row['score']:,.0f}" for row in players]
        yield f"In the same game, on average: {', '.join(scores)}."


def random_player(facts: Facts) -> Iterator[str]:
    """Say where the random player's score is from, and why early scores below it are normal."""
    if (random := random_line(facts.tables["references"])) is None:
        return
    if random["protocol"].startswith("published"):
        yield (
            "No random player was measured under these settings, so a published one takes its place; "
            f"{PROGRAM} baseline with the same env measures one."
        )
    is_early = facts.frames <= facts_of(facts.game).early_frames
    is_below = any(row["mean"] < random["score"] for row in facts.tables["evaluation"])
    if is_early and is_below and (why := early_dqn(facts.game)):
        yield why


CAVEATS: Sequence[Note] = (
    *(by_training, stands, further_answers, conditions, collapsed, lost_seeds, gaps, equal, modes_found, unlike, lossy),
    uncommitted,
    *(unbalanced, later_seeds, moved_seeds),
)
"""What may make a verdict mean something else."""

NOTES: Sequence[Note] = (
    *(in_training, equal_shares, mixed, begun, survival_and_rate),
    *(capped, measured_players, random_player),
)
"""What is said after it."""


def _values(keys: Mapping[str, Sequence[str]]) -> str:
    return ", ".join(f"{key} ({' or '.join(values)})" for key, values in keys.items())


def _differing(configs: Sequence[Mapping[str, object]]) -> dict[str, list[str]]:
    """Return the keys in which configs differ, with their values."""
    keys = dict.fromkeys(key for config in configs for key in config)
    values = {key: list(dict.fromkeys(json.dumps(config.get(key)) for config in configs)) for key in keys}
    return {key: found for key, found in values.items() if len(found) > 1}
