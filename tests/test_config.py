"""The schema: what makes two experiments the same, and what a stored config may not hold."""

import copy
import random
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from hydra import compose, initialize_config_dir

from atlantis_exp.checking import flatten, parse, to_dict
from atlantis_exp.commands import CONF
from atlantis_exp.commands.composing import checked
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError

Tree = dict[str, Any]


@cache  # Hydra takes a third of a second
def composed_tree(*overrides: str) -> Tree:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return to_dict(checked(Config, compose("config", list(overrides))))


TREES = {
    name: composed_tree(*overrides)
    for name, overrides in {
        "cnn": (),
        "resnet": ("experiment=paper_resnet", "optimizer=rmsprop", "epsilon=linear", "env=atlantis_standard"),
        "fast": ("experiment=fast",),
        "constant": (
            "epsilon=constant",
            "lr_schedule=one_cycle",
            "optimizer=adam",
            "objective=double_dqn",
            "sampler=top_half",
        ),
    }.items()
}


RUNGS = {  # of the ladder from the report's recipe to experiment=fast: the keys that each changes
    "ablation_01_environments": {"env.num_envs", "training.learn_every", "training.learn_start", "training.batch_size"},
    "ablation_02_optimizer": {
        "optimizer.name",
        "optimizer.lr",
        "optimizer.eps",
        "optimizer.weight_decay",
        "phase.single.lr",
    },
    "ablation_03_target": {"objective.target.tau", "objective.target.every"},
    "ablation_04_epsilon": {"epsilon.name", "epsilon.start", "epsilon.end", "epsilon.decay", "epsilon.steps"},
    "ablation_05_n_step": {"objective.n_step"},
    "ablation_06_clip": {"objective.reward_clip"},
    "ablation_07_double": {"objective.name"},
    "ablation_08_dueling": {"model.head"},
}
LAST_RUNGS = {  # from the report's head and objective to those of experiment=fast
    "ablation_09_quantile": {"objective.name", "objective.quantiles", "model.head"},
    "ablation_10_life_loss": {"objective.terminal_on_life_loss"},
    "fast": {"env.crop", "training.ema"},  # the second changes who is evaluated, and no training
}


@pytest.mark.parametrize(("first", "rungs"), [("ablation_00_report", RUNGS), ("ablation_06_clip", LAST_RUNGS)])
@pytest.mark.slow
def test_each_rung_of_the_ablation_changes_what_it_says_and_nothing_else(
    first: str, rungs: dict[str, set[str]]
) -> None:
    before = flatten(composed_tree(f"experiment={first}"))
    for rung, keys in rungs.items():
        after = flatten(composed_tree(f"experiment={rung}"))
        different = {key for key in before.keys() | after.keys() if before.get(key) != after.get(key)}
        assert {key for key in different if not key.startswith("evaluation.") and key != "phase.single.steps"} == keys
        before = after


def changed(tree: Tree, key: str, value: Any) -> Tree:
    tree = copy.deepcopy(tree)
    *parents, last = key.split(".")
    node = tree
    for parent in parents:
        node = node[parent]
    node[last] = value
    return tree


def is_scientific(key: str) -> bool:
    """Whether a key decides the run's numbers."""
    group = key.split(".")[0]
    free = {"resume", "device", "threads", "compile", "tracking", "budget", "paths"}
    return group not in free and key != "env.workers"


def another(key: str, value: Any) -> Any:
    """A valid value that is not the given one."""
    special = {
        "env.id": ("Atlantis-v0", "ALE/Atlantis-v5"),
        "objective.name": ("dqn", "double_dqn"),
        "model.head": ("plain", "dueling"),
        "objective.target.mode": ("eval", "train"),
        "objective.target.start": ("copy", "independent"),
        "objective.reward_exponent": (0.5, 0.25),
        "optimizer.name": ("adam", "adamw"),
        "training.precision": ("fp32", "bf16"),
        "training.ema": (100, 200),
        "training.weights": (f"a@{16 * '0'}",),
        "evaluation.video": (False,) if value else ("first_minute",),
        "env.max_pool": (False,) if value else (True,),
        "env.crop": ([0, 160, 210, 0], [16, 160, 96, 0]),
        "env.frameskip": (4, 3),
        "optimizer.betas": ([0.9, 0.999], [0.8, 0.9]),
        "model.name": ("cnn", "cnn_norm", "cnn_small", "resnet", "resnet_fast"),
        "resume": ("auto", "never"),
        "device": ("auto", "cpu"),
        "tracking.name": ("mlflow", "none"),
        "tracking.uri": ("http://127.0.0.1:5000",),
        "budget.forecast": ("warn", "off"),
    }
    if key in special:
        return next(choice for choice in special[key] if choice != value)
    if key.endswith(".sampler"):
        return "uniform" if value == "top_half" else "top_half"
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + 1 if value < 30 else value - 1
    if isinstance(value, float):
        return value / 2 if value else 0.5
    if value is None:
        return 5
    return f"{value}x"


