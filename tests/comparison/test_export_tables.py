"""Tables as LaTeX, with units: a paper shows what the table says."""

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.comparison.export_tables import UNITS, to_latex, with_units
from atlantis_exp.comparison.page import COLUMNS, shown_columns
from atlantis_exp.comparison.published import Table
from tests.comparison.folders import compared_by

Recorded = Callable[..., Path]

SCORES = {
    "family": "model",
    "group": "cnn",
    "baseline": "resnet",
    "seeds": 3,
    "score": 12_345.6,
    "low": 9_000.2,
    "high": 1.5e9,
    "difference": -1_500.25,
    "difference_low": np.nan,
    "difference_high": np.nan,
    "said": "not decided",
}


def body(latex: str) -> list[list[str]]:
    """The cells of a tabular, header first."""
    lines = re.findall(r"^(.*) \\\\$", latex, re.MULTILINE)
    return [line.split(" & ") for line in lines]


def shown(latex: str) -> str:
    """What LaTeX prints for a cell, as far as this module writes any; anything else is an error."""
    commands = {
        r"\textbackslash{}": "\\",
        r"\textasciicircum{}": "^",
        r"\textasciitilde{}": "~",
        r"\textless{}": "<",
        r"\textgreater{}": ">",
        r"\textbar{}": "|",
        r"\symbol{34}": '"',
        r"\symbol{96}": "`",
        **{f"\\{letter}": letter for letter in "{}$&#%_"},
        "{}": "",
    }
    pattern = "|".join(map(re.escape, commands))
    assert not re.search(r"[\\{}$&#%_^~<>|\"`]", re.sub(pattern, "", latex)), latex
    assert not re.search(r"--|,,|''", latex), latex
    return re.sub(pattern, lambda found: commands[found[0]], latex)


def test_a_table_of_the_page_has_its_columns_units_and_intervals() -> None:
    latex = to_latex("scores", [SCORES])
    header, row = body(latex)
    assert dict(zip(header, row, strict=True)) == {
        "group": "cnn",
        "seeds": "3",
        "score (points)": r"12,346 (9,000 to 1.5$\times10^{9}$)",
        "difference (points)": "$-$1,500",
        "verdict": "not decided",
    }
    assert latex.splitlines()[1:4:2] == [r"\begin{tabular}{lrrrl}", " & ".join(header) + r" \\"]
    assert [line for line in latex.splitlines() if "rule" in line] == [r"\toprule", r"\midrule", r"\bottomrule"]


def test_shares_are_in_percent_and_what_is_missing_is_empty() -> None:
    table = [{"group": "cnn", "mean": -5.25, "time_cap_share": 0.125, "human_normalised_mean": np.nan}]
    assert body(to_latex("evaluation", table)) == [
        ["group", "mean (points)", "at time cap", "human-normalised"],
        ["cnn", "$-$5.25", r"12.5\%", ""],
    ]


def test_another_table_has_all_its_columns() -> None:
    table = [{"axis": "flops", "group": "a", "x": 2e12, "score": 70.5, "low": 1, "high": 2, "epsilon": 0.05}]
    header, row = body(to_latex("curves", table))
    assert header == ["axis", "group", "x", "score (points)", "low (points)", "high (points)", "epsilon"]
    assert row == ["flops", "a", r"2$\times10^{12}$", "70", "1", "2", "0.05"]


@pytest.mark.parametrize(
    "name",
    [
        r"\input{/etc/passwd}",
        r"50% & $x_1^2$ #1 ~ {} \\",
        "[2ex]",
        "* after a line's end",
        "a---b ''quoted'' \"too\" <<>> |x| ,, `",
        "^^5cinput",
        "Grüße, naïve Łukasz",
    ],
)
def test_a_name_is_shown_and_not_run(name: str) -> None:
    latex = to_latex("any", [{"name": name}])
    ((_,), (cell,)) = body(latex)
    assert shown(cell) == name
    assert not cell.startswith(("[", "*"))


@given(st.text())
def test_any_text_is_one_balanced_cell_on_one_line(name: str) -> None:
    latex = to_latex("any", [{"name": name, "after": 1}])
    assert len(latex.splitlines()) == 8
    _, (cell, after) = body(latex)
    assert after == "1"
    assert shown(cell) == " ".join(shown(cell).split())
    assert len(cell.replace(r"\{", "").split("{")) == len(cell.replace(r"\}", "").split("}"))
    assert shown(cell).replace(" ", "") == "".join(letter for letter in name if letter.isprintable() and letter != " ")


def test_an_empty_table_is_empty() -> None:
    assert to_latex("evaluation", []) == ""
    assert with_units("evaluation", []) == []


def test_units_are_in_the_keys_but_where_the_key_is_the_unit() -> None:
    row = {"run": "a", "iqm": 1.0, "frames": 2, "flops": 3, "hours": 4, "time_cap_share": 0.5}
    assert with_units("runs", [row]) == [
        {"run": "a", "iqm (points)": 1.0, "frames": 2, "flops": 3, "hours": 4, "time_cap_share (fraction)": 0.5}
    ]


@pytest.fixture
def tables(recorded: Recorded, tmp_path: Path) -> dict[str, Table]:
    """Those of a comparison of two networks with two seeds each."""
    for model, score in (("cnn", 1_000.0), ("resnet", 3_000.0)):
        for seed in (0, 1):
            recorded(f"model={model}", f"seed={seed}", scores=(score, score + 500 * seed, 2 * score), truncated=1)
    return compared_by(tmp_path).tables


def test_all_tables_of_a_comparison_become_latex(tables: dict[str, Table]) -> None:
    for name, table in tables.items():
        latex = to_latex(name, table)
        if table:
            header, *rows = body(latex)
            assert len(rows) == len(table)
            assert {len(row) for row in rows} == {len(header)}
            assert len(header) == len(shown_columns(name, table) if name in COLUMNS else header)


def test_every_number_of_a_comparison_has_a_unit_or_a_name_that_says_what_it_counts(tables: dict[str, Table]) -> None:
    counts = {"runs", "episodes", "episode", "seed", "look", "epsilon", "truncated", "at", "x", "decided"}
    numbers = {
        key
        for table in tables.values()
        for row in table
        for key, value in row.items()
        if isinstance(value, int | float)
    }
    assert numbers - counts <= UNITS.keys()


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="needs pdflatex")
def test_latex_takes_it(tables: dict[str, Table], tmp_path: Path) -> None:
    hostile = [{"name": r"\x{50% & $_1^2$ #1 ~} '' -- <|> `" + '"', "value": -1.0}, {"name": "[2ex]", "value": 1e12}]
    texts = [to_latex(name, table[:5]) for name, table in {**tables, "hostile": hostile}.items()]
    document = "\n\n".join([r"\documentclass{article}\usepackage{booktabs}\begin{document}", *texts, r"\end{document}"])
    (tmp_path / "paper.tex").write_text(document, "utf-8")
    command = ("pdflatex", "-interaction=nonstopmode", "-halt-on-error", "paper.tex")
    subprocess.run(command, cwd=tmp_path, check=True, capture_output=True)
