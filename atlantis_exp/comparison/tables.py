"""Compute the tables and answers of a comparison; they have every number on the page and in the figures."""

import csv
import io
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from math import isnan
from typing import Literal

import numpy as np
import numpy.typing as npt

from atlantis_exp import documents
from atlantis_exp.comparison.account import Account
from atlantis_exp.comparison.choosing import plays_alike
from atlantis_exp.comparison.decision import FEWEST_SEEDS, Plan, Verdict, decide, mean_interval
from atlantis_exp.comparison.gather import AXES, Array, Gathered, Player, Training
from atlantis_exp.comparison.notes import CAVEATS, NOTES, Facts
from atlantis_exp.comparison.published import Row, Table, curves, scores
from atlantis_exp.comparison.verdict import Answer, Group, Question, answer, families, group_of, one_a_seed
from atlantis_exp.comparison.words import measure, said
from atlantis_exp.components import facts_of, title_of
from atlantis_exp.games import Game
from atlantis_exp.statistics import Scores, human_normalised, summarize

Groups = Mapping[str, Sequence[Training]]

_GRID = 100  # points of a curve
_NAN = float("nan")


@dataclass(frozen=True)
class Comparison:
    """A comparison of groups of runs, as it is printed and drawn."""

    title: str  # of the game; empty if unknown
    game: Game
    groups: list[str]
    by: list[str]
    question: Question
    measure: str  # definition of a seed's score
    answers: list[Answer]
    verdict: str  # the answer by the first key
    others: list[str]  # the answers by the other keys
    caveats: list[str]  # may change the meaning of the verdict
    notes: list[str]
    tables: dict[str, Table]

    def document(self, verb: Literal["compare", "decide"]) -> documents.Compared:
        """Return the comparison as a JSON document."""
        seeds: dict[tuple[str, str], dict[int, float]] = defaultdict(dict)
        for row in self.tables["seeds"]:
            seeds[row["family"], row["group"]][row["seed"]] = row["score"]
        question = asdict(self.question) | {"by": self.by, "measure": self.measure}
        if self.question.score != "training":
            question["window"] = None
        verdicts, scores = self.tables["verdict"], self.tables["scores"]
        return documents.Compared.model_validate(
            {
                "verb": verb,
                "question": question,
                "decided": bool(verdicts) and all(row["said"] != "not decided" for row in verdicts),
                **{key: getattr(self, key) for key in ("verdict", "others", "caveats", "notes")},
                "verdicts": verdicts,
                "scores": [row | {"seeds": seeds[row["family"], row["group"]]} for row in scores],
                "looks": [
                    {
                        "family": each.family.name,
                        "planned": each.family.plan.looks,
                        "taken": [look.size for look in each.decision.looks],
                        "next": each.decision.next_look,
                        "error": each.family.plan.error,
                        "spent": each.decision.spent,
                    }
                    for each in self.answers
                ],
            }
        )


