"""A comparison as a run of its own: verdict, tables, figures and page of groups of finished runs."""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from time import strftime

from rich.console import Console
from rich.table import Table
from rich.text import Text

from atlantis_exp.checking import digest, flatten
from atlantis_exp.comparison import tables
from atlantis_exp.comparison.figures import draw
from atlantis_exp.comparison.gather import gather, group, refuse_mixed_protocols, select
from atlantis_exp.comparison.report import page, plain
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.config import PathsConfig, TrackingConfig
from atlantis_exp.faults import ConfigError
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.tracking.publishing import publishing

_PAGE = "comparison.html"


def compare(
    *,
    by: Sequence[str],
    runs: Sequence[str],
    where: Sequence[str],
    at_epsilon: float | None,
    resamples: int,
    seed: int,
    tracking: TrackingConfig,
    paths: PathsConfig,
    command: str,
) -> None:
    """Compare all finished runs; print the verdict, and keep page, figures and tables as a run of their own.

    Raises:
        ConfigError: where nothing is to be compared, or runs of different protocols would be.
    """
    outputs = Path(paths.outputs)
    gathered = gather(outputs, runs, at_epsilon)
    for name, reason in gathered.skipped.items():
        print(f"atlantis_exp: left out {name}: {reason}", file=sys.stderr)
    trainings = select(gathered.trainings, where)
    if not trainings:
        raise ConfigError(f"there is no finished training under {outputs / 'runs'} that compare was asked for")
    refuse_mixed_protocols(trainings, by)
    groups = group(trainings, by)
    comparison = tables.compare(gathered, groups, by, resamples, seed)

    settings = {
        "by": list(by),
        "runs": list(runs),
        "where": list(where),
        "at_epsilon": at_epsilon,
        "resamples": resamples,
        "seed": seed,
    }
    facts = {**settings, "compared": [training.name for training in trainings]}
    folder = RunFolder(outputs / "comparisons" / f"{_slug(comparison.groups)}-{digest(facts)}")
    made = provenance(command)
    shown = {
        "command": made["command"],
        "made": strftime("%Y-%m-%d %H:%M %Z"),
        "code": made.get("git.commit", made["version.atlantis-exp"]),
        "runs": f"{len(trainings)} under {outputs / 'runs'}",
        "bootstrap": f"{tables.fewer_samples(groups, resamples):,} samples, seed {seed}",
    }
    figures = draw(comparison)
    name, colour = folder.name, run_colour("comparison")
    tags = {"mlflow.runName": name, "mlflow.runColor": colour, "atlantis.kind": "comparison"}
    with folder.held(), publishing(folder, tracking, outputs, tags) as journal:
        folder.write_config(facts)
        journal.params({key: str(value) for key, value in flatten(facts).items()})
        journal.tags({**made, "verdict": comparison.verdict})
        journal.note("\n\n".join([comparison.verdict, *comparison.notes]))
        for view in comparison.tables["verdict"]:
            name = view["view"].replace(" ", "_")
            journal.metrics({f"{name}/difference": view["difference"], f"{name}/decided": view["decided"]}, 0)
        journal.artifact(_PAGE, page(comparison, figures, shown).encode())
        for name, figure in figures.items():
            journal.artifact(f"figures/{name}.png", figure.png)
        for name, table in comparison.tables.items():
            journal.artifact(f"tables/{name}.csv", tables.to_csv(table).encode())
        journal.finish()
    _print(comparison)
    print(f"\n{folder.artifact(_PAGE)}")


def _print(comparison: Comparison) -> None:
    header, *rows = plain("evaluation", comparison.tables["evaluation"])
    table = Table(*header, title=f"evaluation after the last step, by {', '.join(comparison.by)}")
    for column in table.columns[1:]:
        column.justify = "right"
    for row in rows:
        table.add_row(*map(Text, row))
    console = Console(highlight=False)
    console = Console(highlight=False, width=max(console.width, 160))
    console.print(table)
    for note in comparison.notes:
        console.print(f"- {note}", markup=False)
    console.print(f"\n{comparison.verdict}", markup=False)


def _slug(groups: list[str]) -> str:
    """A folder's name from the groups' labels."""
    return re.sub(r"[^A-Za-z0-9.]+", "-", "-vs-".join(groups))[:80].strip("-")
