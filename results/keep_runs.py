"""Copy runs, evaluations, comparisons and decisions in the smallest form that `compare`, `sync` and `load_runs` read.

`python results/keep_runs.py OUTPUTS TARGET` leaves out weights, films, pages, this machine's paths, and comparisons
without a look. It keeps a point of a training's curve every 5,000 steps, with five digits, and all of the last 10,000
steps. Each folder beside this file is such a target.
"""

import argparse
import json
from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from atlantis_exp.runs.folder import RunFolder, all_runs
from atlantis_exp.runs.journal import NOTE, commit_bytes

EVALUATION = ("config.json", "result.json", "artifacts/evaluation/*.csv")
RUN = (*EVALUATION, "artifacts/episodes.csv")
TABLES = ("looks", "verdict", "views", "runs")
COMPARISON = ("config.json", "looks.json", *(f"artifacts/tables/{t}.csv" for t in TABLES))
GRID = 5_000  # steps between two points of a kept curve
WHOLE = 10_000  # steps at the end that keep every point


def main(outputs: Path, target: Path) -> None:
    """Copy all of an outputs folder that is finished, replacing folders of the same name."""
    for run in all_runs(outputs):
        if run.result is not None:
            keep(run, RUN, target, run.result.steps)
    for result in sorted(outputs.glob("evaluations/*/result.json")):
        keep(RunFolder(result.parent), EVALUATION, target)
    for looks in sorted(outputs.glob("comparisons/*/looks.json")):
        if any(json.loads(looks.read_bytes()).values()):
            keep(RunFolder(looks.parent), COMPARISON, target)
    for journal in sorted(outputs.glob("decisions/*/journal.jsonl")):
        keep(RunFolder(journal.parent), ("config.json",), target)  # names the runs that its comparison reads


def keep(run: RunFolder, names: Sequence[str], target: Path, steps: int = 0) -> None:
    """Copy a folder, name its outputs folder `outputs`, and detach it from its sweep."""
    outputs = run.path.parents[1]
    places = sorted({bytes(outputs.absolute()), bytes(outputs.resolve())}, key=len, reverse=True)
    target = target / run.path.parent.name / run.name

    def without_place(content: bytes) -> bytes:
        for place in places:
            content = content.replace(place, b"outputs")
        return content

    commit = run.commit
    assert commit is not None
    files = {
        str(path.relative_to(run.path)): without_place(path.read_bytes())
        for name in names
        for path in run.path.glob(name)
    }
    journal = without_place(thinned((run.path / "journal.jsonl").read_bytes()[: commit.offset], steps, files))
    files["journal.jsonl"] = journal
    files["commit.json"] = commit_bytes(replace(commit, offset=len(journal), parent=""))
    for name, content in files.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(content)
    print(target)


def thinned(journal: bytes, steps: int, files: Collection[str]) -> bytes:
    """Return a journal with fewer points of its training's curve, only the last note, and only kept files."""
    lines, records = journal.splitlines(keepends=True), [json.loads(line) for line in journal.splitlines()]
    last_note = max((at for at, record in enumerate(records) if NOTE in record.get("values", {})), default=-1)
    first = next((at for at, record in enumerate(records) if is_of_the_curve(record)), -1)
    kept, taken = list[bytes](), -1  # the latest cell of the grid with a point
    for at, (line, record) in enumerate(zip(lines, records, strict=True)):
        if record["kind"] in ("image", "model") or (set(record.get("values", {})) == {NOTE} and at != last_note):
            continue
        if record["kind"] == "artifact" and f"artifacts/{record['path']}" not in files:
            continue
        if is_of_the_curve(record):
            cell, is_late = record["step"] // GRID, record["step"] > steps - WHOLE
            if not (at == first or cell > taken or is_late):
                continue
            taken = cell
            line = line if is_late else shortened(record)
        kept.append(line)
    return b"".join(kept)


def is_of_the_curve(record: dict[str, Any]) -> bool:
    """Return whether a record is a point of a training's curve, not of an evaluation at the same step."""
    return record["kind"] == "metrics" and "throughput/hours" in record["values"]


def shortened(record: dict[str, Any]) -> bytes:
    """Return a record's line, with fractions of five digits."""
    values = {key: value if value == int(value) else float(f"{value:.5g}") for key, value in record["values"].items()}
    return json.dumps(record | {"values": values}, separators=(",", ":")).encode() + b"\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("outputs", type=Path)
    parser.add_argument("target", type=Path)
    asked = parser.parse_args()
    if not (asked.outputs / "runs").is_dir():
        parser.error(f"{asked.outputs}: has no runs")
    main(asked.outputs, asked.target)