def compare(
    gathered: Gathered,
    groups: Groups,
    question: Question,
    account: Account | None = None,
    now: bool = False,
    scored: Sequence[Group] = (),
) -> Comparison:
    """Compare groups of trainings and take the looks that are due, or with `now` an unplanned one.

    account: earlier looks, and the error left.
    scored: the groups with the scores of their seeds; by default those of the trainings.

    Raises: ConfigError if the baseline is not one of the groups.
    """
    account = account or Account()
    seeds_of = scored or [group_of(runs, question.by) for runs in groups.values()]
    answers = answer(account.limit(families(seeds_of, question)), account.record, now)
    trainings = [training for runs in groups.values() for training in runs]
    component = trainings[0].game if trainings else None
    game = facts_of(component)
    frames = max((float(training.curve["frames"][-1]) for training in trainings if training.curve), default=0.0)
    labels = [group.label for group in seeds_of]
    named: list[tuple[str, dict[str, dict[int, float]], Answer | None]] = [
        (each.family.name, each.family.seeds, each) for each in answers
    ] or [("all", {group.label: group.seeds for group in seeds_of}, None)]
    tables: dict[str, Table] = {
        "scores": [row for family in named for row in _scores(*family)],
        "seeds": [
            {"family": name, "group": value, "seed": seed, "score": score}
            for name, values, _ in named
            for value, seeds in values.items()
            for seed, score in seeds.items()
        ],
        "verdict": [{"family": each.family.name, **_verdict(of)} for each in answers for of in each.decision.verdicts],
        "plan": [_plan(each) for each in answers],
        "looks": [row for each in answers for row in _looks(each)],
        "evaluation": [_evaluation(label, runs, game) for label, runs in groups.items()],
        "why": [_why(label, runs, game.sources) for label, runs in groups.items()],
        "views": _views(groups),
        "runs": _runs(groups),
        "curves": [row for axis in AXES for label, runs in groups.items() for row in _curve(axis, label, runs)],
        "seed_curves": [
            row for axis in AXES for label, runs in groups.items() for row in _seed_curves(axis, label, runs)
        ],
        "profile": _profile(groups, game),
        "actions": [row for label, runs in groups.items() for row in _actions(label, runs)],
        "episodes": [row for label, runs in groups.items() for training in runs for row in _episodes(label, training)],
        "references": [
            *(_measured(player) for player in gathered.players if plays_alike(player, trainings)),
            *scores(component),
        ],
        "published_curves": [row for row in curves(component) if row["frames"] <= frames],
        "skipped": [{"run": name, "reason": reason} for name, reason in gathered.skipped.items()],
    }
    facts = Facts(component, groups, gathered.lost, question, seeds_of, answers, tables, frames, account.lines)
    caveats, notes = ([line for note in each for line in note(facts)] for each in (CAVEATS, NOTES))
    if now and answers and all(each.taken is None for each in answers):
        caveats.append("look=now took no look: no undecided group has new seeds, or one has fewer than five.")
    verdict, *others = _sentences(answers, labels, question)
    title = title_of(trainings[0].config["env.id"]) if trainings else ""
    asked = labels, list(question.by), question, measure(question)
    return Comparison(title, game, *asked, answers, verdict, others, caveats, notes, tables)


def to_csv(table: Table) -> str:
    """Write a table as CSV; an empty table gives an empty text."""
    text = io.StringIO()
    if table:
        writer = csv.DictWriter(text, dict.fromkeys(key for row in table for key in row), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    return text.getvalue()


def _table(**columns: npt.ArrayLike) -> Table:
    """Turn columns into rows; a scalar repeats in every row."""
    values = (column.tolist() for column in np.broadcast_arrays(*columns.values()))
    return [dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True)]


def _sentences(answers: Sequence[Answer], groups: Sequence[str], question: Question) -> list[str]:
    if not answers:
        splits = "" if question.score == "file" else "; by=KEY splits it"
        return [f"There is one group only ({groups[0]}), so there is nothing to compare{splits}."]
    way = "" if question.score != "training" else f"by score=training window={100 * question.window:g}%"
    keys = [f"by {each.family.name}" if len(answers) > 1 else "" for each in answers]
    ways = [", ".join(filter(None, (way, key))) for key in keys]
    return [
        f"{way[0].upper()}{way[1:]}: {said(each)}" if way else said(each)
        for way, each in zip(ways, answers, strict=True)
    ]


def _scores(family: str, values: Mapping[str, Mapping[int, float]], answer: Answer | None) -> Table:
    """Return the score of each value of a family, and its difference from the baseline, if any."""
    baseline = answer.family.plan.baseline if answer else None
    found = {verdict.group: verdict for verdict in answer.decision.verdicts} if answer and baseline else {}
    table = []
    for value, seeds in values.items():
        low, high = _mean_interval(list(seeds.values()))
        verdict = found.get(value, Verdict(value, baseline or ""))
        table.append(
            {
                "family": family,
                "group": value,
                "seeds": len(seeds),
                "score": float(np.mean(list(seeds.values()))) if seeds else _NAN,
                "low": low,
                "high": high,
                "baseline": baseline or "",
                "difference": verdict.difference,
                "difference_low": verdict.low,
                "difference_high": verdict.high,
                "said": verdict.said if value in found else "",
            }
        )
    return table


def _mean_interval(seeds: Sequence[float] | Array) -> tuple[float, float]:
    """Return Student's interval; NaN for fewer than `FEWEST_SEEDS` seeds, where it is not reliable."""
    return mean_interval(seeds) if len(seeds) >= FEWEST_SEEDS else (_NAN, _NAN)


