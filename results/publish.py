"""Compute every published number from the kept runs, tables and cards into `results/numbers.json`.

`python -m results.publish` writes that file and the tables between `<!-- NAME -->` and `<!-- end -->` in the pages.
The file maps each page to its numbers, as text; `tests/test_results.py` looks for them on the page.
"""

import csv
import itertools
import json
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from atlantis_exp.comparison.decision import Look, Plan, Verdict, decide, equivalence, mean_interval, size_found
from atlantis_exp.comparison.estimands import score_of
from atlantis_exp.comparison.published import curves
from atlantis_exp.components import game_of
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.folder import RunFolder, all_runs, evaluation_at
from atlantis_exp.runs.journal import Metrics, Tags
from atlantis_exp.sessions.cards import read_card, side_by_side
from atlantis_exp.statistics import interquartile_mean
from benchmarks import pace

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS, DATA, PRETRAINED = (REPOSITORY / name for name in ("results", "docs/data", "pretrained"))
QUESTIONS = ("verdict", "longer", "rewards", "standard", "reproduction")
KEPT = {question: list(all_runs(RESULTS / question)) for question in QUESTIONS}
SOURCES = (*pace.PAID, "wave_bonus")  # of points
RANDOM = 20_873  # the mean of a random player
PEERS = ("DreamerV3", "QR-DQN Impala ResNet", "QR-DQN Nature CNN")
PUBLISHED = {(row["name"], row["frames"]): row["mean"] for row in curves(game_of("Atlantis-v0"))}
ANSWERS, LAB, REPRODUCTION, ASKED = "docs/results.md", "lab/results.md", "lab/reproduction.md", "lab/questions.md"


def games_at(run: RunFolder, step: int | None = None) -> EpisodeTable:
    """Return a kept run's games after a step, by default its last."""
    assert run.result is not None
    return EpisodeTable.read(run.artifact(evaluation_at(step or run.result.steps)), SOURCES)


def of_the_verdict(model: str, sampler: str = "uniform", precision: str = "fp32") -> dict[int, RunFolder]:
    """Return a network's trainings with a sampler, by seed."""
    runs = [(run, run.trained_config) for run in KEPT["verdict"] if run.name.startswith(f"{model}-{sampler}-s")]
    return dict(sorted((config.seed, run) for run, config in runs if config.training.precision == precision))


def in_the_fields_game() -> list[EpisodeTable]:
    """Return the games of three trainings with rewards of at most 1; only games are kept of the second."""
    first, third = sorted(KEPT["standard"], key=lambda run: run.name.split("-")[2])
    return [games_at(first), EpisodeTable.read(RESULTS / "standard" / "seed_1.csv", SOURCES), games_at(third)]


def with_layer_normalization() -> list[EpisodeTable]:
    """Return the games of three trainings with layer normalization, by seed."""
    return [EpisodeTable.read(RESULTS / "rewards" / f"normed_{seed}.csv", SOURCES) for seed in range(3)]


def to_a_power(question: str) -> list[RunFolder]:
    """Return the trainings in the field's game with rewards to a power and states of four frames, by seed."""
    configs = [(run, run.trained_config) for run in KEPT[question]]
    there = [(run, each) for run, each in configs if (each.env.id, each.env.stack) == ("ALE/Atlantis-v5", 4)]
    return [run for run, each in sorted(there, key=lambda pair: pair[1].seed) if each.objective.reward_exponent < 1]


def metrics_of(run: RunFolder, name: str) -> list[float]:
    """Return a metric's kept values."""
    records = (record.values for record in run.records() if isinstance(record, Metrics))
    return [values[name] for values in records if name in values]


def ends_of(run: RunFolder) -> list[tuple[int, int]]:
    """Return the last step and the length of each game of a training."""
    with run.artifact("episodes.csv").open() as file:
        return [(int(row["step"]), int(row["length"])) for row in csv.DictReader(file)]


