"""A training of tenths of seconds: a game of a few lines, a network of one layer, parts put together by hand."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import pytest
import torch
from rich.console import Console
from torch import nn

from atlantis_exp.components import facts_of, game_of
from atlantis_exp.game.emulator import Emulator, Step
from atlantis_exp.game.preprocessing import FrameStack
from atlantis_exp.game.vector import Emulators, make_emulators
from atlantis_exp.learning.learner import Learner
from atlantis_exp.learning.objectives import DQN
from atlantis_exp.learning.recurrent import RecurrentLearner
from atlantis_exp.learning.schedules import Constant, Exponential
from atlantis_exp.replay.memory import ReplayMemory, Returns, Window
from atlantis_exp.replay.samplers import UniformSampler
from atlantis_exp.runs.journal import Journal
from atlantis_exp.training.actor import Actor, EpsilonGreedy, RecurrentGreedy
from atlantis_exp.training.checkpoint import Checkpoints
from atlantis_exp.training.evaluator import Evaluator
from atlantis_exp.training.plan import Cadence, Phase, Plan
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.recorder import Recorder
from atlantis_exp.training.trainer import Trainer

ATLANTIS = facts_of(game_of("Atlantis-v0"))
NUM_ACTIONS = len(ATLANTIS.actions)
SIZE = 8  # pixels
LAGS = range(4)  # steps ago, of a state's observations
CAPACITY = 120  # observations
BUDGET = 2**20  # bytes


@dataclass
class Game:
    """Takes an Emulator's place: noise on the screen and in the rewards, and an episode is truncated after `steps`."""

    steps: int = 40
    game = ATLANTIS

    def __post_init__(self) -> None:
        self.preprocessing = SimpleNamespace(size=SIZE)
        self.generator = np.random.default_rng(0)
        self.played = 0

    def reset(self, seed: int | None = None) -> npt.NDArray[np.uint8]:
        if seed is not None:
            self.generator = np.random.default_rng(seed)
        self.played = 0
        return self.screen()

    def step(self, action: int) -> Step:
        self.played += 1
        reward = 100.0 * self.generator.integers(3) * (action > 0)
        screen, frames = self.screen(), int(self.generator.integers(2, 5))
        return Step(screen, reward, False, self.played == self.steps, False, frames, [0.0, reward, 0.0, 0.0, 0.0])

    def screen(self) -> npt.NDArray[np.uint8]:
        return self.generator.integers(256, size=(SIZE, SIZE), dtype=np.uint8)

    def state_dict(self) -> dict[str, Any]:
        return {"generator": self.generator.bit_generator.state, "played": self.played}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.generator.bit_generator.state, self.played = state["generator"], state["played"]


def emulators_of(num_envs: int, steps: int = 40, game: type[Game] = Game) -> Emulators:
    return make_emulators(cast(Callable[[], Emulator], partial(game, steps)), num_envs, 0)


def learner_of(seed: int = 0, lags: Sequence[int] = LAGS, remembers: bool = False, **options: Any) -> Learner:
    def network() -> nn.Module:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            if remembers:
                return Remembering(lags)
            return nn.Sequential(nn.Flatten(), nn.Linear(len(lags) * SIZE * SIZE, NUM_ACTIONS))

    online = network()
    optimizer = torch.optim.AdamW(online.parameters(), 1e-3)
    if remembers:
        return RecurrentLearner(online, network(), optimizer, DQN(), 1e-4, ahead=1, **options)
    return Learner(online, network(), optimizer, DQN(), 1e-4, **options)


