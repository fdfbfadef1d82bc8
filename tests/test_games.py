"""Other games than Atlantis: components like any other, and no word of Atlantis where they are shown."""

import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from atlantis_exp.build import build_game, make_emulator
from atlantis_exp.checking import parse, to_dict
from atlantis_exp.commands.composing import admit_plugins
from atlantis_exp.comparison.published import Table, curves, scores
from atlantis_exp.components import game_of, known, title_of
from atlantis_exp.config import Config, EnvConfig
from atlantis_exp.faults import ConfigError
from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.game.vector import make_emulators
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.job import replaced

Command = Callable[..., int]
Compose = Callable[..., Config]
Recorded = Callable[..., Path]

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "atlantis_exp"
BREAKOUT, PONG = (str(ROOT / "examples" / f"{name}.py") for name in ("breakout", "pong"))
BOTH = f"plugins=[{BREAKOUT},{PONG}]"


@pytest.fixture(autouse=True)
def _nothing_is_admitted_afterwards() -> Iterator[None]:
    yield
    admit_plugins([])


@pytest.fixture
def both() -> None:
    """Admits Breakout and Pong, as their command lines do."""
    admit_plugins([BREAKOUT, PONG])


@pytest.fixture
def said(command: Command, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that ends with exit code 2, and returns its one line."""

    def run(*words: str) -> str:
        capsys.readouterr()
        assert command(*words) == 2
        (line,) = capsys.readouterr().err.splitlines()
        return line

    return run


FACTS = r"vessel|bomber|\bguns?\b|building|\bcity\b|wave|leftfire|rightfire|12[_,]?850|29[_,]?028|atlantis"
NAMES = (  # of the package, of its tags in MLflow, of its presets, which are no facts of the game
    *(r"atlantis[_-]exp", r"[\"'`(]atlantis\.(\w+|$)?", r"atlantis_standard", r"atlantis[_-]\{", r"\batlantis\.py"),
    r'experiment: str = "atlantis"',
    r'_ours\("env".*',
)


def facts_in(text: str) -> list[str]:
    return re.findall(FACTS, re.sub("|".join(NAMES), "", text, flags=re.IGNORECASE), re.IGNORECASE)


def test_the_facts_of_atlantis_are_in_one_file() -> None:
    sources = [path for path in PACKAGE.rglob("*") if path.suffix in (".py", ".html")]
    sources.remove(PACKAGE / "__init__.py")  # which says what the package is for
    knowing = {str(path.relative_to(PACKAGE)) for path in sources if facts_in(path.read_text())}
    assert knowing == {"game/atlantis.py"}
    assert {"vessel", "Atlantis", "12_850", "LEFTFIRE"} <= {*facts_in((PACKAGE / "game" / "atlantis.py").read_text())}
    assert facts_in("Atlantis-v0; in Atlantis a held button") == ["Atlantis", "Atlantis"]


@pytest.mark.usefixtures("both")
@pytest.mark.parametrize("name", ["breakout", "pong"])
def test_the_emulator_plays_other_games_as_gymnasium_does(name: str) -> None:
    game = build_game(known("env")[name])
    ours = Emulator(
        game=game,
        preprocessing=Preprocessing(84, (0, 160, 210, 0)),
        frameskip=4,
        sticky=0.25,
        max_frames=6_000,
        max_steps=None,
        noop_max=0,
        max_pool=False,
    )
    env = gymnasium.make(f"ALE/{title_of(name.title())}-v5", max_num_frames_per_episode=6_000, disable_env_checker=True)
    rng, rewards = np.random.default_rng(0), set()
    for seed in (5, None):
        ours.reset(seed)
        _, info = env.reset(seed=seed)
        is_over = False
        while not is_over:
            action, lives = int(rng.integers(len(game.actions))), info["lives"]
            step = ours.step(action)
            _, reward, terminated, truncated, info = env.step(action)
            assert step[1:5] == (reward, terminated, truncated, info["lives"] < lives)
            assert ours.lives == info["lives"]
            assert sum(step.points) == (reward if game.sources else 0)
            rewards.add(reward)
            is_over = terminated or truncated
        assert np.array_equal(ours.screen_rgb(), env.get_wrapper_attr("ale").getScreenRGB())
    assert rewards == {"breakout": {0.0, 1.0}, "pong": {-1.0, 0.0}}[name] or len(rewards) > 1
    env.close()


@pytest.mark.usefixtures("both")
@pytest.mark.parametrize(("name", "sources"), [pytest.param("breakout", 0, marks=pytest.mark.slow), ("pong", 2)])
def test_a_game_of_a_plugin_is_played_in_worker_processes(tiny: Compose, name: str, sources: int) -> None:
    env = tiny(BOTH, f"env={name}", "env.num_envs=2", "env.max_steps=null").env
    steps = []
    for workers in (0, 2):
        rng = np.random.default_rng(0)
        with make_emulators(make_emulator(env), 2, workers) as emulators:
            emulators.reset(range(2), [1, 2])
            steps.append([emulators.step(rng.integers(len(emulators.game.actions), size=2)) for _ in range(120)])
    for serial, parallel in zip(*steps, strict=True):
        for column, other in zip(serial, parallel, strict=True):
            np.testing.assert_array_equal(column, other)
    points = np.array([step.points for step in steps[0]])
    assert points.shape == (120, 2, sources)
    if sources:
        np.testing.assert_array_equal(points.sum(axis=2), [step.rewards for step in steps[0]])
        assert points.any()


GAME = """
from atlantis_exp.components import component


@component("{name}", "env")
class Mine:
    actions = ("NOOP", "FIRE", "RIGHT", "LEFT")
    score_range = (0.0, 100.0)
"""


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        (GAME.format(name="breakut"), "breakut: ALE has no ROM of that name"),
        (GAME.format(name="pong"), "should be ALE's, ('NOOP', 'FIRE', 'RIGHT', 'LEFT', 'RIGHTFIRE', 'LEFTFIRE')"),
        (GAME.format(name="pooyan"), "pooyan: its screen is (220, 160) pixels; only (210, 160) can be played"),
        (GAME.format(name="atlantis"), "env=atlantis is built in and cannot be replaced"),
        (GAME.format(name="atlantis_v5"), "env=atlantis_v5 is a preset and cannot be replaced"),
        (re.sub("    actions.*\n", "", GAME.format(name="pong")), "actions: missing; write actions = "),
        (re.sub("    score_r.*\n", "", GAME.format(name="pong")), "score_range: missing; write score_range = "),
        (GAME.format(name="pong").replace("(0.0, 100.0)", "[0.0, 1.0]"), "score_range: "),
        *(
            (GAME.format(name="pong").replace("(0.0, 100.0)", text), "score_range: should be ")
            for text in ("(5.0, 2.0)", "(864.0,)", '("a", "b")', "(0.0, 1e999)")
        ),
        (GAME.format(name="pong") + "    sources = ('a/b',)\n", "sources: 'a/b' should have letters, digits and"),
        (GAME.format(name="pong") + "    keys = ('up', 'down')\n", "keys: should be a tuple[tuple[str, str], ...]"),
        *(
            (GAME.format(name="pong") + f"    sources = ('bricks',)\n{method}", "sources: need a static method points(")
            for method in (
                "",
                "    @staticmethod\n    def points(reward): ...\n",
                "    def points(self, reward, ram): ...\n",
            )
        ),
        (GAME.format(name="pong") + "    def __init__(self, speed: int = 1): ...\n", "speed: a game takes no settings"),
    ],
)
def test_a_game_that_is_none_is_one_line(source: str, reason: str, said: Callable[..., str], tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(source)
    (name,) = re.findall('@component."(.*?)"', source)
    words = ("agent=random", f"env={name}", f"plugins={tmp_path}/mine.py", "tracking=none", "evaluation=quick")
    assert reason in said("baseline", *words, f"paths.outputs={tmp_path}")


@pytest.mark.usefixtures("both")
def test_a_run_of_another_game_is_one_by_its_id_and_its_plugin(tiny: Compose) -> None:
    pong, plain = tiny(BOTH, "env=pong"), tiny("env=atlantis_standard", "env.size=40")
    assert (pong.env.id, pong.env.title, [*pong.plugins]) == ("ALE/Pong-v5", "Pong", ["pong"])
    assert {**to_dict(plain.env), "id": pong.env.id} == to_dict(pong.env)
    assert "plugins" not in tiny(BOTH).science()  # of Atlantis nothing is recorded
    stored = to_dict(pong)
    admit_plugins([])
    read = parse(Config, stored)
    assert (read.game, read.run_name()) == (None, pong.run_name())
    for id_ in ("../../evil", "ALE/Pong-v5\n", "", "os.system"):
        with pytest.raises(ConfigError, match=r"^env\.id=.*: (no such choice|should match)"):
            parse(Config, {**stored, "env": {**stored["env"], "id": id_}})
    with pytest.raises(ConfigError, match="did you mean 'ALE/Atlantis-v5'"):
        parse(Config, {**stored, "plugins": {}})
    with pytest.raises(ConfigError, match="its game comes from a plugin"):
        make_emulator(parse(EnvConfig, stored["env"]))


@pytest.mark.slow
@pytest.mark.usefixtures("both")
def test_runs_of_two_games_are_not_compared(
    recorded: Recorded, said: Callable[..., str], command: Command, tmp_path: Path
) -> None:
    for game in ("breakout", "pong"):
        admit_plugins([BREAKOUT, PONG])
        recorded(BOTH, f"env={game}")
    outputs = (f"paths.outputs={tmp_path}", "tracking=none")
    for by in ("model", "env", "env.id"):
        assert re.fullmatch(
            "atlantis_exp: env.id differs: scores of different games are not compared: Breakout in cnn-.*; Pong in "
            "cnn-.*; choose with runs= or where=env.id=ID",
            said("compare", f"by={by}", *outputs),
        )
    assert command("compare", "where=env.id=ALE/Pong-v5", *outputs) == 0


@pytest.mark.slow
@pytest.mark.usefixtures("both")
def test_a_game_is_compared_by_its_own_facts_and_without_its_plugin_by_none(
    recorded: Recorded, command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for seed in range(2):
        admit_plugins([BREAKOUT, PONG])
        recorded(BOTH, "env=breakout", f"seed={seed}", scores=(0.0, 3.0 + seed, 7.0))
    pages, tables = [], []
    for plugins in ((), (BOTH,)):
        assert command("compare", "by=seed", *plugins, "tracking=none", f"paths.outputs={tmp_path}") == 0
        assert "MLflow UI" in capsys.readouterr().out
        (folder,) = (tmp_path / "comparisons").glob("*/artifacts")
        page = (folder / "comparison.html").read_text()
        pages.append(re.sub(r"<[^>]*>", " ", page))
        tables.append({path.stem: path.read_text() for path in (folder / "tables").glob("*.csv")})
    for words in ("human-normalised", "Against other players"):
        assert [words in page for page in pages] == [False, True]
    assert [table["references"].count("\n") for table in tables] == [0, 3]
    assert "random player,1.7" in tables[1]["references"]
    for page in pages:
        assert "Atari Breakout" in page
        assert facts_in(page) == []
        assert "logarithmic" not in page
    assert all(table["why"].startswith("group,mean") and "centre" not in table["why"] for table in tables)
    assert all(table["profile"].count("\n") == 201 and table["published_curves"] == "" for table in tables)


@pytest.mark.parametrize(
    ("table", "text", "reason"),
    [
        (scores, "name,score,capped_frames\nDQN,n/a,9\n", "pong_scores.csv, row 1: could not convert string"),
        (scores, "name,score,capped_frames\nDQN,,9\n", "pong_scores.csv, row 1: could not convert string"),
        (scores, "name,points\nDQN,12\n", "pong_scores.csv, row 1: no column 'score'"),
        (scores, "name,score,capped_frames\nDQN,12,\n", "pong_scores.csv, row 1: no column 'kind'"),
        (curves, "name,frames,mean\nDQN,12,3\n", "pong_curves.csv, row 1: no column 'frames_millions'"),
    ],
)
def test_a_mistake_in_a_published_table_is_one_line(
    table: Callable[..., Table], text: str, reason: str, tmp_path: Path
) -> None:
    (tmp_path / "pong.py").write_text(Path(PONG).read_text())
    admit_plugins([str(tmp_path / "pong.py")])
    (tmp_path / f"pong_{table.__name__}.csv").write_text(text)
    with pytest.raises(ConfigError, match=reason):
        table(game_of("ALE/Pong-v5"))


@pytest.mark.usefixtures("both")
def test_frames_have_the_columns_of_the_games_that_are_read(recorded: Recorded, tmp_path: Path) -> None:
    from atlantis_exp import load_runs

    recorded(BOTH, "env=breakout")
    assert "centre_vessel" not in load_runs(tmp_path).evaluations
    recorded(BOTH)
    admit_plugins([BREAKOUT, PONG])
    recorded(BOTH, "env=pong")
    loaded = load_runs(tmp_path)
    assert {"centre_vessel", "wave_bonus", "won", "lost"} <= {*loaded.evaluations, *loaded.episodes}
    ids = dict(zip(loaded.runs["run"], loaded.runs["env.id"], strict=True))
    for frame in (loaded.evaluations, loaded.episodes):
        for run, part in frame.groupby("run"):
            assert part["won"].notna().all() == (ids[str(run)] == "ALE/Pong-v5")
            assert part["side_vessel"].notna().all() == (ids[str(run)] == "Atlantis-v0")


@pytest.mark.slow
def test_the_baseline_of_another_game_is_another_with_its_plugin(command: Command, tmp_path: Path) -> None:
    words = ("agent=constant", "agent.action=2", "env=breakout", "env.max_steps=20", "evaluation=quick")
    more = ("evaluation.episodes=2", "evaluation.video=false", "tracking=none", f"paths.outputs={tmp_path}")
    (tmp_path / "breakout.py").write_text(Path(BREAKOUT).read_text() + "# changed\n")
    for plugin in (BREAKOUT, tmp_path / "breakout.py"):
        assert command("baseline", *words, f"plugins={plugin}", *more) == 0
    one, other = sorted((tmp_path / "runs").iterdir())
    assert one.name.startswith("constant2-Breakout-v5-")
    assert RunFolder(one).config["plugins"] != RunFolder(other).config["plugins"]


def test_no_id_names_two_games() -> None:
    assert game_of("Atlantis-v0") is game_of("ALE/Atlantis-v5") is known("env")["atlantis"]
    assert game_of("ALE/Pong-v5") is None
    assert title_of("ALE/SpaceInvaders-v5") == "SpaceInvaders"


@pytest.mark.slow
def test_breakout_and_pong_are_trained_continued_compared_exported_and_played_again(
    command: Command, tiny_overrides: tuple[str, ...], said: Callable[..., str], tmp_path: Path
) -> None:
    here = f"paths.outputs={tmp_path / 'outputs'}"
    small = ("phase.quick.steps=2000", "env.max_steps=400", "env.num_envs=2", "env.workers=2", "evaluation.num_envs=2")
    words = replaced(tiny_overrides, *small, "evaluation.every_steps=null", "replay.capacity=2000", here, BOTH)
    assert command("-m", "env=breakout,pong", "seed=0,1", *words, "budget.steps=1000") == 0
    assert command("-m", "env=breakout,pong", "seed=0,1", *words) == 0  # goes on
    runs = {run.config["env"]["id"]: run for run in map(RunFolder, sorted((tmp_path / "outputs" / "runs").iterdir()))}
    assert runs.keys() == {"ALE/Breakout-v5", "ALE/Pong-v5"}
    assert "env.id differs" in said("compare", here, "tracking=none")
    for id_, run in runs.items():
        assert run.result is not None
        assert run.result.steps == 2_000
        shown = ("compare", "by=seed", f"where=env.id={id_}", BOTH, "tracking=none", here)
        assert command(*shown) == 0
        assert "needs plugins=./" in said("evaluate", f"run={run.name}", here, "tracking=none")
        to = tmp_path / run.config["env"]["id"].rpartition("/")[2]
        assert command("export", f"run={run.name}", f"to={to}", "episodes=2", BOTH, here, "device=cpu") == 0
        assert command("evaluate", f"weights={to}", "evaluation.video=false", BOTH, "tracking=none", here) == 0
        scores = json.loads((to / "card.json").read_bytes())["scores"]
        (table,) = (tmp_path / "outputs" / "evaluations").glob(f"{to.name}-*/artifacts/evaluation/episodes.csv")
        assert [float(line.split(",")[2]) for line in table.read_text().splitlines()[1:]] == scores
    pages = [*(tmp_path / "outputs" / "comparisons").glob("*/artifacts/comparison.html")]
    assert len(pages) == 2
    for path in pages:
        page = re.sub(r"<[^>]*>", " ", path.read_text())
        assert {*facts_in(page)} == ({"RIGHTFIRE", "LEFTFIRE"} if "Atari Pong" in page else set())  # Pong's own, too
