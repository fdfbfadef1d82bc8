"""Measure how often verdicts are wrong: `python -m benchmarks.decisions`.

Users compare groups of ten seeds with known true means through `comparison.decision`. One trains up to the next printed
look, one asks after every seed, and one takes a look after every seed. All continue until nothing is open. The plan
promises nothing to a fourth, who watches the scores and asks once they are far enough apart. A decision is false if it
calls one of two groups with equal means better or worse, or two groups that differ by delta equivalent. Values are in
standard deviations of one group.
"""

import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations, combinations_with_replacement, product
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit
from scipy.stats import norm

from atlantis_exp.comparison.account import Asked, open_account, seeds_between
from atlantis_exp.comparison.decision import Decision, Look, Plan, decide, looks_up_to, mean_interval
from atlantis_exp.comparison.estimands import TrainingEpisodes, training_score
from atlantis_exp.comparison.verdict import Group, Question, answer, families
from benchmarks.contest import parser_of, print_results, print_table, run

Values = npt.NDArray[np.float64]
Follow = Callable[[Values, Plan], tuple[Decision, int]]

SEEDS = 10  # a group
GROUPS = (2, 4, 8)
NOISE = 0.1  # within a mode, in distances between the two
RESAMPLES = 999
KEPT = Path(__file__).resolve().parents[1] / "results" / "verdict" / "runs"
NETWORKS = ("cnn", "resnet_fast")  # with ten kept seeds each