def at_step(run: RunFolder, step: int, table: str) -> tuple[float, float]:
    """Return the hours until a step and its mean of 20, from a table in docs/data."""
    with (DATA / f"{table}.csv").open() as file:
        row = next(row for row in csv.DictReader(file) if row["run"] == run.name and int(row["step"]) == step)
    return float(row["hours"]), float(row["mean_20"])


def mean_and_iqm(games: EpisodeTable) -> str:
    """Format the scores for the tables."""
    return f"{games.scores.mean():,.0f} ({interquartile_mean(games.scores):,.0f})"


def hits_of(games: EpisodeTable) -> dict[str, float]:
    """Return the number of hits by source of points."""
    return dict(zip(pace.PAID, np.divide(games.points.sum(axis=0)[:-1], [*pace.PAID.values()]), strict=True))


def pace_of(games: EpisodeTable) -> tuple[float, ...]:
    """Return points a frame, hits a thousand frames, percent by side guns, points a hit, steps and points a game."""
    hits, frames = hits_of(games), games.frames.sum()
    every = sum(hits.values())
    side = 100 * (hits["side_vessel"] + hits["side_bomber"]) / every
    rates = games.scores.sum() / frames, 1_000 * every / frames, side
    return (*rates, games.points.sum(axis=0)[:-1].sum() / every, games.steps.mean(), games.scores.mean())


def waiting(games: EpisodeTable) -> str:
    """Format the share of NOOP in the network's decisions."""
    chosen = games.counts[..., 0].sum(axis=0)
    return f"{100 * chosen[games.actions.index('NOOP')] / chosen.sum():.0f} %"


def side_share(games: EpisodeTable) -> float:
    """Return the percentage of bomber hits by side guns."""
    hits = hits_of(games)
    return 100 * hits["side_bomber"] / (hits["side_bomber"] + hits["centre_bomber"])


def whole(values: Iterable[Any]) -> list[str]:
    """Format numbers for the pages."""
    return [f"{value:,.0f}" for value in values]


def of_every_run() -> Iterator[tuple[str, str]]:
    for question, runs in KEPT.items():
        for run in runs:
            yield REPRODUCTION if question == "reproduction" else LAB, mean_and_iqm(games_at(run))


def views_of(comparison: str) -> dict[str, dict[str, str]]:
    """Return a kept comparison's views at equal frames, hours and FLOPs."""
    with (RESULTS / "verdict/comparisons" / comparison / "artifacts/tables/views.csv").open() as file:
        return {row["view"]: row for row in csv.DictReader(file)}


def of_the_verdicts() -> Iterator[tuple[str, str]]:
    for looks in sorted((RESULTS / "verdict" / "comparisons").glob("*/looks.json")):
        for look in json.loads(looks.read_text()).popitem()[1]:
            (verdict,) = look["verdicts"]
            if verdict["said"] != "not decided":
                yield ANSWERS, f"{size_found(Verdict(**verdict), Look(**look), 1):,.0f}"
            yield from (
                (LAB, text.lstrip("-")) for text in whole(verdict[key] for key in ("difference", "low", "high"))
            )
    for view, row in views_of("cnn-vs-resnet-fast-e09e14bb20").items():
        if view != "equal hours":
            values = whole(float(row[f"{key} (points)"]) for key in ("difference", "low", "high"))
            yield from ((LAB, text) for text in values)
    for model in ("cnn", "resnet_fast"):
        uniform, top = (
            {seed: interquartile_mean(games_at(run).scores) for seed, run in of_the_verdict(model, sampler).items()}
            for sampler in ("uniform", "top_half")
        )
        means = [np.mean([*each]) for each in (top.values(), (uniform[seed] for seed in top), uniform.values())]
        yield from ((LAB, text) for text in whole((*means, min(top.values()), max(top.values()))))
    with (DATA / "top_half_on_a_gpu.csv").open() as file:
        printed = [row for row in csv.DictReader(file) if row["kind"] == "evaluation" and row["step"] == "1000000"]
    for row in printed:
        yield LAB, f"{int(row['mean']):,} ({int(row['interquartile_mean']):,})"
    here = games_at(of_the_verdict("resnet_fast", "top_half")[4]).scores.mean()
    yield LAB, f"{here - float(next(row['mean'] for row in printed if row['seed'] == '4')):,.0f}"


