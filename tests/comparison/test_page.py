"""The page: whole in one file, escaped, readable without its pictures; and the pictures themselves."""

import io
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from atlantis_exp.comparison.figures import Drawn, draw
from atlantis_exp.comparison.page import number, page, plain
from atlantis_exp.comparison.tables import Comparison
from tests.comparison.folders import compared_by

Recorded = Callable[..., Path]


@pytest.fixture
def comparison(recorded: Recorded, tmp_path: Path) -> Comparison:
    for seed in (0, 1):
        recorded("model=cnn", f"seed={seed}", scores=(1_000.0 + seed, 2_345.0, 3_100.0, 700.0))
        recorded("model=resnet", f"seed={seed}", scores=(8_000.0 + seed, 9_876.0, 9_100.0, 8_700.0))
    (tmp_path / "runs" / "<script>alert(1)<").mkdir()
    return compared_by(tmp_path)


@pytest.fixture(scope="module")
def _drawn() -> dict[str, Drawn]:
    return {}


@pytest.fixture
def figures(comparison: Comparison, _drawn: dict[str, Drawn]) -> dict[str, Drawn]:
    """Of the comparison, which is the same in every test; they take seconds."""
    if not _drawn:
        _drawn.update(draw(comparison))
    return _drawn


class Tags(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))
        if tag not in ("meta", "path", "rect", "use", "circle"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("meta", "path", "rect", "use", "circle"):
            assert self.open.pop() == tag


def test_the_page_is_whole_fetches_nothing_and_is_made_for_phones_and_both_colour_schemes(
    comparison: Comparison, figures: dict[str, Drawn]
) -> None:
    text = page(comparison, figures, {"command": "compare"})
    tags = Tags(text)
    assert tags.open == []
    for tag, attributes in tags.found:
        assert tag not in ("script", "link", "iframe", "img", "object")
        for name in ("src", "href", "xlink:href", "data"):
            assert (attributes.get(name) or "#").startswith("#")
    assert not re.search(r"@import|url\((?!#)", text)
    assert ("meta", {"name": "viewport", "content": "width=device-width, initial-scale=1"}) in tags.found
    assert "@media (prefers-color-scheme: dark)" in text
    pictures = [attributes for tag, attributes in tags.found if tag == "svg"]
    assert len(pictures) == 10
    assert all(attributes["role"] == "img" and attributes["aria-label"] for attributes in pictures)
    ids = [attributes["id"] for _, attributes in tags.found if attributes.get("id")]
    referred = {(attributes.get("xlink:href") or "#")[1:] for tag, attributes in tags.found if tag == "use"}
    assert referred <= set(ids)


def test_what_comes_from_data_is_escaped(comparison: Comparison, figures: dict[str, Drawn]) -> None:
    text = page(comparison, figures, {"command": "<b>&"})
    assert "&lt;script&gt;alert(1)&lt;" in text
    assert "&lt;b&gt;&amp;" in text
    assert "<script" not in text


def test_the_page_says_the_verdict_the_notes_and_every_shown_table(
    comparison: Comparison, figures: dict[str, Drawn]
) -> None:
    text = page(comparison, figures, {})
    assert comparison.verdict in text
    assert all(note.replace("'", "&#39;").replace('"', "&#34;") in text for note in comparison.notes)
    for row in comparison.tables["scores"]:
        assert f'<td class="number">{row["score"]:,.0f}</td>' in text
    for row in comparison.tables["runs"]:
        assert row["run"] in text
    for row in comparison.tables["references"]:
        assert row["name"] in text


@pytest.mark.parametrize(("score", "title"), [("last", "IQM"), ("training", "training score"), ("given", "score")])
def test_a_column_of_scores_says_which_they_are(comparison: Comparison, score: Any, title: str) -> None:
    asked = replace(comparison, question=replace(comparison.question, score=score))
    assert title in plain("scores", asked.tables["scores"], score)[0]
    heads = re.findall("<thead>(.*?)</thead>", page(asked, {}, {}), re.DOTALL)
    assert sum(f">{title}</th>" in head and ">seeds</th>" in head for head in heads) == 1  # of groups
    assert sum(f">{title}</th>" in head and ">run</th>" in head for head in heads) == 1


@pytest.mark.slow
def test_scores_within_a_decade_are_marked_in_thousands(recorded: Recorded, tmp_path: Path) -> None:
    recorded(scores=(2_100.0, 5_200.0))
    svg = draw(compared_by(tmp_path))["profile"].svg
    assert "mathdefault" not in svg
    assert {">3k<", ">4k<"} <= set(re.findall(r">[0-9.]+k<", svg))


@pytest.mark.slow
def test_two_bands_at_most_lie_over_each_other(recorded: Recorded, tmp_path: Path) -> None:
    for index, model in enumerate(("cnn", "resnet", "resnet_fast")):
        for seed in range(5):
            points = [(0, 0, 0, 1_000 + seed), (600, 0.5, 30, 2_000 + 1_000 * index + 10 * seed)]
            recorded(f"model={model}", f"seed={seed}", curve=points)
    figures = draw(compared_by(tmp_path))
    bands = set(re.findall(r'id="(?:FillBetween)?PolyCollection_\d+"', figures["learning_frames"].svg))
    assert len(bands) == 2


@pytest.mark.parametrize(
    ("value", "column", "text"),
    [
        (12_345.6, "score", "12,346"),
        (0.0, "low", "0"),
        (0.25, "random_share", "25.0%"),
        (0.05, "epsilon", "0.05"),
        (3, "seed", "3"),
        (1.5e12, "flops", "1.5e+12"),
        (0.00123, "hours", "0.00123"),
        (True, "truncated", "yes"),
        (float("nan"), "difference", ""),
        (0.0125, "spent", "1.25%"),
        ("cnn", "group", "cnn"),
    ],
)
def test_numbers_are_written_for_people(value: object, column: str, text: str) -> None:
    assert number(value, column) == text


def test_figures_are_pictures_of_something_and_take_on_the_pages_ink(figures: dict[str, Drawn]) -> None:
    assert list(figures) == [
        *("learning_frames", "exploration", "learning_hours", "learning_flops"),
        *("scores", "why", "distribution", "profile", "actions", "references"),
    ]
    for figure in figures.values():
        pixels = np.asarray(Image.open(io.BytesIO(figure.png)).convert("RGB"))
        assert (pixels[0, 0] == 255).all()
        assert len(np.unique(pixels @ (1 << np.array([16, 8, 0])))) > 20  # colours
        assert "currentColor" in figure.svg
        assert "#24292f" not in figure.svg
        assert "cnn" in figure.svg
    assert "cnn 1,673" in figures["scores"].alt
    # On a phone of 390 pixels a point of a figure is a pixel of the screen.
    assert min(float(size) for size in re.findall(r"font-size: ([\d.]+)px", figures["learning_frames"].svg)) >= 9


@pytest.mark.slow
def test_published_curves_leave_the_picture_rather_than_flatten_what_was_trained_and_no_name_is_cut_off(
    recorded: Recorded, tmp_path: Path
) -> None:
    recorded(curve=[(0, 0, 0, 4_000), (12_000_000, 9, 9, 9_000)])  # where others have 866,604
    figure = draw(compared_by(tmp_path))["learning_frames"]
    assert all(f"{name}, published" in figure.svg for name in ("QR-DQN Impala ResNet", "DreamerV3", "PPO"))
    assert set(re.findall(r">(\d+k)<", figure.svg)) <= {f"{number}k" for number in range(31)}
    pixels = np.asarray(Image.open(io.BytesIO(figure.png)).convert("RGB"))
    assert (pixels[:, [0, -1]] == 255).all()
    assert (pixels[[0, -1]] == 255).all()


@pytest.mark.slow
def test_the_same_comparison_draws_the_same_figures(comparison: Comparison) -> None:
    def content(figures: dict[str, Drawn]) -> list[tuple[str, bytes]]:
        return [(figure.svg, figure.png) for figure in figures.values()]

    assert content(draw(comparison)) == content(draw(comparison))


@pytest.mark.slow
def test_a_comparison_without_curves_has_the_other_figures(recorded: Recorded, tmp_path: Path) -> None:
    recorded(curve=())
    comparison = compared_by(tmp_path)
    figures = draw(comparison)
    assert list(figures) == ["scores", "why", "distribution", "profile", "actions", "references"]
    assert "three fair views" not in page(comparison, figures, {})


def test_comparing_loads_no_torch() -> None:
    program = (
        "import sys; from atlantis_exp.comparison import figures, gather, page, tables; "
        "from atlantis_exp.sessions import comparing; print('torch' in sys.modules, 'mlflow' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "False False\n"
