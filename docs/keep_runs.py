"""Copy finished runs to `TARGET/runs`: all that a comparison reads, without weights, films and places.

`python docs/keep_runs.py OUTPUTS TARGET`: `docs/verdict` and `docs/reproduction` are such targets.
"""

import sys
from dataclasses import replace
from pathlib import Path

from atlantis_exp.runs.folder import RunFolder, all_runs
from atlantis_exp.runs.journal import commit_bytes


def main(outputs: Path, target: Path) -> None:
    """Copy the finished runs of an outputs folder, in the place of what is there of the same names."""
    for run in all_runs(outputs):
        if run.result is not None:
            kept = target / "runs" / run.name
            keep(run, kept)
            print(kept)


def keep(run: RunFolder, target: Path) -> None:
    """Copy a run, whose outputs folder is then called `outputs` and which belongs to no sweep."""
    place = bytes(run.path.parents[1].absolute())

    def without_place(content: bytes) -> bytes:
        return content.replace(place, b"outputs")

    commit = run.commit
    assert commit is not None
    journal = without_place((run.path / "journal.jsonl").read_bytes()[: commit.offset])
    files = {"journal.jsonl": journal, "commit.json": commit_bytes(replace(commit, offset=len(journal), parent=""))}
    names = ("config.json", "result.json", "artifacts/episodes.csv", "artifacts/evaluation/*.csv")
    for name in names:
        for path in run.path.glob(name):
            files[str(path.relative_to(run.path))] = without_place(path.read_bytes())
    for name, content in files.items():
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        (target / name).write_bytes(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