def _verdict(verdict: Verdict) -> Row:
    return {**asdict(verdict), "detectable": _NAN if verdict.detectable is None else verdict.detectable}


def _plan(answer: Answer) -> Row:
    plan, decision = answer.family.plan, answer.decision
    return {
        "family": answer.family.name,
        "planned": " ".join(map(str, plan.looks)),
        "taken": " ".join(str(look.size) for look in decision.looks),
        "error": plan.error,
        "spent": decision.spent,
        "next_look": decision.next_look or "",
    }


def _looks(answer: Answer) -> Table:
    return [
        {"family": answer.family.name, "look": index, "spent": look.error, **_verdict(verdict)}
        for index, look in enumerate(answer.decision.looks, 1)
        for verdict in look.verdicts
    ]


def _pooled(runs: Sequence[Training], column: str = "scores") -> Scores:
    """Return one column of all episodes of some runs."""
    return np.concatenate([getattr(training.episodes, column) for training in runs])


def _evaluation(label: str, runs: Sequence[Training], game: Game) -> Row:
    """Describe the episodes of a group."""
    summary, frames = summarize(_pooled(runs)), _pooled(runs, "frames").sum()
    normalised = human_normalised(summary.mean, game.random_score, game.human_score)
    return {
        "group": label,
        "runs": len(runs),
        **{key: getattr(summary, key) for key in ("episodes", "mean", "median", "low", "high")},
        "points_per_frame": float(_pooled(runs).sum() / frames) if frames else _NAN,
        "time_cap_share": float(_pooled(runs, "truncated").mean()),
        **({} if isnan(normalised) else {"human_normalised_mean": normalised}),
    }


def _why(label: str, runs: Sequence[Training], sources: Sequence[str]) -> Row:
    """Split a group's mean score into frames per episode times rate, and the rate into its sources.

    The rate is in points per 1,000 emulator frames. Its parts sum to it; they are NaN if an episode lacks them.
    """
    frames = _pooled(runs, "frames")
    thousands = frames.sum() / 1_000 or _NAN
    return {
        "group": label,
        "mean": float(_pooled(runs).mean()),
        "frames_mean": float(frames.mean()),
        "time_cap_share": float(_pooled(runs, "truncated").mean()),
        "points_per_1000_frames": float(_pooled(runs).sum() / thousands),
        **dict(zip(sources, (_pooled(runs, "points").sum(axis=0) / thousands).tolist(), strict=True)),
    }


def _runs(groups: Groups) -> Table:
    first: dict[bytes, str] = {}  # run by its scores, in the order of episodes
    table = []
    for label, training in ((label, training) for label, runs in groups.items() for training in runs):
        summary = summarize(training.episodes.scores)
        same_as = first.setdefault(training.episodes.scores.tobytes(), training.name)
        table.append(
            {
                "run": training.name,
                "group": label,
                "seed": training.config["seed"],
                **{axis: training.curve[axis][-1] if axis in training.curve else "" for axis in AXES},
                "epsilon": training.config["evaluation.epsilon"],
                "episodes": summary.episodes,
                "score": training.score,
                **{key: getattr(summary, key) for key in ("mean", "median", "low", "high")},
                "policy": training.policy,
                "same_as": same_as if same_as != training.name else "",
            }
        )
    return table


def _curve(axis: str, label: str, runs: Sequence[Training]) -> Table:
    """Return the mean over seeds up to the shortest run, with an interval if there are enough seeds."""
    if (grid := _grid(axis, runs)) is None:
        return []
    seeds = np.array([*one_a_seed(runs, partial(_at, axis=axis, x=grid)).values()])
    epsilon = np.mean([_at(run, axis, grid, "epsilon") for run in runs], axis=0)
    low, high = np.transpose([_mean_interval(column) for column in seeds.T])
    return _table(axis=axis, group=label, x=grid, score=seeds.mean(axis=0), low=low, high=high, epsilon=epsilon)


def _seed_curves(axis: str, label: str, runs: Sequence[Training]) -> Table:
    """Return the single curves of a group with several runs but too few for an interval."""
    seeds = {training.config["seed"] for training in runs}
    if len(runs) == 1 or len(seeds) >= FEWEST_SEEDS or (grid := _grid(axis, runs)) is None:
        return []
    of = {"axis": axis, "group": label}
    return [row for run in runs for row in _table(**of, run=run.name, x=grid, score=_at(run, axis, grid))]


