"""Let a player play, print its report, and record the evaluation as a run."""

import re
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path
from textwrap import indent
from typing import Any

from atlantis_exp import terminal
from atlantis_exp.build import build_baseline, build_evaluator, build_network_actor, build_person
from atlantis_exp.checking import absolute, digest, flatten, to_dict
from atlantis_exp.components import facts_of
from atlantis_exp.config import (
    BaselineAgentConfig,
    EnvConfig,
    EvaluationConfig,
    PathsConfig,
    PluginConfig,
    TrackingConfig,
)
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour, score_histogram
from atlantis_exp.runs.folder import BEST_EPISODE, EVALUATION, EVALUATION_REPORT, Result, RunFolder, find_run
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.cards import build_exported_actor, read_card, side_by_side
from atlantis_exp.sessions.job import config_colour, labels
from atlantis_exp.sessions.page import terminable
from atlantis_exp.sessions.processor import set_up_torch
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.sessions.window import Window
from atlantis_exp.tracking.publishing import catch_up, publishing
from atlantis_exp.training.actor import Actor
from atlantis_exp.training.evaluation import Evaluation, Stopped
from atlantis_exp.training.progress import Progress

STORED = ("latest", "best")
"""The weights of a stored run; other values of `weights` name folders of exported ones."""


def evaluate(
    *,
    run: str,
    weights: str,
    device: str,
    evaluation: EvaluationConfig,
    tracking: TrackingConfig,
    paths: PathsConfig,
    asked: Collection[str],
    command: str,
    cores: int,
) -> RunFolder:
    """Play a network on its own environment, print the report's table, and return the folder that records it.

    An exported network plays by the protocol of its card, except for keys in `asked`.
    """
    outputs = Path(paths.outputs)
    catch_up(outputs, tracking.uri)
    card = None
    if weights in STORED:
        folder = find_run(outputs, run)
        name, title, trained, source = folder.name, folder.title, folder.trained_config, {"run": folder.name}
        stored, step = stored_weights(folder, weights)
        set_up_torch(trained, device)
        actor = build_network_actor(trained, stored, device)
    else:
        if "run" in asked:
            raise ConfigError(f"run={run}: weights={weights} names exported weights; drop one of the two")
        exported = absolute("weights", weights)
        card, stored = read_card(exported)
        trained, step = card.config, card.step
        name = title = exported.resolve().name
        source = {"weights": name, "sha256": card.sha256}
        protocol: dict[str, Any] = {
            key: getattr(card.evaluation, key)
            # num_envs, too: a batch's size changes rounding, which decides near ties.
            for key in ("episodes", "epsilon", "seed", "num_envs")
            if not set(asked) & {"evaluation", f"evaluation.{key}"}
        }
        evaluation = replace(evaluation, **protocol)
        actor = build_exported_actor(trained, stored, device)
    evaluation = replace(evaluation, num_envs=evaluation.at_once)
    facts = {**source, "step": step, "evaluation": to_dict(evaluation), "env": to_dict(trained.env)}
    recorded = RunFolder(outputs / "evaluations" / f"{_placeable(name)}-at-{step}-{digest(facts)[:6]}")
    shown = labels(f"evaluation of {title} at {step} {digest(facts)[:6]}", config_colour(trained), "evaluation")
    with _held(recorded):
        played = _play(f"{name} at step {step:,}", actor, trained.env, evaluation, cores)
        _record(recorded, facts, played, tracking, outputs, shown, command)
    if card:
        table = side_by_side(card, evaluation, [episode.score for episode in played[0].episodes])
        terminal.console(least=130).print(table)
    return recorded


def _placeable(name: str) -> str:
    """Turn a name into one that a run's folder may have."""
    return re.sub(r"[^A-Za-z0-9_.,~+=@-]+", "-", name).lstrip("_.,~+=@-")[:150] or "weights"


def play_baseline(
    *,
    agent: BaselineAgentConfig,
    env: EnvConfig,
    evaluation: EvaluationConfig,
    tracking: TrackingConfig,
    paths: PathsConfig,
    plugins: Mapping[str, PluginConfig],
    name: str,
    title: str,
    command: str,
    cores: int,
) -> None:
    """Let a player without a network play, print the report's table, and record the run `name`."""
    outputs = Path(paths.outputs)
    catch_up(outputs, tracking.uri)
    facts = _facts(agent=agent, env=env, evaluation=evaluation, tracking=tracking, paths=paths)
    if plugins:
        facts = {"plugins": _facts(**plugins), **facts}
    folder, shown = RunFolder(outputs / "runs" / name), labels(title, run_colour(agent.name), "baseline")
    with _held(folder):
        played = _play(f"{agent.name} player on {env.id}", build_baseline(agent, env), env, evaluation, cores)
        _record(folder, facts, played, tracking, outputs, shown, command)


