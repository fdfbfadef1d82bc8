"""Answer a question: train the seeds that it needs, look when a look is due, stop once it is decided.

The runs are ordinary ones. `compare` takes the looks, and its folder keeps them, so that the same command continues a
decision that was killed.
"""

import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import heapreplace
from itertools import pairwise, product
from math import sqrt
from pathlib import Path

import numpy as np

from atlantis_exp import terminal
from atlantis_exp.checking import digest, flatten, to_dict
from atlantis_exp.comparison.choosing import mixed_protocol, resolve, shortened, values_in
from atlantis_exp.comparison.decision import detectable, equivalence, looks_up_to
from atlantis_exp.comparison.estimands import score_of
from atlantis_exp.comparison.page import plain
from atlantis_exp.comparison.published import curves
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.verdict import Group, Question, families, wanted
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal
from atlantis_exp.sessions.comparing import Choice, compare
from atlantis_exp.sessions.job import Job, labels, replaced
from atlantis_exp.sessions.launchers import BASIC, Launcher
from atlantis_exp.sessions.launchers.joblib import fitting
from atlantis_exp.sessions.page import opened, terminable
from atlantis_exp.sessions.sweep import how_many, sweep
from atlantis_exp.sessions.training import measure, train
from atlantis_exp.terminal import command_line, quoted
from atlantis_exp.tracking.publishing import catch_up
from atlantis_exp.training.forecast import duration


@dataclass(eq=False)
class Contest:
    """A question about contenders, and the way to train them.

    Raises: ConfigError if two contenders are the same training, their scores are not comparable, a run was trained for
    longer, or the baseline is not a contender.
    """

    question: Question
    chosen: Sequence[tuple[str, ...]]  # the overrides of each contender that tell it from the others
    several: Sequence[str]  # the overrides with several values, as typed; empty if `against` makes the contenders
    fixed: Sequence[str]  # the overrides that all contenders share
    launcher: Launcher | None  # runs the trainings; None: as many at a time as the machine runs well
    on_a_node: Callable[[Sequence[str]], None]  # trains the job of some overrides in a process that Slurm has started
    job_of: Callable[[tuple[str, ...]], Job]  # returns the training of some overrides
    command: str  # continues the decision

    def __post_init__(self) -> None:
        question, chosen = self.question, self.chosen
        jobs = {each: self.job_of((*replaced(self.fixed, *each),)) for each in chosen}
        facts = {each: flatten(to_dict(job.config)) for each, job in jobs.items()}
        for key in question.by:
            if not all(resolve(key, each) for each in facts.values()):
                raise ConfigError(f"{key}: is not a single key; name those that differ, as in objective=dqn,quantile")
        by = shortened(question.by, facts[chosen[0]])
        self.question = replace(question, by=by)
        groups = {each: Group(values_in(facts[each], by), {}) for each in chosen}
        self.contenders = {groups[each].label: job for each, job in jobs.items()}
        named: dict[str, tuple[str, ...]] = {}  # by label, and by the name of the run
        for each in chosen:  # two may have the same label
            if (twin := named.setdefault(groups[each].label, each)) is not each:
                raise ConfigError(f"{' '.join(each)}: the same contender as {_said(twin)}")
            if (twin := named.setdefault(jobs[each].config.run_name(), each)) is not each:
                raise ConfigError(f"{' '.join(each)}: makes the same run as {_said(twin)}")
        if mixed := mixed_protocol({groups[each].label: facts[each] for each in chosen}, by):
            raise ConfigError(f"{mixed[1]}; give that key itself several values, or train them under one protocol")
        explored = {digest({key: each[key] for key in each if key.startswith("epsilon.")}) for each in facts.values()}
        if question.score == "training" and len(explored) > 1:
            raise ConfigError("score=training: depends on epsilon, in which contenders differ; use score=last")
        self.families = families(list(groups.values()), self.question)  # without seeds
        for folder in self.runs:
            if (longer := folder.beyond(self.config.budget.limits)) is not None:
                raise ConfigError(
                    f"{longer[0]}: run {folder.name} was trained for {longer[1]}; ask for as many, "
                    "or name other paths.outputs"
                )

    @property
    def config(self) -> Config:
        """The first contender's config; all share the keys for running and measuring trainings."""
        return next(iter(self.contenders.values())).config

    @property
    def outputs(self) -> Path:
        """The folder that everything is written to."""
        return Path(self.config.paths.outputs)

    @cached_property
    def folder(self) -> RunFolder:
        """The folder of the decision's page: one for each question about the same trainings."""
        identity = {
            **self.question.identity,
            "runs": sorted(folder.name for folder in self.runs),
            "budget.steps": None,
            **self.config.budget.limits,  # older decisions lack budget.flops
            "evaluation.epsilon": self.config.evaluation.epsilon,
        }
        return RunFolder(self.outputs / "decisions" / f"decide-{digest(identity)}")

    @property
    def looks(self) -> tuple[int, ...]:
        """The planned looks: numbers of seeds per contender."""
        return looks_up_to(self.question.seeds)

    @cached_property
    def here(self) -> Launcher:
        """The launcher; the machine is asked only once for a decision."""
        if self.launcher is not None:
            return self.launcher
        return fitting([*self.contenders.values()], len(self.contenders) * self.looks[0])

    @cached_property
    def runs(self) -> list[RunFolder]:
        """The runs that may belong to the answer."""
        return [self.run(label, seed) for label in self.contenders for seed in range(self.looks[-1])]

    @property
    def comparing(self) -> str:
        """The command that repeats this comparison, without spending error."""
        question = self.question
        delta = question.delta and (f"{100 * question.delta:.12g}%" if question.relative else f"{question.delta:.12g}")
        return command_line(
            *("compare", f"by={','.join(question.by)}", f"runs={self.folder.name}", f"seeds={question.seeds}"),
            f"at_epsilon={self.config.evaluation.epsilon}",
            *([f"delta={delta}"] if delta else []),
            *([f"baseline={quoted(question.baseline)}"] if question.baseline is not None else []),
            *(["score=training", f"window={question.window:.12g}"] if question.score == "training" else []),
            *([f"error={question.error}"] if question.error != Question.error else []),
            f"paths.outputs={quoted(self.outputs)}",
        )

    def job(self, label: str, seed: int) -> Job:
        """Return the training of a contender with a seed."""
        job = self.contenders[label]
        overrides = (*job.overrides, f"seed={seed}")
        # A value may follow from the seed, here or in a file of the user's: compose anew.
        if any("${" in text or text.startswith(("--config-dir=", "plugins=")) for text in overrides):
            return self.job_of(overrides)
        return replace(job, config=replace(job.config, seed=seed), overrides=overrides)

    def run(self, label: str, seed: int) -> RunFolder:
        """Return the folder of that training."""
        return RunFolder.of(self.job(label, seed).config)

    def look(self) -> Comparison | None:
        """Compare the ended runs and take the look that is due; return None before the first one is possible."""
        ended = [folder.name for folder in self.runs if folder.ended(self.config.budget.limits)]
        self.folder.write_config({"command": self.command, "runs": ended})
        if any(self.left(label, range(self.looks[0])) for label in self.contenders):
            return None
        choice = Choice(self.outputs, [self.folder.name], at_epsilon=self.config.evaluation.epsilon)
        return compare(self.question, choice, self.config.tracking, self.comparing)

    def needed(self, comparison: Comparison | None) -> dict[str, list[int]]:
        """Return the seeds that contenders lack for the next look. Raises: Fault if more would not help."""
        if comparison is None:
            lacking = {label: self.left(label, range(self.looks[0])) for label in self.contenders}
            return {label: seeds for label, seeds in lacking.items() if seeds}
        needed = wanted(comparison.answers)
        if missing := self.contenders.keys() - set(comparison.groups):
            needed = {label: [0] for label in missing}  # none of its runs could be compared
        for label, seeds in needed.items():
            if unusable := set(seeds) - set(self.left(label, seeds)):
                name = self.run(label, min(unusable)).name
                raise Fault(f"run {name} has ended but cannot be compared, as the warning above explains")
        return needed

    def left(self, label: str, seeds: Iterable[int]) -> list[int]:
        """Return the seeds with which a contender has not been trained to the end."""
        return [seed for seed in seeds if not self.run(label, seed).ended(self.config.budget.limits)]

    def jobs(self, needed: Mapping[str, Sequence[int]]) -> list[Job]:
        """Return the needed trainings: the first seed of every contender before the second."""
        order = sorted((seed, at, label) for at, (label, seeds) in enumerate(needed.items()) for seed in seeds)
        return [self.job(label, seed) for seed, _, label in order]


