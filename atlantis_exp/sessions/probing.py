"""Groups' networks asked themselves: about the same archived states, and where their games of one seed part."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, combinations, islice
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.stats import spearmanr

from atlantis_exp import terminal
from atlantis_exp.build import make_emulator
from atlantis_exp.comparison.comparing import Probed, slug
from atlantis_exp.comparison.gather import Training
from atlantis_exp.comparison.published import Row, Table
from atlantis_exp.comparison.verdict import scored
from atlantis_exp.components import facts_of
from atlantis_exp.config import EnvConfig
from atlantis_exp.faults import Fault
from atlantis_exp.game.archive import Archive, read_archive, rebuild
from atlantis_exp.game.preprocessing import Preprocessing
from atlantis_exp.media import film, scene
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.sessions.cards import build_exported_actor
from atlantis_exp.sessions.weights import stored_weights
from atlantis_exp.training.actor import EpsilonGreedy
from atlantis_exp.training.film import Moment, QValues, greedy_moments

SEED = 3_000_017  # of the game that all pairs play
MOST_STEPS = 2_000  # of that game, in which a pair parts or does not
BEFORE_SECONDS, FILM_SECONDS = 1, 20  # of game time: before the parting, and the whole film
_MOST_GROUPS = 4  # whose pairs are all asked
_BATCH = 16  # states
_GAME = ("frameskip", "sticky", "noop_max")  # settings that make another game of the same seed and actions

Values = npt.NDArray[np.float32]  # (states, actions)
Sides = tuple[Moment, Moment]
Tell = Callable[[str], None]


@dataclass(frozen=True)
class Network:
    """The network of a group's run."""

    group: str
    run: str
    env: EnvConfig
    q_values: QValues

    @property
    def mean_frameskip(self) -> float:
        """Frames a step, on average."""
        skip = self.env.frameskip
        return skip if isinstance(skip, int) else (skip[0] + skip[1] - 1) / 2


def probe_groups(outputs: Path, groups: Mapping[str, Sequence[Training]], baseline: str | None) -> Probed:
    """Ask one network of each group, that of its median run, and compare each with each other one.

    Of more than four groups each is compared with one only: the first that the baseline names, or the first. A network
    that cannot be asked is named in a note; everything else goes on.
    """
    said = deque([""], maxlen=1)
    with terminal.working("asking the networks", lambda: said[0]):
        return _probe_groups(outputs, groups, baseline, said.append)


def _probe_groups(outputs: Path, groups: Mapping[str, Sequence[Training]], baseline: str | None, tell: Tell) -> Probed:
    notes: list[str] = []
    archive = None
    if (game := next(iter(groups.values()))[0].game) is not None and game.data_path("states.npz").is_file():
        archive = read_archive(game.data_path("states.npz"))
    else:
        notes.append("There are no archived states of this game, so the networks were asked about none.")
    pairs = list(combinations(groups, 2))
    if len(groups) > _MOST_GROUPS:
        first = next((label for label in groups if baseline in (label, *label.split())), next(iter(groups)))
        pairs = [(first, label) for label in groups if label != first]
        notes.append(f"Of {len(groups)} groups, networks are compared with that of {first} only.")
    networks: dict[str, Network] = {}
    values: dict[str, Values] = {}
    for label in dict.fromkeys(chain.from_iterable(pairs)):
        run = median_run(groups[label])
        tell(f"reading the network of {run.name}")
        try:
            networks[label] = _network(label, RunFolder(outputs / "runs" / run.name))
            if archive is not None:
                values[label] = asked(networks[label], archive, tell)
        except (Fault, ValueError, OSError) as error:
            notes.append(f"The network of {label} was not asked about the archived states: {error}.")
    probes: Table = []
    partings: Table = []
    films: dict[str, bytes] = {}
    for one, other in pairs:
        if one in values and other in values:
            probes.append(probed(networks[one], networks[other], values[one], values[other]))
            notes.append(_in_words(probes[-1]))
        if one in networks and other in networks:
            row, content = part(networks[one], networks[other], tell)
            if content is not None:
                row["film"] = f"films/{len(films) + 1:02d}-{slug([one, other])}.mp4"
                films[row["film"]] = content
            partings.append(row)
            notes.append(_parting_in_words(row))
    about = f"{len(archive.frames)} archived states, SHA-256 {archive.sha256}" if archive else "no archived states"
    return Probed({"probes": probes, "partings": partings}, films, notes, {"networks asked about": about})