def of_the_training_score() -> Iterator[tuple[str, str]]:
    scores = {
        model: {seed: score_of(run) for seed, run in of_the_verdict(model).items()} for model in ("cnn", "resnet_fast")
    }
    for seeds, plan in ((5, Plan()), (10, Plan(looks=(10,)))):
        chosen = {model: {seed: each[seed] for seed in range(seeds)} for model, each in scores.items()}
        (verdict,) = decide(chosen, plan).verdicts
        assert verdict.said == "better"
        yield from ((ASKED, text) for text in whole((verdict.difference, verdict.low, verdict.high)))


def of_equivalence() -> Iterator[tuple[str, str]]:
    for model in ("cnn", "resnet_fast"):
        uniform, top = (
            [*map(score_of, of_the_verdict(model, sampler).values())] for sampler in ("uniform", "top_half")
        )
        spread = np.sqrt(np.mean([np.var(scores, ddof=1) for scores in (uniform, top)]))
        delta = 0.05 * float(np.mean(uniform))
        seeds = next(n for n in itertools.count(5) if equivalence(Plan(looks=(n,), delta=delta), spread) <= delta)
        yield LAB, f"at {seeds}"


def of_equal_arithmetic() -> Iterator[tuple[str, str]]:
    for run in of_the_verdict("resnet").values():
        games = games_at(run)
        yield LAB, f"| {games.steps.mean():,.0f} | {waiting(games)} | {mean_and_iqm(games)} |"
        assert run.result is not None
        yield from ((LAB, text) for text in whole((run.result.steps, run.result.counts["updates"])))
    frames = views_of("cnn-vs-resnet-890faa26f7")["equal frames"]
    columns = ("at", "leader_score (points)", "other_score (points)")
    yield from ((LAB, text) for text in whole(float(frames[key]) for key in columns))


def of_three_networks() -> Iterator[tuple[str, str]]:
    teraflops = {}
    for model, network in (("cnn", "DQNCnn"), ("resnet_fast", "ResNetFast"), ("resnet", "ResNetDQN")):
        for seed, run in of_the_verdict(model, precision="bf16").items():
            assert run.result is not None
            tags = [record.values for record in run.records() if isinstance(record, Tags)]
            (flops,) = (float(values["flops_per_update"]) for values in tags if "flops_per_update" in values)
            counts, config, games = run.result.counts, run.trained_config, games_at(run)
            teraflops[model] = flops * counts["updates"] / 1e12
            rate, hits, side, *_ = pace_of(games)
            row = (seed, network, config.threads, f"{counts['hours']:.2f}", f"{teraflops[model]:,.0f}", f"{rate:.2f}")
            yield LAB, f"| {' | '.join(map(str, row))} | {games.steps.mean():,.0f} | {mean_and_iqm(games)} |"
            if model == "resnet" or (model, seed) == ("cnn", 0):
                yield LAB, waiting(games)
                yield from ((LAB, text) for text in (f"{side:.0f} %", f"{hits:.1f}"))
    yield LAB, f"{teraflops['resnet'] / teraflops['cnn']:.1f} times"
    yield LAB, f"{flops / config.training.batch_size / 1e9:.2f} GFLOP"
    scores = np.concatenate([games_at(run).scores for run in of_the_verdict("resnet", precision="bf16").values()])
    ten = [[games_at(run).scores.mean() for run in of_the_verdict(model).values()] for model in ("cnn", "resnet_fast")]
    for each in (scores.tolist(), *ten):
        yield from ((LAB, text) for text in whole((min(each), max(each))))
    yield LAB, f"{EpisodeTable.read(DATA / 'resnet_in_bfloat16.csv').scores.mean():,.0f}"


