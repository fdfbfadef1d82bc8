"""`python -m atlantis_exp baseline`: a player without a network as a tracked run (report figures 1.4 and 1.5)."""

from pathlib import Path

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import BaselineConfig, to_dict


def baseline(config: BaselineConfig) -> None:
    """Play, print the report's table, and record it all."""
    from atlantis_exp.build import build_baseline, run_evaluation
    from atlantis_exp.commands.runs import RunFolder, record_evaluation, settle
    from atlantis_exp.commands.titles import baseline_title, labels
    from atlantis_exp.media import run_colour
    from atlantis_exp.training.progress import Progress

    outputs = Path(config.paths.outputs)
    settle(outputs)
    folder = RunFolder(outputs / "runs" / config.run_name())
    progress = Progress()
    progress.say(f"{config.agent.name} player, {config.evaluation.episodes} episodes of {config.env.id}")
    evaluation, video = run_evaluation(
        build_baseline(config.agent), config.env, config.evaluation, config.evaluation.episodes, progress
    )
    shown = labels(baseline_title(config), run_colour(config.agent.name))
    record_evaluation(folder, "baseline", to_dict(config), evaluation, video, config.tracking, outputs, shown)


def main() -> None:
    """Compose and play."""
    run_verb("baseline", BaselineConfig, baseline)