def median_run(runs: Sequence[Training]) -> Training:
    """The run of the median score; of two, the lower."""
    ordered = sorted(runs, key=lambda run: (scored(run), run.config["seed"], run.name))
    return ordered[(len(ordered) - 1) // 2]


def asked(network: Network, archive: Archive, tell: Tell = lambda _: None) -> Values:
    """A network's action values in the archived states, each as its own environment shows it.

    Where a step's frames are drawn, states are those of the mean frameskip, rounded down.

    Raises:
        ValueError: where the archive has too few frames of each state.
    """
    env, preprocessing = network.env, Preprocessing(network.env.size, network.env.crop)
    values = []
    for start in range(0, len(archive.frames), _BATCH):
        tell(f"{network.run}: {start} of {len(archive.frames)} archived states")
        states = [
            rebuild(frames, preprocessing, int(network.mean_frameskip), env.stack, env.max_pool)
            for frames in archive.frames[start : start + _BATCH]
        ]
        values.append(network.q_values(np.stack(states)))
    return np.concatenate(values)


def probed(one: Network, other: Network, values: Values, other_values: Values) -> Row:
    """How alike two networks judge the same states: actions, advantages, state values."""
    both = [values.astype(np.float64), other_values.astype(np.float64)]
    best, other_best = (each.argmax(axis=1) for each in both)
    shares = [np.bincount(chosen, minlength=values.shape[1]) / len(chosen) for chosen in (best, other_best)]
    equal = best == other_best
    clear = np.logical_and(*(_is_clear(each) for each in both))
    advantages = [_scaled(each - each.mean(axis=1, keepdims=True)) for each in both]
    highest = [each.max(axis=1) for each in both]
    varies = all(np.ptp(each) > 0 for each in highest)
    return {
        "group": one.group,
        "run": one.run,
        "other": other.group,
        "other_run": other.run,
        "states": len(values),
        "equal_actions": float(equal.mean()),
        "equal_by_chance": float(shares[0] @ shares[1]),
        "equal_where_clear": float(equal[clear].mean()) if clear.any() else float("nan"),
        "advantage_distance": float(np.abs(advantages[0] - advantages[1]).mean()),
        "state_value_correlation": float(spearmanr(highest[0], highest[1]).statistic) if varies else float("nan"),
    }


def _is_clear(values: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    second, first = np.sort(values, axis=1)[:, -2:].T
    is_clear: npt.NDArray[np.bool_] = first - second > np.median(first - second)
    return is_clear


def _scaled(advantages: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """In their own root mean squares; NaN where all of them are zero."""
    scale = np.sqrt(np.mean(advantages**2))
    return advantages / (scale or np.nan)


def part(one: Network, other: Network, tell: Tell = lambda _: None) -> tuple[Row, bytes | None]:
    """Where the games of two networks part that both begin with one seed, and the film of both from there.

    Both play their best actions only, so the games are equal until they choose different ones.
    """
    row: Row = {
        "group": one.group,
        "other": other.group,
        "seed": SEED,
        "outcome": "parted",
        **dict.fromkeys(("step", "frame", "score", "action", "other_action", "values", "other_values"), ""),
        **dict.fromkeys(("later_score", "other_later_score", "film"), ""),
    }
    if differing := [f"env.{key}" for key in _GAME if getattr(one.env, key) != getattr(other.env, key)]:
        row["outcome"] = f"cannot be told, since they play different games ({', '.join(differing)})"
        return row, None
    steps_a_second = 60 / one.mean_frameskip
    moments = enumerate(_side_by_side(one, other))
    seen: deque[tuple[int, Sides]] = deque(maxlen=1 + round(BEFORE_SECONDS * steps_a_second))
    for step, sides in islice(moments, MOST_STEPS):
        tell(f"{one.group} and {other.group}: equal games for {step:,} steps")
        seen.append((step, sides))
        actions = [side.action for side in sides]
        if None in actions:
            row["outcome"] = f"never, a game was over after {step:,} steps"
            return row, None
        if actions[0] != actions[1]:
            break
    else:
        row["outcome"] = f"never within {MOST_STEPS:,} steps"
        return row, None
    row |= {"step": step, "frame": sides[0].frame, "score": sides[0].score}
    names = facts_of(one.env.game).actions
    for prefix, side in zip(("", "other_"), sides, strict=True):
        assert side.action is not None
        assert side.q_values is not None
        row[f"{prefix}action"] = names[side.action]
        # In all their digits: what parts two games may be a near tie.
        row[f"{prefix}values"] = ", ".join(
            f"{action} {value!s}" for action, value in zip(names, side.q_values, strict=True)
        )
    filmed: list[tuple[int, Sides]] = []
    for now, sides in islice(chain(seen, moments), round(FILM_SECONDS * steps_a_second)):
        tell(f"{one.group} and {other.group}: they play on, step {now:,}")
        filmed.append((now, sides))
    row |= {"later_score": sides[0].score, "other_later_score": sides[1].score}
    return row, film(_pictures((one.group, other.group), names, filmed, step, tell), steps_a_second)


def _side_by_side(one: Network, other: Network) -> Iterator[Sides]:
    """Both games, step by step, until both are over; of one that is over first the last moment stays."""
    games = [greedy_moments(SEED, make_emulator(each.env)(), each.env.stack, each.q_values) for each in (one, other)]
    left, right = (next(game) for game in games)
    yield left, right
    while left.action is not None or right.action is not None:
        left, right = next(games[0], left), next(games[1], right)
        yield left, right


def _pictures(
    groups: tuple[str, str], names: Sequence[str], filmed: Sequence[tuple[int, Sides]], parted: int, tell: Tell
) -> Iterator[npt.NDArray[np.uint8]]:
    """The scenes of both games, side by side."""
    for step, sides in filmed:
        tell(f"{groups[0]} and {groups[1]}: film, step {step:,}")
        halves = []
        for group, side in zip(groups, sides, strict=True):
            since = f"parted at {parted:,}" if step >= parted else "equal so far"
            lines = (group[:24], f"step {step:,}", f"score {side.score:,.0f}", since)
            halves.append(scene(side.screen, lines, "network", names, side.action, side.q_values))
        yield np.hstack(halves)


def _network(label: str, run: RunFolder) -> Network:
    """Raises: Fault, OSError."""
    config = run.trained_config
    weights, _ = stored_weights(run, "latest")
    # In float32 on one thread of the CPU, since rounding depends on how a batch is cut, and near ties on rounding.
    actor = build_exported_actor(config, weights, "cpu")
    assert isinstance(actor, EpsilonGreedy)
    return Network(label, run.name, config.env, actor.q_values)


def _in_words(row: Row) -> str:
    return (
        f"{row['group']} and {row['other']} choose the same action in {row['equal_actions']:.0%} of {row['states']} "
        f"archived states, where chance alone would make it {row['equal_by_chance']:.0%}."
    )


def _parting_in_words(row: Row) -> str:
    where = row["outcome"]
    if row["film"]:
        where = (
            f"at step {row['step']:,} with {row['score']:,.0f} points, by {row['action']} and {row['other_action']}; "
            f"where the film ends they have {row['later_score']:,.0f} and {row['other_later_score']:,.0f}"
        )
    return f"Where the games of {row['group']} and {row['other']} part: {where}."
