"""`python -m atlantis_exp new model=mynet to=FOLDER`: write a package with a component to start from."""

import keyword
import re
from collections.abc import Callable
from functools import partial
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from atlantis_exp.checking import absolute
from atlantis_exp.commands import CONF
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.components import NAME, built_in
from atlantis_exp.config import STRICT
from atlantis_exp.faults import ConfigError
from atlantis_exp.sessions.new import EXAMPLES, begin


@dataclass(config=STRICT, kw_only=True, frozen=True)
class NewConfig:
    """A component's kind and name, and the folder of its package."""

    component: dict[str, str | None]  # by kind
    to: Annotated[str, Field(min_length=1)] | None

    def __post_init__(self) -> None:
        for kind, name in self.component.items():
            if name is None:
                continue
            if not re.fullmatch(NAME, name):
                raise ConfigError(
                    f"{kind}={name}: a name has lowercase letters, digits and underscores, as in {kind}=mynet"
                )
            if keyword.iskeyword(name):
                raise ConfigError(f"{kind}={name}: is a Python keyword; choose another name")
            if (kind, name) in built_in():
                raise ConfigError(f"{kind}={name}: is built in and cannot be replaced; choose another name")


def _spell_out(arguments: list[str]) -> list[str]:
    """Expand `model=` to `component.model=`."""
    # Hydra would read `model` as the config group of that name.
    return [re.sub(rf"^({'|'.join(EXAMPLES)})=", r"component.\1=", argument) for argument in arguments]


def _work(asked: Asked[NewConfig]) -> Callable[[], None]:
    named = [(kind, name) for kind, name in asked.config.component.items() if name is not None]
    if len(named) != 1:
        raise ConfigError(f"new: name one component, as in model=mynet (kinds: {', '.join(EXAMPLES)})")
    ((kind, name),) = named
    if asked.config.to is None:
        raise ConfigError(f"to: missing; write to=FOLDER, as in to=./{name}")
    return partial(begin, kind, name, absolute("to", asked.config.to), CONF.parent / "examples")


VERB = Verb("new", NewConfig, _work, rewrite=_spell_out)
