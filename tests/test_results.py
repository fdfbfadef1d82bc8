"""The runs that docs/results.md answers from."""

import csv
import itertools
import re
import runpy
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from atlantis_exp.comparison.decision import mean_interval
from atlantis_exp.comparison.published import curves
from atlantis_exp.components import game_of
from atlantis_exp.config import Config
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.folder import RunFolder, all_runs, evaluation_at
from atlantis_exp.runs.journal import Metrics, Tags
from atlantis_exp.sessions.cards import Card, read_card, side_by_side
from atlantis_exp.statistics import interquartile_mean
from benchmarks import pace

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"
RESULTS = DOCS / "results.md"
PAGES = dict.fromkeys(("verdict", "longer", "rewards", "standard"), RESULTS) | {
    "reproduction": DOCS / "reproduction.md"
}
SOURCES = (*pace.PAID, "wave_bonus")  # of points
GUNS_AND_SHIPS = tuple(itertools.product(("centre", "side"), ("vessel", "bomber")))
KEPT = [(run, folder) for folder in PAGES for run in all_runs(DOCS / folder)]


def evaluated(run: RunFolder) -> EpisodeTable:
    """The evaluation at a kept run's end."""
    assert run.result is not None
    return EpisodeTable.read(run.artifact(evaluation_at(run.result.steps)), SOURCES)


def of_the_verdict(sampler: str, model: str = "cnn", precision: str = "fp32") -> dict[int, RunFolder]:
    """A network's trainings with a sampler, by seed."""
    runs = [run for run, folder in KEPT if folder == "verdict" and run.name.startswith(f"{model}-{sampler}-")]
    configs = [(run, run.trained_config) for run in runs]
    return {config.seed: run for run, config in configs if config.training.precision == precision}


def metrics_of(run: RunFolder, name: str) -> list[float]:
    """A metric's values over a training."""
    records = (record.values for record in run.records() if isinstance(record, Metrics))
    return [values[name] for values in records if name in values]


def ends_of(run: RunFolder) -> list[tuple[int, int]]:
    """At which step each game of a training ended, and its length in steps."""
    with run.artifact("episodes.csv").open() as file:
        return [(int(row["step"]), int(row["length"])) for row in csv.DictReader(file)]


def mean_and_iqm(games: EpisodeTable) -> str:
    """The scores as the tables show them."""
    return f"{games.scores.mean():,.0f} ({interquartile_mean(games.scores):,.0f})"


def listed(words: Sequence[str]) -> str:
    """Words as a sentence lists them."""
    return f"{', '.join(words[:-1])} and {words[-1]}"


def of_the_reports_protocol(model: str) -> list[RunFolder]:
    """A network's trainings by a hundredth of the report's protocol."""
    return [run for run, folder in KEPT if folder == "reproduction" and run.name.startswith(f"{model}-")]


def section_of(heading: str) -> str:
    """What the page has under a heading, up to the next one."""
    return RESULTS.read_text().partition(f"# {heading}\n")[2].partition("\n#")[0]


def of_the_fields_game() -> dict[int, RunFolder]:
    """The kept trainings in the field's game, by seed."""
    return {run.trained_config.seed: run for run, folder in KEPT if folder == "standard"}


def games_of_the_fields_game() -> list[EpisodeTable]:
    """The games of its three seeds; of the second no folder is kept."""
    runs = of_the_fields_game()
    assert runs.keys() == {0, 2}
    return [evaluated(runs[0]), EpisodeTable.read(DOCS / "standard" / "seed_1.csv", SOURCES), evaluated(runs[2])]


def training_at(run: RunFolder, step: int, table: str = "standard") -> tuple[float, float]:
    """The hours until a step and the mean of 20 there, as the page's picture has them."""
    with (DOCS / "data" / f"{table}.csv").open() as file:
        row = next(row for row in csv.DictReader(file) if row["run"] == run.name and int(row["step"]) == step)
    return float(row["hours"]), float(row["mean_20"])


def test_there_are_kept_runs() -> None:
    assert KEPT


@pytest.mark.parametrize(("run", "folder"), KEPT, ids=lambda each: each if isinstance(each, str) else each.name)
def test_a_kept_run_is_still_the_run_of_its_config_and_in_the_table_of_its_page(run: RunFolder, folder: str) -> None:
    assert run.trained_config.run_name() == run.name  # else `decide` would train it again
    scores = evaluated(run).scores
    assert len(scores) == 100
    row = rf"^\| {run.trained_config.seed} \|.* {scores.mean():,.0f} \({interquartile_mean(scores):,.0f}\) \|"
    assert re.search(row, PAGES[folder].read_text(), re.MULTILINE)


