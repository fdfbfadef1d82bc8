"""Break down points a frame, and find where they are lost: `python -m benchmarks.pace`.

A shipped network plays games by its card's protocol, or with `--oracle` a player that tries each action in a copy of
the emulator, then waits there, and fires as soon as a shot pays. A replay of the games then looks at the screen before
every decision: how often a ship, a vessel or a bomber, flies in each lane, and how often there is none. Ships appear in
the top lane and come back a lane lower until they are hit. A gap leads from a hit to the next one. The frames from a
ship to the next one of its wave are those that `python -m benchmarks.schedule` chooses from.
"""

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from ale_py import ALEInterface
from ale_py.roms import get_rom_path
from rich.console import Console

from atlantis_exp.game.emulator import Emulator
from atlantis_exp.game.vector import SerialEmulators
from atlantis_exp.training.actor import PersonActor
from atlantis_exp.training.progress import Progress
from benchmarks.contest import parser_of, print_results, print_table, run
from benchmarks.evaluation import player
from benchmarks.schedule import TICK

PAID = {"centre_vessel": 100, "side_vessel": 200, "centre_bomber": 1_000, "side_bomber": 2_000}
SHIPS_LEFT, BOMBERS_LEFT = 0x70, 0x75  # bytes of the console's memory
_LANES = (19, 40, 61, 82)  # the first row of each
_ROWS = 10  # of a ship
_SHOTS = 5  # pixels; a shot is one, the smallest ship twelve
_AHEAD = 16  # steps that the oracle waits for a shot, which flies for about ten
_SKIP = 4  # frames a step in its copy


class Watched(Emulator):
    """An emulator that shows the ships and bombers that are still to come in the wave."""

    def still_to_come(self) -> tuple[int, int]:
        memory = self._ale.getRAM()
        return int(memory[SHIPS_LEFT]), int(memory[BOMBERS_LEFT])


class Oracle(Watched):
    """An emulator and a greedy player of it, who tries each action in a copy without sticky actions."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._copy = ALEInterface()
        self._copy.setFloat("repeat_action_probability", 0.0)
        self._copy.setInt("frame_skip", _SKIP)
        self._copy.loadROM(cast(Path, get_rom_path(self.game.rom)))

    def choose(self, _screen: object) -> int:
        """Return the action that pays most if none follows it, NOOP if none pays."""
        now, paid = self._ale.cloneState(), []
        for action in self._actions:
            self._copy.restoreState(now)
            paid.append(sum(self._copy.act(each) for each in (action, *_AHEAD * self._actions[:1])))
        return int(np.argmax(paid))  # the first of equals


def ships(screen: npt.NDArray[np.uint8]) -> list[bool]:
    """Return whether a ship flies in each lane, from the top, of a colour screen, (210, 160, 3)."""
    lanes = [screen[row : row + _ROWS].max(axis=-1).ravel() for row in _LANES]
    return [lane.size - int(np.bincount(lane).max()) > _SHOTS for lane in lanes]


def gaps(frames: Sequence[int], points: Sequence[Sequence[float]]) -> dict[str, list[int]]:
    """Return the frames from each hit of a game to the next, by source, from each step's frames and points."""
    paid = np.array(points)[:, : len(PAID)] > 0
    struck = np.flatnonzero(paid.any(axis=1))
    between = np.diff(np.cumsum(frames)[struck])
    dearest = len(PAID) - 1 - paid[struck[:-1], ::-1].argmax(axis=1)  # of several hits in a step
    return {source: between[dearest == index].tolist() for index, source in enumerate(PAID)}


