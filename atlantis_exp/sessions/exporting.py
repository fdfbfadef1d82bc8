"""Export a stored run's network as a folder: play it in its exported form, then write it with its card."""

import hashlib
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Literal

from atlantis_exp import terminal
from atlantis_exp.build import build_evaluator
from atlantis_exp.checking import absolute, check_new
from atlantis_exp.config import EvaluationConfig, PathsConfig
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.files import whole
from atlantis_exp.runs.folder import RunFolder, find_run
from atlantis_exp.runs.journal import Metrics, Tags
from atlantis_exp.sessions.cards import Card, build_exported_actor, pack, portable, write_card
from atlantis_exp.sessions.page import terminable
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.training.progress import Progress

_COUNTERS = ("throughput/episodes", "throughput/frames", "learning/updates", "throughput/hours")


def export(
    *,
    run: str,
    weights: Literal["latest", "best"],
    to: str | None,
    onnx: bool,
    device: str,
    evaluation: EvaluationConfig,
    paths: PathsConfig,
    cores: int,
) -> None:
    """Play the network in its exported form, then write it with a card, whole or not at all."""
    if onnx:
        from atlantis_exp.sessions.onnx import export_onnx, require

        require()
    outputs = Path(paths.outputs)
    catch_up(outputs)
    source = find_run(outputs, run)
    typed = Path(to or f"pretrained/{source.name}")
    folder = absolute("to", str(typed)).resolve()
    if folder == Path.cwd():  # the export takes its place, and a shell would be left in none
        raise ConfigError(f"to={to}: the folder that you are in; name another")
    check_new(folder)
    trained = portable(source.trained_config)
    stored, step = stored_weights(source, weights)
    packed, precision = pack(stored)
    reached, made = _history(source, step)
    actor = build_exported_actor(trained, packed, device)
    exported = None
    if onnx:
        with terminal.working("writing the network as ONNX, and comparing it with torch"):
            exported = export_onnx(trained, packed)
    settings = replace(evaluation, video=False, num_envs=evaluation.at_once)
    progress = Progress()
    with terminable(), whole(folder) as place:  # before playing: the folder may be refused
        progress.say(f"{source.name} at step {step:,}: {settings.episodes} episodes, epsilon {settings.epsilon}")
        played = build_evaluator(trained.env, settings, cores)(actor, settings.episodes, progress)
        card = Card(
            format=1,
            run=source.name,
            weights=weights,
            step=step,
            reached=reached,
            made=made,
            precision=precision,
            sha256=hashlib.sha256(packed).hexdigest(),
            config=trained,
            evaluation=settings,
            scores=[episode.score for episode in played.episodes],
        )
        write_card(place, typed, card, packed, played, exported and exported.content)
    print(f"\n{played.report()}\n\n{len(packed):,} bytes in {precision}, with card and scores, in {folder}")
    if exported:
        print(f"network.onnx: within {exported.difference:.1g} of torch's values in {exported.states} states")


def _history(run: RunFolder, step: int) -> tuple[dict[str, float], dict[str, str]]:
    """Return a training's counters at a step, and its origin. Raises: Fault if its journal is damaged."""
    reached: dict[str, float] = {}
    tags: dict[str, str] = {}
    for record in run.records():
        if isinstance(record, Tags):
            tags |= record.values
        elif isinstance(record, Metrics) and record.values.keys() >= {*_COUNTERS} and record.step <= step:
            reached = {name.split("/")[1]: record.values[name] for name in _COUNTERS}
    made = {key: value for key, value in tags.items() if key.startswith(("command", "git.", "precision", "version."))}
    if "command" in made:
        made["command"] = _without_places(made["command"])
    return reached, made


def _without_places(command: str) -> str:
    """Return a command without this machine's outputs and servers, and with other paths cut to their names."""
    try:
        words = shlex.split(command)
    except ValueError:  # forged
        return ""
    kept = (word for word in words if not re.match(r"[+~]*(paths|tracking)\.", word))
    return shlex.join(re.sub(r"(?<![\w.])(~[^/]*|\.{0,2})/([^,'\[\]]*/)?", "./", word) for word in kept)
