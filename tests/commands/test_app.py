"""The edge: what a person may write on a command line, and what they are told when they may not."""

import json
import os
import re
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.app import CONF, check, checked
from atlantis_exp.config import (
    BaselineConfig,
    CompareConfig,
    Config,
    ConfigError,
    EvaluateConfig,
    ExportConfig,
    PlayConfig,
    QueryConfig,
    ReportConfig,
    SearchConfig,
    SyncConfig,
    UiConfig,
    flatten,
    parse,
    to_dict,
)

SCHEMAS: dict[str, type[Any]] = {
    "config": Config,
    "search": SearchConfig,
    "evaluate": EvaluateConfig,
    "export": ExportConfig,
    "baseline": BaselineConfig,
    "compare": CompareConfig,
    "play": PlayConfig,
    "query": QueryConfig,
    "report": ReportConfig,
    "sync": SyncConfig,
    "ui": UiConfig,
}
GROUPS = {path.name: sorted(file.stem for file in path.glob("*.yaml")) for path in CONF.iterdir() if path.is_dir()}
NO_PART = ("agent", "experiment", "hydra", "space")  # of a training, or chosen otherwise


@cache
def composed(*overrides: str) -> Config:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return checked(Config, compose("config", list(overrides)))


MISTAKES = [  # what is written, and what the one line must hold
    # keys
    ("modle=cnn", "modle=cnn", "'model'"),
    ("+modle=cnn", "+modle=cnn", "'model'"),
    ("++modle=cnn", "++modle=cnn", "'model'"),
    ("lr=0.1", "lr=0.1", "'optimizer.lr'"),
    ("optimizer.l=1", "optimizer.l", "'optimizer.lr'"),
    ("++optimizer.l=1", "optimizer.l", "'optimizer.lr'"),
    ("optimizer.lr.x=1", "optimizer.lr.x", "'optimizer.lr'"),
    ("+env.crop.x=1", "env.crop.x", "'env.crop'"),
    ("objective.target.mod=train", "objective.target.mod", "'objective.target.mode'"),
    ("epsilon=linear epsilon.decay=1", "epsilon.decay", "epsilon.duration"),
    ("optimizer=rmsprop optimizer.beta=[0.9,0.9]", "optimizer.beta", "valid: optimizer.alpha"),
    ("model@foo=cnn", "model@foo", "'model'"),
    ("sampler@samplers.foo=uniform", "sampler@samplers.foo", "'sampler@samplers."),
    ("+samplers.mine={name:uniform}", "samplers.mine", "samplers.uniform"),
    ("+optimizer.lr=0.1", "+optimizer.lr=0.1", "write optimizer.lr=0.1"),
    ("~optimizer.lr", "~optimizer.lr", "needed"),
    ("~optimizer", "~optimizer", "adam, adamw, rmsprop"),
    ("~env.size", "~env.size", "needed"),
    ("~phase.single", "phase", "at least one phase"),
    ("phase=two_phase ~phase.first.lr", "phase.first.lr", "missing"),
    ("optimizer.lr=${optimizer.l}", "optimizer.l", "'optimizer.lr'"),
    ("optimizer.lr=???", "optimizer.lr", "issing"),
    ("samplers.uniform.name=top_half", "samplers.uniform.oversample", "missing"),
    ("=1", "=1", "no such key"),
    # options
    ("model=resnt", "model=resnt", "'resnet'"),
    ("experiment=quik", "experiment=quik", "'quick'"),
    ("phase={}", "phase={}", "quick, single, steps, two_phase"),
    ("env=3", "env=3", "atlantis_v0"),
    ("model=null", "model=None", "cnn, resnet, resnet_fast"),
    ("sampler@samplers.uniform=top", "sampler=top", "'top_half'"),
    ("model.name=foo", "model.name=foo", "cnn, resnet, resnet_fast"),
    ("optimizer.name=adamax", "optimizer.name=adamax", "'adam"),
    ("objective.name=double", "objective.name=double", "'double_dqn'"),
    ("env.id=Pong-v0", "env.id=Pong-v0", "ALE/Atlantis-v5, Atlantis-v0"),
    ("resume=maybe", "resume=maybe", "auto, must, never"),
    ("objective.target.mode=trian", "objective.target.mode=trian", "'train'"),
    ("device=gpu", "device=", "auto|cpu|cuda"),
    # types and ranges
    ("optimizer.lr=abc", "optimizer.lr", "valid number"),
    ("optimizer.lr=true", "optimizer.lr", "valid number"),
    ("optimizer.lr=0", "optimizer.lr=0", "greater than 0"),
    ("optimizer.lr=-1", "optimizer.lr=-1", "greater than 0"),
    ("optimizer.lr=nan", "optimizer.lr", "finite"),
    ("optimizer.lr=${oc.env:HOME}", "optimizer.lr", "valid number"),
    ("optimizer.betas=[0.9]", "optimizer.betas.1", "missing"),
    ("optimizer.betas=[0.9,0.9,0.9]", "optimizer.betas", "at most 2"),
    ("optimizer.betas=[0.9,1.0]", "optimizer.betas.1=1.0", "less than 1"),
    ("seed=-1", "seed=-1", "greater than or equal to 0"),
    ("seed=1.5", "seed=1.5", "valid integer"),
    ("seed=true", "seed=true", "valid integer"),
    ("seed=", "seed=", "valid integer"),
    ("seed=99999999999999999999", "seed=99999999999999999999", "less than"),
    ("threads=0", "threads=0", "greater than or equal to 1"),
    ("epsilon.start=1.5", "epsilon.start=1.5", "less than or equal to 1"),
    ("objective.gamma=1", "objective.gamma=1", "less than 1"),
    ("objective.n_step=0", "objective.n_step=0", "greater than or equal to 1"),
    ("objective.reward_clip=0", "objective.reward_clip=0", "greater than 0"),
    ("objective.target.every=0", "objective.target.every=0", "greater than or equal to 1"),
    ("objective.quantiles=51", "objective.quantiles", "no such key"),
    ("objective.target.tau=2", "objective.target.tau=2", "less than or equal to 1"),
    ("env.sticky=true", "env.sticky=true", "valid number"),
    ("env.size=999", "env.size=999", "less than or equal to 210"),
    ("env.crop=5", "env.crop=5", "valid array"),
    ("env.crop=[0,160]", "env.crop.2", "missing"),
    ("env.crop=[0,160,210,0,1]", "env.crop=", "at most 4"),
    ("env.crop=[0,160,210,a]", "env.crop.3", "valid integer"),
    ("env.frameskip=0", "env.frameskip=0", "greater than or equal to 1"),
    ("env.frameskip=often", "env.frameskip", "valid integer or be a valid array"),
    ("tracking.experiment=../x", "tracking.experiment", "pattern"),
    ("paths.outputs=", "paths.outputs", "at least 1"),
    ("paths.outputs=null", "paths.outputs", "valid string"),
    # one key against another
    ("training.batch_size=2_000_000", "training.batch_size=2000000", "at most 1000000"),
    ("training.learn_start=999_995", "training.learn_start=999995", "less than 999995"),
    ("env.num_envs=4 training.learn_start=999_980", "training.learn_start=999980", "less than 999980"),
    ("env.crop=[90,160,90,0]", "env.crop=[90, 160, 90, 0]", "UP < DOWN <= 210"),
    ("env.crop=[0,161,210,0]", "env.crop", "RIGHT <= 160"),
    ("env.crop=[-1,160,210,0]", "env.crop", "0 <= UP"),
    ("env.size=35", "env.size=35", "at least 36"),
    ("model.head=quantile", "model.head=quantile", "objective.name=dqn"),
    ("objective=quantile model.head=plain", "model.head=plain", "objective.name=quantile"),
    ("experiment=fast model.head=dueling", "model.head=dueling", "model.head=quantile and objective=quantile"),
    ("objective=double_quantile model.head=plain", "model.head=plain", "objective.name=double_quantile"),
    ("objective=double_quantil", "objective=double_quantil", "'double_quantile'"),
    ("objective=double_dqn model.head=quantil", "model.head=quantil", "'quantile'"),
    ("model=resnet env.size=14", "env.size=14", "at least 15"),
    ("env.frameskip=[5,2]", "env.frameskip=[5, 2]", "low"),
    ("env=atlantis_standard env.frameskip=1", "env.max_pool", "at least 2"),
    ("env.max_pool=true", "env.max_pool", "fixed env.frameskip"),
    ("phase=two_phase phase.second.sampler=tophalf", "phase.second.sampler=tophalf", "'top_half'"),
    ("phase.single.steps=5", "phase.single", "either episodes or steps"),
    ("phase.single.episodes=null", "phase.single", "either episodes or steps"),
    ("phase=two_phase phase.first.episodes=null phase.first.steps=9", "phase", "same unit"),
    # sweeps and flags
    ("seed=0,1", "seed=0,1", "-m"),
    ("seed=range(0,3)", "seed=range(0,3)", "-m"),
    ("--cfg job seed=0,1", "seed=0,1", "-m"),
    ("--cfg job optimizer.lr=-1", "optimizer.lr=-1", "greater than 0"),
    ("--cfg foo", "--cfg", "job"),
    ("--cfg", "--cfg", "argument"),
    ("-m model=cnn,resnt", "model=resnt", "'resnet'"),
    ("-m seed=0,1,-1", "seed=-1", "greater than or equal to 0"),
    ("-m model=cnn,resnet env.size=20,84", "env.size=20", "at least 36"),
    ("model=cnn -m seed=0,1", "seed=0,1", "together"),
    ("--multi", "--multi", "'--multirun'"),
    ("--frobnicate", "--frobnicate", "no such flag"),
    ("--config-name=query", "--config-name", "overrides"),
    ("-cn query", "--config-name", "overrides"),
    ("--config-path=/tmp", "--config-path", "overrides"),
    ("--config-dir=/tmp", "--config-dir", "overrides"),
    ("--experimental-rerun=x.pickle", "--experimental-rerun", "overrides"),
    ("--info everything", "--info", "defaults"),
    ("hydra.foo=1", "hydra.foo", ""),
    ("hydra/launcher=lsf", "hydra/launcher", "basic"),
    ("hydra.mode=FOO", "hydra.mode=FOO", ""),
    # writing
    ("model", "'model'", "KEY=VALUE"),
    ("env.crop=[1", "env.crop=[1", "KEY=VALUE"),
    ("sämpler=uniform", "sämpler=uniform", "quotes"),
    ("seed=☃", "seed=☃", "quotes"),
    ("seed='☃'", "seed=", "valid integer"),
    # other verbs
    ("query model=cnn", "model=cnn", "no such key"),
    ("query env=atlantis", "env=atlantis", "'atlantis_v"),
    ("query env.siz=1", "env.siz", "'env.size'"),
    ("baseline agent=rndom", "agent=rndom", "'random'"),
    ("baseline agent.action=4", "agent.action=4", "less than or equal to 3"),
    ("baseline optimizer.lr=1", "optimizer.lr=1", "no such key"),
    ("evaluate evaluation.epsilon=2", "evaluation.epsilon=2", "less than or equal to 1"),
    ("evaluate epsilom=0.1", "epsilom=0.1", "no such key"),
    ("evaluate weights=first", "weights=first", "best, latest"),
    ("evaluate weights=bst", "weights=bst", "'best'"),
    ("export weights=pretrained/fast", "weights=pretrained/fast", "best, latest"),
    ("export too=pretrained/fast", "too=pretrained/fast", "'to'"),
    ("report paths.output=x", "paths.output", "'paths.outputs'"),
    ("ui port=80", "port=80", "greater than or equal to 1024"),
]


