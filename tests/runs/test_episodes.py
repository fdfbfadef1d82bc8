"""The table of evaluated episodes: what is written is what is read."""

import os
from dataclasses import fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.training.evaluation import Episode, Evaluation

GOLDEN = """\
episode,seed,score,steps,frames,truncated,random,NOOP,FIRE,RIGHTFIRE,LEFTFIRE,\
NOOP_random,FIRE_random,RIGHTFIRE_random,LEFTFIRE_random,\
centre_vessel,side_vessel,centre_bomber,side_bomber,wave_bonus
0,1,300.0,4,12,0,1,1,2,0,1,1,0,0,0,100.0,200.0,0.0,0.0,0.0
1,4294967295,900.0,2,6,1,1,0,0,0,2,0,0,0,1,0.0,400.0,0.0,0.0,500.0
"""
WITHOUT_POINTS = "".join(f"{line.rsplit(',', 5)[0]}\n" for line in GOLDEN.splitlines())  # as stored by older versions
EVALUATION = Evaluation(
    0.1,
    [
        Episode(1, 300.0, 12, False, bytearray([0, 1, 1, 3]), bytearray([1, 0, 0, 0]), points=[100, 200, 0, 0, 0]),
        Episode(2**32 - 1, 900.0, 6, True, bytearray([3, 3]), bytearray([1, 0]), points=[0, 400, 0, 0, 500]),
    ],
    facts_of(game_of("Atlantis-v0")),
)
SOURCES = EVALUATION.game.sources

episodes = st.tuples(
    st.integers(0, 2**32 - 1),  # seed
    st.floats(0, 1e9),  # score
    st.integers(0, 10**6),  # frames
    st.booleans(),  # truncated
    st.lists(st.tuples(st.integers(0, 10**5), st.integers(0, 10**5)), min_size=4, max_size=4),  # steps by action
    st.lists(st.floats(0, 1e9) | st.just(float("nan")), min_size=5, max_size=5),  # points by source
)


def assert_equal(one: EpisodeTable, other: EpisodeTable) -> None:
    assert (one.actions, one.sources) == (other.actions, other.sources)
    for name in (field.name for field in fields(EpisodeTable) if field.name not in ("actions", "sources")):
        ours, theirs = getattr(one, name), getattr(other, name)
        assert (ours.dtype, ours.shape) == (theirs.dtype, theirs.shape), name
        assert np.array_equal(ours, theirs, equal_nan=True), name


def test_the_table_of_an_evaluation_is_the_text_that_stored_runs_have() -> None:
    assert EVALUATION.table().to_csv() == GOLDEN


def test_a_stored_table_is_read(tmp_path: Path) -> None:
    (tmp_path / "episodes.csv").write_text(GOLDEN)
    table = EpisodeTable.read(tmp_path / "episodes.csv", SOURCES)
    assert_equal(table, EVALUATION.table())
    assert table.actions == ("NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE")
    assert table.seeds.tolist() == [1, 2**32 - 1]
    assert table.truncated.tolist() == [0, 1]
    assert table.counts.tolist() == [[[0, 1], [2, 0], [0, 0], [1, 0]], [[0, 0], [0, 0], [0, 0], [1, 1]]]


def test_a_table_stored_without_points_is_read_and_their_split_is_not_known(tmp_path: Path) -> None:
    (tmp_path / "episodes.csv").write_text(WITHOUT_POINTS)
    table = EpisodeTable.read(tmp_path / "episodes.csv", SOURCES)
    assert table.points.shape == (2, 5)
    assert np.isnan(table.points).all()
    assert_equal(replace(table, points=EVALUATION.table().points), EVALUATION.table())
    (tmp_path / "episodes.csv").write_text(table.to_csv())
    assert_equal(EpisodeTable.read(tmp_path / "episodes.csv", SOURCES), table)


@given(st.lists(episodes, min_size=1, max_size=5))
def test_writing_and_reading_are_inverse(
    rows: list[tuple[int, float, int, bool, list[tuple[int, int]], list[float]]],
) -> None:
    counts = np.array([row[4] for row in rows], np.float64)
    table = EpisodeTable(
        actions=("NOOP", "FIRE", "RIGHTFIRE", "LEFTFIRE"),
        seeds=np.array([row[0] for row in rows], np.int64),
        scores=np.array([row[1] for row in rows], np.float64),
        steps=counts.sum((1, 2)),
        frames=np.array([row[2] for row in rows], np.float64),
        truncated=np.array([row[3] for row in rows], np.float64),
        counts=counts,
        points=np.array([row[5] for row in rows], np.float64),
        sources=SOURCES,
    )
    with TemporaryDirectory() as folder:
        path = Path(folder, "episodes.csv")
        path.write_text(table.to_csv())
        again = EpisodeTable.read(path, SOURCES)
    assert_equal(again, table)
    assert again.to_csv() == table.to_csv()


def test_a_table_of_many_times_the_episodes_of_any_evaluation_is_small_enough(tmp_path: Path) -> None:
    head, first, _ = GOLDEN.splitlines(keepends=True)
    (tmp_path / "episodes.csv").write_text(head + 20_000 * first)
    assert len(EpisodeTable.read(tmp_path / "episodes.csv").scores) == 20_000
    os.truncate(tmp_path / "episodes.csv", 2**24 + 1)  # parsed, its cells take many times as much
    with pytest.raises(ValueError, match="more than 16,777,216"):
        EpisodeTable.read(tmp_path / "episodes.csv")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("", "is not a table of episodes"),
        (GOLDEN.splitlines()[0], "is not a table of episodes"),
        ("episode,seed,score,steps,frames,truncated\n0,1,300.0,4,12,0\n", "does not say who chose the actions"),
        (GOLDEN.replace("300.0", "many"), "could not convert"),
        *((GOLDEN.replace("300.0", huge), "numbers beyond 1e15") for huge in ("1e308", "nan", "-inf")),
    ],
)
def test_what_is_no_table_is_refused(tmp_path: Path, text: str, fault: str) -> None:
    (tmp_path / "episodes.csv").write_text(text)
    with pytest.raises(ValueError, match=fault):
        EpisodeTable.read(tmp_path / "episodes.csv", SOURCES)
