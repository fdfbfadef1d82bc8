"""Read and write exported weights: a folder with weights, their card, and a page for people."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import indent
from typing import Annotated, Literal

import numpy as np
import safetensors.numpy
from pydantic import Field
from pydantic.dataclasses import dataclass
from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.build import build_network_actor, described
from atlantis_exp.checking import nearest, parse, to_dict
from atlantis_exp.comparison.decision import mean_interval
from atlantis_exp.components import admitted
from atlantis_exp.config import STRICT, Config, EvaluationConfig, PathsConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.files import ARTIFACT, SMALL, read_file, read_object, write_file
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.statistics import summarize
from atlantis_exp.training.actor import Actor
from atlantis_exp.training.evaluation import Evaluation

SINGLE = 8_000_000  # bytes; larger weights are written in half precision, to keep repositories small

_COLUMNS = ("mean", "95 % interval", "median", "IQM", "high", "low", "episodes", "epsilon", "seed")


@dataclass(config=STRICT, kw_only=True, frozen=True)
class Card:
    """The training of exported weights, and their scores."""

    format: Literal[1]
    run: str
    weights: Literal["latest", "best"]
    step: Annotated[int, Field(ge=0)]  # of the training
    reached: dict[str, float]  # episodes, frames, updates and hours, at the last point of the curve until then
    made: dict[str, str]  # command, precision, commit and versions of the last session
    precision: Literal["float32", "float16"]
    sha256: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]  # of weights.safetensors
    config: Config
    evaluation: EvaluationConfig  # that gave the scores
    scores: Annotated[list[Annotated[float, Field(ge=-1e15, le=1e15)]], Field(min_length=1, max_length=10**6)]


def read_card(folder: Path) -> tuple[Card, bytes]:
    """Read a folder's card and its weights as safetensors. Raises: ConfigError, Fault for other weights."""
    path = folder / "card.json"  # may be a link, as in a download cache: a person named this folder
    if not path.exists():
        choices = {"latest", "best", *(str(card.parent) for card in folder.parent.glob("*/card.json"))}
        has = "" if folder.parent.exists() else "; the shipped weights are in pretrained/ of the repository"
        raise ConfigError(f"weights={folder}: not a folder with a card.json{has}; {nearest(str(folder), choices)}")
    try:
        card = parse(Card, read_object(read_file(path.resolve(), SMALL)))
    except (OSError, ValueError) as error:
        raise ConfigError(f"weights={folder}: card.json: {error}") from None
    try:
        weights = read_file((folder / "weights.safetensors").resolve(), ARTIFACT)
    except (OSError, ValueError) as error:
        raise Fault(f"{folder}: its weights cannot be read: {error}") from None
    if hashlib.sha256(weights).hexdigest() != card.sha256:
        raise Fault(f"{folder / 'weights.safetensors'} does not match the checksum in its card")
    return card, weights


def write_card(
    folder: Path, shown: Path, card: Card, weights: bytes, evaluation: Evaluation, onnx: bytes | None = None
) -> None:
    """Write weights, card, plugin files, and a page that calls the folder `shown`."""
    write_file(folder / "weights.safetensors", weights)
    files = f"`weights.safetensors`: {len(weights):,} bytes, {card.precision}, sha256 `{card.sha256}`."
    if onnx is not None:
        write_file(folder / "network.onnx", onnx)
        env = card.config.env
        files += (
            f"\n\n`network.onnx`: {len(onnx):,} bytes, float32: `states`, uint8 (batch, {len(env.lags)}, {env.size}, "
            f"{env.size}), to `q_values`, float32 (batch, actions)."
        )
    place = shown if len(shown.parts) > 1 and not shown.is_absolute() else f"./{shown.name}"
    references = list[str]()
    hashes = {plugin.sha256 for plugin in card.config.plugins.values()}
    for plugin in dict.fromkeys(each.plugin for each in admitted().values()):
        if plugin and plugin.sha256 in hashes:
            references.append(plugin.name if plugin.text is None else terminal.quoted(f"{place}/{plugin.name}.py"))
            if plugin.text is not None:
                write_file(folder / f"{plugin.name}.py", plugin.text)
                files += f"\n\n`{plugin.name}.py`: the source of a plugin, sha256 `{plugin.sha256}`."
    plugins = [f"plugins={','.join(references)}"] if references else []
    play = terminal.command_line("evaluate", f"weights={terminal.quoted(place)}", *plugins)
    write_file(folder / "README.md", _page(shown.name, play, card, files, evaluation).encode())
    write_file(folder / "card.json", (json.dumps(to_dict(card), indent=2) + "\n").encode())