def _grid(axis: str, runs: Sequence[Training]) -> Array | None:
    """Return points at which all runs have a curve; None if there are none."""
    if not all(axis in training.curve for training in runs):
        return None
    first = max(training.curve[axis][0] for training in runs)
    last = min(training.curve[axis][-1] for training in runs)
    return np.linspace(first, last, _GRID) if last > first else None


def _at(training: Training, axis: str, x: float | Array, measure: str = "score") -> Array:
    return np.asarray(np.interp(x, training.curve[axis], training.curve[measure]), np.float64)


def _profile(groups: Groups, game: Game) -> Table:
    """Return the share of episodes above tau (Agarwal et al. 2021), for tau over the range of scores."""
    if not groups:
        return []
    scores = np.concatenate([_pooled(runs) for runs in groups.values()])
    if game.is_logarithmic:
        least = game.score_range[0] / 10
        taus = np.unique(np.geomspace(max(scores.min() / 2, least), max(scores.max(), 2 * least), _GRID))
    else:
        taus = np.linspace(min(scores.min(), 0.0), max(scores.max(), 1.0), _GRID)
    shares = {label: (_pooled(runs) > taus[:, None]).mean(axis=1) for label, runs in groups.items()}
    return [row for label, share in shares.items() for row in _table(group=label, tau=taus, share=share)]


def _actions(label: str, runs: Sequence[Training]) -> Table:
    counts = _pooled(runs, "counts").sum(axis=0)
    network, chance = (counts / counts.sum()).T
    return _table(group=label, action=runs[0].episodes.actions, network=network, random=chance)


def _episodes(label: str, training: Training) -> Table:
    played = training.episodes
    steps, truncated = played.steps.astype(int), played.truncated.astype(int)
    at = {"run": training.name, "group": label}
    return _table(**at, episode=np.arange(steps.size), score=played.scores, steps=steps, truncated=truncated)


def _measured(player: Player) -> Row:
    scores = player.episodes.scores
    return {
        "name": f"{player.called}, measured",
        "score": float(scores.mean()),
        "points_per_frame": float(scores.sum() / frames) if (frames := player.episodes.frames.sum()) else _NAN,
        "kind": "player",
        "protocol": f"{scores.size} episodes under the runs' own settings",
        "source": player.name,
    }


def _views(groups: Groups) -> Table:
    """Compare the leader in each of the three fair views with the other groups, where the shortest run ends.

    These descriptions spend no look. Their intervals are those of one look at all pairs, whichever group leads.
    """
    table: Table = []
    trainings = [training for runs in groups.values() for training in runs]
    for axis, name in AXES.items() if len(groups) > 1 else ():
        if (grid := _grid(axis, trainings)) is None:
            continue
        shortest = float(grid[-1])
        at_end = partial(_at, axis=axis, x=shortest)
        values = {label: one_a_seed(runs, at_end) for label, runs in groups.items()}
        means = {label: float(np.mean(list(seeds.values()))) for label, seeds in values.items()}
        found = _at_once(values)
        leader, *others = sorted(means, key=lambda label: -means[label])
        for other in others:
            verdict = found.get((leader, other), Verdict(leader, other))
            table.append(
                {
                    "view": name,
                    "at": shortest,
                    "leader": leader,
                    "leader_score": means[leader],
                    "other": other,
                    "other_score": means[other],
                    "difference": means[leader] - means[other],
                    "low": verdict.low,
                    "high": verdict.high,
                }
            )
    return table


def _at_once(values: Mapping[str, Mapping[int, float]]) -> dict[tuple[str, str], Verdict]:
    """Return the verdicts of one look at all pairs with an error of 5 %, for their intervals.

    Return none for fewer than `FEWEST_SEEDS` seeds, or for unequal numbers, whose verdicts would not match the
    differences shown.
    """
    sizes = {len(seeds) for seeds in values.values()}
    if len(sizes) > 1 or min(sizes) < FEWEST_SEEDS:
        return {}
    verdicts = decide(values, Plan(looks=(min(sizes),))).verdicts
    return {(of.group, of.other): of for verdict in verdicts for of in (verdict, verdict.turned)}