@pytest.mark.parametrize(("line", "key", "hint"), MISTAKES, ids=[line for line, _, _ in MISTAKES])
def test_a_mistake_is_one_line_that_names_the_key_and_what_would_be_right(line: str, key: str, hint: str) -> None:
    words = line.split(" ")
    verb = words.pop(0) if words[0] in VERBS else "config"
    with pytest.raises(ConfigError) as caught:
        check(verb, SCHEMAS[verb], words)
    message = str(caught.value)
    assert key in message
    assert hint in message
    assert "\n" not in message


@pytest.mark.parametrize(
    "line",
    [
        "",
        "model=resnet sampler=top_half",
        "-m model=cnn,resnet sampler=uniform,top_half",
        "seed=0,1 hydra.mode=MULTIRUN",
        "phase=two_phase sampler=top_half phase.second.lr=1e-4 phase.second.sampler=uniform",
        "phase=two_phase ~phase.second",
        "optimizer.lr=1",
        "++optimizer.lr=1e-4",
        "sampler@samplers.uniform=uniform",
        "env.frameskip=4 env.crop=[0,160,210,0] --cfg job --resolve",
        "paths.outputs='/tmp/ü und ü'",
        "hydra.verbose=true",
        "device=cuda:1 threads=4",
        "--help",
    ],
)
def test_what_is_right_passes(line: str) -> None:
    check("config", Config, re.findall(r"(?:[^ ']|'[^']*')+", line))


