"""A question answered: trains the seeds that it needs, looks when a look is due, stops when it is decided.

The runs are ordinary ones, and the looks are those of `compare` over them, whose folder remembers them: killed at any
moment, the same command goes on where it was.
"""

import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from atlantis_exp import terminal
from atlantis_exp.build import build_trainer
from atlantis_exp.checking import digest, flatten, to_dict
from atlantis_exp.comparison.choosing import mixed_protocol, resolve, shortened, values_in
from atlantis_exp.comparison.published import curves
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.verdict import Family, Group, Question, families, wanted
from atlantis_exp.config import TrackingConfig
from atlantis_exp.decision import detectable, equivalence, looks_up_to
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, Metrics, NullJournal
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.comparing import Choice, compare
from atlantis_exp.sessions.job import Job, command_line, labels, quoted
from atlantis_exp.sessions.sweep import ledger, terminable
from atlantis_exp.sessions.training import expected, train
from atlantis_exp.tracking.publishing import catch_up, publishing
from atlantis_exp.training.forecast import duration
from atlantis_exp.training.plan import Counters
from atlantis_exp.training.progress import Progress


@dataclass(frozen=True)
class Request:
    """A question as it was asked for."""

    question: Question
    contenders: Sequence[tuple[str, ...]]  # the overrides that tell each from the others
    several: Sequence[str]  # the overrides with several values, as typed
    fixed: Sequence[str]  # the overrides that all contenders share
    launcher: Sequence[str]  # the overrides that choose what runs the trainings; none: this process, one by one
    job_of: Callable[[tuple[str, ...]], Job]  # the training that overrides make; raises ConfigError
    command: str  # that continues it


def decide(request: Request) -> None:
    """Train the contenders' seeds in the order of the plan, look, drop what is decided, and say the answer.

    Raises:
        ConfigError: where two contenders are the same training, their scores would not mean the same, a run was trained
            for longer, or the baseline is none of them.
        Fault: where a training fails; the same command goes on.
    """
    with terminal.working("composing the runs"):
        session = _Session.of(request)
    outputs = session.outputs
    catch_up(outputs, session.tracking.uri)
    shown = labels(f"decide {' '.join(request.several)}", run_colour("decide"), "decision")
    with session.folder.held(), terminable(), publishing(session.folder, session.tracking, outputs, shown) as journal:
        try:
            journal.resume()
            journal.tags(provenance(request.command))
            journal.status("RUNNING")
            session.say_what_it_takes()
            while True:
                comparison = session.look()
                if comparison is not None:
                    session.write(journal, comparison)
                needed = session.needed(comparison)
                if not needed:
                    break
                session.train(needed)
            journal.finish()
        except (SystemExit, KeyboardInterrupt) as ended:
            journal.status("KILLED")
            terminal.warn(f"the decision goes on with: {request.command}")
            sys.exit(ended.code if isinstance(ended, SystemExit) else 130)
        except BaseException as error:
            is_late = isinstance(error, Fault) and error.exit_code == 124
            journal.status("KILLED" if is_late else "FAILED", str(error))
            raise
    print(f"its runs again: {session.comparing}")