def _said(overrides: Sequence[str]) -> str:
    return " ".join(overrides) or "the config without it"


def decide(contest: Contest, trained: Callable[[Job], int | None] | None = None) -> None:
    """Train the seeds of the plan, look, drop what is decided, and print the answer.

    trained: trains a job in this process, one after the other; None: the contest's launcher does.

    Raises: Fault if a training fails; the same command continues.
    """
    tracking = contest.config.tracking
    again = f"continue the decision with: {contest.command}"
    catch_up(contest.outputs, tracking.uri)
    shown = labels(
        f"decide {' '.join(contest.several) or ' against '.join(contest.contenders)}", run_colour("decide"), "decision"
    )
    is_first = True
    try:
        with terminable(), opened(contest.folder, tracking, contest.outputs, shown, contest.command) as journal:
            while True:
                comparison = contest.look()
                if comparison is not None:
                    _write(journal, contest, comparison)
                if not (needed := contest.needed(comparison)):
                    break
                if is_first:
                    say_what_it_takes(contest)
                is_first = False
                try:
                    asked = contest.several, contest.command, contest.on_a_node
                    launcher = BASIC if trained else contest.here
                    sweep(contest.jobs(needed), launcher, *asked, trained or train)
                    for label, seeds in needed.items():
                        for seed in contest.left(label, seeds):
                            raise Fault(f"run {contest.run(label, seed).name} has not ended")
                except Fault as fault:
                    raise Fault(f"{fault}; {again}", fault.exit_code) from fault
    except (SystemExit, KeyboardInterrupt) as ended:
        terminal.warn(again)
        sys.exit(ended.code if isinstance(ended, SystemExit) else 130)
    if comparison is not None:
        if any(
            each.decision.contenders and each.decision.looks[-1].size < contest.looks[-1] for each in comparison.answers
        ):
            error = contest.question.error
            print(
                f"error={error:g} is spent, so seeds for a look at {contest.looks[-1]} are not trained. "
                f"To look further, allow a larger error, as in error={2 * error:g}"
            )
        print(f"compare its runs again: {contest.comparing}")
        terminal.document(comparison.document("decide").model_dump_json())