def of_the_fields_game() -> Iterator[tuple[str, str]]:
    tables = in_the_fields_game()
    for games in (*map(games_at, KEPT["longer"]), *tables):
        capped = f"{int(games.truncated.sum())} of {len(games.scores)}"
        rate = games.scores.sum() / games.frames.sum()
        yield LAB, f"| {capped} | {rate:.2f} | {games.scores.min():,.0f} | {mean_and_iqm(games)} |"
    for seed, games in enumerate(tables):
        hits, frames = hits_of(games), games.frames.sum() / 1_000
        bombers = (hits["centre_bomber"] + hits["side_bomber"]) / frames
        cells = f"{sum(hits.values()) / frames:.1f} | {bombers:.1f} | {side_share(games):.0f} %"
        yield LAB, f"| {seed} | {cells} | {pace_of(games)[3]:.0f} |"
    run = min(KEPT["standard"], key=lambda run: run.name.split("-")[2])
    for millions in range(2, 6):
        hours, training = at_step(run, 250_000 * millions, "standard")
        played = "" if millions == 3 else f"{games_at(run, 250_000 * millions).scores.mean():,.0f} "
        peers = " | ".join(whole(PUBLISHED[name, 1e6 * millions] for name in PEERS))
        yield LAB, f"| {millions} | {hours:.2f} | {training:,.0f} | {played}| {peers} |"
    means = np.array([games.scores.mean() for games in tables])
    minutes = [60 * at_step(run, 1_250_000, "standard")[0] for run in KEPT["standard"]]
    yield from ((LAB, text) for text in (*whole((*means, np.mean(means))), *whole(minutes)))


def of_rewards() -> Iterator[tuple[str, str]]:
    cells = "| {:.2f} | {:.1f} | {:.0f} % | {:.0f} | {:,.0f} | {:,.0f} ("
    for run in KEPT["rewards"]:
        yield LAB, cells.format(*pace_of(games_at(run)))
    ranges = "| {:.2f} to {:.2f} | {:.1f} to {:.1f} | {:.0f} to {:.0f} % | {:.0f} to {:.0f} | {:,.0f} to {:,.0f} |"
    for tables in ([games_at(run) for run in of_the_verdict("cnn").values()], in_the_fields_game()):
        paces = np.array([pace_of(games) for games in tables])
        row = ranges.format(*np.stack((paces.min(axis=0), paces.max(axis=0)), axis=1)[:5].ravel())
        yield LAB, row.replace("27,000 to 27,000", "27,000")
    runs = [run for run in to_a_power("rewards") if run.trained_config.objective.gamma == 0.99]
    (longer,) = [run for run in to_a_power("rewards") if run not in runs]
    for path in sorted((RESULTS / "rewards").glob("*.csv")):
        games = EpisodeTable.read(path, SOURCES)
        capped = games.scores[games.truncated.astype(bool)]
        points = whole((capped.mean(), capped.max(), games.scores.mean()))
        yield LAB, " | ".join((f"| {len(capped)} of {len(games.scores)}", *points))
    played = [games_at(run) for run in runs]
    means, scores = [games.scores.mean() for games in played], np.concatenate([games.scores for games in played])
    yield from ((LAB, text) for text in whole((*means, np.mean(means), np.ptp(means), min(scores), max(scores))))
    with (DATA / "rewards.csv").open() as file:
        evaluated = [int(row["evaluation"]) for row in csv.DictReader(file) if row["evaluation"]]
    yield from ((LAB, text) for text in whole(evaluated))
    for run in (*runs, longer):
        yield LAB, f"{60 * metrics_of(run, 'throughput/hours')[-1]:.0f}"
        yield (
            LAB,
            f"{games_at(run, 1_000_000).scores.mean():,.0f}" if run != longer else f"{pace_of(games_at(run))[1]:.1f}",
        )
    yield from ((LAB, f"{side_share(games):.0f}") for games in played)