class Remembering(nn.Module):
    """A network of one recurrent layer."""

    units, burn_in, unroll = 12, 2, 16

    def __init__(self, lags: Sequence[int]) -> None:
        super().__init__()
        self.core = nn.GRUCell(len(lags) * SIZE * SIZE, self.units)
        self.head = nn.Linear(self.units, NUM_ACTIONS)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.sequence(x.unsqueeze(1), torch.zeros(len(x), self.units), torch.zeros(len(x)))[0][:, 0]

    def sequence(self, x: torch.Tensor, h: torch.Tensor, first: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values = []
        for t in range(x.shape[1]):
            h = self.core(x[:, t].flatten(1), h * (t > first).unsqueeze(1))
            values.append(self.head(h))
        return torch.stack(values, 1), h


PLAN = Plan(
    unit="steps",
    phases=[Phase("quick", 160, 1e-3, UniformSampler())],
    epsilon=Exponential(0.9, 0.02, 0.5),
    learning_rate=Constant(1.0),
    returns=Returns(0.99),
    terminal_on_life_loss=False,
    learn_every=4,
    learn_start=20,
    batch_size=4,
)
CADENCE = Cadence(
    curve_steps=20,
    histogram_episodes=500,
    commit_episodes=100,
    commit_seconds=1e9,
    evaluate_episodes=None,
    evaluate_steps=80,
    evaluate_at_end=True,
    interim_episodes=2,
    final_episodes=2,
)


@pytest.fixture(autouse=True)
def _pictures_in_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """To draw one takes longer than a training here, and `media` has tests of its own."""
    for name in ("score_histogram", "score_heatmap"):
        monkeypatch.setattr(f"atlantis_exp.training.recorder.{name}", lambda *arguments: repr(arguments).encode())


@pytest.fixture
def small() -> Callable[..., Trainer]:
    """Builds a trainer in a folder and continues from the checkpoint there: `small(tmp_path, num_envs=3)`.

    Fields of `Plan` and `Cadence` may be given by their names; episode_steps is an episode's length, capacity the
    replay memory's in observations, console what is told, game what is played, remembers whether by a memory.
    """

    def built(
        folder: Path,
        *,
        num_envs: int = 1,
        seed: int = 0,
        episode_steps: int = 40,
        capacity: int = CAPACITY,
        max_steps: int | None = None,
        max_updates: int | None = None,
        console: Console | None = None,
        game: type[Game] = Game,
        lags: Sequence[int] = LAGS,
        remembers: bool = False,
        **options: Any,
    ) -> Trainer:
        if remembers:
            options["window"] = Window(Remembering.burn_in, Remembering.unroll, 1)
        plan = Plan(**{**vars(PLAN), **_taken(options, Plan)})
        cadence = Cadence(**{**vars(CADENCE), **_taken(options, Cadence)})
        assert not options, options
        exploration, sampling, emulation = np.random.SeedSequence(seed).spawn(3)
        learner = learner_of(seed, lags, remembers)
        actor: Actor = EpsilonGreedy(learner.q_values, NUM_ACTIONS)
        watched: Actor = EpsilonGreedy(learner.evaluated_q_values, NUM_ACTIONS, watches=True)
        if isinstance(learner, RecurrentLearner):
            actor, watched = (
                RecurrentGreedy(Remembering.units, step, NUM_ACTIONS) for step in (learner.step, learner.evaluated_step)
            )
        memory = ReplayMemory(capacity, (SIZE, SIZE), lags=lags, budget_bytes=BUDGET)
        evaluator = Evaluator(
            most_frames=1_000,
            make_emulators=partial(emulators_of, steps=episode_steps, game=game),
            make_emulator=cast(Callable[[], Emulator], game),
            epsilon=0.05,
            seed=1_000_003,
            num_envs=1,
            size=SIZE,
            lags=lags,
            video=None,
        )
        trainer = Trainer(
            plan=plan,
            emulators=emulators_of(num_envs, episode_steps, game),
            stack=FrameStack(num_envs, SIZE, lags, actor.units),
            actor=actor,
            memory=memory,
            learner=learner,
            exploration=[np.random.default_rng(child) for child in exploration.spawn(num_envs)],
            sampling=np.random.default_rng(sampling),
            seeds=emulation.generate_state(num_envs).tolist(),
            recorder=Recorder(
                plan=plan,
                cadence=cadence,
                learner=learner,
                memory=memory,
                journal=Journal(folder),
                progress=Progress(console or Console(quiet=True)),
                play=partial(evaluator, watched),
                film=evaluator.film,
                score_range=ATLANTIS.score_range,
            ),
            checkpoints=Checkpoints(folder / "checkpoints", "small"),
            max_steps=max_steps,
            max_flops=None if max_updates is None else max_updates * learner.update_flops((len(lags), SIZE, SIZE), 4),
        )
        if (state := trainer.checkpoints.load(trainer.memory)) is not None:
            trainer.load_state_dict(state)
        return trainer

    return built


def _taken(options: dict[str, Any], schema: type) -> dict[str, Any]:
    names: Sequence[str] = [field.name for field in fields(schema)]
    return {name: options.pop(name) for name in names if name in options}
