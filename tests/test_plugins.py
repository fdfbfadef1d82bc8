"""Components that live outside: named on the command line, trained, continued, compared, exported, played again."""

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import MISSING
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from atlantis_exp.checking import parse, to_dict
from atlantis_exp.commands.overrides import check, located
from atlantis_exp.components import KINDS, admit, admitted, built_in, read
from atlantis_exp.config import Config
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.contracts import fingerprints
from atlantis_exp.sessions.job import replaced

Command = Callable[..., int]
Said = Callable[..., str]

ROOT = Path(__file__).resolve().parents[1]

NETWORK = """
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import nn

from atlantis_exp.components import component

Width = Annotated[int, Interval(ge=1, le=64)]


@component("mynet", "model")
class MyNet(nn.Module):
    smallest_side = 8
    splits_batches = True

    def __init__(self, input_shape, num_actions, head, *, width: Width = 8, act: Literal["relu", "silu"] = "relu"):
        super().__init__()
        channels, height, side = input_shape
        self.features = nn.Sequential(nn.Conv2d(channels, width, 8, 8), nn.ReLU() if act == "relu" else nn.SiLU())
        self.mix, self.mix_again = nn.Conv2d(width, width, 1), nn.Conv2d(width, width, 1)
        self.mix_again.weight = self.mix.weight  # tied
        self.scale = nn.Parameter(torch.tensor(0.1))
        self.head = head(width * (height // 8) * (side // 8), num_actions)

    def forward(self, x):
        x = self.features(x)
        return self.head((x + self.scale * self.mix_again(self.mix(x))).flatten(1))
"""
OTHERS = '''
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from annotated_types import Interval

from atlantis_exp.components import component
from atlantis_exp.learning.objectives import DQN
from atlantis_exp.replay.samplers import Draw


@component("newest", "sampler")
class Newest:
    """The newest transitions, more of them each time."""

    def __init__(self, *, share: Annotated[float, Interval(gt=0, le=1)] = 0.5):
        self.share, self.drawn = share, 0

    def sample(self, memory, batch_size, rng):
        self.drawn += 1
        ids = np.sort(memory.draw(8 * batch_size, rng))
        return Draw(ids[-batch_size - self.drawn % batch_size :][:batch_size], None)

    def feed_back(self, ids, errors):
        pass

    def state_dict(self):
        return {"drawn": self.drawn}

    def load_state_dict(self, state):
        self.drawn = state["drawn"]


@component("cautious", "objective")
@dataclass(frozen=True)
class Cautious(DQN):
    """DQN with a share of its target."""

    caution: float = 0.9

    def targets(self, r_t, s_tpm, discount, online, target):
        return self.caution * super().targets(r_t, s_tpm, discount, online, target)


@component("sawtooth", "epsilon", "lr_schedule")
@dataclass(frozen=True)
class Sawtooth:
    teeth: int = 4

    def __call__(self, progress, steps):
        return 1 - (progress * self.teeth) % 1 / 2
'''
PARTS = ("model=mynet", "sampler=newest", "objective=cautious", "epsilon=sawtooth", "lr_schedule=sawtooth")


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with `mynet.py` and `parts.py`, which is the current one."""
    (tmp_path / "mynet.py").write_text(NETWORK)
    (tmp_path / "parts.py").write_text(OTHERS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def packaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed distribution `atlantis-mynet` 0.3, whose package says when it is imported."""
    package = tmp_path / "site" / "mypackage"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("import os\nos.environ['MYPACKAGE'] = 'imported'\n")
    (package / "nets.py").write_text(NETWORK)
    (package / "conf" / "model").mkdir(parents=True)
    (package / "conf" / "model" / "mynet.yaml").write_text("width: 12\n")
    about = tmp_path / "site" / "atlantis_mynet-0.3.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: atlantis-mynet\nVersion: 0.3\n")
    (about / "entry_points.txt").write_text("[atlantis_exp.plugins]\nmynet = mypackage.nets\n")
    for module in ("mypackage", "mypackage.nets"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    monkeypatch.setenv("MYPACKAGE", "not imported")
    monkeypatch.chdir(tmp_path)
    return package


@pytest.fixture
def said(command: Command, capsys: pytest.CaptureFixture[str]) -> Said:
    """Runs a command that ends with exit code 2, and returns its one line."""

    def run(*words: str) -> str:
        capsys.readouterr()
        assert command(*words) == 2
        lines = capsys.readouterr().err.splitlines()
        assert len(lines) == 1
        return lines[0]

    return run


@pytest.fixture(autouse=True)
def _nothing_is_admitted_afterwards() -> Iterator[None]:
    yield
    admit([])


@pytest.mark.slow
def test_all_kinds_from_files_are_trained_and_continued_bit_for_bit(
    plugins: Path, command: Command, tiny_overrides: tuple[str, ...]
) -> None:
    words = replaced(tiny_overrides, "phase.quick.steps=120", "env.max_steps=20", "evaluation.at_end=false")
    words += ["plugins=[./mynet.py,parts.py]", *PARTS, "model.act=silu"]
    ((_, config),) = check("config", Config, located(words)).items()
    places = [plugins / "unbroken", plugins / "continued"]
    for place, budgets in zip(places, ([], ["50", "80"]), strict=True):
        for budget in (*budgets, "null"):
            assert command(*words, f"budget.steps={budget}", f"paths.outputs={place}") == 0
    whole, continued = (fingerprints(config, place) for place in places)
    assert whole == continued

    stored = RunFolder(places[0] / "runs" / config.run_name()).config
    assert {name: len(each["sha256"]) for name, each in stored["plugins"].items()} == {"mynet": 64, "parts": 64}
    assert (stored["model"]["act"], stored["sampler"]["share"], stored["objective"]["caution"]) == ("silu", 0.5, 0.9)
    admit([])  # whoever reads the run without its plugins sees the same run
    unnamed = parse(Config, stored)
    assert unnamed.model.component is None
    assert unnamed.run_name() == config.run_name()
    assert to_dict(unnamed) == stored


@pytest.mark.slow
def test_a_sweep_side_by_side_finds_plugins_and_options_of_one_s_own(
    plugins: Path, tiny_overrides: tuple[str, ...]
) -> None:
    (plugins / "own" / "model").mkdir(parents=True)
    (plugins / "own" / "model" / "wide.yaml").write_text("defaults: [mynet]\nwidth: 32\n")
    words = replaced(tiny_overrides, "phase.quick.steps=20", "evaluation.at_end=false", "paths.outputs=outputs")
    words += ["plugins=./mynet.py", "model=cnn,mynet,wide", "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]
    python = [sys.executable, "-m", "atlantis_exp", "-m", "--config-dir", "own", *words]
    subprocess.run(python, check=True, capture_output=True)
    runs = [RunFolder(path) for path in sorted(plugins.glob("outputs/runs/*"))]
    assert {run.state for run in runs} == {"done"}
    assert sorted(run.config["model"].get("width", 0) for run in runs) == [0, 8, 32]


@pytest.mark.slow
def test_a_run_is_evaluated_exported_played_and_compared(
    plugins: Path, command: Command, tiny_overrides: tuple[str, ...], said: Said, capsys: pytest.CaptureFixture[str]
) -> None:
    place = f"paths.outputs={plugins / 'outputs'}"
    words = ("plugins=mynet.py", "phase.quick.steps=60", "evaluation.every_steps=null")
    own = replaced(tiny_overrides, *words, place)
    assert command("-m", *own, "model=cnn,mynet", "seed=1") == 0
    names = sorted(path.name for path in (plugins / "outputs" / "runs").iterdir())
    assert [name[:15] for name in names] == ["cnn-uniform-s1-", "mynet-uniform-s"]
    assert json.loads((plugins / "outputs" / "runs" / names[0] / "config.json").read_text())["plugins"] == {}
    capsys.readouterr()
    assert command(*own, "model=mynet", "seed=1") == 0
    assert "has ended" in capsys.readouterr().out

    sha = sha256(NETWORK.encode()).hexdigest()[:12]
    played = ("episodes=1", "evaluation.video=false", "evaluation.num_envs=1")
    needed = rf"needs plugins=\./mynet\.py \(mynet, sha {sha}\)"
    evaluate = ("evaluate", f"run={names[1]}", *played, "tracking=none", place)
    assert re.search(f"{needed}$", said(*evaluate))
    assert command(*evaluate, "plugins=./mynet.py") == 0
    export = ("export", f"run={names[1]}", *played, "to=exported", place)
    assert re.search(f"{needed}$", said(*export))
    assert command(*export, "plugins=./mynet.py") == 0
    card = json.loads((plugins / "exported" / "card.json").read_text())
    assert "plugins=[./mynet.py]" in card["made"]["command"]
    assert str(plugins) not in json.dumps(card)
    weights = ("evaluate", "weights=exported/", "tracking=none", "evaluation.video=false", place)
    assert re.search(f"{needed}$", said(*weights))
    capsys.readouterr()
    assert command(*weights, "plugins=mynet.py") == 0
    shown = [line.split()[-8:-6] for line in capsys.readouterr().out.splitlines() if re.search("│ (card|here) ", line)]
    assert len(shown) == 2
    assert shown[0] == shown[1]

    # Results are data: they are compared without anybody's code.
    admit([])
    assert command("compare", "by=model", "tracking=none", place) == 0
    page = Path(capsys.readouterr().out.rstrip().splitlines()[-1])
    assert "mynet" in (page.parent / "tables" / "runs.csv").read_text()

    # Another source is another network.
    (plugins / "mynet.py").write_text(NETWORK + "# changed\n")
    assert re.search(
        rf"{needed}; /\S+/mynet.py is mynet, sha \w{{12}}, which makes", said(*evaluate, "plugins=mynet.py")
    )
    capsys.readouterr()
    assert command(*own, "model=mynet", "seed=1") == 0
    assert re.search(rf"run {names[1]} used mynet, sha {sha}, this one uses mynet, sha", capsys.readouterr().out)
    assert len([*(plugins / "outputs" / "runs").iterdir()]) == 3


def test_an_exported_network_is_handed_on_with_its_plugin_s_source_and_the_page_s_command_plays_it(
    plugins: Path, command: Command, tiny_overrides: tuple[str, ...], said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = replaced(tiny_overrides, "phase.quick.steps=30", "evaluation.at_end=false", "evaluation.every_steps=20")
    words += ["plugins=[./mynet.py,parts.py]", *PARTS]
    place = f"paths.outputs={plugins / 'outputs'}"
    assert command(*words, place) == 0
    export = ("export", "to=here/mine", "episodes=1", "evaluation.num_envs=1", "device=cpu", place)
    assert command(*export, "plugins=./mynet.py,parts.py") == 0
    (plugins / "mynet.py").unlink()
    (plugins / "there").mkdir()
    (plugins / "here").rename(plugins / "there" / "here")
    monkeypatch.chdir(plugins / "there")
    page = Path("here/mine/README.md").read_text()
    assert f"`mynet.py`: the source of a plugin, sha256 `{sha256(NETWORK.encode()).hexdigest()}`" in page
    shown = re.search(r"python -m atlantis_exp (evaluate .*) episodes=1", page)
    assert shown is not None
    played = [*shlex.split(shown[1]), "evaluation.video=false", "tracking=none", place]
    assert command(*played) == 0
    admit([])
    assert "needs plugins=./mynet.py" in said(*(word for word in played if not word.startswith("plugins=")))


@pytest.mark.usefixtures("packaged")
def test_a_package_is_listed_and_named_without_being_imported(
    said: Said, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    assert said("model=mynet") == "atlantis_exp: model=mynet: add plugins=atlantis-mynet"
    assert "'atlantis-mynet'" in said("plugins=atlantis-mynt")
    capsys.readouterr()
    assert command("--help") == 0
    assert "plugins=atlantis-mynet: mynet\n" in capsys.readouterr().out
    assert os.environ["MYPACKAGE"] == "not imported"


@pytest.mark.usefixtures("packaged")
def test_a_package_that_is_named_gives_settings_ranges_and_values(
    said: Said, command: Command, capsys: pytest.CaptureFixture[str]
) -> None:
    named = ("model=mynet", "plugins=atlantis-mynet")
    assert "width=0: should be greater than or equal to 1" in said(*named, "model.width=0")
    assert command(*named, "--cfg", "job") == 0
    assert "width: 12\n" in capsys.readouterr().out
    assert os.environ["MYPACKAGE"] == "imported"


def test_a_package_is_trained_and_its_identity_is_that_of_all_its_sources(
    packaged: Path, command: Command, tiny_overrides: tuple[str, ...]
) -> None:
    words = replaced(tiny_overrides, "phase.quick.steps=20", "evaluation.at_end=false")
    assert command(*words, "model=mynet", "plugins=atlantis-mynet", f"paths.outputs={packaged.parent}") == 0
    ((_, before),) = check("config", Config, ["model=mynet", "plugins=atlantis-mynet"]).items()
    assert before.plugins["atlantis-mynet"].version == "0.3"
    (packaged / "other.py").write_text("x = 1\n")
    admit([])
    ((_, after),) = check("config", Config, ["model=mynet", "plugins=atlantis-mynet"]).items()
    assert before.identity() != after.identity()


INHERITED = """
from dataclasses import dataclass
from typing import Annotated

from annotated_types import Interval

from atlantis_exp.components import component
from atlantis_exp.learning.objectives import Quantile
from atlantis_exp.networks.resnet_fast import ResNetFast

WIDEST = 512


@component("mynet", "model")
class MyNet(ResNetFast):
    pass


@component("wider", "model")
class Wider(ResNetFast):
    def __init__(self, input_shape, num_actions, head, *, width: Annotated[int, Interval(ge=1, le=WIDEST)] = 8):
        super().__init__(input_shape, num_actions, head)


@component("myquantile", "objective")
class MyQuantile(Quantile):
    pass


@component("mean", "objective")
@dataclass(frozen=True)
class Mean(Quantile):
    power: "float" = 2.0
"""


@pytest.fixture
def inherited(tmp_path: Path) -> dict[str, Any]:
    """Components that inherit from ours, by name."""
    (tmp_path / "inherited.py").write_text(INHERITED)
    admit([str(tmp_path / "inherited.py")])
    return {name: each for (_, name), each in admitted().items()}


def test_a_class_inherits_facts(inherited: dict[str, Any]) -> None:
    assert inherited["mynet"].facts == {"input_size": 84, "smallest_side": 8, "splits_batches": True}
    assert [inherited[name].facts["head"] for name in ("myquantile", "mean")] == ["quantile", "quantile"]


def test_a_class_inherits_settings(inherited: dict[str, Any]) -> None:
    assert [each.name for each in inherited["myquantile"].settings] == ["quantiles"]
    assert {each.name: each.default for each in inherited["mean"].settings} == {"quantiles": MISSING, "power": 2.0}


@pytest.mark.usefixtures("inherited")
def test_a_bound_may_be_a_constant(said: Said, tmp_path: Path) -> None:
    plugin = f"plugins={tmp_path / 'inherited.py'}"
    assert "model.width=513: should be less than or equal to 512" in said("model=wider", plugin, "model.width=513")


@pytest.mark.parametrize(("kind", "name"), built_in())
def test_our_classes_are_declared_as_they_are(kind: str, name: str) -> None:
    component = built_in()[kind, name]
    settings, facts = read(kind, component.load())
    assert {each.name: each.type for each in component.settings} == {each.name: each.type for each in settings}
    assert component.facts == facts
    assert component.path.is_file()


CONTRACTS = [  # kind, a method of one of the parts, what is there instead
    ("sampler", "sample(self, memory, batch_size, rng)", "sample(self, memory, batch_size)"),
    ("sampler", "feed_back(self, ids, errors)", "feedback(self, ids, errors)"),
    ("sampler", "state_dict(self)", "state(self)"),
    ("sampler", "load_state_dict(self, state)", "load_state_dict(self)"),
    ("objective", "targets(self, r_t, s_tpm, discount, online, target)", "targets(self, r_t, s_tpm)"),
    ("epsilon", "__call__(self, progress, steps)", "__call__(self, progress)"),
    ("epsilon", "__call__(self, progress, steps)", "call(self, progress, steps)"),
]


@pytest.mark.parametrize(("kind", "method", "instead"), CONTRACTS)
def test_a_method_that_does_not_take_what_it_is_given_is_one_line(
    kind: str, method: str, instead: str, plugins: Path, said: Said
) -> None:
    assert f"def {method}:" in OTHERS
    (plugins / "parts.py").write_text(OTHERS.replace(f"def {method}:", f"def {instead}:"))
    assert kind in KINDS
    assert re.search(rf"/parts\.py:\d+: TypeError: needs a method {re.escape(method)}$", said("plugins=./parts.py"))


BROKEN = [  # what is in mynet.py instead of a part of it, the line that is to blame, and what is said of it
    ("import torch\n", "import torch\nimport torhc\n", "import torhc", r"ModuleNotFoundError: No module named 'torhc'"),
    ("class MyNet", "clas MyNet", "clas MyNet", r"SyntaxError: invalid syntax"),
    ("super().__init__()", "super().__init__(); 1 / 0", "1 / 0", r"ZeroDivisionError: division by zero"),
    ("self.features = ", "self.features = nn.Conv3d() or ", "Conv3d", r"TypeError: .* missing 3 required"),
    ("flatten(1)", "flatten()", "flatten()", r"RuntimeError: mat1 and mat2"),
    (
        "self.head((x",
        "((x",
        "@component",
        r"TypeError: MyNet returns \(2, 200\) for two states; should be \(2, 4\)",
    ),
    ("num_actions, head, *,", "*,", "@component", r"TypeError: __init__ takes 1 arguments but gets 3"),
    (
        "width: Width",
        "width: torch.Tensor",
        "@component",
        r"TypeError: width: .*Tensor cannot be a setting's type; use",
    ),
    ("width: Width", "width: np.ndarray", "def __init__", r"NameError: name 'np' is not defined"),
    ("width: Width", "width: 'a side of'", "@component", r"SyntaxError: "),
    ("width: Width", "width: Annotated[int]", "def __init__", r"TypeError: Annotated"),
    ("width: Width", "settings: Width", "@component", r"TypeError: settings: a setting has .* not one of component,"),
    ("width: Width = 8", "width=8", "@component", r"TypeError: width: has no type"),
    ("width: Width = 8", "width: Width = 80", "@component", r"TypeError: width: default 80: Input should be less than"),
    ("width: Width = 8", "width: Width = torch.ones(1)", "@component", r"TypeError: Object of type Tensor is not JSON"),
    ("Interval(ge=1, le=64)", "Interval(1, 64)", "Width =", r"TypeError: Interval.__init__\(\) takes 1 positional"),
    ("Interval(ge=1, le=64)", "Interval(ge='x')", "@component", r"\w+Error: "),
    (
        '"mynet", "model"',
        '"mynet", "modle"',
        "@component",
        r"ValueError: 'modle': no such kind; did you mean 'model'\?",
    ),
    ('"mynet", "model"', '"mynet"', "@component", r"ValueError: '': no such kind"),
    ('"mynet", "model"', '"MyNet", "model"', "@component", r"ValueError: 'MyNet': a name has lowercase letters"),
    ('"mynet", "model"', '"cnn", "model"', "@component", r"model=cnn is built in and cannot be replaced"),
    ("smallest_side = 8", "smallest_side = 8.5", "@component", r"TypeError: smallest_side: should be a int, not 8\.5"),
    ("def forward(self, x)", "def forward(self)", "@component", r"TypeError: needs a method forward\(self, x\)"),
    ("import torch\n", "import torch\nraise SystemExit(3)\n", "raise System", r"SystemExit: 3"),
    ('@component("mynet", "model")\n', "", "", r"has no component; put @component"),
]


@pytest.mark.parametrize(
    ("part", "instead", "blamed", "reason"), BROKEN, ids=[f"{each[1]} {each[3]}" for each in BROKEN]
)
def test_a_plugin_that_fails_is_one_line_with_its_file_and_line(
    part: str, instead: str, blamed: str, reason: str, plugins: Path, said: Said, tiny_overrides: tuple[str, ...]
) -> None:
    assert part in NETWORK
    text = NETWORK.replace(part, instead)
    (plugins / "mynet.py").write_text(text)
    line = said(*tiny_overrides, "model=mynet", "plugins=./mynet.py", f"paths.outputs={plugins / 'outputs'}")
    line_number = f":{text[: text.index(blamed)].count(chr(10)) + 1}" if blamed else ""
    assert re.search(f"{re.escape(str(plugins / 'mynet.py'))}{line_number}: {reason}", line)


MEMORY = """
    units, burn_in, unroll = 4, 2, 3

    def sequence(self, x, h, first):
        q = self.forward(x.flatten(0, 1))
        return q.reshape(*x.shape[:2], *q.shape[1:]), h
"""


@pytest.mark.parametrize(
    ("part", "instead", "reason"),
    [
        ("unroll =", "unrol =", "unroll is None; a network with a method sequence needs an int of at least 1"),
        ("4, 2, 3", "4, 0, 3", "burn_in is 0; "),
        ("*x.shape[:2]", "3, 2", r"sequence returns \(\(3, 2, 4\), \(2, 4\)\) for two .*; should be \(\(2, 3, 4\), "),
        (", h\n", ", h[:1]\n", r"sequence returns \(\(2, 3, 4\), \(1, 4\)\) for two "),
    ],
)
def test_a_memory_that_would_fail_or_be_passed_over_is_one_line(
    part: str, instead: str, reason: str, plugins: Path, said: Said, tiny_overrides: tuple[str, ...]
) -> None:
    (plugins / "mynet.py").write_text(NETWORK + MEMORY.replace(part, instead))
    line = said(*tiny_overrides, "model=mynet", "plugins=./mynet.py", f"paths.outputs={plugins / 'outputs'}")
    assert re.search(rf"/mynet\.py:\d+: TypeError: {reason}", line)


def test_a_head_of_quantiles_needs_their_number(plugins: Path, said: Said) -> None:
    (plugins / "parts.py").write_text(OTHERS.replace("    caution:", "    head = 'quantile'\n    caution:"))
    assert re.search(r"/parts.py:\d+: TypeError: head = .* needs a setting quantiles", said("plugins=./parts.py"))
    (plugins / "parts.py").write_text(
        OTHERS.replace("    caution:", "    head = 'quantile'\n    quantiles: str = 'x'\n    caution:")
    )
    assert re.search(r"/parts.py:\d+: TypeError: head = .* needs a setting quantiles: int", said("plugins=./parts.py"))


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        ("plugins=./none.py", "/.*/none.py is not a file"),
        ("plugins=./other/mynet.py,mynet.py", r"mynet\.py: /.*/other/mynet\.py is called mynet, too; rename one"),
        ("plugins=copy.py,mynet.py", r"/mynet.py:13: model=mynet is also in /.*/copy\.py"),
        ("plugins=./my-net.py", r"name a file NAME\.py"),
        ("plugins=nothing", "no such distribution is installed"),
        ("plugins=3", "plugins=3: no such distribution"),
        ("plugins={a:1}", "no such distribution"),
        ("plugins=[] model=mynet", "one of your own needs plugins="),
        ("plugins=mynet.py plugins=copy.py", "contradicts plugins="),
        ("search trials=2 plugins=mynet.py model=mynt,cnn", "'mynet'"),
    ],
)
def test_a_plugin_that_is_none_or_one_of_two_is_refused(words: str, reason: str, plugins: Path, said: Said) -> None:
    (plugins / "other").mkdir()
    for copy in ("other/mynet.py", "copy.py", "my-net.py"):
        (plugins / copy).write_text(NETWORK)
    assert re.search(reason, said(*words.split(" ")))


def test_options_of_one_s_own_come_from_a_folder_and_name_no_code(
    plugins: Path, command: Command, said: Said, capsys: pytest.CaptureFixture[str]
) -> None:
    own = plugins / "own"
    for path, text in {
        "model/wide.yaml": "defaults: [mynet]\nwidth: 32\n",
        "experiment/mine.yaml": "# @package _global_\ndefaults:\n  - override /model: resnet\noptimizer: {lr: 0.5}\n",
    }.items():
        (own / path).parent.mkdir(parents=True)
        (own / path).write_text(text)
    assert command("--config-dir", "own", "model=wide", "plugins=mynet.py", "--cfg", "job") == 0
    assert re.search(r"name: mynet\n.*\n.*\n  width: 32\n", capsys.readouterr().out)
    assert command("--config-dir=own", "experiment=mine", "--cfg", "job") == 0
    assert re.search(r"lr: 0\.5\n", capsys.readouterr().out)
    assert "'mine'" in said("--config-dir=own", "experiment=mne")
    experiment = (own / "experiment" / "mine.yaml").read_text()
    for text, reason in {
        "plugins: [./mynet.py]": "names plugins; name them on the command line",
        "optimizer: {_target_: os.system}": r"optimizer\._target_: no such key",
    }.items():
        (own / "experiment" / "mine.yaml").write_text(experiment.replace("optimizer: {lr: 0.5}", text))
        assert re.search(reason, said("--config-dir=own", "experiment=mine"))
    marker = plugins / "was_run"
    for text in (  # nothing of Hydra's is made or run, whatever a file says of it
        f"hydra: {{callbacks: {{x: {{_target_: pathlib.Path.touch, self: {marker}}}}}}}",
        "hydra: {overrides: {task: ['plugins=[mynet.py]']}}",
        "hydra: {job: {chdir: true, env_set: {PYTHONPATH: own}}}",
    ):
        (own / "experiment" / "mine.yaml").write_text(f"{experiment}{text}\n")
        assert command("--config-dir=own", "experiment=mine", "--cfg", "job") == 0
        assert re.search(r"lr: 0\.5\n", capsys.readouterr().out)
    assert not marker.exists()
    assert Path.cwd() == plugins
    assert os.environ.get("PYTHONPATH") != "own"
    (own / "model" / "cnn.yaml").write_text("name: cnn\n")
    assert "/own/model/cnn.yaml: model=cnn is built in; rename yours" in said("--config-dir=own", "seed=1")
    (own / "model" / "cnn.yaml").unlink()
    (own / "hydra").mkdir()
    assert "its group hydra/ could name code" in said("--config-dir=own", "seed=1")


def test_an_installed_plugin_that_cannot_be_read_is_not_called_missing(packaged: Path, said: Said) -> None:
    (packaged / "nets.py").unlink()
    reason = r"plugins=atlantis-mynet: ModuleNotFoundError: No module named 'mypackage\.nets'"
    assert re.search(reason, said("plugins=atlantis-mynet", "--cfg", "job"))


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"width:\t[\n\t1", r"wide\.yaml"),
        (b"width: [1", r"wide\.yaml"),
        (b"width: \xff", "UnicodeDecodeError"),
        (b"width: !!python/name:os.system", r"wide\.yaml"),
        (b"defaults: [cnn]\nwidth: !!binary aGVsbG8=", "own: TypeError"),
        (b"defaults: 3", "ValueError"),
        (b"defaults: [wide]", "RecursionError"),
        (b"width: " + b"[" * 3_000 + b"]" * 3_000, "RecursionError"),
        (b"defaults: [cnn]\n1: 2", r"model\.1: no such key"),
    ],
    ids=["tab", "bracket", "byte", "tag", "binary", "defaults", "itself", "nested", "number"],
)
def test_a_damaged_option_of_one_s_own_is_one_line(text: bytes, reason: str, tmp_path: Path, said: Said) -> None:
    own = tmp_path / "own"
    (own / "model").mkdir(parents=True)
    (own / "model" / "wide.yaml").write_bytes(text)
    assert re.search(reason, said(f"--config-dir={own}", "model=wide", "--cfg", "job"))


