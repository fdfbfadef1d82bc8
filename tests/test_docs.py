"""The scripts that draw and keep what the documentation shows."""

import json
import runpy
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
OF_DATA = {
    "fast": ("make_results_picture",),
    "standard": ("make_standard_picture", "standard"),
    "rewards": ("make_standard_picture", "rewards"),
    "million": ("make_standard_picture", "million"),
}


@pytest.fixture
def script(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """Calls a script of docs/ by its name, with arguments, in a copy of what it reads, without any picture."""
    shutil.copytree(DOCS / "data", tmp_path / "docs/data")
    (tmp_path / "docs/images").mkdir()
    for path in DOCS.glob("*.py"):
        shutil.copy(path, tmp_path / "docs")
    (tmp_path / "pretrained").symlink_to(REPOSITORY / "pretrained")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path / "docs")

    def call(name: str, *arguments: Path | str) -> None:
        monkeypatch.setattr("sys.argv", [f"docs/{name}.py", *map(str, arguments)])
        runpy.run_path(f"docs/{name}.py", run_name="__main__")

    return call


def assert_it_is_drawn(name: str, share: float = 0.005) -> None:
    """The picture is the documentation's, but for this share of its pixels, wherever the same Matplotlib drew both."""
    drawn, shown = (Image.open(folder / "images" / f"{name}.png") for folder in (Path("docs"), DOCS))
    assert drawn.size == shown.size
    if drawn.info.get("Software") == shown.info.get("Software"):  # another version's letters are others
        difference = np.abs(np.asarray(drawn, int) - np.asarray(shown, int))
        assert (difference.max(axis=2) > 32).mean() <= share


def assert_it_is_the_table(name: str) -> None:
    """Without new trainings a table stays as it is."""
    written, kept = (folder / "data" / f"{name}.csv" for folder in (Path("docs"), DOCS))
    assert written.read_bytes() == kept.read_bytes()


@pytest.mark.parametrize("picture", OF_DATA)
def test_a_picture_of_trainings_is_of_their_table(picture: str, script: Callable[..., None]) -> None:
    script(*OF_DATA[picture])
    assert_it_is_drawn(picture)
    assert_it_is_the_table(picture)


def test_the_ladder_is_drawn_and_printed_as_the_page_has_it(
    script: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    script("make_ladder")
    assert_it_is_drawn("ladder")
    assert_it_is_the_table("ladder")
    numbers = [line.partition("`")[2].partition("`")[2] for line in capsys.readouterr().out.splitlines()]
    rows = (DOCS / "results.md").read_text().splitlines()
    assert len(numbers) == 19
    assert [row for row in numbers if sum(shown.endswith(row) for shown in rows) != 1] == []


@pytest.mark.parametrize("name", ["time_to_score", "time_to_score_longer"])
def test_a_picture_of_hours_is_of_its_table(name: str, script: Callable[..., None]) -> None:
    script("make_time_picture", name)
    assert_it_is_drawn(name)
    assert_it_is_the_table(name)


def test_the_table_of_hours_is_what_the_benchmark_prints(script: Callable[..., None], tmp_path: Path) -> None:
    of_ours, of_a_peer = {"ours": [[0.05, 1_000, 10.0], [0.05, 2_000, 20.0]]}, {"sb3_qrdqn": [[0.1, 9, 0.5]]}
    outputs = [tmp_path / "ours", tmp_path / "peer"]
    for output, turns in zip(outputs, (of_ours, of_a_peer), strict=True):
        output.write_text(f"words of progress\n{json.dumps({'curves': turns})}\n")
    script("make_time_picture", "time_to_score", *outputs)
    assert (tmp_path / "docs/data/time_to_score.csv").read_text().splitlines() == [
        "program,hours,steps,score",
        "ours,0.0500,1000,10.0",
        "ours,0.1000,2000,20.0",
        "sb3_qrdqn,0.1000,9,0.5",
    ]


def test_the_crop_and_the_game_are_drawn(script: Callable[..., None]) -> None:
    script("make_crop_picture")
    assert_it_is_drawn("crop", share=0.05)  # it does not say by which Matplotlib
    script("make_game_picture")
    assert_it_is_drawn("game", share=0.5)  # elsewhere a rounding may lead to another moment


def test_what_has_been_kept_is_kept_as_it_is(script: Callable[..., None], tmp_path: Path) -> None:
    script("keep_runs", DOCS / "longer", tmp_path / "kept")
    script("keep_runs", tmp_path / "kept", tmp_path / "again")
    kept, again = (
        {path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        for folder in (DOCS / "longer" / "runs", tmp_path / "again" / "runs")
    )
    assert kept
    assert again == kept
