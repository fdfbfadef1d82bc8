"""Hash each part of a training, to compare two trainings."""

import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from atlantis_exp.replay.memory import ReplayMemory
from atlantis_exp.runs.journal import Image, Metrics, Model, read
from atlantis_exp.training.checkpoint import files_of

WALL_CLOCK = ("throughput/steps_per_second", "throughput/hours")
"""Metrics that measure the machine, not the training."""


def fingerprint(state: Mapping[str, Any], memory: ReplayMemory, folder: Path) -> dict[str, str]:
    """Hash a training's state, replay memory and committed history, without all that depends on time."""
    parts = {name: part for name, part in state.items() if name not in ("learner", "tracker")}
    parts["counters"] = {name: count for name, count in state["counters"].items() if name != "seconds"}
    learner = dict(state["learner"])
    parts["weights"] = {"network": learner.pop("network"), "target": learner.pop("target")}
    parts["learner"] = learner
    parts["replay"] = memory.state_dict()
    parts["history"] = {str(index): event for index, event in enumerate(history(folder))}
    return {name: _digest(part) for name, part in sorted(parts.items())}


def history(folder: Path) -> list[dict[str, Any]]:
    """Return the committed metrics, images and models, in order, without times."""
    events = []
    for _, record in read(folder):
        if isinstance(record, Metrics | Image | Model):
            fields = {name: value for name, value in vars(record).items() if name not in ("time", "values")}
            values = getattr(record, "values", {})
            fields["values"] = {name: value for name, value in values.items() if name not in WALL_CLOCK}
            events.append(fields)
    return events


def _digest(tree: Any) -> str:
    return hashlib.sha256(b"".join(files_of({"part": tree}).values())).hexdigest()
