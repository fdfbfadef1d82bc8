"""Read the space of a search, written as for Hydra's Optuna sweeper, and check it before anything starts."""

import math
from collections.abc import Mapping, Sequence

from hydra.core.override_parser.types import ChoiceSweep, Glob, IntervalSweep, RangeSweep
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from atlantis_exp.commands.app import Asked
from atlantis_exp.commands.jobs import job_of
from atlantis_exp.commands.overrides import check, flags_of, is_longer, key_of, read_override
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.job import Job

_CORNERS = 32  # configs to compose before a search starts, at 0.1 s each; larger spaces are checked along their edges
_MOST_NUMBERS = 100_000  # of a range with fractions


Distribution = CategoricalDistribution | FloatDistribution | IntDistribution
Space = Mapping[str, Distribution]
"""The distribution of each key; a choice's values are texts, as an override has them."""


def read_space(texts: Mapping[str, str], closed: set[str]) -> Space:
    """Parse the distribution of each key; `closed` has the first parts of keys to refuse. Raises: ConfigError."""
    return {key: _read(key, text, closed) for key, text in texts.items()}


def _read(key: str, text: str, closed: set[str]) -> Distribution:
    override = read_override(f"{key}={text}")
    if override.key_or_group != key:  # as `++seed` or `sampler@samplers.uniform`, which MLflow refuses as names
        raise ConfigError(f"{key}={text}: cannot be searched; write a plain key, as in {override.key_or_group}")
    if key.split(".")[0] in closed:
        raise ConfigError(f"{key}={text}: cannot be searched; it decides how trials are run or measured")
    values = override.value()
    if not override.is_sweep_override() or isinstance(values, Glob):
        raise ConfigError(f"{key}={text}: not a set of values; write choice(a, b), range(1, 9) or interval(0.1, 0.9)")
    try:
        if isinstance(values, IntervalSweep):
            low, high, step = values.start, values.end, None
        elif isinstance(values, RangeSweep):
            drawn = values.range()
            if not isinstance(drawn, range) and is_longer(values, _MOST_NUMBERS):
                raise ValueError(f"more than {_MOST_NUMBERS:,} numbers; write interval(a, b)")
            numbers = drawn if isinstance(drawn, range) else [*drawn]
            if not numbers:
                raise ValueError("has no numbers")
            low, high, step = min(numbers[0], numbers[-1]), max(numbers[0], numbers[-1]), abs(values.step)
        else:
            assert isinstance(values, ChoiceSweep)
            values.shuffle = False  # else each call would have another order, and be another search
            return CategoricalDistribution(list(dict.fromkeys(override.sweep_string_iterator())))
        is_log = "log" in values.tags
        if isinstance(low, int) and isinstance(high, int):
            return IntDistribution(low, high, is_log, int(step or 1))
        assert low is not None
        assert high is not None
        return FloatDistribution(low, high, is_log, step)
    except ValueError as error:
        raise ConfigError(f"{key}={text}: {error}") from None


def check_space(space: Space, overrides: Sequence[str]) -> Job:
    """Compose the configs at the corners of a space and return the first. Raises: ConfigError."""
    fixed = {key_of(text) for text in flags_of(overrides).overrides}
    if twice := sorted(fixed & space.keys()):
        raise ConfigError(f"{twice[0]}: is both fixed and searched; drop one of them")
    ends = {
        key: drawn.choices if isinstance(drawn, CategoricalDistribution) else (drawn.low, drawn.high)
        for key, drawn in space.items()
    }
    is_small = math.prod(map(len, ends.values())) <= _CORNERS
    corners: dict[tuple[str, ...], Config] = {}
    for varied in [None] if is_small else ends:
        chosen = {key: end if varied in (None, key) else end[:1] for key, end in ends.items()}
        swept = [f"{key}={','.join(map(str, end))}" for key, end in chosen.items()]
        corners |= check("config", Config, ["-m", *overrides, *swept])
    texts, config = next(iter(corners.items()))
    return job_of(Asked(config, "train", texts))
