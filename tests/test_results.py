"""The runs that docs/results.md answers from."""

import csv
import re
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.runs.folder import RunFolder, all_runs, evaluation_at
from atlantis_exp.statistics import interquartile_mean

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
KEPT = [(run, page) for page in ("verdict", "reproduction") for run in all_runs(DOCS / page)]
PAGES = {"verdict": "results.md", "reproduction": "reproduction.md"}


def test_there_are_kept_runs() -> None:
    assert KEPT


@pytest.mark.parametrize(("run", "page"), KEPT, ids=lambda each: each if isinstance(each, str) else each.name)
def test_a_kept_run_is_still_the_run_of_its_config_and_in_the_table_of_its_page(run: RunFolder, page: str) -> None:
    assert run.trained_config.run_name() == run.name  # else `decide` would train it again
    assert run.result is not None
    with run.artifact(evaluation_at(run.result.steps)).open() as file:
        scores = np.array([float(episode["score"]) for episode in csv.DictReader(file)])
    assert len(scores) == 100
    row = rf"^\| {run.trained_config.seed} \|.* {scores.mean():,.0f} \({interquartile_mean(scores):,.0f}\) \|"
    assert re.search(row, (DOCS / PAGES[page]).read_text(), re.MULTILINE)
