"""`python -m atlantis_exp export run=NAME to=pretrained/NAME`: a stored run's network as a folder to hand on."""

import hashlib
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from atlantis_exp.commands.app import run_verb
from atlantis_exp.commands.evaluate import spell_out
from atlantis_exp.config import CardConfig, ConfigError, ExportConfig
from atlantis_exp.faults import Fault

if TYPE_CHECKING:
    from atlantis_exp.commands.runs import RunFolder


def export(config: ExportConfig) -> None:
    """Play the network as it will be handed on, then write it with a card of how it was made and what it scored."""
    from atlantis_exp.build import run_evaluation, stored_weights
    from atlantis_exp.commands.cards import build_exported_actor, pack, portable, write_card
    from atlantis_exp.commands.runs import find_run, settle, trained_config
    from atlantis_exp.training.progress import Progress

    outputs = Path(config.paths.outputs)
    settle(outputs)
    run = find_run(outputs, config.run)
    folder = Path(config.to or f"pretrained/{run.name}")
    trained = portable(trained_config(run))
    stored, step = stored_weights(trained, run.path, config.weights)
    weights, precision = pack(stored)
    reached, made = _history(run, step)
    folder.mkdir(parents=True, exist_ok=True)  # before the episodes, lest there be no place for their scores
    if any(folder.iterdir()):
        raise ConfigError(f"to={folder}: is not empty; name another folder")
    actor = build_exported_actor(trained, weights, config.device)
    settings = replace(config.evaluation, video=False)
    progress = Progress()
    progress.say(f"{run.name} at step {step:,}: {settings.episodes} episodes, epsilon {settings.epsilon}")
    evaluation, _ = run_evaluation(actor, trained.env, settings, settings.episodes, progress)
    card = CardConfig(
        format=1,
        run=run.name,
        weights=config.weights,
        step=step,
        reached=reached,
        made=made,
        precision=precision,
        sha256=hashlib.sha256(weights).hexdigest(),
        config=trained,
        evaluation=settings,
        scores=[episode.score for episode in evaluation.episodes],
    )
    write_card(folder, card, weights, evaluation)
    print(f"\n{evaluation.report()}\n\n{len(weights):,} bytes in {precision}, with card and scores, in {folder}")


def _history(run: "RunFolder", step: int) -> tuple[dict[str, float], dict[str, str]]:
    """What a training had behind it at a step, and what made it. Raises: Fault, where its journal is damaged."""
    from atlantis_exp.tracking.journal import Metrics, Tags, read

    reached: dict[str, float] = {}
    tags: dict[str, str] = {}
    try:
        records = [record for _, record in read(run.path)]
    except ValueError as error:
        raise Fault(f"run {run.name}: {error}") from error
    for record in records:
        if isinstance(record, Tags):
            tags |= record.values
        elif isinstance(record, Metrics) and "throughput/frames" in record.values and record.step <= step:
            counters = ("throughput/episodes", "throughput/frames", "learning/updates", "throughput/hours")
            reached = {name.split("/")[1]: record.values[name] for name in counters}
    made = {key: value for key, value in tags.items() if key == "command" or key.startswith(("git.", "version."))}
    if "command" in made:  # without the places of this machine
        made["command"] = re.sub(r" (paths|tracking)\.\S+", "", made["command"])
    return reached, made


def main() -> None:
    """Compose and export."""
    spell_out()
    run_verb("export", ExportConfig, export)
