"""Copy finished runs, comparisons and decisions: what `compare` reads, and what it left.

`python docs/keep_runs.py OUTPUTS TARGET`: `docs/verdict` and `docs/reproduction` are such targets. Weights, films, and
the places of this machine are left out, and so are comparisons that nothing was looked at in.
"""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from atlantis_exp.runs.folder import RunFolder, all_runs
from atlantis_exp.runs.journal import commit_bytes

RUN = ("config.json", "result.json", "artifacts/episodes.csv", "artifacts/evaluation/*.csv")
COMPARISON = ("config.json", "looks.json", "artifacts/comparison.html", "artifacts/*/*.png", "artifacts/*/*.csv")


def main(outputs: Path, target: Path) -> None:
    """Copy what has ended under an outputs folder, in the place of what is there of the same names."""
    for run in all_runs(outputs):
        if run.result is not None:
            keep(run, RUN, target)
    for looks in sorted(outputs.glob("comparisons/*/looks.json")):
        if any(json.loads(looks.read_bytes()).values()):
            keep(RunFolder(looks.parent), COMPARISON, target)
    for journal in sorted(outputs.glob("decisions/*/journal.jsonl")):
        keep(RunFolder(journal.parent), ("config.json",), target)  # which names the runs that its comparison is of


def keep(run: RunFolder, names: Sequence[str], target: Path) -> None:
    """Copy a folder of a run's form, whose outputs folder is then called `outputs` and which belongs to no sweep."""
    place = bytes(run.path.parents[1].absolute())
    target = target / run.path.parent.name / run.name

    def without_place(content: bytes) -> bytes:
        return content.replace(place, b"outputs")

    commit = run.commit
    assert commit is not None
    journal = without_place((run.path / "journal.jsonl").read_bytes()[: commit.offset])
    files = {"journal.jsonl": journal, "commit.json": commit_bytes(replace(commit, offset=len(journal), parent=""))}
    for name in names:
        for path in run.path.glob(name):
            files[str(path.relative_to(run.path))] = without_place(path.read_bytes())
    for name, content in files.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(content)
    print(target)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