def test_how_long_the_trainings_by_the_reports_protocol_took_is_said_as_they_say_it() -> None:
    runs = [run for run, folder in KEPT if folder == "reproduction"]
    for run in runs:
        assert run.result is not None
        counts = run.result.counts
        cells = (
            f"{run.result.steps:,} | {counts['updates']:,.0f} | {counts['hours']:.2f} | {mean_and_iqm(evaluated(run))}"
        )
        assert f"| {run.trained_config.seed} | {cells} |" in PAGES["reproduction"].read_text()
    assert len(runs) == 4


def test_how_far_apart_the_seeds_of_the_reports_protocol_are_is_said_as_their_scores_say_it() -> None:
    page = " ".join(PAGES["reproduction"].read_text().split())
    scores = [evaluated(run).scores.mean() for run in of_the_reports_protocol("cnn")]
    low, high = mean_interval(scores)
    assert f"the 95 % interval of their mean, {np.mean(scores):,.0f}, is {low:,.0f} to {high:,.0f}" in page
    apart = f"{min(scores):,.0f} to {max(scores):,.0f}, with a standard deviation of {np.std(scores, ddof=1):,.0f}"
    assert apart in page


def test_what_resnet_dqn_does_by_the_reports_protocol_is_said_as_its_run_says_it() -> None:
    readme, page = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", PAGES["reproduction"]))
    (run,) = of_the_reports_protocol("resnet")
    assert run.result is not None
    played, mean = run.result.evaluation, evaluated(run).scores.mean()
    others = [evaluated(other).scores.mean() for other in of_the_reports_protocol("cnn")]
    assert mean < min(others)
    assert run.result.counts["episodes"] == 200
    earlier = EpisodeTable.read(run.artifact(evaluation_at(303_000)), SOURCES).scores
    ended = sum(step <= 303_000 for step, _ in ends_of(run))
    random = runpy.run_path(str(DOCS / "tables.py"))["RANDOM"]
    for sentence in (
        f"After {ended} episodes and 303,000 steps it had {earlier.mean():,.0f}",
        f"this one has {mean:,.0f} points, {100 * mean / random:.0f} % of the random player's",
        f"chooses NOOP in {100 * played['actions/favourite_share']:.1f} % of its decisions",
        f"Of the points {played['evaluation/score_wave_bonus']:,.0f} are wave bonuses",
        f"the last 20 episodes have a mean of {metrics_of(run, 'score/mean_20')[-1]:,.0f}",
    ):
        assert sentence in page
    firing = sum(played[f"actions/{action}"] for action in ("FIRE", "RIGHTFIRE", "LEFTFIRE"))
    assert 3 / 4 * played["actions/random_share"] / firing == pytest.approx(1, abs=0.01)  # three of four actions fire
    assert "so that its shots are random ones" in page
    assert f"trainings of DQNCnn have {listed([f'{other:,.0f}' for other in others])} points" in readme
    assert f"collapsed to NOOP, {mean:,.0f}; a random player has {random:,}" in readme


def test_survival_and_rate_of_the_longer_trainings_are_said_as_their_games_say_them() -> None:
    longer = [evaluated(run) for run, folder in KEPT if folder == "longer"]
    assert longer
    for games in (*longer, *games_of_the_fields_game()):
        rate, capped = games.scores.sum() / games.frames.sum(), int(games.truncated.sum())
        mean = mean_and_iqm(games)
        cells = f"| {capped} of {len(games.scores)} | {rate:.2f} | {games.scores.min():,.0f} | {mean} |"
        assert cells in RESULTS.read_text()


def hits_of(games: EpisodeTable) -> tuple[dict[str, float], float]:
    """How often each source of points was hit, and what a hit pays on average."""
    paid = games.points.sum(axis=0)[:-1]  # all but wave bonuses
    hits = dict(zip(pace.PAID, np.divide(paid, [*pace.PAID.values()]), strict=True))
    return hits, paid.sum() / sum(hits.values())


def pace_of(games: EpisodeTable) -> tuple[float, ...]:
    """The columns of the table of rewards: three rates, points a hit, steps a game, points a game."""
    hits, paid = hits_of(games)
    every, frames = sum(hits.values()), games.frames.sum()
    by_side = 100 * (hits["side_vessel"] + hits["side_bomber"]) / every
    rates = games.scores.sum() / frames, 1_000 * every / frames, by_side
    return (*rates, paid, games.steps.mean(), games.scores.mean())


def test_by_which_guns_seeds_of_the_fields_game_differ_is_said_as_their_games_say_it() -> None:
    for seed, played in enumerate(games_of_the_fields_game()):
        hits, paid = hits_of(played)
        frames, bombers = played.frames.sum() / 1_000, hits["centre_bomber"] + hits["side_bomber"]
        cells = f"{sum(hits.values()) / frames:.1f} | {bombers / frames:.1f} | {hits['side_bomber'] / bombers:.0%}"
        assert f"| {seed} | {cells.replace('%', ' %')} | {paid:.0f} |" in RESULTS.read_text()


