"""Bound the points that the ships of Atlantis allow: `python -m benchmarks.schedule`.

A ship comes only at a tick, every 32 frames, and only if the top lane is empty and no bomber explodes. To cross that
lane takes more than a tick, so the next ship comes two ticks later, or three if the first still explodes then. The bits
of a shift register say which ship comes, a bomber one time in four. No action touches the register, and it begins alike
in every game: the ships of all ticks are known beforehand, and a player chooses the ticks. The bounds assume that a
side gun hits each ship and no building is lost.
"""

import sys
from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from benchmarks.contest import parser_of, print_results, print_table, run

TICK, FIRST_TICK = 32, 24  # frames
_REGISTER = 0x6977  # before the first frame: 15 bits, 0xc6 and 0xc5 of the console's memory
_VESSEL, _BOMBER, _BONUS = 200, 2_000, 3_500  # points, of a hit by a side gun and a wave with all buildings standing
_SHIPS, _MORE_SHIPS = 10, 2  # of the first wave, and from wave to wave; wave n, from 0, has at most n bombers
_BREAK = 8  # ticks from a wave's last ship to the next one's first, as in most waves of a good player

Gaps = Mapping[bool, Sequence[int]]  # ticks that may lead from a ship to the next one of its wave, by "is a bomber"
PLAYERS: Mapping[str, Gaps] = {
    "each ship 64 frames after the last": {False: [2], True: [2]},
    "each 96 frames after a bomber, 64 after a vessel": {False: [2], True: [3]},
    "foresight, 64 or 96 frames after a bomber, 64 after a vessel": {False: [2], True: [2, 3]},
    "foresight, 64 or 96 frames after each": {False: [2, 3], True: [2, 3]},
}


def bombers(frames: int) -> npt.NDArray[np.bool_]:
    """Return whether the ship of each tick would be a bomber, in a game's first frames."""
    register, draws = _REGISTER, []
    for frame in range(frames):
        if frame % TICK == FIRST_TICK:
            draws.append(register >> 8 & 3 == 3)
        register = (register << 1 | (register >> 14 ^ register) & 1) & 0x7FFF
    return np.array(draws)


def most_points(draws: npt.NDArray[np.bool_], gaps: Gaps) -> float:
    """Return the points of a player who knows all draws and chooses the best gaps, by dynamic programming."""
    ticks, latest = len(draws), max(map(max, gaps.values()))
    waves, earliest = [], 0
    while earliest < ticks:
        waves.append(earliest)
        earliest += (_SHIPS + _MORE_SHIPS * (len(waves) - 1) - 1) * min(map(min, gaps.values())) + _BREAK
    after = np.zeros(ticks + _BREAK)  # points from each tick at which the next wave may begin
    for wave in reversed(range(len(waves))):
        # Points from a ship at each tick, by the wave's ships after it and the bombers left.
        points = np.zeros((ticks + latest, _SHIPS + _MORE_SHIPS * wave, wave + 1))
        for tick in reversed(range(waves[wave], ticks)):
            here = points[tick]
            here[0] = _VESSEL + _BONUS + after[tick + _BREAK]
            here[1:] = _VESSEL + np.maximum.reduce([points[tick + gap, :-1] for gap in gaps[False]])
            if draws[tick]:
                here[0, 1:] += _BOMBER - _VESSEL
                here[1:, 1:] = _BOMBER + np.maximum.reduce([points[tick + gap, :-1, :-1] for gap in gaps[True]])
        after[:ticks] = points[:ticks, -1, -1]
    return float(after[0])


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the bounds as a table and as a JSON line."""
    parser = parser_of("schedule", __doc__)
    parser.add_argument("--frames", type=int, default=108_000, help="of a game")
    args = parser.parse_args(arguments)
    print("about ten seconds", file=sys.stderr, flush=True)
    draws = bombers(args.frames)
    bounds = {player: most_points(draws, gaps) for player, gaps in PLAYERS.items()}
    rows = [(player, f"{points:,.0f}", f"{points / args.frames:.2f}") for player, points in bounds.items()]
    print_table(f"most points in {args.frames:,} frames", ("", "points", "a frame"), rows)
    print_results({"frames": args.frames, "most_points": bounds})


if __name__ == "__main__":
    run(main)
