"""`python -m atlantis_exp baseline`: track a player without a network (report figures 1.4 and 1.5)."""

from collections.abc import Callable
from dataclasses import field
from functools import partial

from pydantic.dataclasses import dataclass

from atlantis_exp.checking import digest, to_dict
from atlantis_exp.commands.app import Asked, Verb
from atlantis_exp.components import facts_of
from atlantis_exp.config import (
    STRICT,
    BaselineAgentConfig,
    Env,
    EvaluationConfig,
    PathsConfig,
    Plugins,
    TrackingConfig,
)
from atlantis_exp.faults import ConfigError


@dataclass(config=STRICT, kw_only=True, frozen=True)
class BaselineConfig:
    """A tracked run of a player without a network."""

    plugins: Plugins = field(default_factory=dict)  # of its game; first, since the game needs it
    agent: BaselineAgentConfig
    env: Env
    evaluation: EvaluationConfig
    tracking: TrackingConfig
    paths: PathsConfig

    def __post_init__(self) -> None:
        actions = facts_of(self.env.game).actions
        if self.agent.action >= len(actions):
            named = ", ".join(f"{index} {name}" for index, name in enumerate(actions))
            raise ConfigError(f"agent.action={self.agent.action}: {self.env.title} has no such action (valid: {named})")

    def identity(self) -> str:
        """Return ten hexadecimal digits of the hash of all keys that change a baseline's numbers."""
        env = to_dict(self.env)
        del env["workers"]
        plugins = {"plugins": {name: to_dict(each) for name, each in self.plugins.items()}} if self.plugins else {}
        return digest({**plugins, "agent": to_dict(self.agent), "env": env, "evaluation": to_dict(self.evaluation)})

    def run_name(self) -> str:
        """Return a name of the player, its action, the game and the identity."""
        action = f"{self.agent.action}" if self.agent.name == "constant" else ""
        return f"{self.agent.name}{action}-{self.env.id.rsplit('/')[-1]}-{self.identity()}"

    def title(self) -> str:
        """Return the name for people."""
        action = f" {self.agent.action}" if self.agent.name == "constant" else ""
        return f"{self.agent.name}{action} {self.env.id.rsplit('/')[-1]} {self.identity()[:6]}"


def _work(asked: Asked[BaselineConfig]) -> Callable[[], None]:
    from atlantis_exp.sessions.evaluating import play_baseline

    config = asked.config
    work = partial(play_baseline, **vars(config), command=asked.command, cores=asked.machine.cores)
    return partial(work, name=config.run_name(), title=config.title())


VERB = Verb("baseline", BaselineConfig, _work)
