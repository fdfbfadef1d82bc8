"""Evaluate by a protocol: own emulators, epsilon, seed, film."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.vector import Emulators
from atlantis_exp.training.actor import Actor
from atlantis_exp.training.evaluation import Evaluation, Stopped, evaluate
from atlantis_exp.training.film import Part, film_episode
from atlantis_exp.training.progress import Progress


@dataclass(frozen=True)
class Evaluator:
    """Evaluate any actor by one protocol, without touching the training."""

    make_emulators: Callable[[int], Emulators]
    make_emulator: Callable[[], Emulator]
    epsilon: float
    seed: int
    num_envs: int  # episodes played side by side
    size: int  # pixels
    lags: Sequence[int]  # steps ago, of a state's observations
    most_frames: int  # an episode
    video: Part | None  # the part of the best episode to film

    def __call__(
        self,
        actor: Actor,
        episodes: int,
        progress: Progress,
        stop: Callable[[], bool] = lambda: False,
        emulators: Emulators | None = None,
    ) -> Evaluation:
        """Play a number of episodes on `emulators`, by default new ones. Raises: Stopped when `stop` returns True."""
        with emulators or self.make_emulators(min(self.num_envs, episodes)) as emulators:
            return evaluate(
                actor,
                emulators,
                episodes=episodes,
                epsilon=self.epsilon,
                seed=self.seed,
                size=self.size,
                lags=self.lags,
                on_step=partial(progress.evaluating, most_frames=self.most_frames),
                stop=stop,
            )

    def film(
        self, evaluation: Evaluation, progress: Progress, stop: Callable[[], bool] = lambda: False
    ) -> bytes | None:
        """Return an mp4 of the best episode, or None if `video` is. Raises: Stopped; calls `stop` at every picture."""
        if self.video is None:
            return None

        def tell(drawn: int, pictures: int) -> None:
            if stop():
                raise Stopped
            progress.filming(drawn, pictures)

        return film_episode(evaluation.best, self.make_emulator(), self.video, tell)