def outcome(cwd: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "atlantis_exp", *words]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False, timeout=120)


@pytest.mark.parametrize(
    "line",
    [
        "optimizer.lr=-1 paths.outputs=o",
        "-m seed=0,-1 paths.outputs=o",
        "--cfg job model=cnm paths.outputs=o",
        "trian seed=1",
    ],
)
def test_a_mistake_ends_with_code_2_and_one_line_and_leaves_nothing_behind(tmp_path: Path, line: str) -> None:
    done = outcome(tmp_path, *line.split())
    assert done.returncode == 2
    assert done.stdout == ""
    assert re.fullmatch(r"atlantis_exp: .+\n", done.stderr)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("verb", ["", "evaluate", "ui"])
def test_help_says_what_the_verb_does_and_which_verbs_there_are(tmp_path: Path, verb: str) -> None:
    done = outcome(tmp_path, *([verb] if verb else []), "--help")
    assert done.returncode == 0
    assert done.stdout.splitlines()[1] == VERBS[verb or "train"]
    assert all(purpose in done.stdout for purpose in VERBS.values())
    assert list(tmp_path.iterdir()) == []


def test_showing_the_config_prints_one_that_is_valid_and_leaves_nothing_behind(tmp_path: Path) -> None:
    done = outcome(tmp_path, "model=resnet", f"paths.outputs={tmp_path}/o", "--cfg", "job", "--resolve")
    tree = OmegaConf.to_container(OmegaConf.create(done.stdout))
    assert isinstance(tree, dict)
    assert parse(Config, {str(key): value for key, value in tree.items()}) == composed(
        "model=resnet", f"paths.outputs={tmp_path}/o"
    )
    assert list(tmp_path.iterdir()) == []


