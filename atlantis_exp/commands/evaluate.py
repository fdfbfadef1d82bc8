"""`python -m atlantis_exp evaluate run=NAME epsilon=0.05`: a stored run's network, played again."""

import re
import sys
from pathlib import Path

from safetensors import SafetensorError

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import Config, ConfigError, EvaluateConfig, digest, parse, to_dict
from atlantis_exp.faults import Fault


def evaluate(config: EvaluateConfig) -> None:
    """Play a stored network on its own environment, print the report's table, and record it beside the run."""
    from atlantis_exp.build import build_network_actor, run_evaluation
    from atlantis_exp.commands.runs import RunFolder, find_run, record_evaluation, settle
    from atlantis_exp.commands.titles import colour, labels, title
    from atlantis_exp.training.checkpoint import CheckpointError
    from atlantis_exp.training.progress import Progress

    outputs = Path(config.paths.outputs)
    settle(outputs)
    run = find_run(outputs, config.run)
    try:
        trained = parse(Config, run.config)
    except ConfigError as error:
        raise ConfigError(f"{run.path / 'config.json'}: {error}") from None
    progress = Progress()
    try:
        actor, step = build_network_actor(trained, run.path, config.weights, config.device)
    except (CheckpointError, SafetensorError) as error:
        raise Fault(f"run {run.name}: the {config.weights} weights cannot be read: {error}") from error
    settings = config.evaluation
    progress.say(f"{run.name} at step {step:,}: {settings.episodes} episodes, epsilon {settings.epsilon}")
    evaluation, video = run_evaluation(actor, trained.env, settings, settings.episodes, progress)
    facts = {"run": run.name, "step": step, "evaluation": to_dict(settings), "env": to_dict(trained.env)}
    folder = RunFolder(outputs / "evaluations" / f"{run.name}-at-{step}-{digest(facts)[:6]}")
    shown = labels(f"evaluation of {title(trained)} at {step} {digest(facts)[:6]}", colour(trained))
    record_evaluation(folder, "evaluation", facts, evaluation, video, config.tracking, outputs, shown)


def main() -> None:
    """Compose and evaluate; `epsilon=` and `episodes=` are short for the evaluation's."""
    # Hydra itself would take `epsilon` for the config group of that name.
    sys.argv[1:] = [re.sub(r"^(epsilon|episodes)=", r"evaluation.\1=", argument) for argument in sys.argv[1:]]
    run_verb("evaluate", EvaluateConfig, evaluate)