def test_the_pace_of_trainings_with_other_rewards_is_said_as_their_games_say_it() -> None:
    cells = "| {:.2f} | {:.1f} | {:.0f} % | {:.0f} | {:,.0f} | {:,.0f} ("
    others = [run for run, folder in KEPT if folder == "rewards"]
    assert others
    for run in others:
        assert cells.format(*pace_of(evaluated(run))) in RESULTS.read_text()
    ten = [evaluated(run) for run in of_the_verdict("uniform").values()]
    assert len(ten) == 10
    ranges = "| {:.2f} to {:.2f} | {:.1f} to {:.1f} | {:.0f} to {:.0f} % | {:.0f} to {:.0f} | {:,.0f} to {:,.0f} |"
    for clipped in (ten, games_of_the_fields_game()):
        paces = np.array([pace_of(games) for games in clipped])
        low_and_high = np.stack((paces.min(axis=0), paces.max(axis=0)), axis=1)
        row = ranges.format(*low_and_high[:5].ravel()).replace("27,000 to 27,000", "27,000")
        assert row in RESULTS.read_text()
    in_the_reports_game = [evaluated(run) for run in others if run.trained_config.env.id == "Atlantis-v0"]
    assert len(in_the_reports_game) == 3
    assert max(games.scores.mean() for games in in_the_reports_game) < min(games.scores.mean() for games in ten)


def to_a_power(folder: str) -> list[tuple[RunFolder, Config]]:
    """The kept trainings in the field's game from rewards to a power, by seed."""
    configs = [(run, run.trained_config) for run, of in KEPT if of == folder]
    there = [(run, config) for run, config in configs if config.env.id == "ALE/Atlantis-v5"]
    of_a_power = [(run, config) for run, config in there if config.objective.reward_exponent < 1]
    return sorted(of_a_power, key=lambda each: each[1].seed)


def with_a_discount(gamma: float) -> list[RunFolder]:
    """Those of five million frames, with a discount."""
    return [run for run, config in to_a_power("rewards") if config.objective.gamma == gamma]


