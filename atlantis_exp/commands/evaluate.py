"""`python -m atlantis_exp evaluate run=NAME epsilon=0.05`: a stored run's network, or an exported one, played again."""

import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from rich.console import Console

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import ConfigError, EvaluateConfig, digest, to_dict


def evaluate(config: EvaluateConfig) -> None:
    """Play a network on its own environment, print the report's table, and record it beside the runs.

    An exported network plays by the protocol of its card, as far as the command line does not ask for another.
    """
    from atlantis_exp.build import build_network_actor, run_evaluation, stored_weights
    from atlantis_exp.commands.cards import beside, build_exported_actor, read_card
    from atlantis_exp.commands.runs import RunFolder, find_run, record_evaluation, settle, trained_config
    from atlantis_exp.commands.titles import colour, labels, title
    from atlantis_exp.training.progress import Progress

    outputs, settings, card = Path(config.paths.outputs), config.evaluation, None
    settle(outputs)
    if config.weights in ("latest", "best"):
        run = find_run(outputs, config.run)
        name, trained, source = run.name, trained_config(run), {"run": run.name}
        weights, step = stored_weights(trained, run.path, config.weights)
        actor = build_network_actor(trained, weights, config.device)
    else:
        asked = {override.split("=")[0].lstrip("+") for override in HydraConfig.get().overrides.task}
        if "run" in asked:
            raise ConfigError(
                f"run={config.run}: weights={config.weights} are of no run here; leave out one of the two"
            )
        folder = Path(config.weights)
        card, weights = read_card(folder)
        name, trained, step = folder.resolve().name, card.config, card.step
        source = {"weights": name, "sha256": card.sha256}
        protocol: dict[str, Any] = {
            key: getattr(card.evaluation, key)
            # The environments, too: rounding depends on how many states a batch has, and a near tie on rounding.
            for key in ("episodes", "epsilon", "seed", "num_envs")
            if not asked & {"evaluation", f"evaluation.{key}"}
        }
        settings = replace(settings, **protocol)
        actor = build_exported_actor(trained, weights, config.device)
    progress = Progress()
    progress.say(f"{name} at step {step:,}: {settings.episodes} episodes, epsilon {settings.epsilon}")
    evaluation, video = run_evaluation(actor, trained.env, settings, settings.episodes, progress)
    facts = {**source, "step": step, "evaluation": to_dict(settings), "env": to_dict(trained.env)}
    recorded = RunFolder(outputs / "evaluations" / f"{name}-at-{step}-{digest(facts)[:6]}")
    shown = labels(f"evaluation of {title(trained)} at {step} {digest(facts)[:6]}", colour(trained))
    record_evaluation(recorded, "evaluation", facts, evaluation, video, config.tracking, outputs, shown)
    if card:
        table = beside(card, settings, [episode.score for episode in evaluation.episodes])
        Console(highlight=False, width=max(Console().width, 130)).print(table)


def spell_out() -> None:
    """Let `epsilon=` and `episodes=` on the command line be the evaluation's."""
    # Hydra itself would take `epsilon` for the config group of that name.
    sys.argv[1:] = [re.sub(r"^(epsilon|episodes)=", r"evaluation.\1=", argument) for argument in sys.argv[1:]]


def main() -> None:
    """Compose and evaluate."""
    spell_out()
    run_verb("evaluate", EvaluateConfig, evaluate)
