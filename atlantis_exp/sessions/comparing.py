"""Compare finished runs: take the looks that are due, publish and print the answers."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from time import strftime
from typing import Any

from rich.text import Text

from atlantis_exp import terminal
from atlantis_exp.checking import digest, flatten
from atlantis_exp.comparison import tables
from atlantis_exp.comparison.account import read_account
from atlantis_exp.comparison.choosing import (
    COMMIT,
    group,
    is_where,
    plays_alike,
    refuse_mixed_protocols,
    select,
    shortened,
)
from atlantis_exp.comparison.elsewhere import read_scores
from atlantis_exp.comparison.estimands import by_training
from atlantis_exp.comparison.export_tables import to_latex, with_units
from atlantis_exp.comparison.figures import Drawn, draw
from atlantis_exp.comparison.gather import Gathered, Player, Training, gather, refuse_unknown
from atlantis_exp.comparison.looks import write_looks
from atlantis_exp.comparison.page import page, plain
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.verdict import Question, families, group_of, worse_than_baseline
from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.job import labels
from atlantis_exp.sessions.page import opened
from atlantis_exp.tracking.publishing import how_to_open

_PAGE = "comparison.html"


@dataclass(frozen=True)
class Choice:
    """The finished runs to compare, and the evaluations to use."""

    outputs: Path
    runs: Sequence[str] = ()  # names, starts of names, patterns or a decision's name; none: all
    where: Sequence[str] = ()  # KEY=VALUE
    at_epsilon: float | None = None  # of the evaluations; None: each run's latest
    scores: Path | None = None  # a table of seeds trained elsewhere, in place of runs
    columns: Mapping[str, str] = field(default_factory=dict)  # of that table: names by group, seed and score


def compare(
    question: Question, choice: Choice, tracking: TrackingConfig, command: str, *, look_now: bool = False
) -> Comparison:
    """Compare finished runs, print the answers, and record page, figures and tables as a run.

    A question keeps its folder, with the looks taken so far, as seeds are added.

    Raises: ConfigError if there is nothing to compare, the runs' protocols differ, or no group is the baseline.
    """
    outputs = choice.outputs
    if choice.scores is None:
        gathered = _gather(choice, put_aside=COMMIT in question.by)
        refuse_mixed_protocols(gathered.trainings, question.by)
        if question.score == "training":
            gathered = replace(gathered, trainings=by_training(gathered.trainings, outputs, question.window))
        question = replace(question, by=shortened(question.by, gathered.trainings[0].facts))
        groups = group(gathered.trainings, question.by)
        scored = [group_of(members, question.by) for members in groups.values()]
        of: dict[str, Any] = {"groups": [[label, *_recipes(members)] for label, members in groups.items()]}
        compared = f"{len(gathered.trainings)} under {outputs / 'runs'}"
    else:
        question, gathered, groups = replace(question, by=("group",), score="file"), Gathered(), {}
        scored = read_scores(choice.scores, choice.columns)
        path = str(choice.scores.resolve())
        of = {"groups": [each.label for each in scored], "scores": path, "columns": dict(choice.columns)}
        compared = f"{sum(len(each.seeds) for each in scored)} seeds in {path}"
    trainings = gathered.trainings
    asked = families(scored, question)
    identity = {
        **question.identity,
        "by": list(question.by),
        "runs": sorted({*choice.runs}),
        "where": sorted({*choice.where}),
        "at_epsilon": choice.at_epsilon,
        "baseline": next((each.plan.baseline for each in asked if each.plan.baseline is not None), None),
        **of,
    }
    folder = RunFolder(outputs / "comparisons" / f"{_slug([each.label for each in scored])}-{digest(identity)}")
    shown = labels(folder.name, run_colour("comparison"), "comparison")
    with opened(folder, tracking, outputs, shown, command) as journal:
        account = read_account(folder, asked, identity, [training.name for training in trainings])
        with terminal.working("computing the tables"):
            comparison = tables.compare(gathered, groups, question, account, look_now, scored)
        write_looks(folder.path, comparison.answers)
        folder.write_config({**identity, **account.kept})
        journal.params({key: str(value) for key, value in flatten(identity).items()})
        with terminal.working("drawing the figures"):
            figures = draw(comparison)
        _write(journal, comparison, figures, provenance(command), compared)
    _print(comparison)
    _print_film([*trainings, *(player for player in gathered.players if plays_alike(player, trainings))])
    print(f"{how_to_open(outputs)}\n{folder.artifact(_PAGE)}")
    return comparison


def refuse_worse_commits(comparison: Comparison, baseline: str | None) -> None:
    """Raise Fault if a commit is worse than the baseline that it was compared with."""
    if COMMIT in comparison.by and (worse := worse_than_baseline(comparison.answers, comparison.by)):
        raise Fault(f"worse than the baseline {baseline}: {'; '.join(worse)}")


def _gather(choice: Choice, put_aside: bool) -> Gathered:
    """Read the chosen runs; warn of those left out. Raises: ConfigError if none is left."""
    refuse_unknown(choice.outputs, choice.runs)
    with terminal.working(f"reading the runs under {choice.outputs}"):
        gathered = gather(choice.outputs, choice.runs, choice.at_epsilon, put_aside)
    for name, reason in gathered.skipped.items():
        terminal.warn(f"left out {name}: {reason}")
    if not (trainings := select(gathered.trainings, choice.where)):
        found = len(gathered.trainings)
        none = f": none of {found} has where={','.join(choice.where)}" if found else ""
        raise ConfigError(f"no finished training under {choice.outputs / 'runs'} to compare{none}")
    lost = [run for run in gathered.lost if is_where(run, choice.where)]
    return replace(gathered, trainings=trainings, lost=lost)


def _recipes(runs: Sequence[Training]) -> list[str]:
    """Hash a group's runs without their seeds: science, length and evaluation.

    Leave out keys that may follow from the seed: they differ between seeds, but not between runs of one seed. With
    evaluation.seed=${seed} each new seed would otherwise begin another comparison and lose the looks taken.
    """
    recipes = [run.science | {key: run.config[key] for key in ("budget.steps", "evaluation.epsilon")} for run in runs]
    for recipe, run in zip(recipes, runs, strict=True):
        if (flops := run.config.get("budget.flops")) is not None:  # older comparisons lack the key
            recipe["budget.flops"] = flops
    seeds = {run.config["seed"] for run in runs}

    def follows(key: str) -> bool:
        values = {(run.config["seed"], json.dumps(recipe.get(key))) for run, recipe in zip(runs, recipes, strict=True)}
        return len(values) == len(seeds) > 1 and len({value for _, value in values}) > 1

    left_out = {key for recipe in recipes for key in recipe if follows(key)} | {"seed"}
    return sorted({digest({key: recipe[key] for key in recipe.keys() - left_out}) for recipe in recipes})


def _write(
    journal: Journal, comparison: Comparison, figures: Mapping[str, Drawn], made: Mapping[str, str], compared: str
) -> None:
    """Write the page, figures and tables, and the note and metrics for MLflow."""
    shown = {
        "command": made["command"],
        "made": strftime("%Y-%m-%d %H:%M %Z"),
        "code": made.get("git.commit", made["version.atlantis-exp"]),
        "runs": compared,
    }
    journal.tags({"verdict": comparison.verdict})
    journal.note("\n\n".join([comparison.verdict, *comparison.others, *comparison.caveats, *comparison.notes]))
    journal.metrics(_metrics(comparison), 0)
    journal.artifact(_PAGE, page(comparison, figures, shown).encode())
    for name, figure in figures.items():
        journal.artifact(f"figures/{name}.png", figure.png)
    for name, table in comparison.tables.items():
        journal.artifact(f"tables/{name}.csv", tables.to_csv(with_units(name, table)).encode())
        journal.artifact(f"tables/{name}.tex", to_latex(name, table).encode())


def _metrics(comparison: Comparison) -> dict[str, float]:
    """Return each pair's difference, and whether it is decided, under names that MLflow accepts."""
    metrics: dict[str, Any] = {}
    for row in comparison.tables["verdict"]:
        if row["seeds"]:
            pair = f"difference/{_slug([row['group']])} over {_slug([row['other']])}"
            if pair in metrics:  # other names with the same letters, or another family's pair
                pair += f" {len(metrics) // 2}"
            metrics |= {pair: row["difference"], f"{pair}/decided": float(row["said"] != "not decided")}
    return metrics


def _print(comparison: Comparison) -> None:
    """Print scores, caveats and, last, the answers; the page has the rest."""
    console = terminal.console(least=160)
    header, *rows = plain("scores", comparison.tables["scores"], comparison.question.score)
    table = terminal.table(*header, title=f"scores by {', '.join(comparison.by)}")
    for row in rows:
        table.add_row(*map(Text, row))
    console.print(table)
    for sentence in comparison.caveats:
        console.print(f"- {sentence}")
    for sentence in (*reversed(comparison.others), comparison.verdict):
        console.print(f"\n{sentence}")


def _print_film(played: Sequence[Training | Player]) -> None:
    """Print the path of the film of the highest score, if there is one."""
    best = max(played, key=lambda each: each.episodes.scores.max(), default=None)
    if best is not None and best.film is not None and best.film.exists():
        print(f"\nthe highest score, {best.episodes.scores.max():,.0f}, as a film: {best.film}")


def _slug(groups: Sequence[str]) -> str:
    """Join the labels of groups to a file name."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", "-vs-".join(groups))[:80].strip("-.") or "group"
