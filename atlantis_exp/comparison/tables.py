"""Runs to tables and a verdict: every number that a figure or the page shows is in one of the tables."""

import csv
import io
import json
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from itertools import combinations
from typing import Any

import numpy as np

from atlantis_exp.comparison.gather import Array, Gathered, Player, Training, plays_alike, resolve
from atlantis_exp.statistics import (
    EARLY_FRAMES,
    FEWEST_SEEDS,
    RANDOM_SCORE,
    Scores,
    difference,
    human_normalised,
    interquartile_mean,
    interval,
    probability_of_improvement,
    resample,
    summarize,
)

Row = dict[str, Any]
Table = list[Row]
Groups = Mapping[str, Sequence[Training]]

AXES = {"frames": "equal frames", "hours": "equal hours", "flops": "equal gradient FLOPs"}
"""The three fair views: column of a learning curve to what is equal."""

_GRID = 100  # points of a curve
_MOST_DRAWN = 40_000_000  # scores in all bootstrap samples together: 320 MB
_FEWEST_SAMPLES = 200
_HELD = 2_000.0  # what any one action scores when it is held


@dataclass(frozen=True)
class Comparison:
    """All that is known about some groups of runs."""

    groups: list[str]
    by: list[str]
    verdict: str
    notes: list[str]
    tables: dict[str, Table]


def compare(gathered: Gathered, groups: Groups, by: Sequence[str], resamples: int, seed: int) -> Comparison:
    """Compare groups of trainings; intervals are 95 % bootstrap intervals of `resamples` samples drawn from `seed`.

    Of very many episodes there are fewer, see `fewer_samples`.
    """
    rng = np.random.default_rng(seed)
    resamples = fewer_samples(groups, resamples)
    samples = {
        label: resample([training.episodes.scores for training in runs], resamples, rng)
        for label, runs in groups.items()
    }
    views = _views(groups)
    trainings = [training for runs in groups.values() for training in runs]
    players = [player for player in gathered.players if plays_alike(player, trainings[0])]
    evaluation = [_evaluation(label, runs, samples[label]) for label, runs in groups.items()]
    frames = max((training.curve["frames"][-1] for training in trainings if training.curve), default=0.0)
    tables: dict[str, Table] = {
        "verdict": views,
        "evaluation": evaluation,
        "improvement": _improvement(groups, samples),
        "runs": [_run(label, training) for label, runs in groups.items() for training in runs],
        "curves": [row for axis in AXES for label, runs in groups.items() for row in _curve(axis, label, runs, rng)],
        "profile": _profile(groups, samples),
        "actions": [row for label, runs in groups.items() for row in _actions(label, runs)],
        "episodes": [row for label, runs in groups.items() for training in runs for row in _episodes(label, training)],
        "references": [_measured(player) for player in players] + literature("scores"),
        "published_curves": [row for row in literature("curves") if row["frames"] <= frames],
        "skipped": [{"run": name, "reason": reason} for name, reason in gathered.skipped.items()],
    }
    notes = _notes(groups, by, views, evaluation, random_line(tables["references"]), frames)
    return Comparison(list(groups), list(by), _verdict(views, groups), notes, tables)