LEAVES = [
    (name, key)
    for name, tree in TREES.items()
    for key in flatten(tree)
    # Samplers count by the phases that use them, a phase has one length of two, and some names stand for a whole
    # schema: each has a test of its own.
    if key.split(".")[0] not in ("sampler", "samplers")
    and not (key.startswith("phase.") and key.endswith((".episodes", ".steps")))
    and key not in ("epsilon.name", "lr_schedule.name")
    and (name, key) not in (("resnet", "optimizer.name"), ("fast", "objective.name"), ("fast", "model.head"))
]


@pytest.mark.parametrize(("name", "key"), LEAVES)
def test_the_identity_depends_on_every_scientific_key_and_on_no_other(name: str, key: str) -> None:
    tree = TREES[name]
    if key == "env.max_pool":  # not with a drawn frameskip
        tree = changed(tree, "env.frameskip", 4)
    value = flatten(tree)[key]
    other = parse(Config, changed(tree, key, another(key, value)))
    assert (other.identity() != parse(Config, tree).identity()) == is_scientific(key)


def test_the_identity_depends_on_a_phases_length_and_unit() -> None:
    lengths = [(2_000, None), (7, None), (None, 7)]
    trees = [
        changed(changed(TREES["cnn"], "phase.single.episodes", episodes), "phase.single.steps", steps)
        for episodes, steps in lengths
    ]
    assert len({parse(Config, tree).identity() for tree in trees}) == 3


def test_the_identity_tells_schemas_apart() -> None:
    overrides = ["epsilon=linear", "epsilon=constant", "optimizer=adam", "optimizer=rmsprop", "objective=double_dqn"]
    identities = {parse(Config, composed_tree(override)).identity() for override in ["seed=0", *overrides]}
    assert len(identities) == 6


def test_a_sampler_counts_where_a_phase_uses_it_and_by_what_it_is() -> None:
    def identity(*overrides: str) -> str:
        return parse(Config, composed_tree(*overrides)).identity()

    assert identity("sampler=top_half") != identity("sampler=uniform")
    assert identity("sampler=top_half") == identity("phase.single.sampler=top_half")
    assert identity("samplers.top_half.oversample=4") == identity()
    assert identity("sampler=top_half", "sampler.oversample=4") != identity("sampler=top_half")


def test_the_identity_depends_on_no_order() -> None:
    overrides = ["model=resnet", "sampler=top_half", "phase=two_phase", "seed=3", "optimizer.lr=0.01", "env.sticky=0"]
    identities = set()
    for seed in range(3):
        random.Random(seed).shuffle(overrides)
        identities.add(parse(Config, composed_tree(*overrides)).identity())
    assert len(identities) == 1


def test_the_order_of_phases_counts_and_their_names_do_not() -> None:
    tree = composed_tree("phase=two_phase")
    first, second = tree["phase"].values()
    identity = parse(Config, tree).identity()
    assert parse(Config, changed(tree, "phase", {"second": second, "first": first})).identity() != identity
    assert parse(Config, changed(tree, "phase", {"warm": first, "cold": second})).identity() == identity


@pytest.mark.parametrize(
    "uri", ["", "sqlite:///a.db", "127.0.0.1:5000", "http://me:secret@host", "http://h/?token=secret"]
)
def test_an_address_that_is_none_or_holds_a_password_is_refused_without_repeating_it(uri: str) -> None:
    with pytest.raises(ConfigError, match=r"tracking\.uri: .*MLFLOW_TRACKING_USERNAME") as refused:
        parse(Config, changed(TREES["cnn"], "tracking.uri", uri))
    assert "secret" not in str(refused.value)