def test_a_plugin_s_settings_that_are_nested_too_deeply_are_one_line(plugins: Path, said: Said) -> None:
    (plugins / "conf" / "model").mkdir(parents=True, exist_ok=True)
    (plugins / "conf" / "model" / "mynet.yaml").write_text("width: " + "[" * 3_000 + "]" * 3_000)
    assert re.search(r"conf/model/mynet\.yaml: ", said("model=mynet", "plugins=mynet.py", "--cfg", "job"))


HOSTILE = """
import json, sys
from pathlib import Path

seen = []
def hook(event, arguments):
    if event in ("import", "exec", "open"):
        what = arguments[0].co_filename if event == "exec" else arguments[0]
        if "evil" in str(what):
            seen.append((event, what))
sys.addaudithook(hook)
from atlantis_exp.checking import parse
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.cards import build_exported_actor, read_card
for path in sys.argv[1:]:
    try:
        card, weights = read_card(Path(path))
        build_exported_actor(card.config, weights, "cpu")
        print("played")
    except ConfigError as error:
        print(" ".join(str(error).split()))
print(seen)
"""


def test_what_is_read_from_disk_names_no_code(
    plugins: Path, command: Command, tiny: Callable[..., Config], capsys: pytest.CaptureFixture[str]
) -> None:
    """An audit hook sees every import, every piece of code that is run and every file that is opened."""
    (plugins / "evil.py").write_text(NETWORK.replace("mynet", "evil") + "raise SystemExit('it ran')\n")
    tree = to_dict(tiny())
    sha = sha256((plugins / "evil.py").read_bytes()).hexdigest()
    evil = {"plugins": {"evil": {"version": None, "sha256": sha}}}
    network = {**tree["model"], "name": "evil"}
    named: dict[str, tuple[dict[str, Any], str]] = {
        "recorded": ({**evil, "model": network}, "needs plugins=./evil.py"),
        "unrecorded": ({"model": network}, "model.name=evil: no such choice"),
        "module": ({**evil, "model": {**network, "name": "evil.MyNet"}}, "no such choice"),
        "path": ({**evil, "model": {**network, "name": "../evil"}}, "no such choice"),
        "target": ({**evil, "model": {**network, "_target_": "evil.MyNet"}}, "not the settings of a component"),
        "file": ({"plugins": ["./evil.py"], "model": network}, "plugins"),
        "place": ({"plugins": {"./evil.py": evil["plugins"]["evil"]}, "model": network}, "plugins"),
        "head": (
            {
                **evil,
                "model": {**tree["model"], "head": "quantile"},
                "objective": {**tree["objective"], "name": "evil"},
            },
            "needs plugins=./evil.py",
        ),
        "cnn": ({**evil, "model": {**tree["model"], "path": "evil.py"}}, "model.path: no such key"),
    }
    for name, (changed, _) in named.items():
        folder = plugins / "cards" / name
        folder.mkdir(parents=True)
        weights = safetensors.numpy.save({"x": np.zeros(1)})
        (folder / "weights.safetensors").write_bytes(weights)
        card = {
            "format": 1,
            "run": "x",
            "weights": "best",
            "step": 0,
            "reached": {},
            "made": {},
            "scores": [1.0],
            "precision": "float32",
            "sha256": sha256(weights).hexdigest(),
            "config": {**tree, **changed},
            "evaluation": tree["evaluation"],
        }
        (folder / "card.json").write_text(json.dumps(card))
        run = plugins / "runs" / name
        run.mkdir(parents=True)
        (run / "config.json").write_text(json.dumps(card["config"]))
        journal = Journal(run)
        journal.model("network", weights, 0, {}, best=True)
        journal.finish()
    process = subprocess.run(
        [sys.executable, "-c", HOSTILE, *(str(plugins / "cards" / name) for name in named)],
        capture_output=True,
        text=True,
        check=False,
        cwd=plugins,
    )
    *lines, seen = process.stdout.splitlines()
    assert seen == "[]", process.stderr
    for line, (_, reason) in zip(lines, named.values(), strict=True):
        assert reason in line
    for name, (_, reason) in named.items():
        capsys.readouterr()
        assert command("evaluate", f"run={name}", f"paths.outputs={plugins}", "tracking=none") in (1, 2)
        (line,) = capsys.readouterr().err.splitlines()
        assert reason in line
    assert "evil" not in sys.modules