def fewer_samples(groups: Groups, resamples: int) -> int:
    """As many bootstrap samples as are asked for, but of very many episodes fewer, so that all fit into memory."""
    episodes = sum(training.episodes.scores.size for runs in groups.values() for training in runs)
    return min(resamples, max(_FEWEST_SAMPLES, _MOST_DRAWN // episodes))


def to_csv(table: Table) -> str:
    """A table with its keys as header; empty for an empty table."""
    text = io.StringIO()
    if table:
        writer = csv.DictWriter(text, table[0].keys(), lineterminator="\n")
        writer.writeheader()
        writer.writerows(table)
    return text.getvalue()


def literature(name: str) -> Table:
    """The published `scores` (players and algorithms) or learning `curves` that ship with the package, with sources."""
    text = (files("atlantis_exp.comparison") / f"published_{name}.csv").read_text("utf-8")
    table: Table = list(csv.DictReader(io.StringIO(text)))
    for row in table:
        for key in {"score", "mean", "low", "high", "seeds"} & row.keys():
            row[key] = float(row[key])
        if "frames_millions" in row:
            row["frames"] = 1e6 * float(row.pop("frames_millions"))
    return table


def random_line(references: Table) -> Row:
    """The random player measured under the runs' own settings, else the published one."""
    return next(row for row in references if row["name"].startswith("random"))


def _pooled(runs: Sequence[Training]) -> Scores:
    return np.concatenate([training.episodes.scores for training in runs])


def _mean(scores: Scores) -> float:
    return float(scores.mean())


def _median(scores: Scores) -> float:
    return float(np.median(scores))


def _evaluation(label: str, runs: Sequence[Training], samples: Sequence[Scores]) -> Row:
    scores = _pooled(runs)
    row: Row = {"group": label, "runs": len(runs), "episodes": scores.size}
    for name, statistic in (("iqm", interquartile_mean), ("mean", _mean), ("median", _median)):
        low, high = interval([statistic(sample) for sample in samples])
        row |= {name: statistic(scores), f"{name}_low": float(low), f"{name}_high": float(high)}
    steps = np.concatenate([training.episodes.steps for training in runs])
    truncated = np.concatenate([training.episodes.truncated for training in runs])
    return row | {
        "low": float(scores.min()),
        "high": float(scores.max()),
        "score_per_1000_steps": float(1_000 * scores.sum() / steps.sum()),
        "time_cap_share": float(truncated.mean()),
        "human_normalised_mean": human_normalised(float(scores.mean())),
    }


def _run(label: str, training: Training) -> Row:
    summary = summarize(training.episodes.scores)
    last = {axis: training.curve[axis][-1] if axis in training.curve else "" for axis in AXES}
    return {
        "run": training.name,
        "group": label,
        "seed": training.config["seed"],
        **last,
        "epsilon": training.config["evaluation.epsilon"],
        "episodes": summary.episodes,
        "iqm": summary.interquartile_mean,
        "mean": summary.mean,
        "median": summary.median,
        "low": summary.low,
        "high": summary.high,
    }


def _improvement(groups: Groups, samples: Mapping[str, Sequence[Scores]]) -> Table:
    table = []
    for one, other in combinations(groups, 2):
        estimates = [probability_of_improvement(*pair) for pair in zip(samples[one], samples[other], strict=True)]
        low, high = interval(estimates)
        probability = probability_of_improvement(_pooled(groups[one]), _pooled(groups[other]))
        table.append({"group": one, "over": other, "probability": probability, "low": float(low), "high": float(high)})
    return table


def _curve(axis: str, label: str, runs: Sequence[Training], rng: np.random.Generator) -> Table:
    """The mean over runs as far as all of them go, with a bootstrap band over runs where there are several."""
    if not all(axis in training.curve for training in runs):
        return []
    first = max(training.curve[axis][0] for training in runs)
    last = min(training.curve[axis][-1] for training in runs)
    if last <= first:
        return []
    grid = np.linspace(first, last, _GRID)
    scores = np.array([_at(training, axis, grid) for training in runs])
    epsilons = np.mean([_at(training, axis, grid, "epsilon") for training in runs], axis=0)
    drawn = rng.multinomial(len(runs), np.full(len(runs), 1 / len(runs)), size=2_000)  # how often each run is
    low, high = interval(drawn @ scores / len(runs))
    return [
        {"axis": axis, "group": label, "x": x, "score": score, "low": under, "high": over, "epsilon": epsilon}
        for x, score, under, over, epsilon in np.stack(
            (grid, scores.mean(axis=0), low, high, epsilons), axis=1
        ).tolist()
    ]


def _at(training: Training, axis: str, x: float | Array, measure: str = "score") -> Array:
    return np.asarray(np.interp(x, training.curve[axis], training.curve[measure]), np.float64)


def _profile(groups: Groups, samples: Mapping[str, Sequence[Scores]]) -> Table:
    """The share of episodes that score more than tau (Agarwal et al. 2021), for tau over all scores."""
    scores = np.concatenate([_pooled(runs) for runs in groups.values()])
    taus = np.unique(np.geomspace(max(scores.min() / 2, 100.0), max(scores.max(), 200.0), _GRID))
    table = []
    for label, runs in groups.items():
        low, high = interval([_shares(sample, taus) for sample in samples[label]])
        rows = zip(taus.tolist(), _shares(_pooled(runs), taus).tolist(), low.tolist(), high.tolist(), strict=True)
        table += [{"group": label, "tau": tau, "share": share, "low": a, "high": b} for tau, share, a, b in rows]
    return table


def _shares(scores: Scores, taus: Scores) -> Scores:
    return np.asarray(1 - np.searchsorted(np.sort(scores), taus, "right") / scores.size, np.float64)


def _actions(label: str, runs: Sequence[Training]) -> Table:
    counts = sum(training.episodes.counts.sum(axis=0) for training in runs)
    shares = np.asarray(counts) / np.sum(counts)
    return [
        {"group": label, "action": action, "network": float(network), "random": float(chance)}
        for action, (network, chance) in zip(runs[0].episodes.actions, shares, strict=True)
    ]


def _episodes(label: str, training: Training) -> Table:
    episodes = training.episodes
    rows = zip(episodes.scores.tolist(), episodes.steps.tolist(), episodes.truncated.tolist(), strict=True)
    return [
        {
            "run": training.name,
            "group": label,
            "episode": index,
            "score": score,
            "steps": int(steps),
            "truncated": int(cut),
        }
        for index, (score, steps, cut) in enumerate(rows)
    ]


def _measured(player: Player) -> Row:
    scores, config = player.episodes.scores, player.config
    if "player" in config:
        name = f"{config['player']} (human)"
    elif config["agent.name"] == "constant":
        name = f"{player.episodes.actions[config['agent.action']]} held"
    else:
        name = "random player"
    return {
        "name": f"{name}, measured",
        "score": float(scores.mean()),
        "kind": "player",
        "protocol": f"{scores.size} episodes under the runs' own settings",
        "source": player.name,
    }


def _views(groups: Groups) -> Table:
    """The leader against the runner-up in the evaluation and in the three fair views, by one value a run."""
    table: Table = []
    if len(groups) < 2:
        return table
    values = {
        label: [interquartile_mean(training.episodes.scores) for training in runs] for label, runs in groups.items()
    }
    table.append(_view("evaluation", "", values))
    for axis, name in AXES.items():
        trainings = [training for runs in groups.values() for training in runs]
        if not all(axis in training.curve for training in trainings):
            continue
        shortest = min(float(training.curve[axis][-1]) for training in trainings)
        if shortest <= max(float(training.curve[axis][0]) for training in trainings):
            continue
        values = {label: [float(_at(run, axis, shortest)) for run in runs] for label, runs in groups.items()}
        table.append(_view(name, shortest, values))
    return table


def _view(name: str, at: float | str, values: Mapping[str, Sequence[float]]) -> Row:
    leader, other = sorted(values, key=lambda label: -float(np.mean(values[label])))[:2]
    found = difference(values[leader], values[other])
    return {
        "view": name,
        "at": at,
        "leader": leader,
        "other": other,
        "leader_score": float(np.mean(values[leader])),
        "other_score": float(np.mean(values[other])),
        "difference": found.value,
        "low": found.low,
        "high": found.high,
        "decided": found.is_decided,
        "more_seeds": found.more_seeds,
    }


def _verdict(views: Table, groups: Groups) -> str:
    """One sentence: who leads, by how much, how surely, and whether the fair views agree."""
    if not views:
        (label,) = groups
        return f"There is one group only ({label}), so there is nothing to compare; by=KEY splits it."
    main, *fair = views
    sizes = " and ".join(str(len(groups[main[side]])) for side in ("leader", "other"))
    known = f"95 % interval {main['low']:,.0f} to {main['high']:,.0f}, " if not np.isnan(main["low"]) else ""
    gap = f"{main['difference']:,.0f} points of evaluation IQM ({known}{sizes} runs)"
    if main["decided"]:
        said = f"{main['leader']} plays better than {main['other']}, by {gap}"
    elif main["more_seeds"] is None:
        said = f"Not decided: {main['leader']} is ahead of {main['other']} by {gap}, too little for any number of seeds"
    else:
        more = (
            f"one seed says nothing of the next, so at least {main['more_seeds']} more seeds each are needed"
            if np.isnan(main["low"])
            else f"about {main['more_seeds']} more seeds each would decide a difference of this size"
        )
        said = f"Not decided: {main['leader']} is ahead of {main['other']} by {gap}; {more}"
    sides = defaultdict(list)
    for view in fair:
        sides[view["leader"]].append(f"{view['view']}{'' if view['decided'] else ' (not decided)'}")
    if sides:
        said += "; in training " + " and ".join(f"{label} leads at {', '.join(at)}" for label, at in sides.items())
    return said + "."


def _notes(
    groups: Groups, by: Sequence[str], views: Table, evaluation: Table, random_player: Row, frames: float
) -> list[str]:
    """What a reader must know before believing the tables."""
    notes = []
    for label, runs in groups.items():
        if len(runs) < FEWEST_SEEDS:
            notes.append(
                f"{label} has {len(runs)} of the {FEWEST_SEEDS} seeds without which no interval can be trusted."
            )
    varied = {label: _differing([run.science for run in runs]) for label, runs in groups.items()}
    for label, keys in varied.items():
        if keys := {key: values for key, values in keys.items() if key != "seed"}:
            listed = ", ".join(f"{key} ({' or '.join(values)})" for key, values in keys.items())
            notes.append(f"{label} mixes runs that differ in more than their seed: {listed}; by= can tell them apart.")
    within = {key for keys in varied.values() for key in keys}
    firsts = [runs[0] for runs in groups.values()]
    asked = {resolve(key, run.config) for key in by for run in firsts}
    between = {
        key: values
        for key, values in _differing([run.science for run in firsts]).items()
        if key not in within | asked and not set(by) & set(key.split("."))
    }
    if between:
        listed = ", ".join(f"{key} ({' or '.join(values)})" for key, values in between.items())
        notes.append(f"The groups also differ in {listed}.")
    shown = {view["view"] for view in views}
    missing = [name for name in AXES.values() if views and name not in shown]
    if missing:
        notes.append(f"No verdict at {' and '.join(missing)}: a run has no such learning curve, or one too short.")
    if capped := [f"{row['time_cap_share']:.0%} of {row['group']}" for row in evaluation if row["time_cap_share"] > 0]:
        notes.append(
            f"The time cap ended episodes and so decides their scores: {', '.join(capped)}; "
            f"look at the score per 1,000 steps."
        )
    for runs in groups.values():
        notes += [
            f"{run.name} scored {_HELD:,.0f} in every episode, as any one action does that is held: it has collapsed."
            for run in runs
            if (run.episodes.scores == _HELD).all()
        ]
    if random_player["protocol"].startswith("published"):
        notes.append(
            "No random player was measured under these settings, so a published one takes its place; "
            "python -m atlantis_exp baseline with the same env measures one."
        )
    if frames <= EARLY_FRAMES and any(row["iqm"] < random_player["score"] for row in evaluation):
        notes.append(early_dqn())
    return notes


def early_dqn() -> str:
    """Why below random is no bug, from the published learning curves."""
    at = [row for row in literature("curves") if row["name"].startswith("DQN") and row["frames"] == 5e6]
    low, high = min(row["mean"] for row in at), max(row["mean"] for row in at)
    return (
        f"At 5 M frames published DQN scores {low:,.0f} to {high:,.0f}, below the random player's "
        f"{RANDOM_SCORE:,.0f}: below random is normal here ({at[0]['source'].rpartition('/')[0]})."
    )


def _differing(configs: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """The keys in which configs differ, with their values."""
    keys = dict.fromkeys(key for config in configs for key in config)
    values = {key: list(dict.fromkeys(json.dumps(config.get(key)) for config in configs)) for key in keys}
    return {key: found for key, found in values.items() if len(found) > 1}