def say_what_it_takes(contest: Contest) -> None:
    """Print the number of runs, the hours that they take here, and the difference that they can find."""
    say = terminal.console().print
    looks, count = contest.looks, len(contest.contenders)
    missing = {label: contest.left(label, range(looks[-1])) for label in contest.contenders}
    fewest = f"{count * looks[0]} to " if len(looks) > 1 else ""
    say(
        f"{', '.join(contest.contenders)}: {fewest}{count * looks[-1]} runs, looks at "
        f"{' and '.join(map(str, looks))} seeds each; {count * looks[-1] - sum(map(len, missing.values()))} exist."
    )
    launcher, forecasts = BASIC if contest.launcher else contest.here, dict[str, float]()
    cores = launcher.settings.get("cores")
    if not contest.launcher:
        say(how_many(launcher))
    for label, seeds in missing.items():
        if seeds and contest.config.budget.forecast != "off":
            forecasts[label] = measure(contest.job(label, 0), cores)[1].hours
            where = "on its share" if cores else "alone on this machine"
            say(f"{label}: {duration(forecasts[label])} a run, {where}")
    if forecasts:
        at_once, hours = launcher.settings.get("n_jobs", 1), 0.0
        for span in pairwise((0, *looks)):
            ends = [hours] * at_once  # of the trainings side by side; a look waits for the last
            for seed, label in product(range(*span), forecasts):
                if seed in missing[label]:
                    heapreplace(ends, ends[0] + forecasts[label])
            hours = max(ends)
        how = "side by side" if at_once > 1 else "one after the other"
        say(f"at most {duration(hours)} {how}, evaluations not counted")
    if (known := _spread(contest)) is None:
        return
    spread, whence = known
    for family in contest.families:
        pairs = len(family.plan.pairs(family.seeds))
        averaged = spread / sqrt(min(map(len, family.groups.values())))
        words = "a difference" if len(contest.families) == 1 else f"by {family.name}, a difference"
        words += f" of {100 * detectable(family.plan, averaged, pairs):.0f} % of the score is found"
        if family.plan.delta is not None:
            least = 100 * equivalence(family.plan, averaged, pairs)
            words += f", and no difference where delta is {least:.0f} % or more,"
        say(f"{words} with a probability of 80 % at {looks[-1]} seeds")
    say(f"(if the standard deviation over seeds is {100 * spread:.0f} % of the mean, as {whence})")


def _spread(contest: Contest) -> tuple[float, str] | None:
    """Return the standard deviation over seeds as a share of the score, and its source; None if it is unknown."""
    shares = []
    for label in contest.contenders:
        runs = [contest.run(label, seed) for seed in range(contest.looks[-1])]
        if contest.question.score == "training":
            scores = list[float]()
            for run in runs:
                with suppress(ValueError, OSError):  # it has not ended, or cannot be estimated
                    scores.append(score_of(run, contest.question.window))
        else:
            ended = [run.result for run in runs]
            scores = [
                result.evaluation["evaluation/interquartile_mean"] for result in ended if result and result.evaluation
            ]
        if len(set(scores)) > 2 and np.mean(scores) > 0:
            shares.append(float(np.std(scores, ddof=1) / np.mean(scores)))
    if shares:
        return float(np.mean(shares)), "in the existing runs"
    # Of five seeds the range is 2.326 standard deviations on average.
    published = [
        (row["high"] - row["low"]) / 2.326 / row["mean"]
        for row in curves(contest.config.game)
        if row["source"].startswith("google/dopamine") and row["mean"] > 0
    ]
    return (float(np.median(published)), "in published runs (Dopamine's, five seeds)") if published else None


def _write(journal: Journal, contest: Contest, comparison: Comparison) -> None:
    """Write the looks taken and the answer to the page."""
    header, *rows = plain("looks", comparison.tables["looks"])
    table = "\n".join(f"| {' | '.join(row)} |" for row in (header, len(header) * ["---"], *rows) if rows)
    commands = [f"Continue or report: `{contest.command}`", f"Compare its runs again: `{contest.comparing}`"]
    journal.tags({"verdict": comparison.verdict})
    # MLflow cuts a long note, so what the comparison's page has, too, comes last.
    said = [comparison.verdict, *commands, *comparison.others, *comparison.caveats]
    journal.note("\n\n".join([*said, table]))
    journal.flush()
