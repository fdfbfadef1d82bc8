"""Turn a training's command line into a `Job` with a title."""

import json
from collections.abc import Sequence

from atlantis_exp.checking import digest
from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.overrides import check, flags_of, read_override
from atlantis_exp.config import FREE, Config
from atlantis_exp.sessions.job import Job

_TITLED = ("model", "sampler", "seed")  # in every title
_BARE = ("experiment", "objective", "optimizer", "epsilon", "env")  # groups whose options speak for themselves
_SPELLED = 4  # changed values at most; more are shortened to a hash


def job_of(asked: Asked[Config]) -> Job:
    """Return the training that a checked config asks for."""
    return Job(asked.config, words_of(asked.overrides), asked.overrides, asked.machine)


def words_of(overrides: Sequence[str]) -> tuple[str, ...]:
    """Return a title's words besides network, sampler and seed: chosen options, then changed values.

    `experiment=fast objective.n_step=3` gives `fast n_step=3`. Keys are shortened as far as they stay unique. Values
    are normalised, since Hydra writes 1_000 as 1000 for a job of a sweep.
    """
    options: dict[str, str] = {}
    values: dict[str, str] = {}
    for text in flags_of(overrides).overrides:
        override = read_override(text)
        key, value = override.get_key_element(), override.value()
        word = "" if override.is_delete() else value if isinstance(value, str) else json.dumps(value)
        root = key.lstrip("~").split(".")[0]
        if key in _TITLED or root in FREE or key == "env.workers" or word == "none":
            continue
        if key in _BARE:
            options[key] = word
        elif "." not in key or "@" in key:
            options[key] = f"{key}={word}"
        else:
            values[key] = word
    if len(values) > _SPELLED:
        return (*options.values(), digest(values)[:6])
    last = [key.rsplit(".", 1)[-1] for key in values]
    short = {key: name if last.count(name) == 1 else key for key, name in zip(values, last, strict=True)}
    return (*options.values(), *(f"{short[key]}={value}" if value else key for key, value in values.items()))


def training_of(overrides: Sequence[str]) -> Job:
    """Return the training that overrides ask for. Raises: ConfigError."""
    ((texts, config),) = check("config", Config, overrides).items()
    return job_of(Asked(config, "train", texts))
