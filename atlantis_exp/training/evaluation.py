"""Play episodes at a fixed epsilon, on their own emulators and random streams (report figure 3.3)."""

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.game.vector import Emulators
from atlantis_exp.games import Game
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.statistics import Summary, summarize
from atlantis_exp.training.actor import Actor, Decisions

_COLLAPSED = 0.99  # share of one action in the network's decisions


class Stopped(Exception):
    """An evaluation stopped on request; nothing of it is kept."""


@dataclass
class Episode:
    """One evaluated episode; its seed and actions suffice to play it again."""

    seed: int
    score: float = 0.0
    frames: int = 0
    truncated: bool = False
    actions: bytearray = field(default_factory=bytearray)  # one a step
    random: bytearray = field(default_factory=bytearray)  # 1 where chance chose
    rewards: "array[float]" = field(default_factory=lambda: array("f"))  # one a step
    raw_values: bytearray = field(default_factory=bytearray)  # of `values`
    points: list[float] = field(default_factory=list)  # the score, in the order of the game's sources
    over: bool = False

    @property
    def steps(self) -> int:
        return len(self.actions)

    @property
    def values(self) -> npt.NDArray[np.float32] | None:
        """The network's values before each step, (steps, actions); None for a player without a network."""
        return np.frombuffer(self.raw_values, np.float32).reshape(self.steps, -1) if self.raw_values else None

    @property
    def random_share(self) -> float:
        """Share of random decisions."""
        return sum(self.random) / self.steps

    def action_counts(self, num_actions: int) -> npt.NDArray[np.int64]:
        """Count each action, (actions, 2): chosen by the network, by chance."""
        counts = np.zeros((num_actions, 2), np.int64)
        np.add.at(counts, (np.frombuffer(self.actions, np.uint8), np.frombuffer(self.random, np.uint8)), 1)
        return counts


@dataclass(frozen=True)
class Evaluation:
    """The episodes of one evaluation, in the order of their seeds."""

    epsilon: float
    episodes: list[Episode]
    game: Game

    @cached_property
    def summary(self) -> Summary:
        return summarize([episode.score for episode in self.episodes])

    @property
    def best(self) -> Episode:
        """The first episode with the highest score."""
        return max(self.episodes, key=lambda episode: episode.score)

    @cached_property
    def action_counts(self) -> npt.NDArray[np.int64]:
        """Each action's decisions in all episodes, (actions, 2): by the network, by chance."""
        counts: npt.NDArray[np.int64] = self._action_counts.sum(axis=0)
        return counts

    @cached_property
    def _action_counts(self) -> npt.NDArray[np.int64]:
        """The same in each episode, (episodes, actions, 2)."""
        return np.array([episode.action_counts(len(self.game.actions)) for episode in self.episodes])

    @property
    def random_share(self) -> float:
        """Share of random decisions in all episodes."""
        return float(self.action_counts[:, 1].sum() / self.action_counts.sum())

    @property
    def chance_agreement(self) -> float | None:
        """Share of the random decisions that equal the network's best action; None if unknown."""
        agrees: list[bool] = []
        for episode in self.episodes:
            if (values := episode.values) is not None:
                by_chance = np.flatnonzero(np.frombuffer(episode.random, np.uint8))
                actions = np.frombuffer(episode.actions, np.uint8)[by_chance]
                agrees += (values[by_chance].argmax(axis=1) == actions).tolist()
        return sum(agrees) / len(agrees) if agrees else None

    @property
    def favourite(self) -> tuple[str, float]:
        """The network's most frequent action, and its share of the network's decisions; 0 without any."""
        chosen = self.action_counts[:, 0]
        return self.game.actions[int(chosen.argmax())], int(chosen.max()) / max(1, int(chosen.sum()))

    @property
    def collapsed(self) -> bool:
        """Whether the network always chooses one action."""
        return self.favourite[1] > _COLLAPSED

    @property
    def policy(self) -> str:
        """The network's favourite action in words."""
        action, share = self.favourite
        if not share:
            return "chance alone"
        return f"{'collapsed: ' if self.collapsed else ''}{action} in {share:.1%} of the network's decisions"

    def metrics(self) -> dict[str, float]:
        """Return the metrics under `evaluation/` and `actions/`."""
        shares = self.action_counts.sum(axis=1) / self.action_counts.sum()
        agreement = self.chance_agreement
        return {
            **{f"evaluation/{name}": value for name, value in vars(self.summary).items()},
            "evaluation/epsilon": self.epsilon,
            "evaluation/steps_mean": float(np.mean([episode.steps for episode in self.episodes])),
            "evaluation/truncated_share": float(np.mean([episode.truncated for episode in self.episodes])),
            "actions/random_share": self.random_share,
            "actions/network_share": 1 - self.random_share,
            "actions/random_share_best": self.best.random_share,
            "actions/network_share_best": 1 - self.best.random_share,
            **{f"actions/{action}": float(share) for action, share in zip(self.game.actions, shares, strict=True)},
            "actions/entropy": float(-sum(share * np.log2(share) for share in shares if share)),  # bits
            "actions/favourite_share": self.favourite[1],
            **({} if agreement is None else {"actions/random_equals_best": agreement}),
            **{
                f"evaluation/score_{source}": float(np.mean([episode.points[index] for episode in self.episodes]))
                for index, source in enumerate(self.game.sources)
            },
        }

    def table(self) -> EpisodeTable:
        """Return the table of the episodes."""
        columns = ("score", "steps", "frames", "truncated", "points")
        values = {name: np.array([getattr(episode, name) for episode in self.episodes], np.float64) for name in columns}
        return EpisodeTable(
            actions=self.game.actions,
            sources=self.game.sources,
            seeds=np.array([episode.seed for episode in self.episodes]),
            scores=values.pop("score"),
            counts=self._action_counts.astype(np.float64),
            **values,
        )

    def report(self) -> str:
        """Return the evaluation as the report prints it (figures 5.4, 5.5 and 5.9)."""
        summary, best = self.summary, self.best
        player = "player" if best.values is None else "neural net"
        return (
            f"eval:\n\n"
            f"avg score: {summary.mean}  high score: {summary.high}  low score: {summary.low}\n\n"
            f"interquartile range ({summary.lower_quartile} -> {summary.upper_quartile}) "
            f"mean = {summary.interquartile_mean:.2f}\n\n"
            f"high score: {best.score}, rand: {best.random_share:.1%} {player}: {1 - best.random_share:.1%}"
        )