def test_nothing_heavy_is_loaded_before_the_config_is_checked() -> None:
    program = (
        "import sys; from importlib import import_module; from atlantis_exp import config; "
        f"[import_module(f'atlantis_exp.commands.{{verb}}') for verb in {[verb.replace('-', '_') for verb in VERBS]}]; "
        "from atlantis_exp.commands.app import check; "
        "check('config', config.Config, ['model=resnet']); print(*sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    heavy = {"torch", "mlflow", "ale_py", "gymnasium", "cv2", "matplotlib", "scipy", "av", "numpy"}
    assert heavy & set(done.stdout.split()) == set()


@pytest.mark.parametrize(
    "experiment",
    ["fast", *(pytest.param(name, marks=pytest.mark.slow) for name in GROUPS["experiment"] if name != "fast")],
)
def test_every_option_of_every_group_goes_with_every_experiment(experiment: str) -> None:
    groups = {group: options for group, options in GROUPS.items() if group not in NO_PART}
    for turn in range(max(map(len, groups.values()))):
        chosen = {group: options[turn % len(options)] for group, options in groups.items()}
        config = composed(f"experiment={experiment}", *(f"{group}={option}" for group, option in chosen.items()))
        named = {"model", "objective", "optimizer", "lr_schedule", "epsilon", "sampler", "tracking"}
        assert {group: getattr(config, group).name for group in named} == {group: chosen[group] for group in named}


def test_a_preset_gives_way_to_what_is_written_beside_it() -> None:
    config = composed("experiment=paper_cnn", "model=resnet", "evaluation.epsilon=0.3", "phase=single")
    assert (config.model.name, config.evaluation.epsilon, list(config.phase)) == ("resnet", 0.3, ["single"])


@pytest.mark.parametrize(
    ("preset", "model", "size", "epsilon"), [("cnn", "cnn", 84, 0.1), ("resnet", "resnet", 159, 0.05)]
)
def test_the_papers_presets_are_the_reports_protocol(preset: str, model: str, size: int, epsilon: float) -> None:
    config = composed(f"experiment=paper_{preset}")
    assert (config.model.name, config.env.size, config.evaluation.epsilon) == (model, size, epsilon)
    first, second = config.phase.values()
    assert (first.episodes, first.lr, first.sampler) == (10_000, 1e-3, "uniform")
    assert (second.episodes, second.lr, second.sampler) == (10_000, 3e-4, "top_half")
    assert to_dict(config.sampler_of("second")) == {"name": "top_half", "oversample": 2}
    science = flatten(config.science())
    assert {
        "env.id": "Atlantis-v0",
        "env.frameskip": [2, 5],
        "env.stack": 4,
        "objective.name": "dqn",
        "objective.gamma": 0.99,
        "objective.target.tau": 1e-4,
        "optimizer.name": "adamw",
        "epsilon.name": "exponential",
        "epsilon.start": 0.9,
        "epsilon.end": 0.02,
        "epsilon.decay": 0.5,
        "replay.capacity": 1_000_000,
        "training.learn_every": 10,
        "evaluation.episodes": 100,
    }.items() <= science.items()


def test_phases_take_the_chosen_sampler_and_rate_unless_they_name_their_own() -> None:
    config = composed("phase=two_phase", "sampler=top_half", "phase.second.lr=1e-4", "phase.second.sampler=uniform")
    assert [(phase.lr, phase.sampler) for phase in config.phase.values()] == [(1e-3, "uniform"), (1e-4, "uniform")]
    config = composed("sampler=top_half", "sampler.oversample=4", "optimizer.lr=0.5")
    assert config.phase["single"].lr == 0.5
    assert to_dict(config.sampler_of("single")) == {"name": "top_half", "oversample": 4}


def test_an_outputs_folder_is_made_absolute_and_a_checkout_keeps_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert composed("paths.outputs=o").paths.outputs == str(tmp_path / "o")
    assert composed().paths.outputs == str(CONF.parent / "outputs")


def test_a_config_survives_json(tmp_path: Path) -> None:
    config = composed("experiment=paper_resnet", f"paths.outputs={tmp_path}", "env.num_envs=3", "threads=2")
    stored = parse(Config, json.loads(json.dumps(to_dict(config))))
    assert stored == config
    assert stored.identity() == config.identity()