def play(
    *,
    player: str,
    scale: int,
    env: EnvConfig,
    evaluation: EvaluationConfig,
    tracking: TrackingConfig,
    paths: PathsConfig,
    command: str,
    cores: int,
) -> None:
    """Let a person play at the game's 60 frames a second, print the report's table, and record it.

    The picture changes and keys are read once a step, as for the networks.
    """
    outputs = Path(paths.outputs)
    catch_up(outputs, tracking.uri)
    names = (f"human-{player}-{env.id.rsplit('/')[-1]}-{number}" for number in count(1))
    folder = RunFolder(next(path for name in names if not (path := outputs / "runs" / name).exists()))
    low, high = (env.frameskip, env.frameskip + 1) if isinstance(env.frameskip, int) else env.frameskip
    game, progress = facts_of(env.game), Progress()
    settings = _facts(env=env, evaluation=evaluation, tracking=tracking, paths=paths)
    facts = {"player": player, "scale": scale, **settings}
    shown = labels(folder.name, run_colour("human"), "human")
    with _held(folder):
        progress.say(f"{player} plays {env.title}: {game.keys_in_words}")
        window = Window(env.title, game, 60 / ((low + high - 1) / 2), scale)  # steps a second, on average
        actor, emulators = build_person(env, window.choose)
        evaluator = build_evaluator(env, evaluation, cores)
        try:
            played = evaluator(actor, evaluation.episodes, progress, lambda: window.closed, emulators)
        except Stopped:
            raise Fault("the window was closed before the last episode ended; nothing is recorded") from None
        finally:
            window.close()
        _record(folder, facts, (played, evaluator.film(played, progress)), tracking, outputs, shown, command)


def _facts(**parts: Any) -> dict[str, Any]:
    return {name: to_dict(part) for name, part in parts.items()}


@contextmanager
def _held(folder: RunFolder) -> Iterator[None]:
    """Hold a run's folder while a game is played; remove a new one if nothing was recorded."""
    is_new = not folder.path.exists()
    with terminable(), folder.held():
        try:
            yield
        finally:
            if is_new and not folder.has_started:
                shutil.rmtree(folder.path)


def _play(
    what: str, actor: Actor, env: EnvConfig, evaluation: EvaluationConfig, cores: int
) -> tuple[Evaluation, bytes | None]:
    progress = Progress()
    progress.say(f"{what}: {evaluation.episodes} episodes, epsilon {evaluation.epsilon}")
    evaluator = build_evaluator(env, evaluation, cores)
    played = evaluator(actor, evaluation.episodes, progress)
    return played, evaluator.film(played, progress)


def _record(
    folder: RunFolder,
    facts: Mapping[str, Any],
    played: tuple[Evaluation, bytes | None],
    tracking: TrackingConfig,
    outputs: Path,
    shown: Mapping[str, str],
    command: str,
) -> None:
    """Print an evaluation's report, and record it in a held folder with `facts` as its params."""
    evaluation, video = played
    print(f"\n{evaluation.report()}\n")
    with publishing(folder, tracking, outputs, shown) as journal:
        folder.write_config(facts)
        journal.params({key: str(value) for key, value in flatten(facts).items()})
        journal.tags({**provenance(command), "policy": evaluation.policy})
        journal.note(indent(evaluation.report(), "    "))
        step = int(facts.get("step", 0))
        journal.metrics(evaluation.metrics(), step)
        for index, episode in enumerate(evaluation.episodes):
            journal.metrics({"score/episode": episode.score, "score/length": episode.steps}, index)
        scores = [episode.score for episode in evaluation.episodes]
        journal.image("evaluation/histogram", score_histogram(scores, folder.name, evaluation.game.score_range), step)
        journal.artifact(EVALUATION, evaluation.table().to_csv().encode())
        journal.artifact(EVALUATION_REPORT, evaluation.report().encode())
        if video is not None:
            journal.artifact(BEST_EPISODE, video)
        journal.finish()
        folder.write_result(Result("finished", step, {}, evaluation.metrics(), evaluation.report()))
    print(f"recorded as {folder.name} in {folder.path}")