def evaluate(
    actor: Actor,
    emulators: Emulators,
    *,
    episodes: int,
    epsilon: float,
    seed: int,
    size: int,
    lags: Sequence[int],
    on_step: Callable[[Sequence[Episode]], None] = lambda _: None,
    stop: Callable[[], bool] = lambda: False,
) -> Evaluation:
    """Play episodes side by side; `seed` and its index alone determine each.

    While one half of the environments is emulated, the actor decides for the other. States have the observations,
    `size` x `size` pixels, of `lags` steps ago. Calls `stop` before every step of a half, and `on_step` with all
    episodes after it.

    Raises:
        Stopped: `stop` returned True.
    """
    game, emulators.stop = emulators.game, stop
    played = [
        Episode(_seed_sequence(seed, index).generate_state(1).item(), points=[0.0] * len(game.sources))
        for index in range(episodes)
    ]
    streams = [np.random.default_rng(_seed_sequence(seed, index).spawn(1)[0]) for index in range(episodes)]
    stacks = FrameStack(emulators.num_envs, size, lags, actor.units)
    waiting = iter(range(episodes))
    playing: dict[int, int] = {}  # environment to the episode it plays
    under_way: deque[tuple[range, npt.NDArray[np.int64], Decisions]] = deque()  # each with the half that it is of

    def begin(envs: Sequence[int]) -> None:
        for env in envs:
            playing.pop(env, None)
        begun = dict(zip(envs, waiting, strict=False))  # until no episode is left
        playing.update(begun)
        if begun:
            stacks.reset([*begun], emulators.reset([*begun], [played[index].seed for index in begun.values()]))

    def decide(half: range) -> None:
        envs = np.array([env for env in half if env in playing])
        if len(envs):
            memory = stacks.memory[envs]
            decisions = actor.act(stacks.state[envs], epsilon, [streams[playing[env]] for env in envs], memory)
            stacks.memory[envs] = memory
            emulators.send(decisions.actions, envs)
            under_way.append((half, envs, decisions))

    begin(range(emulators.num_envs))
    for first in (0, 1):
        decide(range(first, emulators.num_envs, 2))
    while under_way:
        if stop():
            raise Stopped
        half, envs, decisions = under_way.popleft()
        steps = emulators.receive()
        stacks.push(steps.observations, envs)
        ended = []
        for row, env in enumerate(envs.tolist()):
            episode = played[playing[env]]
            episode.actions.append(int(decisions.actions[row]))
            episode.random.append(bool(decisions.random[row]))
            if decisions.values is not None:
                episode.raw_values += decisions.values[row].astype(np.float32).tobytes()
            reward = float(steps.rewards[row])
            episode.rewards.append(reward)
            episode.score += reward
            if reward:
                episode.points = (steps.points[row] + episode.points).tolist()
            episode.frames += int(steps.frames[row])
            if steps.terminated[row] or steps.truncated[row]:
                episode.over, episode.truncated = True, bool(steps.truncated[row])
                ended.append(env)
        begin(ended)
        decide(half)
        on_step(played)
    return Evaluation(epsilon, played, game)


def _seed_sequence(seed: int, index: int) -> np.random.SeedSequence:
    return np.random.SeedSequence(seed, spawn_key=(index,))
