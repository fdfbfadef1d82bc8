"""`python -m atlantis_exp compare by=model,sampler`: which group of runs is better, by how much, how surely."""

import re
import sys
from pathlib import Path
from time import strftime
from typing import TYPE_CHECKING

from rich.console import Console
from rich.table import Table
from rich.text import Text

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import CompareConfig, ConfigError, digest, flatten, to_dict

if TYPE_CHECKING:
    from atlantis_exp.comparison.tables import Comparison


def compare(config: CompareConfig) -> None:
    """Compare all finished runs; print the verdict, and keep page, figures and tables as a run of their own.

    Raises:
        ConfigError: where nothing is to be compared, or runs of different protocols would be.
    """
    from atlantis_exp.commands.runs import RunFolder, provenance, published
    from atlantis_exp.commands.titles import labels
    from atlantis_exp.comparison import tables
    from atlantis_exp.comparison.figures import draw
    from atlantis_exp.comparison.gather import gather, group, refuse_mixed_protocols, select
    from atlantis_exp.comparison.report import page
    from atlantis_exp.media import run_colour

    outputs = Path(config.paths.outputs)
    gathered = gather(outputs, config.runs, config.at_epsilon)
    for name, reason in gathered.skipped.items():
        print(f"atlantis_exp: left out {name}: {reason}", file=sys.stderr)
    trainings = select(gathered.trainings, config.where)
    if not trainings:
        raise ConfigError(f"there is no finished training under {outputs / 'runs'} that compare was asked for")
    refuse_mixed_protocols(trainings, config.by)
    groups = group(trainings, config.by)
    comparison = tables.compare(gathered, groups, config.by, config.resamples, config.seed)

    settings = {key: value for key, value in to_dict(config).items() if key not in ("tracking", "paths")}
    facts = {**settings, "compared": [training.name for training in trainings]}
    folder = RunFolder(outputs / "comparisons" / f"{_slug(comparison.groups)}-{digest(facts)}")
    made = provenance()
    shown = {
        "command": made["command"],
        "made": strftime("%Y-%m-%d %H:%M %Z"),
        "code": made.get("git.commit", made["version.atlantis-exp"]),
        "runs": f"{len(trainings)} under {outputs / 'runs'}",
        "bootstrap": f"{tables.fewer_samples(groups, config.resamples):,} samples, seed {config.seed}",
    }
    figures = draw(comparison)
    tags = {**labels(folder.name, run_colour("comparison")), "atlantis.kind": "comparison"}
    with folder.held(), published(folder, config.tracking, outputs, tags) as journal:
        folder.write_config(facts)
        journal.params({key: str(value) for key, value in flatten(facts).items()})
        journal.tags({**made, "verdict": comparison.verdict})
        journal.note("\n\n".join([comparison.verdict, *comparison.notes]))
        for view in comparison.tables["verdict"]:
            name = view["view"].replace(" ", "_")
            journal.metrics({f"{name}/difference": view["difference"], f"{name}/decided": view["decided"]}, 0)
        journal.artifact("comparison.html", page(comparison, figures, shown).encode())
        for name, figure in figures.items():
            journal.artifact(f"figures/{name}.png", figure.png)
        for name, table in comparison.tables.items():
            journal.artifact(f"tables/{name}.csv", tables.to_csv(table).encode())
        journal.state_dict()
        journal.commit()
        journal.status("FINISHED")
    _print(comparison)
    print(f"\n{folder.path / 'artifacts' / 'comparison.html'}")


def _print(comparison: "Comparison") -> None:
    from atlantis_exp.comparison.report import plain

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


def main() -> None:
    """Compose and compare; a list may be written without brackets, as in `by=model,sampler`."""
    # Hydra itself would take the commas for a sweep, and a second `=` for a mistake.
    sys.argv[1:] = [re.sub(r"^(by|runs|where)=([^\[].*)$", _listed, argument) for argument in sys.argv[1:]]
    run_verb("compare", CompareConfig, compare)


def _listed(match: re.Match[str]) -> str:
    items = (f"'{item}'" for item in match[2].replace("'", "").split(","))
    return f"{match[1]}=[{','.join(items)}]"
