"""What a person may write on a command line, and what they are told when they may not."""

import re
from pathlib import Path
from typing import Any, cast

import pytest
from hydra import compose
from hypothesis import example, given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from atlantis_exp.commands import VERBS
from atlantis_exp.commands.baseline import BaselineConfig
from atlantis_exp.commands.compare import CompareConfig
from atlantis_exp.commands.composing import composing
from atlantis_exp.commands.evaluate import EvaluateConfig
from atlantis_exp.commands.export import ExportConfig
from atlantis_exp.commands.new import NewConfig
from atlantis_exp.commands.overrides import _composed, check, located, read_override, refuse_twice
from atlantis_exp.commands.play import PlayConfig
from atlantis_exp.commands.query import QueryConfig
from atlantis_exp.commands.report import ReportConfig
from atlantis_exp.commands.search import SearchConfig
from atlantis_exp.commands.sync import SyncConfig
from atlantis_exp.commands.ui import UiConfig
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.terminal import quoted

SCHEMAS: dict[str, type[Any]] = {
    "config": Config,
    "search": SearchConfig,
    "check": Config,
    "new": NewConfig,
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


MISTAKES = [  # what is written, and what the one line must hold
    # keys
    ("modle=cnn", "modle=cnn", "'model'"),
    ("++modle=cnn", "modle=cnn", "'model'"),
    ("lr=0.1", "lr=0.1", "'optimizer.lr'"),
    ("optimizer.l=1", "optimizer.l", "'optimizer.lr'"),
    ("optimizer.lr.x=1", "optimizer.lr.x", "'optimizer.lr'"),
    ("+env.crop.x=1", "env.crop.x", "'env.crop'"),
    ("objective.target.mod=train", "objective.target.mod", "'objective.target.mode'"),
    ("epsilon=linear epsilon.decay=1", "epsilon.decay", "epsilon.duration"),
    ("optimizer=rmsprop optimizer.beta=[0.9,0.9]", "optimizer.beta", "valid: optimizer.alpha"),
    ("model@foo=cnn", "model@foo", "'model'"),
    ("sampler@samplers.foo=uniform", "sampler@samplers.foo", "'sampler@samplers."),
    ("+samplers.mine={name:uniform}", "samplers.mine", "samplers.uniform"),
    ("~optimizer", "~optimizer", "required; write optimizer=VALUE"),
    ("~plugins=0.5", "~plugins=0.5", "required"),
    ("~phase.single", "phase", "at least one phase"),
    ("phase=two_phase ~phase.first.lr", "phase.first.lr", "missing"),
    ("optimizer.lr=${optimizer.l}", "optimizer.l", "'optimizer.lr'"),
    ("optimizer.lr=???", "optimizer.lr", "issing"),
    ("seed=${oc.env:NOWHERE}", "seed: ", "NOWHERE"),
    ("-m seed=range(nan,5)", "seed", "more than"),
    ("samplers.uniform.name=top_half", "samplers.uniform.oversample", "missing"),
    ("=1", "=1", "no such key"),
    ("gama=0.9", "gama=0.9", "'objective.gamma'"),
    ("experiment=quick phase.quikc.steps=1", "phase.quikc.steps=1", "'phase.quick.steps'"),
    # options
    ("model=resnt", "model=resnt", "'resnet'"),
    ("experiment=quik", "experiment=quik", "'quick'"),
    ("phase={}", "phase={}", "quick, single, steps, two_phase"),
    ("env=3", "env=3", "atlantis_v0"),
    ("model=null", "model=None", "cnn, cnn_gru, cnn_norm, cnn_small, resnet, resnet_fast"),
    ("objective.name=double", "objective.name=double", "'double_dqn'"),
    ("env.id=Pong-v0", "env.id=Pong-v0", "ALE/Atlantis-v5, Atlantis-v0"),
    ("resume=maybe", "resume=maybe", "auto, must, never"),
    ("objective.target.mode=trian", "objective.target.mode=trian", "'train'"),
    ("device=gpu", "device=gpu", "a GPU is cuda"),
    # types and ranges
    ("optimizer.lr=abc", "optimizer.lr", "valid number"),
    ("optimizer.lr=true", "optimizer.lr", "valid number"),
    ("optimizer.lr=-1", "optimizer.lr=-1", "greater than or equal to "),
    ("optimizer.lr=1e300", "optimizer.lr=1e+300", "less than or equal to 10"),
    ("phase.single.lr=1e300", "phase.single.lr=1e+300", "less than or equal to 10"),
    ("optimizer.eps=1e300", "optimizer.eps=1e+300", "less than or equal to 1"),
    ("optimizer=adamw optimizer.weight_decay=1e300", "optimizer.weight_decay=1e+300", "less than or equal to 1"),
    ("objective.target.tau=1e-308", "objective.target.tau=1e-308", "greater than or equal to "),
    ("objective.reward_scale=1e-308", "objective.reward_scale=1e-308", "greater than or equal to "),
    ("training.ema=9223372036854775808", "training.ema=9223372036854775808", "less than or equal to 10000000"),
    ("training.learn_start=9223372036854775808", "training.learn_start", "less than or equal to 1000000000000"),
    ("lr_schedule=linear lr_schedule.duration=1e300", "lr_schedule.duration=1e+300", "less than or equal to 1000"),
    ("optimizer.lr=nan", "optimizer.lr", "finite"),
    ("optimizer.lr=${oc.env:HOME}", "optimizer.lr", "valid number"),
    ("optimizer.betas=[0.9]", "optimizer.betas.1", "missing"),
    ("optimizer.betas=[0.9,1.0]", "optimizer.betas.1=1.0", "less than 1"),
    ("seed=-1", "seed=-1", "greater than or equal to 0"),
    ("budget.steps=1e6", "budget.steps=1e+06", "write budget.steps=1_000_000"),
    ("budget.steps=1e300", "budget.steps=1e+300", "valid integer"),
    ("objective.gamma=3.0 phase.single.steps=1.5", "objective.gamma=3.0", "less than 1"),
    ("threads=0", "threads=0", "greater than or equal to 1"),
    ("epsilon.start=1.5", "epsilon.start=1.5", "less than or equal to 1"),
    ("objective.target.tau=2", "objective.target.tau=2", "less than or equal to 1"),
    ("env.frameskip=0", "env.frameskip=0", "greater than or equal to 1"),
    ("seed=1.5", "seed=1.5", "valid integer"),
    ("seed=", "seed=", "valid integer"),
    ("seed=99999999999999999999", "seed=99999999999999999999", "less than"),
    ("objective.gamma=1", "objective.gamma=1", "less than 1"),
    ("objective.n_step=0", "objective.n_step=0", "greater than or equal to 1"),
    ("objective.reward_exponent=0", "objective.reward_exponent=0", "greater than 0"),
    ("objective.reward_exponent=1.5", "objective.reward_exponent=1.5", "less than or equal to 1"),
    ("objective.reward_clip=0", "objective.reward_clip=0", "greater than or equal to "),
    ("objective.target.every=0", "objective.target.every=0", "greater than or equal to 1"),
    ("objective.quantiles=51", "objective.quantiles", "no such key"),
    ("env.sticky=true", "env.sticky=true", "valid number"),
    ("env.size=999", "env.size=999", "less than or equal to 210"),
    ("env.crop=5", "env.crop=5", "valid array"),
    ("env.crop=[0,160,210,0,1]", "env.crop=", "at most 4"),
    ("env.stack=17", "env.stack=17", "less than or equal to 16"),
    ("env.stack=[]", "env.stack=[]", "at least 1 item"),
    ("env.stack=[1,2]", "env.stack=[1, 2]", "ascend from 0"),
    ("env.stack=[0,8,8]", "env.stack=[0, 8, 8]", "as in env.stack=[0,1,2,3,8,16,24]"),
    ("env.stack=[0,65]", "env.stack.1=65", "less than or equal to 64"),
    ("env.frameskip=often", "env.frameskip", "valid integer or be a valid array"),
    ("tracking.experiment=../x", "tracking.experiment", "pattern"),
    ("paths.outputs=", "paths.outputs", "at least 1"),
    ("paths.outputs=/dev/null", "paths.outputs=/dev/null: /dev/null is not a folder", "as in paths.outputs=./outputs"),
    ("paths.outputs=/", "paths.outputs=/: the root", "as in paths.outputs=./outputs"),
    ("budget.flops=0", "budget.flops=0: should be greater than 0", ""),
    ("budget.flops=abc", "budget.flops=", "should be a valid number"),
    ("budget.wall_clock=abc", "budget.wall_clock=abc: not a duration", "use 90s, 10min or 3h"),
    ("paths.outputs=null", "paths.outputs", "valid string"),
    # one key against another
    ("training.batch_size=2_000_000", "training.batch_size=2000000", "at most 1000000"),
    ("training.learn_start=999_995", "training.learn_start=999995", "less than 999995"),
    ("env.num_envs=4 training.learn_start=999_980", "training.learn_start=999980", "less than 999980"),
    ("env.num_envs=4 env.stack=[0,24] training.learn_start=999_900", "training.learn_start=999900", "than 999896"),
    ("env.crop=[90,160,90,0]", "env.crop=[90, 160, 90, 0]", "UP < DOWN <= 210"),
    ("env.crop=[0,161,210,0]", "env.crop", "RIGHT <= 160"),
    ("env.crop=[0,160,211,0]", "env.crop", "DOWN <= 210"),
    ("env.crop=[-1,160,210,0]", "env.crop", "0 <= UP"),
    ("env.crop=[0,160,210,-1]", "env.crop", "0 <= LEFT"),
    ("env.crop=[0,80,210,80]", "env.crop", "LEFT < RIGHT"),
    ("env.crop=[-1,160,210,0]", "env.crop", "0 <= UP"),
    ("env.size=35", "env.size=35", "at least 36"),
    ("model.head=quantile", "model.head=quantile", "objective.name=dqn"),
    ("experiment=fast model.head=dueling", "model.head=dueling", "model.head=quantile and objective=quantile"),
    ("model=resnet env.size=14", "env.size=14", "at least 15"),
    ("env.frameskip=[5,2]", "env.frameskip=[5, 2]", "low"),
    ("env=atlantis_standard env.frameskip=1", "env.max_pool", "at least 2"),
    ("env.max_pool=true", "env.max_pool", "fixed env.frameskip"),
    ("phase=two_phase phase.second.sampler=tophalf", "phase.second.sampler=tophalf", "'top_half'"),
    ("phase.single.steps=5", "phase.single", "either episodes or steps"),
    ("phase=two_phase phase.first.episodes=null phase.first.steps=9", "phase", "or steps in all"),
    # sweeps and flags
    ("seed=0,1", "seed=0,1", "-m"),
    ("--cfg foo", "--cfg", "job"),
    ("--cfg", "--cfg", "argument"),
    ("-m model=cnn,resnt", "model=resnt", "'resnet'"),
    ("-m seed=0,1,-1", "seed=-1", "greater than or equal to 0"),
    ("-m model=cnn,resnet env.size=20,84", "env.size=20", "at least 36"),
    ("--multi", "--multi", "'--multirun'"),
    ("--frobnicate", "--frobnicate", "no such flag"),
    ("--config-name=query", "--config-name=query: no such flag", "'--config-dir'"),
    ("--config-dir=/nowhere", "--config-dir=/nowhere", "no such folder"),
    ("--run", "--run: no such flag", "--cfg"),
    # Hydra's own, which name code and places
    ("hydra.foo=1", "hydra.foo=1", "hydra/launcher=NAME"),
    ("-m seed=0,1 hydra/launcher=lsf", "hydra/launcher", "basic"),
    ("hydra/launcher=joblib", "hydra/launcher=joblib", "add -m"),
    ("search hydra/launcher=basic", "hydra/launcher=basic", "add -m"),
    ("hydra.mode=MULTIRUN", "hydra.mode=MULTIRUN", "-m"),
    *(
        (f"-m seed=0,1 {text}", text, "hydra/launcher=NAME")
        for text in (
            *("hydra.sweeper._target_=os.system", "hydra/sweeper=basic", "hydra.run.dir=/tmp/x", "~hydra.launcher"),
            *("hydra.launcher={a:1}", "hydra={a:1}", "hydra=basic", "hydra/launcher@hydra.job_logging=basic"),
        )
    ),
    ("--resolve", "--resolve", "--cfg job"),
    # folders of a user whom the machine does not know
    ("paths.outputs='~nobodyhere/x'", "paths.outputs=~nobodyhere/x", "no such user"),
    ("plugins=['~nobodyhere/mynet.py']", "plugins=~nobodyhere/mynet.py", "no such user"),
    # too much
    ("replay.capacity=1000000000000000000", "replay.capacity", "less than or equal to 1000000000"),
    (f"seed={'9' * 5_000}", "seed=999", "digits"),
    ("budget.wall_clock=99999999999999999999h", "budget.wall_clock", "10 years"),
    ("objective.n_step=1000000", "objective.n_step", "less than or equal to 1000"),
    ("training.batch_size=100000000", "training.batch_size", "less than or equal to"),
    ("env.frameskip=100000", "env.frameskip", "less than or equal to"),
    ("env.max_frames=3000000000", "env.max_frames", "less than 2147483648"),
    ("evaluation.seed=99999999999999999999", "evaluation.seed", "less than"),
    ("objective=quantile objective.quantiles=100000000", "objective.quantiles", "less than or equal to"),
    # a sweep has no one config to show
    ("--cfg job -m seed=0,1", "--cfg", "drop -m"),
    # writing
    ("model", "'model'", "KEY=VALUE"),
    ("env.crop=[1", "env.crop=[1", "KEY=VALUE"),
    ("sämpler=uniform", "sämpler=uniform", "quotes"),
    ("seed='☃'", "seed=", "valid integer"),
    # other verbs
    ("query model=cnn", "model=cnn", "no such key"),
    ("query env.siz=1", "env.siz", "'env.size'"),
    ("baseline agent=rndom", "agent=rndom", "'random'"),
    ("baseline agent.action=4", "agent.action=4", "3 LEFTFIRE"),
    ("evaluate epsilom=0.1", "epsilom=0.1", "no such key"),
    ("evaluate weights=first", "weights=first", "best, latest"),
    ("export weights=pretrained/fast", "weights=pretrained/fast", "best, latest"),
    ("export too=pretrained/fast", "too=pretrained/fast", "'to'"),
    ("report paths.output=x", "paths.output", "'paths.outputs'"),
    ("new component.model=cnn to=x", "model=cnn", "built in"),
    ("new component.model=MyNet to=x", "model=MyNet", "lowercase letters"),
    ("new component.model=class to=x", "model=class", "a Python keyword"),
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


def test_a_plugin_of_an_unknown_user_is_one_line_before_hydra_reads_it() -> None:
    with pytest.raises(ConfigError, match=r"^plugins=~nobodyhere/mynet\.py: no such user"):
        located(["plugins=~nobodyhere/mynet.py"])


def test_a_glob_sweeps_over_the_options_that_it_matches() -> None:
    jobs = check("config", Config, ["-m", "model=glob(resnet*)", "sampler=glob(*,exclude=prio*)", "seed=3"])
    assert [*jobs] == [
        (f"model={model}", f"sampler={sampler}", "seed=3")
        for model in ("resnet", "resnet_fast")
        for sampler in ("top_half", "uniform")
    ]


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("seed=range(0)", "seed=range(0): has no values"),
        ("optimizer.lr=interval(0,1)", "optimizer.lr=interval(0,1): not a list of values; write them out"),
        ("model=glob(resnt*)", "model=glob(resnt*): not a list of values; write them out"),
        ("seed=glob(*)", "seed=glob(*): not a list of values; write them out"),
        ("seed=1,range(0,3)", "seed=1,range(0,3): Unexpected type annotation"),
        ("seed=range(0,1,0)", "seed=range(0,1,0): range() arg 3 must not be zero"),
        ("seed=range(0,1000000000)", "seed=range(0,1000000000): more than 10,000 values"),
        ("seed=shuffle(range(0,1000000000))", "seed=shuffle(range(0,1000000000)): more than 10,000 values"),
        ("optimizer.lr=range(0,1,1e-9)", "optimizer.lr=range(0,1,1e-9): more than 10,000 values"),
        (
            "seed=range(0,5000) model=cnn,resnet,resnet_fast",
            "these values make 15,000 jobs; write values for at most 10,000",
        ),
        (f"env.crop={'[' * 500}1{']' * 500}", f"env.crop={'[' * 51}...: lists nested too deeply"),
        ("hydra/launcher=null", "hydra/launcher=null: of Hydra's keys, set only"),
        (
            "hydra/launcher=joblib hydra.launcher.n_jobs=0",
            "hydra.launcher.n_jobs=0: write the number of jobs at a time",
        ),
    ],
)
def test_a_sweep_that_cannot_be_is_one_line(line: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=f"^{re.escape(reason)}"):
        check("config", Config, ["-m", *line.split()])


