"""Help: every key with its value and its sentence, without loading what a verb works with."""

import re
import subprocess
import sys
from importlib.metadata import version

import pytest
from hydra import compose
from omegaconf import OmegaConf

from atlantis_exp.checking import flatten
from atlantis_exp.commands import CONF, VERBS, main
from atlantis_exp.commands.composing import composing
from atlantis_exp.commands.helping import help_text, overview


@pytest.mark.parametrize("verb", VERBS)
def test_no_key_of_a_verb_is_shown_with_two_values(verb: str) -> None:
    keys = re.findall(r"^  ([a-z_.]+)=", help_text(verb, ["all"]).partition("\nFlags:")[0], re.MULTILINE)
    assert len(keys) == len({*keys}) > 0


def shown_keys(verb: str, *arguments: str) -> dict[str, str]:
    """The keys of a help and their values; of a preset's the last."""
    return dict(
        re.findall(r"^  ([a-z_.]+)=(.*?)(?:  .*)?$", help_text(verb, arguments).partition("\nFlags:")[0], re.MULTILINE)
    )


@pytest.mark.parametrize("verb", VERBS)
def test_every_key_of_a_verb_is_shown_and_no_other(verb: str) -> None:
    with composing():
        tree = OmegaConf.to_container(compose("config" if verb == "train" else verb), resolve=False)
    assert isinstance(tree, dict)
    keys = flatten({str(key): value for key, value in tree.items()})
    lists = {re.sub(r"\.\d+$", "", key) for key in keys}  # a list is one key
    named = {key for key in lists if key.endswith(".name")}
    library = {key for key in lists if key.startswith("samplers.")}
    refused = {"seed", "resume"} if verb == "decide" else set[str]()
    assert {*shown_keys(verb, "all")} - {"plugins"} == lists - named - library - refused - {"plugins"}


def test_a_preset_and_a_chosen_option_show_their_keys() -> None:
    fast = shown_keys("train", "experiment=fast", "--help", "all")
    assert (fast["objective.n_step"], fast["objective.quantiles"]) == ("10", "51")
    assert "epsilon.duration" in shown_keys("train", "epsilon=linear")
    assert "epsilon.duration" not in shown_keys("train")
    assert "epsilon.decay" not in shown_keys("train")
    assert "epsilon.decay" in shown_keys("train", "all")
    assert "model=nothing   (cnn, cnn_gru, cnn_norm, cnn_small, resnet, resnet_fast)" in help_text(
        "train", ["model=nothing"]
    )
    assert f"model={300 * 'a'}   (cnn, " in help_text("train", [f"model={300 * 'a'}"])  # too long for a file's name


def test_every_sentence_next_to_a_key_is_there() -> None:
    text = help_text("compare", [])
    sentences = re.findall(r"# (.+)", (CONF / "compare.yaml").read_text().partition("\n\n")[2])
    assert len(sentences) > 8
    assert all(sentence in text for sentence in sentences)


def test_help_and_a_misspelt_verb_load_nothing_heavy() -> None:
    program = (
        "import atexit, sys; "
        "atexit.register(lambda: print(sorted({'torch', 'mlflow', 'hydra', 'omegaconf', 'numpy', 'ale_py'} "
        "& {*sys.modules}), file=sys.stderr)); "
        "from atlantis_exp.commands import main; main()"
    )
    for words in (["--help"], ["compare", "--help"], ["--help", "compare"], ["trian"]):
        done = subprocess.run([sys.executable, "-c", program, *words], capture_output=True, text=True, check=False)
        assert done.stderr.splitlines()[-1] == "[]", words


def test_the_version_is_the_packages_and_a_plan_of_its_own_takes_no_sweep(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["atlantis_exp", "--version"])
    with pytest.raises(SystemExit, match="0"):
        main()
    assert capsys.readouterr().out == f"atlantis-exp {version('atlantis-exp')}\n"
    assert {verb for verb in VERBS if "\n  -m " not in help_text(verb, [])} == {"decide", "search"}


def test_the_first_screen_lists_every_verb_the_six_of_every_day_first() -> None:
    lines = overview().splitlines()
    daily, more = (lines[2 : lines.index("more:")], lines[lines.index("more:") :])
    assert [line.split()[0] for line in daily if line] == ["train", "decide", "compare", "evaluate", "report", "ui"]
    assert {line.split()[0] for line in [*daily, *more] if line.startswith("  ")} == {*VERBS}


def test_a_help_begins_with_what_people_change_most_and_fits_a_screen_or_two() -> None:
    lines = help_text("train", []).splitlines()
    assert lines[4].startswith("  seed=0")
    assert lines[lines.index("Groups:") + 1].startswith("  model=cnn ")
    assert lines[lines.index("Groups:") + 2].startswith("  experiment=none ")
    assert len(lines) < 50 < len(help_text("train", ["all"]).splitlines())
    for verb, key in (("decide", "against"), ("search", "trials")):  # their own keys, ahead of the training's
        assert help_text(verb, []).splitlines()[4].startswith(f"  {key}=")