def normal(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    """Draw with mean 0 and standard deviation 1, as do all below."""
    return rng.normal(size=shape)


def lognormal(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    return np.asarray((rng.lognormal(size=shape) - np.exp(0.5)) / np.sqrt((np.e - 1) * np.e))


def bimodal(rng: np.random.Generator, shape: tuple[int, ...], survival: float = 0.7) -> Values:
    """Draw seeds that survive with this probability and else collapse, as in Atlantis."""
    values = (rng.random(shape) < survival) + NOISE * rng.normal(size=shape)
    return np.asarray((values - survival) / np.sqrt(survival * (1 - survival) + NOISE**2))


def halves(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    return bimodal(rng, shape, 0.5)


def steady(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    """Draw seeds with a tenth of the others' spread."""
    return 0.1 * rng.normal(size=shape)


def at_the_cap(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    """Draw nine of ten seeds exactly at the cap, the others low, with mean 0."""
    return np.asarray(np.where(rng.random(shape) < 0.9, 1.0, 0.3 * rng.random(shape)) - 0.915) / 0.265


def rarely(rng: np.random.Generator, shape: tuple[int, ...]) -> Values:
    return bimodal(rng, shape, 0.9)


SHAPES = {"normal": normal, "log-normal": lognormal, "bimodal 70:30": bimodal, "bimodal 50:50": halves}


def advised(values: Values, plan: Plan) -> tuple[Decision, int]:
    """Train contenders up to the next due look; return the decision and the number of seeds of group 0."""
    return _follow(values, plan, lambda _, due: due, now=False)


def one_by_one(values: Values, plan: Plan) -> tuple[Decision, int]:
    """Ask after every seed."""
    return _follow(values, plan, lambda trained, _: trained + 1, now=False)


def every_seed(values: Values, plan: Plan) -> tuple[Decision, int]:
    """Take a look after every seed, whether due or not."""
    return _follow(values, plan, lambda trained, _: trained + 1, now=True)


def watching(values: Values, plan: Plan) -> tuple[Decision, int]:
    """Watch the scores after every seed, and first ask once they are far enough apart to be decided."""
    for trained in range(plan.looks[0], plan.looks[-1] + 1):
        seeds = {f"group {index}": dict(enumerate(row[:trained])) for index, row in enumerate(values.tolist())}
        decision = decide(seeds, plan, now=True)
        if any(verdict.said != "not decided" for verdict in decision.verdicts):
            break
    return decision, trained


def _follow(values: Values, plan: Plan, train: Callable[[int, int], int], now: bool) -> tuple[Decision, int]:
    seeds = {f"group {index}": dict(enumerate(row)) for index, row in enumerate(values.tolist())}
    trained = dict.fromkeys(seeds, 0)
    contenders: Sequence[str] = list(seeds)
    looks: Sequence[Look] = ()
    due: int | None = plan.looks[0]
    while due is not None:
        trained |= {name: train(trained[name], due) for name in contenders}
        groups = {name: {seed: row[seed] for seed in range(trained[name])} for name, row in seeds.items()}
        decision = decide(groups, plan, looks, now=now)
        contenders, looks, due = decision.contenders, decision.looks, decision.next_look
    return decision, trained["group 0"]


USERS: Mapping[str, Follow] = {"advised": advised, "one by one": one_by_one, "look every seed": every_seed}


def false_decision(values: Values, plan: Plan, follow: Follow) -> bool:
    """Return whether any of several groups with equal means are decided."""
    return any(verdict.said in ("better", "worse") for verdict in follow(values, plan)[0].verdicts)


def false_of_two_means(values: Values, plan: Plan) -> bool:
    """Return whether a verdict is wrong if groups 1, 3 and 5 are delta better than groups 0, 2 and 4."""
    for verdict in advised(values, plan)[0].verdicts:
        above = int(verdict.group.split()[1]) % 2 - int(verdict.other.split()[1]) % 2
        wrong = {0: ("better", "worse"), 1: ("worse", "equivalent"), -1: ("better", "equivalent")}
        if verdict.said in wrong[above]:
            return True
    return False


def found(values: Values, plan: Plan) -> tuple[float, float]:
    """Return the share of the pairs with group 0 that find it better, and the seeds until all of them do."""
    decision, seeds = advised(values, plan)
    pairs = [verdict.said == "better" for verdict in decision.verdicts if verdict.group == "group 0"]
    return float(np.mean(pairs)), seeds


def before(values: Values, every: bool) -> tuple[bool, int]:
    """Return whether two groups differ by the rule before plans, and after how many seeds.

    From three seeds on it tested Welch's 95 % interval, after every seed or after "about K more seeds", the number at
    which the interval would exclude zero if means and variances did not change.
    """
    trained = 3
    while True:
        seeds = values[:, :trained]
        distance, variances = abs(seeds[0].mean() - seeds[1].mean()), seeds.var(axis=1, ddof=1)
        sizes = np.arange(trained, SEEDS + 1)
        freedom = variances.sum() ** 2 * (sizes - 1) / (variances**2).sum()
        enough = distance > -stdtrit(freedom, 0.025) * np.sqrt(variances.sum() / sizes)
        if enough[0] or trained == SEEDS:
            return bool(enough[0]), trained
        trained = trained + 1 if every else int(sizes[enough.argmax() if enough.any() else -1])


def at_once(values: Values) -> tuple[bool, int]:
    """Return whether one look at ten seeds finds that two groups differ."""
    return false_decision(values, Plan(looks=(SEEDS,)), advised), SEEDS


def by_plan(values: Values) -> tuple[bool, int]:
    """Return whether looks at five and ten seeds find that two groups differ, and the seeds used."""
    decision, seeds = advised(values, Plan())
    return decision.verdicts[0].said != "not decided", seeds


PROCEDURES: Mapping[str, Callable[[Values], tuple[bool, int]]] = {
    "before: a test at each of 3 to 10 seeds": lambda values: before(values, every=True),
    'before: "about K more seeds", followed to 10': lambda values: before(values, every=False),
    "one look at 10 seeds": at_once,
    "now: looks at 5 and 10 seeds": by_plan,
}


def covered(values: Values, means: Values, plan: Plan) -> tuple[float, float]:
    """Return the share of intervals that contain the true difference, and 1 if all do."""
    holds = [
        verdict.low <= means[int(verdict.group.split()[1])] - means[int(verdict.other.split()[1])] <= verdict.high
        for verdict in advised(values, plan)[0].verdicts
    ]
    return float(np.mean(holds)), float(all(holds))


def coverage_of_means(values: Values, rng: np.random.Generator) -> dict[str, float]:
    """Return the share of rows whose 95 % interval of the mean over seeds contains 0, by method.

    Student's t is `decision.mean_interval`. The others are bootstraps over seeds (Efron and Tibshirani 1993):
    percentiles, bias-corrected and accelerated, and studentized.
    """
    rows, size = values.shape
    means, errors = values.mean(axis=1), values.std(axis=1, ddof=1) / np.sqrt(size)
    weights = rng.multinomial(size, np.full(size, 1 / size), RESAMPLES) / size
    drawn = values @ weights.T
    spreads = np.sqrt(np.maximum((values**2) @ weights.T - drawn**2, 0) / (size - 1))
    with np.errstate(divide="ignore", invalid="ignore"):
        studentized = np.where(spreads > 1e-9, (drawn - means[:, None]) / spreads, np.nan)
    t_low, t_high = (np.nanquantile(studentized, share, axis=1) for share in (0.025, 0.975))
    deviations = values - means[:, None]
    below = (drawn < means[:, None]).mean(axis=1) + (drawn == means[:, None]).mean(axis=1) / 2
    bias = norm.ppf(np.clip(below, 1 / RESAMPLES, 1 - 1 / RESAMPLES))
    skew = (deviations**3).sum(axis=1) / (6 * (deviations**2).sum(axis=1) ** 1.5)
    ends = [bias + (bias + z) / (1 - skew * (bias + z)) for z in (norm.ppf(0.025), norm.ppf(0.975))]
    ranks = [np.clip((norm.cdf(end) * RESAMPLES).astype(int), 0, RESAMPLES - 1) for end in ends]
    drawn.sort(axis=1)
    at = np.arange(rows)
    intervals = {
        "t": np.array([mean_interval(row) for row in values]).T,
        "percentile": np.quantile(drawn, (0.025, 0.975), axis=1),
        "BCa": (drawn[at, ranks[0]], drawn[at, ranks[1]]),
        "studentized": (means - t_high * errors, means - t_low * errors),
    }
    return {name: float(((low <= 0) & (high >= 0)).mean()) for name, (low, high) in intervals.items()}


class Outputs:
    """Comparisons of the same runs, as in an outputs folder, with their errors in `false` and `silent`.

    Args:
        values: a row of seeds for each group; all groups have equal means.
    """

    def __init__(self, values: Values) -> None:
        self.values, self.kept = values.tolist(), dict[str, Asked]()
        self.false = False  # any verdict
        self.silent = False  # any false verdict without a line about other questions or missing seeds

    def ask(self, name: str, seeds: Mapping[int, Sequence[int]], upto: int = SEEDS, now: bool = False) -> Decision:
        """Compare some seeds of some groups in a plan of `upto` seeds; the same name repeats the same question."""
        groups = [
            Group((str(group),), {seed: self.values[group][seed] for seed in chosen}) for group, chosen in seeds.items()
        ]
        asked = families(groups, Question(["group"], upto))
        runs = {f"{group}-{seed}" for group, chosen in seeds.items() for seed in chosen}
        before = self.kept.get(name, Asked(["group"], 0.05, None, False, None, [[str(each)] * 2 for each in seeds], []))
        mine = replace(before, name=name, compared=sorted({*before.compared, *runs}))
        account = open_account(asked, mine, [each for each in self.kept.values() if each.name != name], runs)
        (answered,) = answer(account.limit(asked), account.record, now)
        decision = answered.decision
        record = {"group": decision.looks}
        self.kept[name] = replace(mine, record=record, account=account.root, errors=dict(account.errors))
        is_false = any(verdict.said != "not decided" for verdict in decision.verdicts)
        self.false |= is_false
        self.silent |= (
            is_false and not account.is_warned and not seeds_between({str(k): v for k, v in seeds.items()}, {})
        )
        return decision


def longer_plans(outputs: Outputs, plans: Sequence[int] = (10, 20, 40)) -> None:
    """Extend the plan until something is decided."""
    for upto in plans:
        for size in looks_up_to(upto):
            outputs.ask(f"{upto}", {0: range(size), 1: range(size)}, upto)


def every_plan(outputs: Outputs) -> None:
    longer_plans(outputs, range(5, 11))


def each_pair(outputs: Outputs) -> None:
    """Compare all groups, then each pair."""
    for groups in (range(len(outputs.values)), *combinations(range(len(outputs.values)), 2)):
        for size in (5, 10):
            outputs.ask(f"{groups}", {group: range(size) for group in groups})


def best_and_worst(outputs: Outputs) -> None:
    """Compare all groups, then the best and the worst."""
    for size in (5, 10):
        outputs.ask("all", {group: range(size) for group in range(len(outputs.values))})
    means = [float(np.mean(row[:10])) for row in outputs.values]
    for size in (5, 10):
        outputs.ask("two", {group: range(size) for group in (means.index(max(means)), means.index(min(means)))})


def leave_one_out(outputs: Outputs) -> None:
    """Compare ten seeds, then leave out each of them."""
    for left_out in (None, *range(10)):
        seeds = [seed for seed in range(10) if seed != left_out]
        outputs.ask(f"without {left_out}", {0: seeds, 1: seeds}, now=True)


def one_more_group(outputs: Outputs) -> None:
    """Compare two groups, then three, and so on."""
    for count, size in product(range(2, len(outputs.values) + 1), (5, 10)):
        outputs.ask(f"{count}", {group: range(size) for group in range(count)})


def lowest_deleted(outputs: Outputs) -> None:
    """Delete the leading group's lowest seed, and only then compare."""
    rows = [row[:10] for row in outputs.values]
    leader = int(np.mean(rows, axis=1).argmax())
    lowest = rows[leader].index(min(rows[leader]))
    outputs.ask("one", {group: [s for s in range(10) if (group, s) != (leader, lowest)] for group in (0, 1)}, now=True)


ASKERS: Mapping[str, tuple[Callable[[Outputs], None], int, int]] = {  # with how many groups and seeds
    "plans of 10, 20 and 40 in turn": (longer_plans, 2, 40),
    "plans of 5, 6 ... 10 in turn": (every_plan, 2, 10),
    "eight groups, then each pair": (each_pair, 8, 10),
    "five groups, then best and worst": (best_and_worst, 5, 10),
    "a seed left out, ten ways": (leave_one_out, 2, 10),
    "two groups, then three, four, five": (one_more_group, 5, 10),
    "the leader's lowest seed deleted": (lowest_deleted, 2, 10),
}


SCORES = ("last evaluation", "training")


def kept_seeds(score: str) -> dict[str, Values]:
    """Return the scores of ten kept seeds of each network: of 100 games with the last weights, or while training."""
    scores: dict[str, list[float]] = {network: [] for network in NETWORKS}
    for folder in sorted(KEPT.glob("*-uniform-s*")):
        config, result = (json.loads((folder / f"{name}.json").read_text()) for name in ("config", "result"))
        if config["training"]["precision"] == "fp32" and config["model"]["name"] in scores:
            table = TrainingEpisodes.read(folder / "artifacts" / "episodes.csv")
            scores[config["model"]["name"]].append(
                training_score(table, result["steps"], config["env"]["num_envs"])
                if score == "training"
                else result["evaluation"]["evaluation/interquartile_mean"]
            )
    return {network: np.array(values) for network, values in scores.items()}


def percent(share: float) -> str:
    """Format a share in percent for the tables."""
    return f"{100 * share:.1f}"


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the tables and the JSON line."""
    parser = parser_of("decisions", __doc__)
    parser.add_argument("--simulations", type=int, default=2_000, help="comparisons in each cell")
    count = parser.parse_args(arguments).simulations
    rng = np.random.default_rng(0)
    plan = Plan()

    began = time.perf_counter()
    for groups, follow in product(GROUPS, USERS.values()):
        for values in normal(rng, (10, groups, SEEDS)):
            follow(values, plan)
    minutes = (time.perf_counter() - began) / 10 * count * 5 / 60  # the work of five shapes, roughly
    margin = 196 * np.sqrt(0.05 * 0.95 / count)
    print(f"{count:,} comparisons a cell estimate 5 % to {margin:.1f}; about {minutes:.1f} minutes", flush=True)

    wrong = {
        f"{shape}, {groups} groups": {
            user: float(np.mean([false_decision(values, plan, follow) for values in drawn[:: 4 if looks_often else 1]]))
            for drawn in [draw(rng, (count, groups, SEEDS))]
            for user, follow in USERS.items()
            for looks_often in [follow is every_seed]  # three times the work, and far from 5 %
        }
        for (shape, draw), groups in product(SHAPES.items(), GROUPS)
    }
    print_table(
        "comparisons of equal groups that decide anything, in % (at most 5)",
        ("", *USERS),
        [(cell, *map(percent, users.values())) for cell, users in wrong.items()],
    )

    watched = {
        shape: float(np.mean([false_decision(values, plan, watching) for values in drawn]))
        for shape, draw in SHAPES.items()
        for drawn in [draw(np.random.default_rng(2), (count, 2, SEEDS))]
    }
    print_table(
        "two equal groups that are decided if the scores say when to ask, in %",
        ("", "watching"),
        [(shape, percent(share)) for shape, share in watched.items()],
    )

    askers: dict[str, dict[str, float]] = {}
    for asker, (ask, groups, size) in ASKERS.items():
        folders = [Outputs(values) for values in normal(rng, (count if groups == 2 else count // 4, groups, size))]
        for outputs in folders:
            ask(outputs)
        askers[asker] = {
            "false": float(np.mean([outputs.false for outputs in folders])),
            "silent": float(np.mean([outputs.silent for outputs in folders])),
        }
    print_table(
        "equal groups (normal) compared in several ways: any false verdict, and any without such a line, in %",
        ("", "false", "without a line"),
        [(asker, percent(row["false"]), percent(row["silent"])) for asker, row in askers.items()],
    )

    single = Plan(looks=(SEEDS,))
    power = {}
    for (shape, draw), groups, difference in product(SHAPES.items(), GROUPS, (1, 2)):
        drawn = draw(rng, (count if groups == 2 else count // 4, groups, SEEDS))
        drawn[:, 0] += difference
        share, seeds = np.mean([found(values, plan) for values in drawn], axis=0)
        at_once = np.mean([found(values, single) for values in drawn], axis=0)[0]
        power[f"{shape}, {groups} groups, {difference} sd"] = {
            "power": float(share),
            "seeds": float(seeds),
            "power_at_ten": float(at_once),
        }
    print_table(
        "one group better than all others: its pairs found in %, its mean seeds; and by one look at ten seeds",
        ("", "found", "seeds", "found at ten"),
        [(cell, percent(x["power"]), f"{x['seeds']:.1f}", percent(x["power_at_ten"])) for cell, x in power.items()],
    )

    after: dict[str, dict[str, dict[str, float]]] = {}
    for procedure, (shape, draw) in product(PROCEDURES, SHAPES.items()):
        drawn = draw(np.random.default_rng(1), (count, 2, SEEDS))  # the same for all procedures
        wrongly = np.mean([PROCEDURES[procedure](values) for values in drawn], axis=0)[0]
        apart = np.array([[1.0], [0.0]])  # sd
        decided, trained = np.mean([PROCEDURES[procedure](values + apart) for values in drawn], axis=0)
        measured = {"false": float(wrongly), "power": float(decided), "seeds": float(trained)}
        after.setdefault(procedure, {})[shape] = measured
    print_table(
        "two groups: decided though equal, in %; decided at 1 sd, in %; mean seeds at 1 sd",
        ("", "false", "power", "seeds"),
        [
            (f"{procedure}; {shape}", percent(row["false"]), percent(row["power"]), f"{row['seeds']:.1f}")
            for procedure, rows in after.items()
            for shape, row in rows.items()
        ],
    )

    plans = {
        "5 (`seeds=5`)": Plan(looks=(5,)),
        "5 and 10": plan,
        "10": single,
        "5, 10 and 20 (`seeds=20`)": Plan(looks=looks_up_to(20)),
    }
    mixtures = {
        "bimodal 70:30 and steady (a tenth of the spread)": (bimodal, steady),
        "two bimodal 70:30 and one steady": (bimodal, bimodal, steady),
        "four bimodal 70:30 and one steady": (*[bimodal] * 4, steady),
        "seven bimodal 70:30 and one steady": (*[bimodal] * 7, steady),
        "bimodal 90:10 and steady": (rarely, steady),
        "nine of ten at the cap and steady": (at_the_cap, steady),
        "log-normal and steady": (lognormal, steady),
        "log-normal and normal": (lognormal, normal),
        "normal and steady": (normal, steady),
    }
    shapes = {}
    for mixture, draws in mixtures.items():
        drawn = np.stack([draw(rng, (count, 2 * SEEDS)) for draw in draws], axis=1)
        shapes[mixture] = {
            looks: float(np.mean([false_decision(values, each, advised) for values in drawn]))
            for looks, each in plans.items()
        }
    print_table(
        "groups of one mean and different shapes that decide anything, in %, by the looks of the plan",
        ("", *plans),
        [(mixture, *map(percent, row.values())) for mixture, row in shapes.items()],
    )

    worst_groups, worst_plan = max(product(shapes, plans), key=lambda cell: shapes[cell[0]][cell[1]])

    seeds_of = {score: kept_seeds(score) for score in SCORES}
    real: dict[str, float] = {}
    needed: dict[str, dict[str, float]] = {score: {} for score in SCORES}
    long = Plan(looks=looks_up_to(40))
    for score, kept in seeds_of.items():
        for networks in combinations_with_replacement(NETWORKS, 2):
            drawn = np.stack([rng.choice(kept[each] - kept[each].mean(), (count, SEEDS)) for each in networks], axis=1)
            wrongly = np.mean([false_decision(values, plan, advised) for values in drawn])
            real[f"{score}, {' and '.join(networks)}"] = float(wrongly)
        drawn = np.stack([rng.choice(kept[each], (count // 4, 40)) for each in NETWORKS], axis=1)
        level = np.mean([kept[each].mean() for each in NETWORKS])
        centred = drawn - np.array([kept[each].mean() for each in NETWORKS])[:, None]
        for asked, rows in {"as they are": drawn, "10 % apart": centred + np.array([[level / 10], [0]])}.items():
            shares = [found(values, long) for values in rows]
            needed[score][asked] = float(np.mean([trained for _, trained in shares]))
            needed[score][f"{asked}, at ten"] = float(np.mean([found(values[:, :SEEDS], plan)[0] for values in rows]))
    print_table(
        "groups drawn from the kept seeds and centred to one mean that decide anything, in %",
        ("", "false"),
        [(cell, percent(share)) for cell, share in real.items()],
    )
    print_table(
        "DQNCnn and ResNetFast, drawn from the kept seeds: mean seeds a network until decided, in a plan of 40",
        ("", "seeds as they are", "found by ten", "seeds 10 % apart", "found by ten"),
        [
            (
                score,
                f"{row['as they are']:.1f}",
                percent(row["as they are, at ten"]),
                f"{row['10 % apart']:.1f}",
                percent(row["10 % apart, at ten"]),
            )
            for score, row in needed.items()
        ],
    )

    equivalent = {}
    for (shape, draw), delta in product(SHAPES.items(), (1.0, 2.0)):
        drawn = draw(rng, (count, 2, SEEDS))
        apart = drawn + np.array([[delta], [0.0]])
        said, at_delta = (
            np.mean([advised(x, Plan(delta=delta))[0].verdicts[0].said == "equivalent" for x in values])
            for values in (drawn, apart)
        )
        six = draw(rng, (count // 4, 6, SEEDS)) + delta * np.array([0, 1, 0, 1, 0, 1])[:, None]
        mixed = np.mean([false_of_two_means(values, Plan(delta=delta)) for values in six])
        equivalent[f"{shape}, delta {delta:g} sd"] = {
            "of_one_mean": float(said),
            "delta_apart": float(at_delta),
            "six_groups": float(mixed),
        }
    print_table(
        "two groups found equivalent within delta, and any false verdict on three groups and three delta above, in %",
        ("", "of one mean", "delta apart (false)", "of six groups (false)"),
        [(cell, *map(percent, row.values())) for cell, row in equivalent.items()],
    )

    edges = {}
    for (mixture, draws), delta in product(mixtures.items(), (0.5, 1.0, 2.0)):
        if len(draws) == 2:
            drawn = np.stack([draw(rng, (count // 2, SEEDS)) for draw in draws], axis=1)
            apart = np.array([[delta], [0.0]])
            edges[f"{mixture}, delta {delta:g} sd"] = max(  # the better one may be either
                float(np.mean([advised(x, Plan(delta=delta))[0].verdicts[0].said == "equivalent" for x in values]))
                for values in (drawn + apart, drawn - apart)
            )
    print_table(
        "groups of different shapes that are delta apart and found equivalent, in %",
        ("", "false"),
        [(cell, percent(share)) for cell, share in edges.items()],
    )

    coverage = {
        f"mean, {shape}, {size} seeds": coverage_of_means(draw(rng, (count, size)), rng)
        for (shape, draw), size in product(SHAPES.items(), (3, 5, 10))
    }
    print_table(
        "95 % intervals of a group's mean that hold it, in %",
        ("", "t (printed)", "percentile", "BCa", "studentized"),
        [(cell, *map(percent, row.values())) for cell, row in coverage.items()],
    )
    for (shape, draw), groups, step in product(SHAPES.items(), GROUPS, (0.0, 1.0)):
        means = step * np.arange(groups)
        drawn = draw(rng, (count if groups == 2 else count // 4, groups, SEEDS)) + means[:, None]
        one, every = np.mean([covered(values, means, plan) for values in drawn], axis=0)
        cell = f"difference, {shape}, {groups} groups {step:g} sd apart"
        coverage[cell] = {"one": float(one), "all": float(every)}
    print_table(
        "intervals of the verdicts that hold the true difference, in %: one of them, and all of a comparison",
        ("", "one", "all"),
        [(cell, *map(percent, row.values())) for cell, row in coverage.items() if cell.startswith("difference")],
    )

    print_results(
        {
            "simulations": count,
            "worst_false_decision": max(
                max(share for users in wrong.values() for share in users.values()),
                *real.values(),
                *(row["silent"] for row in askers.values()),
            ),
            "worst_shape": {"groups": worst_groups, "looks": worst_plan, "false": shapes[worst_groups][worst_plan]},
            "seeds_to_decide_before": needed["last evaluation"],
            "seeds_to_decide_after": needed["training"],
            "kept_seeds": real,
            "false_decisions": wrong,
            "asked_in_several_ways": askers,
            "watching": watched,
            "power": {cell: [row["power"], row["power_at_ten"]] for cell, row in power.items()},
            "seeds": {cell: row["seeds"] for cell, row in power.items()},
            "before_and_after": after,
            "different_shapes": shapes,
            "equivalent": equivalent,
            "equivalent_of_different_shapes": edges,
            "coverage": coverage,
            "seconds": round(time.perf_counter() - began),
        }
    )


if __name__ == "__main__":
    run(main)
