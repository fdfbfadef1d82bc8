"""Scores of seeds that were trained elsewhere."""

from pathlib import Path

import pytest

from atlantis_exp.comparison.elsewhere import read_scores
from atlantis_exp.faults import ConfigError


def table(folder: Path, text: str) -> Path:
    (folder / "scores.csv").write_text(text, "utf-8")
    return folder / "scores.csv"


def test_rows_of_a_seed_are_averaged_and_further_columns_not_read(tmp_path: Path) -> None:
    path = table(tmp_path, "\ufeffseed,group,score,step\n3,b,4,x\n1,a,-1.5,\n3,b,5,y\n0,b, 7e1 ,\n")
    link = tmp_path / "link.csv"
    link.symlink_to(path)
    one, other = read_scores(link, {})
    assert (one.label, one.seeds) == ("a", {1: -1.5})
    assert (other.label, other.seeds) == ("b", {0: 70.0, 3: 4.5})
    assert list(other.seeds) == [0, 3]


def test_columns_may_have_other_names(tmp_path: Path) -> None:
    path = table(tmp_path, "algo,run,return\nppo,1,2\n")
    (group,) = read_scores(path, {"group": "algo", "seed": "run", "score": "return"})
    assert (group.label, group.seeds) == ("ppo", {1: 2.0})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "group,seed,scor\na,1,2\n",
            "row 1, column score: no such column; did you mean 'scor'? (valid: group, scor, seed); "
            "set columns=score=NAME",
        ),
        ("group,seed,score,score\na,1,2,3\n", "row 1, column score: several such columns; set columns="),
        ("", "row 1, column group: no such column"),
        ("group,seed,score\n", "row 2, column group: no row below the header"),
        ("group,seed,score\na,1,2\na,2,two\n", "row 3, column score: 'two' is not a number"),
        ("group,seed,score\na,1,nan\n", "row 2, column score: 'nan' is not a number"),
        ("group,seed,score\na,1,inf\n", "row 2, column score: 'inf' is not a number"),
        ("group,seed,score\na,1,1e16\n", "row 2, column score: '1e16' is not a number up to 1e15"),
        ("group,seed,score\na,1.5,2\n", "row 2, column seed: '1.5' is not a seed, a whole number from 0 on"),
        ("group,seed,score\na,-1,2\n", "row 2, column seed: '-1' is not a seed"),
        ("group,seed,score\na,1\n", "row 2, column score: '' is not a number"),
        ("group,seed,score\n,1,2\n", "row 2, column group: '' is not a name"),
        (f"group,seed,score\n{101 * 'a'},1,2\n", "is not a name of 1 to 100 printable characters"),
        ("group,seed,score\n\x1b[2J,1,2\n", "row 2, column group: '\\\\x1b[2J' is not a name"),
        ('group,seed,score\n"a\n', "unexpected end of data"),
        (
            "group,seed,score\n" + "".join(f"g{n},1,2\n" for n in range(101)),
            "row 102, column group: more than 100 groups",
        ),
        ("group,seed,score\n" + "".join(f"a,{n},2\n" for n in range(10_001)), "row 10002, column group: more than"),
    ],
)
def test_a_bad_table_is_one_line_with_the_row_and_the_column(text: str, said: str, tmp_path: Path) -> None:
    path = table(tmp_path, text)
    with pytest.raises(ConfigError) as raised:
        read_scores(path, {})
    line = str(raised.value)
    assert line.startswith(f"scores={path}: ")
    assert said.replace("\\\\", "\\") in line
    assert "\n" not in line


def test_a_file_that_is_large_missing_or_no_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "large.csv").write_bytes(b"group,seed,score\n" + b"a,1,2\n" * 3_000_000)
    (tmp_path / "bytes.csv").write_bytes(b"\xff\xfe")
    for name in ("large.csv", "bytes.csv", "missing.csv"):
        with pytest.raises(ConfigError, match=f"^scores={tmp_path / name}: "):
            read_scores(tmp_path / name, {})