def test_the_examples_are_trained(command: Command, tiny_overrides: tuple[str, ...], tmp_path: Path) -> None:
    files = sorted((ROOT / "examples").glob("*.py"))
    assert all(len(file.read_text().splitlines()) < 40 for file in files)
    words = replaced(tiny_overrides, "phase.quick.steps=60", "evaluation.at_end=false", f"paths.outputs={tmp_path}")
    chosen = ("model=residual", "sampler=paying", "objective=mellow")
    assert command(*words, *chosen, f"plugins={','.join(map(str, files))}") == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "firsts"),
    [
        ("extending", {"decide", "check", "baseline", "compare", "evaluate", "export", "-m", "model=mynet"}),
        (
            "first-hour",
            {"sync", "-m", "evaluate", "compare", "report", "experiment=quick", "new", "check", "decide"},
        ),
    ],
)
def test_the_page_does_what_it_says(
    command: Command,
    tiny_overrides: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    page: str,
    firsts: set[str],
) -> None:
    """Every command of the page, on its own network, smaller and shorter."""
    text = (ROOT / "docs" / f"{page}.md").read_text()
    for network in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        (tmp_path / "mynet.py").write_text(network)
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    shutil.copytree(ROOT / "pretrained", tmp_path / "pretrained")  # where an export goes, too
    monkeypatch.chdir(tmp_path)
    blocks = "".join(re.findall(r"```sh\n(.*?)```", text, re.DOTALL))
    if "make run\n" in text:
        shutil.copytree(ROOT / "results" / "verdict", tmp_path / "outputs")
    (recipe,) = re.findall(r"^run: .*\n((?:\t.*\n)+)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    run = "".join(re.findall(r"^\t\$\(BIN\)/(python -m .*\n)", recipe, re.MULTILINE))
    lines = blocks.replace("make run\n", run).replace("\\\n", "").replace("steps=1500", "steps=20").splitlines()
    place = f"paths.outputs={tmp_path / 'outputs'}"
    quick = replaced(tiny_overrides, "phase.quick.steps=20", "evaluation.every_steps=null", place)
    played = ("episodes=1", "evaluation.video=false", "evaluation.num_envs=1", "tracking=none", place)
    more: dict[str, list[str]] = {
        "decide": ["--cfg", "job"],
        "check": ["--cfg", "job"],
        "new": [],
        "report": [place],
        "sync": ["--cfg", "job"],
        "baseline": [*played[1:], "evaluation.episodes=1", "env.max_steps=20"],
        "compare": ["tracking=none", place],
        "evaluate": [*played, "epsilon=1"],
        "export": [word for word in played if not word.startswith("tracking")],
    }
    for line in lines:
        words = shlex.split(re.sub("(.*) --cfg job$", r"\1", line))
        assert words[:3] == ["python", "-m", "atlantis_exp"]
        first, *rest = words[3:]
        words = [first, *replaced(rest, *more[first])] if first in more else replaced([first, *rest], *quick)
        shown = ["--cfg", "job"] if line.endswith("--cfg job") else []
        assert command(*sorted(words, key=lambda word: word != "-m"), *shown) == 0, line
    assert {line.split()[3] for line in lines} >= firsts
