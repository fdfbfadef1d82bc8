"""Break down points a frame, and find where they are lost: `python -m benchmarks.pace`.

A shipped network plays one game by its card's protocol. A replay of it then looks at the screen before every decision:
how often a ship, a vessel or a bomber, flies in each lane, and how often there is none. Ships appear in the top lane
and come back a lane lower until they are hit.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from rich.console import Console

from atlantis_exp.training.film import moments
from atlantis_exp.training.progress import Progress
from benchmarks.contest import print_results
from benchmarks.evaluation import player

PAID = {"centre_vessel": 100, "side_vessel": 200, "centre_bomber": 1_000, "side_bomber": 2_000}
_LANES = (19, 40, 61, 82)  # the first row of each
_ROWS = 10  # of a ship
_SHOTS = 5  # pixels; a shot is one, the smallest ship twelve


def ships(screen: npt.NDArray[np.uint8]) -> list[bool]:
    """Return whether a ship flies in each lane, from the top, of a colour screen, (210, 160, 3)."""
    lanes = [screen[row : row + _ROWS].max(axis=-1).ravel() for row in _LANES]
    return [lane.size - int(np.bincount(lane).max()) > _SHOTS for lane in lanes]


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the game's figures in words and as a JSON line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.pace")
    parser.add_argument("--weights", default="pretrained/cnn_fast", help="a folder of exported weights")
    parser.add_argument("--epsilon", type=float, help="1: random play; by default the card's")
    parser.add_argument("--steps", type=int, default=27_000, help="most steps of the game")
    args = parser.parse_args(arguments)
    print(f"about {args.steps / 9_000:.0f} minutes", file=sys.stderr, flush=True)
    actor, evaluator = player(args.weights, 1, args.steps)
    evaluator = replace(evaluator, epsilon=evaluator.epsilon if args.epsilon is None else args.epsilon)
    (episode,) = evaluator(actor, 1, Progress(Console(quiet=True))).episodes
    emulator = evaluator.make_emulator()
    seen = np.array([ships(moment.screen) for moment in moments(episode, emulator)])
    points = dict(zip(emulator.game.sources, episode.points, strict=True))
    hits = sum(points[source] / paid for source, paid in PAID.items())
    results: dict[str, Any] = {
        "points_a_frame": episode.score / episode.frames,
        "bonus_a_frame": points["wave_bonus"] / episode.frames,
        "hits_a_thousand_frames": 1_000 * hits / episode.frames,
        "share_of_steps_in_lane": seen.mean(axis=0).tolist(),
        "share_of_steps_without_a_ship": float((~seen.any(axis=1)).mean()),
    }
    print(f"{args.weights} at epsilon {evaluator.epsilon:g}: {episode.steps:,} steps, {episode.frames:,} frames")
    print("{points_a_frame:.2f} points a frame, {bonus_a_frame:.2f} of them wave bonuses".format(**results))
    print("{hits_a_thousand_frames:.1f} hits a thousand frames".format(**results))
    lanes = ", ".join(f"{share:.1%}" for share in results["share_of_steps_in_lane"])
    print(f"a ship in the lanes, from the top: {lanes} of the steps")
    print("no ship at all: {share_of_steps_without_a_ship:.1%}".format(**results))
    print_results(results)


if __name__ == "__main__":
    main()