def test_what_rewards_to_a_power_score_is_said_as_their_games_say_it() -> None:
    runs = with_a_discount(0.99)
    assert [run.trained_config.seed for run in runs] == [0, 1, 2]
    assert {run.trained_config.objective.reward_exponent for run in runs} == {0.25}
    drawn = [training_at(run, 1_250_000, "rewards")[0] for run in runs]
    assert drawn == pytest.approx([metrics_of(run, "throughput/hours")[-1] for run in runs])
    played = [evaluated(run) for run in runs]
    assert all(games.truncated.all() for games in played)
    scores = np.concatenate([games.scores for games in played])
    means = listed([f"{games.scores.mean():,.0f}" for games in played])
    minutes = listed([f"{60 * metrics_of(run, 'throughput/hours')[-1]:.0f}" for run in runs])
    commands = listed([f"{60 * run.result.counts['hours']:.0f}" for run in runs if run.result is not None])
    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    capped = f"all of three hundred games at the cap**, {scores.min():,.0f} to {scores.max():,.0f}"
    assert f"**{means} points, {capped}, after {minutes} minutes on two cores" in results
    assert f"with their games the commands took {commands}." in results
    assert f"have **{means}**" in readme
    assert f"have **{means}**" in results
    shares, clipped = (
        [100 * hits["side_bomber"] / (hits["centre_bomber"] + hits["side_bomber"]) for hits, _ in map(hits_of, tables)]
        for tables in (played, games_of_the_fields_game())
    )
    percent = [listed([f"{share:.0f}" for share in each]) for each in (shares, clipped)]
    assert f"which shoot {percent[0]} % of the bombers it hits and most of the vessels, too" in results
    assert all(hits["side_vessel"] > hits["centre_vessel"] for hits, _ in map(hits_of, played))
    assert f"that is luck, {percent[1]} % of the bombers" in results
    here, there = ([games.scores.mean() for games in tables] for tables in (played, games_of_the_fields_game()))
    assert min(here) < max(there)
    means_of_both = f"have a mean of {np.mean(here):,.0f}, those with rewards of at most 1 one of {np.mean(there):,.0f}"
    assert means_of_both in results
    assert f"here the seeds are {np.ptp(here):,.0f} apart" in results
    assert round(np.ptp(there), -4) == 160_000
    assert "which gun a seed prefers is worth 160,000 points" in results

    with (DOCS / "data" / "standard.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["step"] == "1000000" and row["evaluation"]]
    halfway = {row["run"].split("-")[2]: f"{float(row['evaluation']):,.0f}" for row in rows}
    halfway_here = [EpisodeTable.read(run.artifact(evaluation_at(1_000_000))).scores.mean() for run in runs]
    early = listed([f"{mean:,.0f}" for mean in halfway_here])
    three = "{s0}, {s1} and {s2}".format(**halfway)
    assert f"five games average {early}, where the three have {three}: it learns no sooner" in results
    third = of_the_fields_game()[2]
    assert (
        f"had {halfway['s2']} in five games after a million steps and {training_at(third, 1_000_000)[0]:.2f}" in results
    )


def test_what_a_longer_discount_scores_is_said_as_its_games_say_it() -> None:
    (run,) = with_a_discount(0.997)
    assert run.trained_config.objective.reward_exponent == 0.25
    here, others = pace_of(evaluated(run)), [pace_of(evaluated(other)) for other in with_a_discount(0.99)]
    assert evaluated(run).truncated.all()
    assert here[-1] < min(other[-1] for other in others)
    hits = [other[1] for other in others]
    minutes = 60 * metrics_of(run, "throughput/hours")[-1]
    text = " ".join(RESULTS.read_text().split())
    assert f"{here[-1]:,.0f} points, all of a hundred games at the cap, after {minutes:.0f} minutes;" in text
    assert f"the lowest of the three with .99 has {min(other[-1] for other in others):,.0f}." in text
    assert f"{here[1]:.1f} against {min(hits):.1f} to {max(hits):.1f} times a thousand frames" in text


def interval_next_to(card: Card, games: EpisodeTable) -> str:
    """The interval of games' mean as `evaluate` shows it next to a card."""
    _, here = side_by_side(card, card.evaluation, games.scores.tolist()).columns[2].cells
    return str(here)


def test_what_four_million_steps_bring_is_said_as_their_games_say_it() -> None:
    (run,) = [run for run, config in to_a_power("longer") if config.training.weights is None]
    means = {(row["name"], row["frames"]): row["mean"] for row in curves(game_of("Atlantis-v0"))}
    steps = sorted(int(path.stem) for path in run.artifact("evaluation").glob("*.csv"))
    assert steps[-1] == 4_000_000
    for step in steps:
        games = EpisodeTable.read(run.artifact(evaluation_at(step)), SOURCES)
        rate, hits, side, *_, mean = pace_of(games)
        hours, _ = training_at(run, step, "million")
        published = [means.get((name, 4.0 * step)) for name in ("DreamerV3", "QR-DQN Impala ResNet")]
        cells = (
            *(f" {step / 250_000:g} ", f" {hours:.2f} ", f" {rate:.2f} ", f" {hits:.1f} ", f" {side:.0f} % "),
            *(f" {mean:,.0f} ", f" {len(games.scores)} "),
            *(" " if score is None else f" {score:,.0f} " for score in published),
        )
        assert f"|{'|'.join(cells)}|" in RESULTS.read_text()

    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    capped = games.truncated.astype(bool)
    assert (
        f"The last hundred games have {mean:,.0f} points: {capped.sum()} reach the cap, with "
        f"{games.scores[capped].mean():,.0f} on average"
    ) in results
    early = np.sort(games.steps[~capped])[:-1]
    assert f"and {len(early)} of the others are over within their first {early.max():,.0f} steps" in results
    ended = ends_of(run)
    num_envs, cap = run.trained_config.env.num_envs, games.steps.max()
    lost = [length for step, length in ended if step - num_envs * length >= 2_600_000 and length < cap]
    began = np.array([step for step, _ in ended if step > 2_600_000])  # where one ends the next one begins
    late, before = (began > 3_900_000).sum(), (began < 3_900_000).sum()
    assert len(lost) == 3
    assert (
        f"Of the {late} games that began in the last 100,000 steps three were lost within {max(lost)} steps, of the "
        f"{before} before them none."
    ) in results
    card, _ = read_card(REPOSITORY / "pretrained" / "cnn_standard")
    hours, _ = training_at(run, card.step, "million")
    calm = EpisodeTable.read(DOCS / "longer" / "epsilon_0.001.csv", SOURCES)
    for text in (readme, results):
        assert f"after {hours:.1f} hours on two cores" in text
        assert f"**{calm.scores.mean():,.0f}**" in text
    low, high, rate = calm.scores.min(), calm.scores.max(), calm.scores.sum() / calm.frames.sum()
    assert f"has **{calm.scores.mean():,.0f}**, {low:,.0f} to {high:,.0f}, {rate:.2f} points a frame" in results
    assert f"The 95 % interval of this mean, {interval_next_to(card, calm)}, holds a million;" in results
    assert f"{(calm.scores > 1_000_000).sum()} of the games pass it." in results
    assert f"costs {1 - np.mean(card.scores) / calm.scores.mean():.0%}." in results.replace(" %", "%")
    landed, _ = hits_of(calm)
    sideways = sum(landed[f"{gun}_{ship}"] * pace.PAID[f"side_{ship}"] for gun, ship in GUNS_AND_SHIPS)
    most = (sideways + calm.points[:, -1].sum()) / calm.frames.sum()
    assert f"were all of its hits by side guns, it would have {most:.1f}." in results


def test_what_a_falling_learning_rate_brings_is_said_as_its_games_say_it() -> None:
    ((run, config),) = [each for each in to_a_power("longer") if each[1].training.weights is not None]
    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    games = evaluated(run)
    assert config.lr_schedule.name == "linear"
    assert config.replay.capacity == config.budget.steps
    before, _ = read_card(REPOSITORY / "pretrained" / "cnn_standard")
    assert config.training.weights == f"pretrained/cnn_standard@{before.sha256[:16]}"
    card, _ = read_card(REPOSITORY / "pretrained" / "cnn_annealed")
    assert (card.run, card.step) == (run.name, config.budget.steps)
    assert f"weights={card.weights} to=pretrained/cnn_annealed" in results
    assert f"with {before.reached['hours']:.1f} and {card.reached['hours']:.1f} hours of training" in results
    _, hits, side, *_ = pace_of(games)
    assert f"stays what it was**, {hits:.1f} a thousand frames, {side:.0f} % by side guns" in results
    hours = metrics_of(run, "throughput/hours")[-1]
    assert f"| 0 | bf16, Xeon with AMX | {hours:.2f} | {games.truncated.sum():.0f} of {len(games.scores)} |" in results
    ended, cap, num_envs = ends_of(run), int(games.steps.max()), config.env.num_envs
    lost = [(step - num_envs * length, length) for step, length in ended if length < cap]
    assert [began for began, _ in lost] == pytest.approx([num_envs * cap] * 2, abs=num_envs)
    later = sum(step > num_envs * cap for step, _ in ended)  # where one ends the next one begins
    assert (
        f"two of the {num_envs} games that began at step {num_envs * cap:,} were over within "
        f"{max(length for _, length in lost):,} steps, and of the {later} that began after these none."
    ) in results

    calm = EpisodeTable.read(DOCS / "longer" / "annealed_epsilon_0.001.csv", SOURCES)
    mean, rate = calm.scores.mean(), calm.scores.sum() / calm.frames.sum()
    assert calm.truncated.all()
    assert len(calm.scores) == 100
    for text in (readme, results):
        assert f"**{mean:,.0f}**" in text
        assert f" {np.mean(card.scores):,.0f} over {len(card.scores)}" in text
    here = interval_next_to(card, calm)
    span = f"{calm.scores.min():,.0f} to {calm.scores.max():,.0f}"
    assert f"**{mean:,.0f}** over 100 games (95 % interval {here}), {span}, {rate:.2f} points a frame" in results
    assert f"{(calm.scores > 1_000_000).sum()} of them pass a million" in results


def test_the_three_networks_in_bfloat16_are_set_side_by_side_as_their_runs_are() -> None:
    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    teraflops: dict[str, float] = {}
    habits: dict[str, list[tuple[float, float, float]]] = {}  # a seed: NOOP and side guns in percent, hits
    played: dict[str, list[EpisodeTable]] = {}
    for model, network in (("cnn", "DQNCnn"), ("resnet_fast", "ResNetFast"), ("resnet", "ResNetDQN")):
        for seed, run in of_the_verdict("uniform", model, "bf16").items():
            assert run.result is not None
            tags = [record.values for record in run.records() if isinstance(record, Tags)]
            (flops,) = (float(values["flops_per_update"]) for values in tags if "flops_per_update" in values)
            counts, config, games = run.result.counts, run.trained_config, evaluated(run)
            teraflops[network] = flops * counts["updates"] / 1e12
            rate, hits, side, *_ = pace_of(games)
            assert (
                f"| {seed} | {network} | {config.threads} | {counts['hours']:.2f} | {teraflops[network]:,.0f} | "
                f"{rate:.2f} | {games.steps.mean():,.0f} | {mean_and_iqm(games)} |"
            ) in results
            chosen = games.counts[..., 0].sum(axis=0)
            wait = 100 * chosen[games.actions.index("NOOP")] / chosen.sum()
            habits.setdefault(network, []).append((wait, side, hits))
            played.setdefault(network, []).append(games)
    ten = [
        [evaluated(run).scores.mean() for run in of_the_verdict("uniform", model).values()]
        for model in ("cnn", "resnet_fast")
    ]
    (low, high), (least, most) = ((f"{min(scores):,.0f}", f"{max(scores):,.0f}") for scores in ten)
    assert f"trainings of DQNCnn have {low} to {high}, ten of ResNetFast {least} to {most}." in results
    assert f"those of DQNCnn lie between {low} and {high}, those of ResNetFast between {least} and {most}:" in results
    means = {network: [games.scores.mean() for games in each] for network, each in played.items()}
    within, below, between = means["ResNetDQN"]
    assert all(min(scores) < within < max(scores) and below < min(scores) for scores in ten)
    assert min(ten[1]) < between < min(ten[0])
    assert means["DQNCnn"][1] < min(ten[0])
    pairs = [*zip(played["ResNetDQN"], played["DQNCnn"], strict=False)]  # of equal seeds
    assert all(residual.scores.mean() < plain.scores.mean() for residual, plain in pairs)
    all_of, same = (listed([f"{mean:,.0f}" for mean in means[network]]) for network in ("ResNetDQN", "DQNCnn"))
    assert f"ResNetDQN has {all_of} points" in readme
    assert f"DQNCnn, which has {same} with the first two seeds;" in readme
    assert f"ResNetFast has {means['ResNetFast'][0]:,.0f} with the first one" in readme
    assert f"ResNetDQN scores {all_of} by the recipe" in results
    assert f"which has {same} with the first two seeds." in results
    scores = np.concatenate([games.scores for games in played["ResNetDQN"]])
    assert f"they differ more; of all three they have {scores.min():,.0f} to {scores.max():,.0f} points" in results
    for residual, plain in pairs:
        assert residual.scores.std() > plain.scores.std()
        assert residual.steps.mean() == pytest.approx(plain.steps.mean(), rel=0.1)  # about as long
    wait, side, hits = habits["DQNCnn"][0]
    waits, sides, frequent = zip(*habits["ResNetDQN"], strict=True)
    assert (
        f"NOOP in {listed([f'{each:.0f} %' for each in waits])} of the network's decisions where DQNCnn's seed 0 has "
        f"{wait:.0f} %. Of its hits {listed([f'{each:.0f} %' for each in sides])} are by the side guns, which pay "
        f"double (DQNCnn: {side:.0f} %), but it has {listed([f'{each:.1f}' for each in frequent])} of them a thousand "
        f"frames (DQNCnn: {hits:.1f}), and so"
    ) in results
    more = f"{teraflops['ResNetDQN'] / teraflops['DQNCnn']:.1f} times the arithmetic of DQNCnn"
    assert more in readme
    assert results.count(more) == 2
    assert f"a sample takes {flops / config.training.batch_size / 1e9:.2f} GFLOP of an update" in results


def test_what_the_exported_resnet_has_in_either_precision_is_said_as_its_games_say_it() -> None:
    card, _ = read_card(REPOSITORY / "pretrained" / "resnet")
    exact, rounded = np.mean(card.scores), EpisodeTable.read(DOCS / "data" / "resnet_in_bfloat16.csv").scores.mean()
    results = " ".join(RESULTS.read_text().split())
    assert f"as exported weights are, they have {exact:,.0f} points" in results
    assert f"the run's own network has {rounded:,.0f} with the same random streams" in results
    assert f"{exact:,.0f} points in float32. In bfloat16, in which it learned, it has {rounded:,.0f}:" in " ".join(
        (REPOSITORY / "CHANGELOG.md").read_text().split()
    )


@pytest.mark.parametrize("model", ["cnn", "resnet_fast"])
def test_what_top_half_scores_is_said_as_its_games_say_it(model: str) -> None:
    uniform, top_half = (
        {seed: interquartile_mean(evaluated(run).scores) for seed, run in of_the_verdict(sampler, model).items()}
        for sampler in ("uniform", "top_half")
    )
    top, same, ten = [*top_half.values()], [uniform[seed] for seed in top_half], [*uniform.values()]
    assert (len(top), len(ten)) == (5, 10)
    said = (
        f"average {np.mean(top):,.0f} points, {min(top):,.0f} to {max(top):,.0f}; the same seeds of uniform sampling "
        f"average {np.mean(same):,.0f}, and all its ten {np.mean(ten):,.0f}"
    )
    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    assert said in results
    for text in (readme, results):
        assert f"average {np.mean(top):,.0f} points with it and {np.mean(same):,.0f} without" in text


def test_what_resnet_fast_scores_with_either_sampler_is_said_as_its_games_say_it() -> None:
    with (DOCS / "data" / "top_half_on_a_gpu.csv").open() as file:
        printed = list(csv.DictReader(file))
    rows = [row for row in printed if row["kind"] == "evaluation" and row["step"] == "1000000"]
    on_gpu = {int(row["seed"]): f"{int(row['mean']):,} ({int(row['interquartile_mean']):,})" for row in rows}
    uniform, top_half = (
        {seed: mean_and_iqm(evaluated(run)) for seed, run in of_the_verdict(sampler, "resnet_fast").items()}
        for sampler in ("uniform", "top_half")
    )
    assert on_gpu
    assert top_half
    for seed in on_gpu.keys() | top_half.keys():
        row = f"| {seed} | {uniform[seed]} | {top_half.get(seed, '-')} | {on_gpu.get(seed, '-')} |"
        assert row in RESULTS.read_text()
    run = of_the_verdict("top_half", "resnet_fast")[4]
    (there,) = (float(row["mean"]) for row in rows if row["seed"] == "4")
    assert f"yet the two differ by {evaluated(run).scores.mean() - there:,.0f} points" in RESULTS.read_text()
    begun = [float(row["mean"]) for row in printed if row["kind"] == "training" and row["seed"] == "4"][:3]
    assert set(begun) <= {*metrics_of(run, "score/mean_20")}


def test_published_curves_are_quoted_as_they_are() -> None:
    text = " ".join(RESULTS.read_text().split())
    means = {(row["name"], row["frames"]): row["mean"] for row in curves(game_of("Atlantis-v0"))}
    for name, words in (
        ("DreamerV3", "DreamerV3"),
        ("QR-DQN Impala ResNet", "QR-DQN with Impala's residual network"),
        ("QR-DQN Nature CNN", "QR-DQN with the Nature network"),
    ):
        assert f"{words} {means[name, 4e6]:,.0f} and {means[name, 5e6]:,.0f}" in text


def test_the_fields_game_is_set_against_the_published_curves_as_both_are() -> None:
    means = {(row["name"], row["frames"]): row["mean"] for row in curves(game_of("Atlantis-v0"))}
    run = of_the_fields_game()[0]
    evaluated_at = {2: evaluation_at(500_000), 4: evaluation_at(1_000_000), 5: evaluation_at(1_250_000)}
    for millions in range(2, 6):
        hours, training = training_at(run, 250_000 * millions)
        games = evaluated_at.get(millions)
        evaluation = f"{EpisodeTable.read(run.artifact(games)).scores.mean():,.0f} " if games else ""
        published = " | ".join(
            f"{means[name, 1e6 * millions]:,.0f}" for name in ("DreamerV3", "QR-DQN Impala ResNet", "QR-DQN Nature CNN")
        )
        row = f"| {millions} | {hours:.2f} | {training:,.0f} | {evaluation}| {published} |"
        assert row in RESULTS.read_text()


def test_what_the_fields_game_scores_is_said_as_card_and_games_say_it() -> None:
    card, _ = read_card(REPOSITORY / "pretrained" / "cnn_standard")
    means = [games.scores.mean() for games in games_of_the_fields_game()]
    minutes = [60 * training_at(run, 1_250_000)[0] for _, run in sorted(of_the_fields_game().items())]
    readme, results = (
        " ".join(page.read_text().replace("*", "").split()) for page in (REPOSITORY / "README.md", RESULTS)
    )
    for text in (readme, results):
        assert "have {:,.0f}, {:,.0f} and {:,.0f} points after five million frames".format(*means) in text
        assert "{:.0f} minutes on one core or {:.0f} on two".format(*minutes) in text
        assert f"{np.mean(card.scores):,.0f}" in text
    assert f" {np.mean(card.scores):,.0f} over {len(card.scores)}," in readme
    scores = (REPOSITORY / "pretrained" / "cnn_standard" / "README.md").read_text()
    (interval,) = re.findall(rf"^\| {np.mean(card.scores):,.0f} \| (\S+ to \S+) \|", scores, re.MULTILINE)
    assert f"95 % interval {interval}, the lowest {min(card.scores):,.0f}." in results


def test_what_is_kept_compares_as_it_did_and_names_no_place(
    recorded: Callable[..., Path], command: Callable[..., int], tmp_path: Path
) -> None:
    for seed in range(5):
        for model, score in (("cnn", 1_000.0), ("resnet", 9_000.0)):
            recorded(f"model={model}", f"seed={seed}", scores=(score + seed, score + 3 * seed))
    for run in all_runs(tmp_path):
        (run.path / "latest.safetensors").write_bytes(b"weights")
    (tmp_path / "runs" / "begun").mkdir()
    for begun in ("comparisons", "decisions"):
        (tmp_path / begun / "begun").mkdir(parents=True)
    (tmp_path / "decisions" / "begun" / "config.json").write_text("{}")
    kept = tmp_path / "kept"

    def compared(outputs: Path) -> tuple[dict[str, str], bytes]:
        assert command("compare", "by=model", "tracking=none", f"paths.outputs={outputs}") == 0
        (page,) = outputs.glob("comparisons/cnn-*")
        tables = {path.name: path.read_text() for path in page.glob("artifacts/tables/*.csv")}
        return tables, (page / "looks.json").read_bytes()

    tables, looks = compared(tmp_path)
    runpy.run_path(str(DOCS / "keep_runs.py"))["main"](tmp_path, kept)
    (page,) = kept.glob("comparisons/*")
    assert (page / "looks.json").read_bytes() == looks
    assert len(tables["looks.csv"].splitlines()) == 2  # the first look, which is not taken again
    assert len(tables) >= 10
    files = [path for path in kept.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".jsonl", ".csv", ".html", ".png"}
    assert not [path for path in files if bytes(tmp_path) in path.read_bytes()]

    again, looks_again = compared(kept)
    assert looks_again == looks
    assert again.keys() == tables.keys()
    assert [name for name in tables if tables[name] != again[name]] == ["skipped.csv"]


@pytest.fixture
def asked_again(
    command: Callable[..., int], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., tuple[str, Path]]:
    """Take the looks of a section's question anew, over the kept runs of so many seeds each, against what is kept."""

    def asked_again(heading: str, *looks: str) -> tuple[str, Path]:
        section = section_of(heading)
        (question,) = re.findall(r"^    python -m atlantis_exp (compare by=.* runs=decide-.*)$", section, re.MULTILINE)
        shutil.copytree(DOCS / "verdict" / "decisions", tmp_path / "decisions")
        for seeds in looks:  # the first before the later seeds are there
            for run in (DOCS / "verdict" / "runs").glob(f"*-s[{seeds}]-*"):
                shutil.copytree(run, tmp_path / "runs" / run.name)
            capsys.readouterr()
            assert command(*question.split(), "tracking=none", f"paths.outputs={tmp_path}") == 0
        printed = capsys.readouterr().out
        (made,) = tmp_path.glob("comparisons/*")
        notes = re.sub(
            "<svg.*?</svg>|<header>.*?</header>", "", (made / "artifacts/comparison.html").read_text(), flags=re.S
        )
        said = " ".join((printed + notes[notes.index("What else to know") :]).split())
        kept = DOCS / "verdict" / "comparisons" / made.name
        assert (made / "looks.json").read_text() == (kept / "looks.json").read_text()
        for name in ("verdict", "views", "runs"):
            table = f"artifacts/tables/{name}.csv"
            assert (made / table).read_text() == (kept / table).read_text()
        return said, kept

    return asked_again


def test_the_verdict_is_said_as_the_kept_runs_say_it(asked_again: Callable[..., tuple[str, Path]]) -> None:
    said, kept = asked_again("The answer, so far", "01234", "56789")

    def only(pattern: str) -> str:
        (found,) = re.findall(pattern, said)
        return str(found)

    readme, results = (" ".join(page.read_text().split()) for page in (REPOSITORY / "README.md", RESULTS))
    difference, interval = (
        only(rf"cnn plays better than resnet_fast by {part}, 10 seeds each\)")
        for part in (r"([\d,]+) points \(.*", r"[\d,]+ points \((.*)")
    )
    for text in (readme, results):
        assert re.search(rf"DQNCnn plays better than [^.]*\bResNetFast,? by {difference} points", text)
        assert interval in text
    for pattern in (r"is \+([\d,]+) points: ", r"points: \+([\d,]+) by survival", r" and \+([\d,]+) by rate"):
        assert only(pattern) in results
    with (kept / "artifacts" / "tables" / "views.csv").open() as file:
        views = {row["view"]: row for row in csv.DictReader(file)}
    for view in ("equal frames", "equal gradient FLOPs"):
        values = [f"{float(views[view][f'{key} (points)']):,.0f}" for key in ("difference", "low", "high")]
        assert re.search(r"{} points[^.]* {} to {}\b".format(*values), results)


@pytest.mark.parametrize(
    "heading", ["Uniform or top-half sampling: the first look", "Uniform or top-half sampling: ResNetFast"]
)
def test_the_first_look_at_top_half_sampling_is_said_as_the_kept_runs_say_it(
    asked_again: Callable[..., tuple[str, Path]], heading: str
) -> None:
    said, kept = asked_again(heading, "0123456789")
    found = re.search(r"Not decided: top_half against uniform \(difference ((-?)([\d,]+)), (.*), 5 seeds each\)", said)
    assert found
    readme, section = (" ".join(text.split()) for text in ((REPOSITORY / "README.md").read_text(), section_of(heading)))
    assert f"a difference of {found[1]} points ({found[4]})" in readme
    assert f"top-half sampling has {found[3]} points {'less' if found[2] else 'more'}, {found[4]}." in section
    assert f"verdict/comparisons/{kept.name}/artifacts/figures/scores.png" in section
