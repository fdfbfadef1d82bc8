"""Describe the environment (report figures 1.1 to 1.3)."""

import warnings

from atlantis_exp import terminal
from atlantis_exp.checking import to_dict
from atlantis_exp.config import EnvConfig
from atlantis_exp.documents import Query
from atlantis_exp.game.emulator import query_environment


def query(*, env: EnvConfig) -> None:
    """Print the environment's spaces, limits and rewards as in the report, then as this config uses them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium calls the report's environment out of date
        answers = query_environment(env.id)
    said = {key: answers[key] for key in answers if key != "reward_range"}  # infinite
    terminal.document(Query(environment=said, config=to_dict(env)).model_dump_json())
    frames = env.frameskip if isinstance(env.frameskip, int) else f"{env.frameskip[0]} to {env.frameskip[1] - 1}"
    up, right, down, left = env.crop
    print(f"Action Space: {answers['action_space']}")
    print(f"possible actions: {answers['possible_actions']}")
    print(f"Observation Space: {answers['observation_space']}")
    print(f"Max Episode Steps: {answers['max_episode_steps']}")
    print(f"Nondeterministic: {answers['nondeterministic']}")
    print(f"Reward Range: {answers['reward_range']}")
    print(f"Reward Threshold: {answers['reward_threshold']}")
    print(f"\n{env.id} in this config")
    print(f"frames per step: {frames}; each repeats the previous action with probability {env.sticky}")
    limits = [*([f"{env.max_steps:,} steps"] if env.max_steps else []), f"{env.max_frames:,} frames"]
    print(f"an episode ends: when the game is over, or after {' or '.join(limits)}")
    print(f"observation: rows {up}-{down - 1}, columns {left}-{right - 1}, grey, at {env.size}x{env.size} pixels")
    print(f"state: the observations of {', '.join(map(str, env.lags))} steps ago")