@pytest.mark.parametrize("line", ["seed=1 seed=2", "model=cnn model=resnet", "-m seed=0,1 seed=2", "+seed=1 ++seed=2"])
def test_a_key_given_twice_is_refused(line: str) -> None:
    *_, first, second = (word.lstrip("+") for word in line.split())
    with pytest.raises(ConfigError, match=f"^{re.escape(second)}: contradicts {re.escape(first)}"):
        refuse_twice(line.split())
    refuse_twice([first, first])


@pytest.mark.parametrize(
    "line",
    [
        "",
        "model=resnet sampler=top_half",
        "-m model=cnn,resnet sampler=uniform,top_half",
        "phase=two_phase sampler=top_half phase.second.lr=1e-4 phase.second.sampler=uniform",
        "phase=two_phase ~phase.second",
        "optimizer.lr=1",
        "++optimizer.lr=1e-4",
        "+optimizer.lr=1e-4 +model=resnet",
        "sampler@samplers.uniform=uniform",
        "env.frameskip=4 env.crop=[0,160,210,0] --cfg job --resolve",
        "paths.outputs='/tmp/ü und ü'",
        "device=cuda:1 threads=4",
        "model=cnn -m seed=0,1",
    ],
)
def test_what_is_right_passes(line: str) -> None:
    check("config", Config, re.findall(r"(?:[^ ']|'[^']*')+", line))