@dataclass(frozen=True)
class _Session:
    """A question on its way to an answer."""

    request: Request
    contenders: Mapping[str, tuple[tuple[str, ...], Job]]  # by the labels that a comparison gives their groups
    asked: Sequence[Family]  # without seeds
    folder: RunFolder

    @classmethod
    def of(cls, request: Request) -> "_Session":
        jobs = {chosen: request.job_of((*request.fixed, *chosen)) for chosen in request.contenders}
        facts_of = {chosen: flatten(to_dict(job.config)) for chosen, job in jobs.items()}
        keys = request.question.by
        if unknown := [key for key in keys for facts in facts_of.values() if not resolve(key, facts)]:
            raise ConfigError(f"{unknown[0]}: is no single key; name those that differ, as in objective=dqn,quantile")
        question = replace(request.question, by=shortened(keys, facts_of[request.contenders[0]]))
        contenders: dict[str, tuple[tuple[str, ...], Job]] = {}
        configs: dict[str, dict[str, Any]] = {}
        trained: dict[str, tuple[str, ...]] = {}  # by the name of the run
        groups = []
        for chosen in request.contenders:  # of which two may be written alike
            job = jobs[chosen]
            group = Group(values_in(facts_of[chosen], question.by), {})
            if group.label in contenders:
                raise ConfigError(f"{' '.join(chosen)}: the same contender as {' '.join(contenders[group.label][0])}")
            if (twin := trained.setdefault(job.config.run_name(), chosen)) is not chosen:
                raise ConfigError(f"{' '.join(chosen)}: trains what {' '.join(twin)} trains, under the same name")
            contenders[group.label], configs[group.label] = (chosen, job), facts_of[chosen]
            groups.append(group)
        if mixed := mixed_protocol(configs, question.by):
            raise ConfigError(f"{mixed[1]}; give that key itself several values, or train them under one protocol")
        asked = families(groups, question)
        config = next(iter(contenders.values()))[1].config
        session = cls(replace(request, question=question), contenders, asked, RunFolder(Path(config.paths.outputs)))
        session.refuse_longer_runs()
        identity = {
            **vars(question),
            "runs": sorted(folder.name for folder in session.runs),
            "budget.steps": config.budget.steps,
            "evaluation.epsilon": config.evaluation.epsilon,
        }
        return replace(session, folder=RunFolder(session.folder.path / "decisions" / f"decide-{digest(identity)}"))

    @property
    def outputs(self) -> Path:
        return self.folder.path.parents[1]

    @property
    def tracking(self) -> TrackingConfig:
        return self._first.config.tracking

    @property
    def _first(self) -> Job:
        return next(iter(self.contenders.values()))[1]

    @property
    def epsilon(self) -> float:
        """Of the evaluations that count, the same for all contenders."""
        return self._first.config.evaluation.epsilon

    @property
    def looks(self) -> tuple[int, ...]:
        """Numbers of seeds a contender."""
        return looks_up_to(self.request.question.seeds)

    @property
    def runs(self) -> list[RunFolder]:
        """The runs that may belong to the answer."""
        seeds = range(self.looks[-1])
        return [RunFolder.of(self.job(label, seed).config) for label in self.contenders for seed in seeds]

    @property
    def comparing(self) -> str:
        """The command that compares the runs as they have been here, which spends no error and finds nothing else."""
        question = self.request.question
        delta = f"{question.delta:.12g}" if question.delta is not None else ""
        if question.delta is not None and question.relative:
            delta = f"{100 * question.delta:.12g}%"
        return command_line(
            *("compare", f"by={','.join(question.by)}", f"runs={self.folder.name}", f"seeds={question.seeds}"),
            f"at_epsilon={self.epsilon}",
            *([f"delta={delta}"] if delta else []),
            *([f"baseline={quoted(question.baseline)}"] if question.baseline is not None else []),
            *([f"error={question.error}"] if question.error != Question.error else []),
            f"paths.outputs={quoted(str(self.outputs))}",
        )

    def job(self, label: str, seed: int) -> Job:
        """The training of a contender with a seed."""
        _, job = self.contenders[label]
        overrides = (*job.overrides, f"seed={seed}")
        if any("${" in text for text in overrides):  # a value may follow from the seed; else composing is slow
            return self.request.job_of(overrides)
        return replace(job, config=replace(job.config, seed=seed), overrides=overrides)

    def done(self, label: str, seed: int) -> bool:
        """Whether that training has ended."""
        return self._has_ended(RunFolder.of(self.job(label, seed).config))

    def _has_ended(self, folder: RunFolder) -> bool:
        return folder.ended(self._first.config.budget.steps) is not None

    def refuse_longer_runs(self) -> None:
        """Raise ConfigError where a run that would be a seed was trained for more steps than are asked for."""
        steps = self._first.config.budget.steps
        if steps is None:
            return
        for folder in self.runs:
            # All environments step at once, so that the last of these steps may end beyond the budget.
            result = folder.result
            if result is not None and result.steps - folder.trained_config.env.num_envs >= steps:
                raise ConfigError(
                    f"budget.steps={steps}: run {folder.name} was trained for {result.steps:,} steps; ask for as many, "
                    "or for other paths.outputs"
                )

    def look(self) -> Comparison | None:
        """The comparison of what is there, with the look that is due; None until all have the first look's seeds."""
        ended = [folder.name for folder in self.runs if self._has_ended(folder)]
        self.folder.write_config({"command": self.request.command, "runs": ended})
        if not all(self.done(label, seed) for label in self.contenders for seed in range(self.looks[0])):
            return None
        choice = Choice(self.outputs, [self.folder.name], at_epsilon=self.epsilon)
        return compare(self.request.question, choice, self.tracking, self.comparing)

    def needed(self, comparison: Comparison | None) -> dict[str, list[int]]:
        """The seeds that each contender lacks for its next look; empty once there is none.

        Raises:
            Fault: where more seeds would not help.
        """
        if comparison is None:
            lacking = {
                label: [seed for seed in range(self.looks[0]) if not self.done(label, seed)]
                for label in self.contenders
            }
            return {label: seeds for label, seeds in lacking.items() if seeds}
        needed = wanted(comparison.answers)
        if missing := self.contenders.keys() - set(comparison.groups):
            needed = {label: [0] for label in missing}  # none of its runs could be compared
        for label, seeds in needed.items():
            if unusable := [seed for seed in seeds if self.done(label, seed)]:
                name = self.job(label, unusable[0]).config.run_name()
                raise Fault(f"run {name} has ended and cannot be compared; above it says why")
        return needed

    def train(self, needed: Mapping[str, Sequence[int]]) -> None:
        """Train seeds of contenders, all contenders' first seed before their second ones. Raises: Fault."""
        try:
            if not self.request.launcher:
                order = sorted({seed for seeds in needed.values() for seed in seeds})
                jobs = [self.job(label, seed) for seed in order for label, seeds in needed.items() if seed in seeds]
                with ledger(jobs, self.request.several, command=self.request.command):
                    for job in jobs:
                        if (late := train(job)) is not None:
                            sys.exit(128 + late)
            elif len(set(map(tuple, needed.values()))) == 1 and needed.keys() == self.contenders.keys():
                self._launch(next(iter(needed.values())), self.request.several)
            else:
                for label, seeds in needed.items():
                    self._launch(seeds, self.contenders[label][0])
            for label, seeds in needed.items():
                if left := [seed for seed in seeds if not self.done(label, seed)]:
                    raise Fault(f"run {self.job(label, left[0]).config.run_name()} has not ended")
        except Fault as fault:
            raise Fault(f"{fault}; the decision goes on with: {self.request.command}", fault.exit_code) from fault

    def _launch(self, seeds: Sequence[int], chosen: Sequence[str]) -> None:
        """Run a sweep by the launcher that was asked for. Raises: Fault."""
        overrides = [f"seed={','.join(map(str, seeds))}", *self.request.fixed, *chosen]
        command = [sys.executable, "-m", "atlantis_exp", "train", "-m", *self.request.launcher, *overrides]
        with subprocess.Popen(command) as sweep:
            try:
                code = sweep.wait()
            except BaseException:
                sweep.terminate()  # which has its jobs commit, and is waited for
                raise
        if code:
            raise Fault(f"a sweep ended with exit code {code}", exit_code=code if code > 0 else 128 - code)

    def say_what_it_takes(self) -> None:
        """Print how many runs there may be, the hours that they take here, and what difference they can find."""
        console = terminal.console()

        def say(text: str) -> None:
            console.print(text)

        looks, count = self.looks, len(self.contenders)
        missing = {label: sum(not self.done(label, seed) for seed in range(looks[-1])) for label in self.contenders}
        fewest = f"{count * looks[0]} to " if len(looks) > 1 else ""
        say(
            f"{', '.join(self.contenders)}: {fewest}{count * looks[-1]} runs, looks at "
            f"{' and '.join(map(str, looks))} seeds each; {count * looks[-1] - sum(missing.values())} are there."
        )
        hours = 0.0
        for label, runs in missing.items():
            if runs and self._first.config.budget.forecast != "off":
                forecast = self._forecast(label)
                hours += runs * forecast
                say(f"{label}: {duration(forecast)} a run, alone on this machine")
        if hours:
            say(f"at most {duration(hours)} where they run one after the other, evaluations not counted")
        if (known := self._spread()) is None:
            return
        spread, whence = known
        for family in self.asked:
            pairs = len(family.plan.pairs(family.seeds))
            averaged = spread / sqrt(min(map(len, family.groups.values())))
            words = "a difference" if len(self.asked) == 1 else f"by {family.name}, a difference"
            words += f" of {100 * detectable(family.plan, averaged, pairs):.0f} % of the score is found"
            if family.plan.delta is not None:
                least = 100 * equivalence(family.plan, averaged, pairs)
                words += f", and no difference where delta is {least:.0f} % or more,"
            say(f"{words} with 80 % at {looks[-1]} seeds")
        say(f"(if a contender's seeds differ as {whence}: {100 * spread:.0f} % of their mean, standard deviation)")

    def _forecast(self, label: str) -> float:
        """The hours that a contender's training takes here."""
        config = self.job(label, 0).config
        with tempfile.TemporaryDirectory() as aside:
            trainer = build_trainer(config, Path(aside), NullJournal(), Progress(Console(quiet=True)))
            with trainer.emulators:
                return expected(trainer, config, Counters()).hours

    def _spread(self) -> tuple[float, str] | None:
        """The standard deviation over seeds as a share of the score, and where that is known from; None if nowhere."""
        shares = []
        for label in self.contenders:
            ended = [RunFolder.of(self.job(label, seed).config).result for seed in range(self.looks[-1])]
            scores = [
                result.evaluation["evaluation/interquartile_mean"] for result in ended if result and result.evaluation
            ]
            if len(set(scores)) > 2 and np.mean(scores) > 0:
                shares.append(float(np.std(scores, ddof=1) / np.mean(scores)))
        if shares:
            return float(np.mean(shares)), "those that are there do"
        # Of five seeds the range is 2.326 standard deviations on average.
        published = [
            (row["high"] - row["low"]) / 2.326 / row["mean"]
            for row in curves(self._first.config.game)
            if row["source"].startswith("google/dopamine") and row["mean"] > 0
        ]
        return (float(np.median(published)), "published ones do (Dopamine's agents, five seeds)") if published else None

    def write(self, journal: Journal, comparison: Comparison) -> None:
        """Write the looks that the page does not have yet, what they spent, and what is known now."""
        there = {
            (record.step, key)
            for record in self.folder.records()
            if isinstance(record, Metrics)
            for key in record.values
        }
        for answer in comparison.answers:
            spent = 0.0
            for look in answer.decision.looks:
                spent += look.error
                values = {f"error_spent/{answer.family.name}": spent}
                for verdict in look.verdicts:
                    pair = f"{answer.family.name}/{verdict.group} over {verdict.other}"
                    values |= {f"difference/{pair}": verdict.difference}
                    values |= {f"low/{pair}": verdict.low, f"high/{pair}": verdict.high}
                named = {_metric(name): value for name, value in values.items()}
                if new := {key: value for key, value in named.items() if (look.size, key) not in there}:
                    journal.metrics(new, look.size)
        journal.tags({"verdict": comparison.verdict})
        lines = [comparison.verdict, *comparison.others, *comparison.caveats, _looks(comparison)]
        commands = f"Continue or report: `{self.request.command}`\n\nIts runs again: `{self.comparing}`"
        journal.note("\n\n".join(line for line in (*lines, commands) if line))
        journal.flush()


def _looks(comparison: Comparison) -> str:
    """The looks that were taken, as a table for MLflow's page; empty before the first."""
    rows = [
        f"| {look.size} | {verdict.group} over {verdict.other} | {verdict.said} | {verdict.difference:,.0f} "
        f"| {verdict.low:,.0f} to {verdict.high:,.0f} | {look.error:.2%} |"
        for answer in comparison.answers
        for look in answer.decision.looks
        for verdict in look.verdicts
    ]
    head = ["| look at seeds | pair | said | difference | interval | error spent |", f"|{' --- |' * 6}"]
    return "\n".join([*head, *rows]) if rows else ""


def _metric(name: str) -> str:
    """A name in MLflow's alphabet: what is measured, of what, of which pair."""
    parts = (re.sub(r"[^A-Za-z0-9_. -]|^\W", "_", part) for part in name.split("/", 2))
    whole = "/".join(parts)
    return whole if len(whole) <= 250 else f"{whole[:240]} {digest({'name': name})[:8]}"
