"""`python -m atlantis_exp query`: what the environment is (report figures 1.1 to 1.3)."""

from atlantis_exp.commands.app import run_verb
from atlantis_exp.config import QueryConfig


def query(config: QueryConfig) -> None:
    """Print the environment's spaces, limits and rewards, and the observation that this config makes of it."""
    from atlantis_exp.game.emulator import query_environment

    print(f"environment: {config.env.id}")
    for key, value in query_environment(config.env.id).items():
        print(f"{key}: {value}")
    print(f"Config: {config.env}")


def main() -> None:
    """Compose and query."""
    run_verb("query", QueryConfig, query)