@given(st.text(st.characters(exclude_categories=["Cs", "Cc"]), min_size=1).filter(lambda text: "${" not in text))
@example("Müller (1)")
@example("cnn~1")
@example("nan")
@example("12")
@example("postgresql://u@h/d")
@example('\\"\\')
@example("./mine")
@example("...")
def test_a_printed_command_holds_the_value(text: str) -> None:
    assert read_override(f"key={quoted(text)}").value() == text


@pytest.mark.parametrize("path", ["mine", "./mine", "../mine.py", "/tmp/mine@0a"])
def test_a_plain_path_is_printed_without_quotes(path: str) -> None:
    assert quoted(path) == path
    assert read_override(f"key={path}").value() == path


@pytest.mark.parametrize("typed", ["'./a,b/x.py'", '"./a,b/x.py"', "['./a,b/x.py']", '["./a,b/x.py",other]'])
def test_the_path_of_a_plugin_may_hold_a_comma(typed: str) -> None:
    (text,) = located([f"plugins={typed}"])
    first, *others = cast(list[str], read_override(text).value())
    assert first == str(Path.cwd() / "a,b" / "x.py")
    assert others == (["other"] if "other" in typed else [])


@pytest.mark.parametrize(
    "line",
    ["objective=quantile,double_quantile objective.quantiles=11", "lr_schedule=linear,one_cycle lr_schedule.end=0.1"],
)
def test_a_key_that_all_swept_options_have_and_the_default_one_lacks_is_taken(line: str) -> None:
    assert len(check("config", Config, ["-m", *line.split()])) == 2


@pytest.mark.parametrize(
    "line",
    [
        "experiment=quick model=resnet seed=3 phase.quick.steps=9 optimizer.betas=[0.1,0.2]",
        "model=cnn_small ~phase.single +phase.mine={steps:5} sampler@samplers.uniform=prioritized",
        "sampler=top_half phase=two_phase ~phase.first env=atlantis_v5 paths.outputs=${oc.env:HOME} threads=null",
    ],
)
def test_a_config_is_composed_as_hydra_composes_it(line: str) -> None:
    with composing():
        expected = compose("config", line.split())
        for _ in range(2):  # the second from what the first has kept
            composed = _composed("config", [read_override(text) for text in line.split()], None)
            assert OmegaConf.to_yaml(composed) == OmegaConf.to_yaml(expected)
            assert OmegaConf.is_struct(composed)