def of_the_best_player() -> Iterator[tuple[str, str]]:
    before, after = sorted(to_a_power("longer"), key=lambda run: run.trained_config.training.weights or "")
    for step in sorted(int(path.stem) for path in before.artifact("evaluation").glob("*.csv")):
        games = games_at(before, step)
        rate, hits, side, *_, mean = pace_of(games)
        peers = [PUBLISHED.get((name, 4.0 * step)) for name in PEERS[:2]]
        cells = (f"{step / 250_000:g}", f"{at_step(before, step, 'million')[0]:.2f}", f"{rate:.2f}", f"{hits:.1f}")
        shown = "".join(" |" if score is None else f" {score:,.0f} |" for score in peers)
        yield LAB, f"| {' | '.join(cells)} | {side:.0f} % | {mean:,.0f} | {len(games.scores)} |{shown}"
    capped = games.truncated.astype(bool)
    early, ended, envs = np.sort(games.steps[~capped])[:-1], ends_of(before), before.trained_config.env.num_envs
    late = [length for end, length in ended if end - envs * length >= 2_600_000 and length < games.steps.max()]
    began = np.array([end for end, _ in ended if end > 2_600_000])
    counts = (len(early), early.max(), max(late), (began > 3_900_000).sum(), (began < 3_900_000).sum())
    yield from ((LAB, text) for text in whole((games.scores[capped].mean(), *counts)))
    last = games_at(after)
    lost = [length for end, length in ends_of(after) if length < last.steps.max()]
    yield from ((LAB, text) for text in whole((max(lost), pace_of(last)[2])))
    yield (
        LAB,
        f"| {metrics_of(after, 'throughput/hours')[-1]:.2f} | {int(last.truncated.sum())} of {len(last.scores)} |",
    )
    for name, table in (("cnn_standard", "epsilon_0.001"), ("cnn_annealed", "annealed_epsilon_0.001")):
        card, _ = read_card(PRETRAINED / name)
        calm = EpisodeTable.read(RESULTS / "longer" / f"{table}.csv", SOURCES)
        _, here = side_by_side(card, card.evaluation, calm.scores.tolist()).columns[2].cells
        spread = whole((calm.scores.mean(), calm.scores.min(), calm.scores.max(), (calm.scores > 1_000_000).sum()))
        yield from ((LAB, text) for text in (*spread, str(here), f"{calm.scores.sum() / calm.frames.sum():.2f}"))


def of_the_cards() -> Iterator[tuple[str, str]]:
    for folder in sorted(PRETRAINED.glob("*/card.json")):
        card, _ = read_card(folder.parent)
        yield LAB, f"{np.mean(card.scores):,.0f}"


def of_the_reports_protocol() -> Iterator[tuple[str, str]]:
    for run in KEPT["reproduction"]:
        assert run.result is not None
        counts, config = run.result.counts, run.trained_config
        cells = (
            f"{run.result.steps:,} | {counts['updates']:,.0f} | {counts['hours']:.2f} | {mean_and_iqm(games_at(run))}"
        )
        yield REPRODUCTION, f"| {config.seed} | {cells} |"
    scores = [games_at(run).scores.mean() for run in KEPT["reproduction"] if run.name.startswith("cnn")]
    numbers = (float(np.mean(scores)), *mean_interval(scores), min(scores), max(scores), float(np.std(scores, ddof=1)))
    yield from ((REPRODUCTION, text.lstrip("-")) for text in whole(numbers))
    (run,) = [run for run in KEPT["reproduction"] if run.name.startswith("resnet")]
    assert run.result is not None
    mean, last = games_at(run).scores.mean(), metrics_of(run, "score/mean_20")[-1]
    bonus = run.result.evaluation["evaluation/score_wave_bonus"]
    earlier = games_at(run, 303_000).scores.mean(), sum(step <= 303_000 for step, _ in ends_of(run))
    yield from ((REPRODUCTION, text) for text in whole((mean, last, bonus, *earlier, 100 * mean / RANDOM)))
    yield REPRODUCTION, f"{100 * run.result.evaluation['actions/favourite_share']:.1f} %"