def spacings(frames: Sequence[int], to_come: Sequence[tuple[int, int]]) -> dict[str, dict[int, int]]:
    """Count the frames from each ship of a game to the next of its wave, by its kind.

    Takes each step's frames, and the wave's ships and bombers still to come after it. Ships come at ticks, which a
    step may pass by a few frames.
    """
    ticks, left = np.cumsum(frames) // TICK, np.array(to_come)
    fewer = -np.diff(left, axis=0, prepend=left[:1])
    found = {kind: Counter[int]() for kind in ("vessel", "bomber")}
    (came,) = np.nonzero(fewer[:, 0] == 1)
    for step, following in pairwise(came):
        if left[following, 0] < left[step, 0]:
            found["bomber" if fewer[step, 1] == 1 else "vessel"][TICK * int(ticks[following] - ticks[step])] += 1
    return {kind: dict(sorted(each.items())) for kind, each in found.items()}


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the games in words and as a JSON line."""
    parser = parser_of("pace", __doc__)
    parser.add_argument("--weights", default="pretrained/cnn_annealed", help="a folder of exported weights")
    parser.add_argument("--oracle", action="store_true", help="look ahead instead, in the game of the weights")
    parser.add_argument("--epsilon", type=float, help="1: random play; default: the card's; the oracle ignores it")
    parser.add_argument("--games", type=int, default=1)
    parser.add_argument("--steps", type=int, default=27_000, help="most steps of a game")
    args = parser.parse_args(arguments)
    print(f"about {args.games * args.steps / (900 if args.oracle else 9_000):.0f} minutes", file=sys.stderr, flush=True)
    actor, evaluator = player(args.weights, 1, args.steps)
    epsilon = evaluator.epsilon if args.epsilon is None else args.epsilon
    settings = cast("partial[Emulator]", evaluator.make_emulator).keywords
    emulator, emulators = Watched(**settings), None
    if args.oracle:
        emulator = oracle = Oracle(**settings)
        actor, emulators = PersonActor(oracle.screen_rgb, oracle.choose), SerialEmulators(lambda: oracle, 1)
    played = replace(evaluator, epsilon=epsilon)(actor, args.games, Progress(Console(quiet=True)), emulators=emulators)
    seen, between = [], {source: list[int]() for source in PAID}
    spaced = {kind: Counter[int]() for kind in ("vessel", "bomber")}
    for episode in played.episodes:
        emulator.reset(episode.seed)
        steps, to_come = [], []
        for action in episode.actions:
            seen.append(ships(emulator.screen_rgb()))
            steps.append(emulator.step(action))
            to_come.append(emulator.still_to_come())
        for source, lengths in gaps([step.frames for step in steps], [step.points for step in steps]).items():
            between[source] += lengths
        for kind, counts in spacings([step.frames for step in steps], to_come).items():
            spaced[kind].update(counts)
    table = played.table()
    frames, points = table.frames.sum(), dict(zip(table.sources, table.points.sum(axis=0), strict=True))
    hits = sum(points[source] / paid for source, paid in PAID.items())
    results: dict[str, Any] = {
        "scores": table.scores.tolist(),
        "frames": table.frames.tolist(),
        "points_a_frame": table.scores.sum() / frames,
        "bonus_a_frame": points["wave_bonus"] / frames,
        "hits_a_thousand_frames": 1_000 * hits / frames,
        "share_of_steps_in_lane": np.mean(seen, axis=0).tolist(),
        "share_of_steps_without_a_ship": float((~np.any(seen, axis=1)).mean()),
        "hits": {source: points[source] / paid for source, paid in PAID.items()},
        "frames_to_the_next_hit": {
            source: np.percentile(each, (25, 50, 75)).tolist() for source, each in between.items() if each
        },
        "frames_to_the_next_ship": {kind: dict(sorted(counts.items())) for kind, counts in spaced.items()},
    }
    who = "greedy look-ahead" if args.oracle else f"{args.weights} at epsilon {epsilon:g}"
    print(f"{who}: {table.steps.sum():,.0f} steps, {frames:,.0f} frames, a mean of {table.scores.mean():,.0f} points")
    print("{points_a_frame:.2f} points a frame, {bonus_a_frame:.2f} of them wave bonuses".format(**results))
    print("{hits_a_thousand_frames:.1f} hits a thousand frames".format(**results))
    lanes = ", ".join(f"{share:.1%}" for share in results["share_of_steps_in_lane"])
    print(f"a ship in the lanes, from the top: {lanes} of the steps")
    print("no ship at all: {share_of_steps_without_a_ship:.1%}".format(**results))
    quartiles = results["frames_to_the_next_hit"].items()
    rows = [(source, f"{results['hits'][source]:,.0f}", *(f"{each:,.0f}" for each in cut)) for source, cut in quartiles]
    print_table("frames from a hit to the next", ("", "hits", "a quarter below", "half", "three quarters"), rows)
    for kind, counts in results["frames_to_the_next_ship"].items():
        spread = ", ".join(f"{count:,} after {length}" for length, count in counts.items())
        print(f"ships after a {kind} of their wave, by frames: {spread or 'none'}")
    print_results(results)


if __name__ == "__main__":
    run(main)
