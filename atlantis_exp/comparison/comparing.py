"""A comparison as a run of its own: verdict, tables, figures and page of groups of finished runs."""

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import strftime

from rich.table import Table
from rich.text import Text

from atlantis_exp import terminal
from atlantis_exp.checking import digest, flatten
from atlantis_exp.comparison import published, tables
from atlantis_exp.comparison.export_tables import to_latex, to_parquet, with_units
from atlantis_exp.comparison.figures import draw
from atlantis_exp.comparison.gather import (
    COMMIT,
    Player,
    Training,
    gather,
    group,
    plays_alike,
    refuse_mixed_protocols,
    refuse_unknown,
    select,
    shortened,
)
from atlantis_exp.comparison.looks import read_looks, write_looks
from atlantis_exp.comparison.report import page, plain
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.verdict import Answer, Question, families, group_of
from atlantis_exp.comparison.words import spent
from atlantis_exp.config import PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.tracking.publishing import how_to_open, publishing

_PAGE = "comparison.html"


@dataclass(frozen=True)
class Probed:
    """What the groups' networks themselves were asked, and what came of it."""

    tables: Mapping[str, published.Table]
    films: Mapping[str, bytes]  # mp4, by artifact
    notes: Sequence[str]
    facts: Mapping[str, str]  # what was asked of all


Probe = Callable[[Mapping[str, Sequence[Training]], str | None], Probed]
"""Asks the networks of groups, each with each other one; of many groups, with the baseline, if there is one."""


def compare(
    question: Question,
    *,
    runs: Sequence[str],
    where: Sequence[str],
    at_epsilon: float | None,
    look_now: bool,
    tracking: TrackingConfig,
    paths: PathsConfig,
    command: str,
    probe: Probe | None = None,
) -> Comparison:
    """Compare all finished runs; print the answers, and keep page, figures and tables as a run of their own.

    The same question of more seeds is the same comparison: its folder holds the looks taken so far. Whether the
    networks are asked, too, by `probe`, is no part of the question.

    Raises:
        ConfigError: where nothing is to be compared, runs of different protocols would be, or no group is the baseline.
        Fault: where commits are compared with a baseline and another one is worse.
    """
    outputs = Path(paths.outputs)
    refuse_unknown(outputs, runs)
    with terminal.working(f"reading the runs under {outputs}"):
        gathered = gather(outputs, runs, at_epsilon, put_aside=COMMIT in question.by)
    for name, reason in gathered.skipped.items():
        terminal.warn(f"left out {name}: {reason}")
    trainings = select(gathered.trainings, where)
    if not trainings:
        none = f": none of {len(gathered.trainings)} has where={','.join(where)}" if gathered.trainings else ""
        raise ConfigError(f"there is no finished training under {outputs / 'runs'} that compare was asked for{none}")
    refuse_mixed_protocols(trainings, question.by)
    question = replace(question, by=shortened(question.by, trainings[0].facts))
    groups = group(trainings, question.by)
    asked = families([group_of(members, question.by) for members in groups.values()], question)

    # Before a look is spent and the folder held: it takes minutes.
    baseline = next((each.plan.baseline for each in asked if each.plan.baseline is not None), None)
    probed = probe(groups, baseline) if probe else Probed({}, {}, (), {})

    identity = {
        **asdict(question),
        "by": list(question.by),
        "runs": sorted({*runs}),
        "where": sorted({*where}),
        "at_epsilon": at_epsilon,
        "baseline": baseline,
        "groups": [[label, *_recipes(members)] for label, members in groups.items()],
    }
    facts = {**identity, "compared": [training.name for training in trainings]}
    folder = RunFolder(outputs / "comparisons" / f"{slug(list(groups))}-{digest(identity)}")
    name, colour = folder.name, run_colour("comparison")
    tags = {"mlflow.runName": name, "mlflow.runColor": colour, "atlantis.kind": "comparison"}
    with folder.held():
        record = read_looks(folder.path, asked)
        with terminal.working("computing the tables"):
            comparison = tables.compare(gathered, groups, question, record, look_now)
        write_looks(folder.path, comparison.answers)
        comparison = replace(
            comparison,
            tables={**comparison.tables, **probed.tables},
            notes=[*comparison.notes, *probed.notes],
        )
        made = provenance(command)
        shown = {
            "command": made["command"],
            "made": strftime("%Y-%m-%d %H:%M %Z"),
            "code": made.get("git.commit", made["version.atlantis-exp"]),
            "runs": f"{len(trainings)} under {outputs / 'runs'}",
            **probed.facts,
        }
        with terminal.working("drawing the figures"):
            figures = draw(comparison)
        with publishing(folder, tracking, outputs, tags) as journal:
            folder.write_config(facts)
            journal.params({key: str(value) for key, value in flatten(facts).items()})
            journal.tags({**made, "verdict": comparison.verdict})
            journal.note("\n\n".join([comparison.verdict, *comparison.others, *comparison.caveats, *comparison.notes]))
            journal.metrics(_metrics(comparison), 0)
            journal.artifact(_PAGE, page(comparison, figures, shown).encode())
            for name, figure in figures.items():
                journal.artifact(f"figures/{name}.png", figure.png)
            for name, film in probed.films.items():
                journal.artifact(name, film)
            for name, table in comparison.tables.items():
                journal.artifact(f"tables/{name}.csv", tables.to_csv(with_units(name, table)).encode())
                journal.artifact(f"tables/{name}.tex", to_latex(name, table).encode())
                journal.artifact(f"tables/{name}.parquet", to_parquet(name, table))
            journal.finish()
    _print(comparison)
    players = [player for player in gathered.players if plays_alike(player, trainings)]
    _print_film((*trainings, *players))
    print(f"{how_to_open(outputs)}\n{folder.artifact(_PAGE)}")
    if COMMIT in question.by and (worse := worse_than_baseline(comparison.answers, question.by)):
        raise Fault(f"worse than the baseline {question.baseline}: {'; '.join(worse)}")
    return comparison