SECTIONS = (
    of_every_run,
    of_the_verdicts,
    of_the_training_score,
    of_equal_arithmetic,
    of_equivalence,
    of_three_networks,
    of_the_fields_game,
    of_rewards,
    of_the_best_player,
    of_the_cards,
    of_the_reports_protocol,
)


@cache
def numbers() -> dict[str, list[str]]:
    """Return all published numbers by page."""
    said = list(dict.fromkeys(itertools.chain.from_iterable(section() for section in SECTIONS)))
    return {page: [text for of, text in said if of == page] for page in (ANSWERS, LAB, REPRODUCTION, ASKED)}


@cache
def tables() -> dict[str, str]:
    """Return the tables of the pages by the name in their comments."""
    answers = ["| trainings | seeds | mean | lowest | highest |", "| --- | ---: | ---: | ---: | ---: |"]
    for model, network in (("cnn", "DQNCnn"), ("resnet_fast", "ResNetFast")):
        for sampler in ("uniform", "top_half"):
            seeds = [interquartile_mean(games_at(run).scores) for run in of_the_verdict(model, sampler).values()]
            shown = " | ".join(whole((np.mean(seeds), min(seeds), max(seeds))))
            answers.append(f"| {network}, `sampler={sampler}` | {len(seeds)} | {shown} |")
    field = ["| training | seed 0 | seed 1 | seed 2 |", "| --- | ---: | ---: | ---: |"]
    clipped = [games.scores.mean() for games in in_the_fields_game()]
    runs = [run for run in to_a_power("rewards") if run.trained_config.objective.gamma == 0.99]
    powered = [games_at(run).scores.mean() for run in runs]
    normed = [games.scores.mean() for games in with_layer_normalization()]
    names = "rewards of at most 1", "rewards to the power of .25", "the same, with `model=cnn_norm`"
    for name, means in zip(names, (clipped, powered, normed), strict=True):
        field.append(f"| {name} | {' | '.join(whole(means))} |")
    players = ["| player | network | mean | games | game |", "| --- | --- | ---: | ---: | --- |"]
    for path in sorted(PRETRAINED.glob("*/card.json")):
        card, _ = read_card(path.parent)
        cells = f"{np.mean(card.scores):,.0f} | {len(card.scores)} | `{card.config.env.id}`"
        players.append(f"| `pretrained/{path.parent.name}` | `{card.config.model.name}` | {cells} |")
    report = ["| network | seed | steps | updates | hours | mean (IQM) |", "| --- | ---: | ---: | ---: | ---: | ---: |"]
    for run in sorted(KEPT["reproduction"], key=lambda run: (run.name.split("-")[0], run.trained_config.seed)):
        assert run.result is not None
        counts = run.result.counts
        cells = (
            f"{run.result.steps:,} | {counts['updates']:,.0f} | {counts['hours']:.2f} | {mean_and_iqm(games_at(run))}"
        )
        report.append(f"| `{run.trained_config.model.name}` | {run.trained_config.seed} | {cells} |")
    named = {"answers": answers, "field": field, "players": players, "report": report}
    return {name: "\n".join(lines) for name, lines in named.items()}


def with_tables(page: str, tables: Mapping[str, str]) -> str:
    """Insert the tables between their comments on a page."""

    def filled(found: re.Match[str]) -> str:
        return f"<!-- {found[1]} -->\n\n{tables[found[1]]}\n\n<!-- end -->"

    return re.sub(r"<!-- (\w+) -->\n.*?<!-- end -->", filled, page, flags=re.DOTALL)


def main() -> None:
    """Write the file of numbers and the tables of the pages."""
    (RESULTS / "numbers.json").write_text(json.dumps(numbers(), indent=1) + "\n")
    made = tables()
    for name in (ANSWERS, "docs/reproduction.md"):
        path = REPOSITORY / name
        path.write_text(with_tables(path.read_text(), made))


if __name__ == "__main__":
    main()
