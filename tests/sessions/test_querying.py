"""The environment query, on the real emulator."""

import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.commands.query import QueryConfig
from atlantis_exp.sessions.querying import query


def answer(capsys: pytest.CaptureFixture[str], *overrides: str) -> list[str]:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = checked(QueryConfig, compose("query", list(overrides)))
    query(env=config.env)
    captured = capsys.readouterr()
    assert captured.err == ""
    return captured.out.splitlines()


def test_the_query_prints_figure_1_3_with_todays_answer_on_steps(capsys: pytest.CaptureFixture[str]) -> None:
    assert answer(capsys)[:7] == [
        "Action Space: Discrete(4)",
        "possible actions: ['NOOP', 'FIRE', 'RIGHTFIRE', 'LEFTFIRE']",
        "Observation Space: Box(0, 255, (210, 160, 3), uint8)",
        "Max Episode Steps: None",  # 27000 in the report: an older registration
        "Nondeterministic: False",
        "Reward Range: (-inf, inf)",
        "Reward Threshold: None",
    ]


def test_the_query_says_what_this_config_makes_of_the_environment(capsys: pytest.CaptureFixture[str]) -> None:
    report = "\n".join(answer(capsys))
    assert "2 to 4" in report
    assert "an episode ends: when the game is over, or after 27,000 steps or 108,000 frames" in report
    assert "rows 16-95, columns 0-159" in report
    standard = "\n".join(answer(capsys, "env=atlantis_standard", "env.sticky=0.5"))
    assert "frames per step: 4" in standard
    assert "probability 0.5" in standard
    assert "an episode ends: when the game is over, or after 108,000 frames" in standard