def pack(weights: bytes) -> tuple[bytes, Literal["float32", "float16"]]:
    """Return weights as safetensors, in half precision if they exceed `SINGLE` bytes."""
    if len(weights) <= SINGLE:
        return weights, "float32"
    arrays = safetensors.numpy.load(weights)
    half = {name: array.astype(np.float16) if array.dtype == np.float32 else array for name, array in arrays.items()}
    return safetensors.numpy.save(half), "float16"


def portable(config: Config) -> Config:
    """Return a config without this machine's processes, devices, paths and servers."""
    begun = config.training.pinned
    return replace(
        config,
        resume="auto",
        device="auto",
        threads=None,
        compile=False,
        env=replace(config.env, workers=None),
        training=replace(config.training, weights=begun and f"{Path(begun[0]).name or 'weights'}@{begun[1]}"),
        tracking=replace(config.tracking, uri=None),
        paths=PathsConfig(outputs="outputs"),
    )


def build_exported_actor(config: Config, weights: bytes, device: str) -> Actor:
    """Build the player of exported weights: float32 on one thread, which rounds alike everywhere. Raises: Fault."""
    exact = replace(config, threads=1, training=replace(config.training, precision="fp32"))
    set_up_torch(exact, device)
    return build_network_actor(exact, weights, device)


def side_by_side(card: Card, settings: EvaluationConfig, scores: Sequence[float]) -> Table:
    """Tabulate the card's scores above those played with these settings."""
    table = terminal.table("", *_COLUMNS)
    table.add_row("card", *_points(card.evaluation, card.scores))
    table.add_row("here", *_points(settings, scores))
    return table


def _points(settings: EvaluationConfig, scores: Sequence[float]) -> Iterator[str]:
    """Yield the cells of `_COLUMNS`; the interval is that of the mean over episodes."""
    summary = summarize(scores)
    low, high = mean_interval(scores)
    yield f"{summary.mean:,.0f}"
    yield f"{low:,.0f} to {high:,.0f}" if len(scores) > 1 else ""
    yield from (f"{point:,.0f}" for point in (summary.median, summary.interquartile_mean, summary.high, summary.low))
    yield from (str(setting) for setting in (summary.episodes, settings.epsilon, settings.seed))


def metadata(name: str, card: Card) -> str:
    """Return the YAML that model hubs read at the top of a page; values as JSON, which is YAML."""
    game = card.config.env.id.rsplit("/")[-1]
    reward = f"{np.mean(card.scores):.2f} +/- {np.std(card.scores):.2f}"
    task = {"type": "reinforcement-learning", "name": "reinforcement-learning"}
    result = {
        "task": task,
        "dataset": {"type": game, "name": game},
        "metrics": [{"type": "mean_reward", "value": reward, "name": "mean_reward", "verified": False}],
    }
    facts = {
        "license": "mit",
        "library_name": "atlantis-exp",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "deep-reinforcement-learning", "atari", game, card.config.model.name],
        "model-index": [{"name": name, "results": [result]}],
    }
    return "\n".join(["---", *(f"{key}: {json.dumps(value)}" for key, value in facts.items()), "---"])


def _page(name: str, play: str, card: Card, files: str, evaluation: Evaluation) -> str:
    env = to_dict(card.config.env)
    del env["num_envs"], env["workers"]
    training = {
        "run": card.run,
        "weights": f"{card.weights}, of step {card.step:,}",
        **{key: f"{value:,.2f}" if value % 1 else f"{value:,.0f}" for key, value in card.reached.items()},
        "seed": card.config.seed,
        **({"plugins": described(card.config)} if card.config.plugins else {}),
        **card.made,
    }
    what = f"{card.config.model.name} with {card.config.objective.name}"
    learned = card.made.get("precision", "float32")
    otherwise = "" if learned == "float32" else f"; it learned in {learned}, in which it may choose otherwise"
    return f"""{metadata(name, card)}

# {name}

Weights of a network that plays Atari {card.config.env.title}: {what}.

    {play}               # plays the episodes below
    {play} episodes=1    # a first look

## Scores

| {" | ".join(_COLUMNS)} |
|{" ---: |" * len(_COLUMNS)}
| {" | ".join(_points(card.evaluation, card.scores))} |

Played with the weights of this folder, in float32{otherwise}.
The interval is Student's 95 % of the mean over these episodes; it says nothing of trainings
with other seeds. The network's policy: {evaluation.policy}.

{indent(evaluation.report(), "    ")}

## Protocol

{_table(env)}

## Training

{_table(training)}

`card.json` has the whole config. Episodes, frames, updates and hours are those of the last point of the training's
curve at or before the step.

## File

{files}

## Licence

That of this repository (MIT), except for the sources of plugins. The weights were learned from the game as ale-py
emulates it. They do not contain its ROM, which comes with ale-py under its own terms.
"""


def _table(facts: dict[str, object]) -> str:
    return "\n".join(["| | |", "| --- | --- |", *(f"| {key} | `{value}` |" for key, value in facts.items())])