def test_a_stack_without_gaps_is_the_number_of_its_observations_and_one_with_gaps_another_run() -> None:
    plain, listed, gaps = (
        parse(Config, changed(TREES["cnn"], "env.stack", each)) for each in (4, [0, 1, 2, 3], [0, 3])
    )
    assert listed == plain
    assert gaps.identity() != parse(Config, changed(TREES["cnn"], "env.stack", 2)).identity()
    assert (list(plain.env.lags), list(gaps.env.lags)) == ([0, 1, 2, 3], [0, 3])
    assert parse(Config, to_dict(gaps)) == gaps


def test_the_identity_takes_what_weights_are_and_not_where_they_lie() -> None:
    def identity(weights: str) -> str:
        return parse(Config, changed(TREES["cnn"], "training.weights", weights)).identity()

    assert identity(f"a@{16 * '0'}") == identity(f"../b@c@{16 * '0'}") != identity(f"a@{16 * '1'}")


@pytest.mark.parametrize("weights", ["a", "@", f"@{16 * '0'}", f"a@{15 * '0'}g", f"a\n@{16 * '0'}", ""])
def test_weights_without_their_digest_are_refused(weights: str) -> None:
    with pytest.raises(ConfigError, match=r"training\.weights="):
        parse(Config, changed(TREES["cnn"], "training.weights", weights))


def test_a_run_from_before_a_key_stays_itself() -> None:
    """The name that commit 70f4df5, without `training.ema` and `compile`, gave to this run (docs/data/ladder.csv)."""
    assert parse(Config, composed_tree("experiment=ablation_00_report")).run_name() == "cnn-uniform-s0-1b9b358ed5"


def test_a_run_is_named_after_what_it_is() -> None:
    config = parse(Config, composed_tree("experiment=paper_resnet", "seed=4"))
    assert config.run_name() == f"resnet-uniform-top_half-s4-{config.identity()}"


def test_writing_a_config_down_and_reading_it_again_changes_nothing() -> None:
    for tree in TREES.values():
        config = parse(Config, tree)
        assert parse(Config, to_dict(config)) == config


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda tree: tree.pop("seed"), r"seed: missing"),
        (lambda tree: tree["env"].pop("size"), r"env\.size: missing"),
        (lambda tree: tree["optimizer"].pop("lr"), r"optimizer\.lr: missing"),
        (lambda tree: tree.update(modle=1), r"modle: no such key; did you mean 'model'"),
        (lambda tree: tree["optimizer"].update(ls=1), r"optimizer\.ls: no such key; did you mean 'lr'"),
        (lambda tree: tree["model"].update(_target_="os.system"), r"model\._target_: no such key"),
        (lambda tree: tree["phase"]["single"].update(lr=float("nan")), r"phase\.single\.lr=NaN: should be a finite"),
        (lambda tree: tree.update(env=3), r"env=3: "),
        (lambda tree: tree.update(phase={}), r"phase: at least one"),
        (lambda tree: tree["phase"].update({"w\xe4rm": tree["phase"]["single"]}), r"'phase\.w\\xe4rm': a name has at"),
        (lambda tree: tree["samplers"].update({"a/b": tree["sampler"]}), r"'samplers\.a/b': a name has at most 100"),
        (lambda tree: tree.update(model={"name": "vit"}), r"model\.name=vit: no such choice.*cnn, cnn_gru"),
        (lambda tree: tree["env"].update(crop=[0, 160, 210]), r"env\.crop\.3: missing"),
    ],
)
def test_a_stored_config_that_is_wrong_is_one_line(change: Callable[[Tree], Any], line: str) -> None:
    tree = copy.deepcopy(TREES["cnn"])
    change(tree)
    with pytest.raises(ConfigError, match=line) as caught:
        parse(Config, tree)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("episodes", "num_envs", "at_once"),
    [(1, None, 1), (5, None, 5), (64, None, 64), (65, None, 33), (100, None, 50), (1_000, None, 63), (100, 16, 16)],
)
def test_an_evaluation_plays_many_games_at_once_in_rounds_of_one_length(
    tiny: Callable[..., Config], episodes: int, num_envs: int | None, at_once: int
) -> None:
    evaluation = replace(tiny().evaluation, episodes=episodes, num_envs=num_envs)
    assert evaluation.at_once == at_once
    assert -(-episodes // at_once) == -(-episodes // (num_envs or 64))
