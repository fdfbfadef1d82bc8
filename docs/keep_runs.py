"""Copy finished trainings to `docs/verdict/runs`: all that a comparison reads, without weights, films and places.

`python docs/keep_runs.py OUTPUTS...`, from the root of the checkout.
"""

import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from atlantis_exp.runs.folder import RunFolder, all_runs
from atlantis_exp.runs.journal import commit_bytes, commit_of

KEPT = Path("docs/verdict/runs")


def main(outputs: Sequence[Path]) -> None:
    """Copy the finished trainings of some outputs folders, in the place of what is there of the same names."""
    for folder in outputs:
        for run in all_runs(folder):
            if run.result is not None:
                keep(run, KEPT / run.name)
                print(KEPT / run.name)


def keep(run: RunFolder, target: Path) -> None:
    """Copy a run, whose outputs folder is then called `outputs` and which belongs to no sweep."""
    place = run.path.parents[1]

    def without_place(content: bytes) -> bytes:
        return content.replace(str(place.absolute()).encode(), b"outputs").replace(str(place).encode(), b"outputs")

    commit = commit_of((run.path / "commit.json").read_bytes())
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
    main([Path(argument) for argument in sys.argv[1:]])