def worse_than_baseline(answers: Sequence[Answer], by: Sequence[str]) -> list[str]:
    """What was found worse than the baseline and differs from it in its commit alone, by how much."""
    place = list(by).index(COMMIT)

    def others(answer: Answer, value: str) -> set[tuple[str, ...]]:
        return {group.values[:place] + group.values[place + 1 :] for group in answer.family.groups[value]}

    def commits(answer: Answer, value: str) -> set[str]:
        return {group.values[place] for group in answer.family.groups[value]}

    base = {commit for each in answers if (name := each.family.plan.baseline) for commit in commits(each, name)}
    lines = []
    for each in answers:  # also a family without the baseline, as of the groups behind its average
        for verdict in each.decision.verdicts:
            match verdict.said:
                case "worse":
                    worse, better, low, high = verdict.group, verdict.other, -verdict.high, -verdict.low
                case "better":
                    worse, better, low, high = verdict.other, verdict.group, verdict.low, verdict.high
                case _:
                    continue
            is_of_baseline = commits(each, better) == base and commits(each, worse) != base
            if is_of_baseline and others(each, worse) == others(each, better):
                lines.append(
                    f"{worse} by {abs(verdict.difference):,.0f} points ({low:,.0f} to {high:,.0f}, "
                    f"{verdict.seeds} seeds each)"
                )
    return lines


def _recipes(runs: Sequence[Training]) -> list[str]:
    """What a group's runs are but for their seeds: their science, how long they trained and how they were evaluated.

    A key that differs between seeds, but not between runs of one seed, may follow from the seed and says nothing: with
    evaluation.seed=${seed} each further seed would else make another comparison, without the looks taken before.
    """
    recipes = [run.science | {key: run.config[key] for key in ("budget.steps", "evaluation.epsilon")} for run in runs]
    seeds = {run.config["seed"] for run in runs}

    def follows(key: str) -> bool:
        values = {(run.config["seed"], json.dumps(recipe.get(key))) for run, recipe in zip(runs, recipes, strict=True)}
        return len(values) == len(seeds) > 1 and len({value for _, value in values}) > 1

    left_out = {key for recipe in recipes for key in recipe if follows(key)} | {"seed"}
    return sorted({digest({key: recipe[key] for key in recipe.keys() - left_out}) for recipe in recipes})


def _metrics(comparison: Comparison) -> dict[str, float]:
    """The decided quantity, in MLflow's alphabet."""
    metrics: dict[str, float] = {}
    for row in comparison.tables["verdict"]:
        if row["seeds"]:
            pair = f"difference/{slug([row['group']])} over {slug([row['other']])}"
            metrics |= {pair: row["difference"], f"{pair}/decided": float(row["said"] != "not decided")}
    return metrics


def _print(comparison: Comparison) -> None:
    console = terminal.console(least=160)
    for name, title in (("scores", "scores"), ("evaluation", "episodes")):
        header, *rows = plain(name, comparison.tables[name])
        table = Table(*header, title=f"{title} after the last step, by {', '.join(comparison.by)}")
        for column in table.columns[1:]:
            column.justify = "right"
        for row in rows:
            table.add_row(*map(Text, row))
        console.print(table)
    for note in comparison.notes:
        console.print(f"- {note}")
    console.print()
    for each in comparison.answers:
        console.print(f"By {each.family.name}: {spent(each)}.")
    for sentence in comparison.caveats:
        console.print(f"- {sentence}")
    for sentence in (*reversed(comparison.others), comparison.verdict):
        console.print(f"\n{sentence}")


def _print_film(played: Sequence[Training | Player]) -> None:
    """Say where the highest score of all can be seen, if it was filmed."""
    best = max(played, key=lambda each: each.episodes.scores.max())
    if best.film is not None and best.film.exists():
        print(f"\nthe highest score, {best.episodes.scores.max():,.0f}, as a film: {best.film}")


def slug(groups: Sequence[str]) -> str:
    """What a folder or a file is called after the groups' labels."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", "-vs-".join(groups))[:80].strip("-.") or "group"
