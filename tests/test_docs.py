"""The scripts that draw and keep what the documentation shows."""

import ast
import inspect
import json
import re
import runpy
import shlex
import shutil
from collections.abc import Callable
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.helping import help_text, key_names
from atlantis_exp.faults import ConfigError
from atlantis_exp.learning.objectives import Objective
from atlantis_exp.replay.samplers import Sampler

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
OF_ANOTHER_MOMENT = 0.15  # elsewhere a rounding may lead to one; two of a game differ in 6 % of the pixels
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


def assert_it_is_drawn(name: str, share: float = 0.005, docs: Path = DOCS) -> None:
    """The picture is the documentation's, but for this share of its pixels, wherever the same Matplotlib drew both."""
    drawn, shown = (Image.open(folder / "images" / f"{name}.png") for folder in (Path("docs"), docs))
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


@pytest.mark.slow
def test_the_ladder_is_drawn_and_printed_as_the_page_has_it(
    script: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    script("make_ladder")
    assert_it_is_drawn("ladder")
    assert_it_is_the_table("ladder")
    numbers = [line.partition("`")[2].partition("`")[2] for line in capsys.readouterr().out.splitlines()]
    rows = (REPOSITORY / "lab" / "results.md").read_text().splitlines()
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


@pytest.mark.slow
def test_the_crop_and_the_game_are_drawn(script: Callable[..., None], tmp_path: Path) -> None:
    script("make_crop_picture")
    assert_it_is_drawn("crop", share=0.05)  # it does not say by which Matplotlib
    script("make_game_picture")
    assert_it_is_drawn("game", share=OF_ANOTHER_MOMENT)
    painted = np.array(Image.open(DOCS / "images" / "game.png").convert("RGB"))
    painted[:, : painted.shape[1] // 2] = (0, 200, 0)
    (tmp_path / "painted/images").mkdir(parents=True)
    Image.fromarray(painted).save(tmp_path / "painted/images/game.png")
    with pytest.raises(AssertionError):
        assert_it_is_drawn("game", share=OF_ANOTHER_MOMENT, docs=tmp_path / "painted")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages as `make docs` gathers them."""
    pages = tmp_path_factory.mktemp("site")
    runpy.run_path(str(DOCS / "site.py"))["main"](pages)
    return pages


def anchors_of(page: str) -> set[str]:
    """Return the anchors of a page's headings."""
    headings = re.findall(r"^#+ (.*)$", re.sub(r"^```.*?^```", "", page, flags=re.MULTILINE | re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", re.sub(r"[`*]", "", heading).lower()).replace(" ", "-") for heading in headings}


def links_of(path: Path) -> set[str]:
    """Return the targets of a page's links and pictures that lie beside it."""
    return {link for link in re.findall(r"(?:\]\(|src=\")([^)\s\"]+)", path.read_text()) if not link.startswith("http")}


def lost_links(path: Path) -> set[str]:
    """Return the links of a page that lead nowhere."""
    lost = set()
    for link in links_of(path):
        name, _, anchor = link.partition("#")
        target = path.parent / name if name else path
        if not target.exists() or (anchor and anchor not in anchors_of(target.read_text())):
            lost.add(link)
    return lost


def commands_of(page: Path) -> list[list[str]]:
    """Return the words of each of our commands on a page, without what a shell does with their output."""
    text = page.read_text().replace("\\\n", " ")
    lines = re.findall(r"^(?: {4}|)(?:\$ )?python -m atlantis_exp (.*)$", text, re.MULTILINE)
    return [shlex.split(re.split(r" (?:2?>|\|) ?", line)[0], comments=True) for line in lines if " ... " not in line]


@pytest.mark.parametrize(("in_lab", "least"), [(False, 70), pytest.param(True, 30, marks=pytest.mark.slow)])
def test_every_command_of_a_page_is_one(
    in_lab: bool, least: int, command: Callable[..., int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("pretrained", "examples"):
        (tmp_path / name).symlink_to(REPOSITORY / name)
    assert command("new", "model=mynet", "to=mine") == 0
    shutil.copy("mine/atlantis_mynet/mynet.py", "mynet.py")
    refused, count = [], 0
    for page in NOTEBOOK if in_lab else SHORT:
        for words in commands_of(page):
            verb, arguments = (words[0], words[1:]) if words[0] in VERBS else ("train", words)
            count += 1
            try:
                if "--help" not in arguments:
                    import_module(f"atlantis_exp.commands.{verb}").VERB.read(arguments)
            except ConfigError as error:
                refused.append(str(error))
    assert count >= least
    meant = "pip install|srun is not installed|^optimizer.lrr=1: no such key"
    assert [line for line in refused if not re.search(meant, line)] == []


SHORT = [REPOSITORY / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")]
SHORT += [*DOCS.glob("*.md"), REPOSITORY / "results" / "README.md"]
NOTEBOOK = sorted((REPOSITORY / "lab").glob("*.md"))
PAGES = [*SHORT, *NOTEBOOK]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_the_links_of_a_page_lead_somewhere(path: Path) -> None:
    assert lost_links(path) == set()


def test_the_links_of_the_site_lead_somewhere_and_each_page_is_in_its_navigation(site: Path) -> None:
    pages = {path.relative_to(site).as_posix(): lost_links(path) for path in site.rglob("*.md")}
    assert {name: lost for name, lost in pages.items() if lost} == {}
    assert {"results.md", "contributing.md", "images/game.png"} <= links_of(site / "index.md")
    navigation = (REPOSITORY / "mkdocs.yml").read_text().partition("\nnav:")[2]
    assert sorted(re.findall(r": (\S+\.md)$", navigation, re.MULTILINE)) == sorted(pages)


def test_the_site_searches_from_disk_by_a_script_of_its_own(site: Path) -> None:
    (script,) = re.findall(r"polyfills: \[(\S*iframe-worker\S*)\]", (REPOSITORY / "mkdocs.yml").read_text())
    assert "IFrameWorker" in (site / script).read_text()


def test_the_site_has_every_verb_and_every_key(site: Path) -> None:
    listed = (site / "keys.md").read_text()
    assert [
        key for key in key_names("train", []) if "." in key and "@" not in key and f"| `{key}` |" not in listed
    ] == []
    assert "| `sampler.beta` | `0.5` |" in listed  # of an option that is not the default
    verbs = (site / "verbs.md").read_text()
    assert [verb for verb in VERBS if f"## {verb}\n" not in verbs] == []


@pytest.mark.parametrize("path", SHORT, ids=lambda path: path.name)
def test_a_page_is_short(path: Path) -> None:
    assert len(path.read_text().split()) <= (800 if path.name == "README.md" else 1_200)


def test_extending_has_the_methods_of_a_sampler_and_of_an_objective_as_they_are() -> None:
    (block,) = re.findall(r"```py\n(.*?)```", (DOCS / "extending.md").read_text(), re.DOTALL)
    for shown, kind in zip(ast.parse(block).body, (Sampler, Objective), strict=True):
        (own,) = ast.parse(inspect.getsource(kind)).body
        methods = [
            [
                (each.name, ast.unparse(each.args), ast.unparse(each.returns or each))
                for each in ast.walk(cls)
                if isinstance(each, ast.FunctionDef)
            ]
            for cls in (shown, own)
        ]
        assert methods[0] == methods[1] != []


def test_no_message_and_no_help_names_a_page_that_an_installed_package_lacks() -> None:
    texts = [help_text(verb, ["all"]) for verb in VERBS]
    for path in (REPOSITORY / "atlantis_exp").rglob("*.py"):
        nodes = [*ast.walk(ast.parse(path.read_text()))]
        docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
        texts += [
            node.value
            for node in nodes
            if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings
        ]
    assert [text for text in texts if re.search(r"\b(docs|lab)/", text)] == []


BANNED = re.compile(
    r"\bwhoever\b|\bof which\b|matter of course|have their like|\bis no (?:fault|proof|matter|one|part|point|run)\b",
    re.IGNORECASE,
)


@pytest.mark.parametrize("path", [path for path in SHORT if path.name != "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_a_page_has_no_phrase_that_the_style_forbids(path: Path) -> None:
    assert BANNED.findall(path.read_text()) == []
