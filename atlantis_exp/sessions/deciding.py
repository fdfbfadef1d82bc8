"""A question answered: trains the seeds that it needs, looks when a look is due, stops when it is decided.

The runs are ordinary ones, and the looks are those of `compare` over them, whose folder remembers them: killed at any
moment, the same command goes on where it was.
"""

import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console

from atlantis_exp.build import build_trainer
from atlantis_exp.checking import digest, flatten, to_dict
from atlantis_exp.comparison.comparing import compare
from atlantis_exp.comparison.gather import values_in
from atlantis_exp.comparison.published import literature
from atlantis_exp.comparison.tables import Comparison
from atlantis_exp.comparison.verdict import Question, wanted
from atlantis_exp.config import TrackingConfig
from atlantis_exp.decision import Plan, detectable, looks_up_to
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import Journal, NullJournal
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.job import Job, labels
from atlantis_exp.sessions.sweep import ledger
from atlantis_exp.sessions.training import expected, train
from atlantis_exp.tracking.publishing import catch_up, publishing
from atlantis_exp.training.progress import Progress

_SPARE = 2  # times the plan's seeds that may be trained, since equal games count once


@dataclass(frozen=True)
class Request:
    """A question as it was asked for."""

    question: Question
    contenders: Sequence[tuple[str, ...]]  # the overrides that tell each from the others
    several: Sequence[str]  # the overrides with several values, as typed
    fixed: Sequence[str]  # the overrides that all contenders share
    launcher: Sequence[
        str
    ]  # the overrides that choose what runs the trainings; none: this process, one after the other
    job_of: Callable[[Sequence[str]], Job]  # the training that overrides make; raises ConfigError
    command: str  # that continues it


def decide(request: Request) -> None:
    """Train the contenders' seeds in the order of the plan, look, drop what is decided, and say the answer.

    Raises:
        ConfigError: where two contenders are the same training, or the baseline is none of them.
        Fault: where a training fails; the same command goes on.
    """
    session = _Session.of(request)
    outputs = session.outputs
    catch_up(outputs)
    shown = labels(f"decide {' '.join(request.several)}", run_colour("decide"), "decision")
    try:
        with session.folder.held(), publishing(session.folder, session.tracking, outputs, shown) as journal:
            session.folder.write_config({"command": request.command, "runs": session.names})
            journal.resume()
            journal.tags(provenance(request.command))
            journal.status("RUNNING")
            session.say_what_it_takes()
            try:
                while True:
                    comparison = session.look()
                    if comparison is not None:
                        session.write(journal, comparison)
                    needed = session.needed(comparison)
                    if not needed:
                        break
                    session.train(needed)
            except BaseException:
                journal.status("KILLED")
                raise
            journal.finish()
    except (SystemExit, KeyboardInterrupt):
        print(f"atlantis_exp: the decision goes on with: {request.command}", file=sys.stderr)
        raise


@dataclass(frozen=True)
class _Session:
    """A question on its way to an answer."""

    request: Request
    contenders: Mapping[str, tuple[tuple[str, ...], Job]]  # by the labels that a comparison gives their groups
    folder: RunFolder

    @classmethod
    def of(cls, request: Request) -> "_Session":
        contenders: dict[str, tuple[tuple[str, ...], Job]] = {}
        for chosen in request.contenders:
            job = request.job_of([*request.fixed, *chosen])
            label = " ".join(values_in(flatten(to_dict(job.config)), request.question.by))
            if label in contenders:
                raise ConfigError(f"{' '.join(chosen)}: the same contender as {' '.join(contenders[label][0])}")
            contenders[label] = chosen, job
        question = request.question
        if question.baseline is not None and not any(question.baseline in label.split() for label in contenders):
            raise ConfigError(f"baseline={question.baseline}: none of the contenders {', '.join(contenders)}")
        _, first = next(iter(contenders.values()))
        identity = {"several": list(request.several), "fixed": sorted(request.fixed), **vars(question)}
        folder = RunFolder(first.outputs / "decisions" / f"decide-{digest(identity)}")
        return cls(request, contenders, folder)

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
    def looks(self) -> tuple[int, ...]:
        """Numbers of seeds a contender."""
        return looks_up_to(self.request.question.seeds)

    @property
    def names(self) -> list[str]:
        """The runs that may belong to the answer."""
        seeds = range(_SPARE * self.request.question.seeds)
        return [self.job(label, seed).config.run_name() for label in self.contenders for seed in seeds]

    def job(self, label: str, seed: int) -> Job:
        """The training of a contender with a seed."""
        _, job = self.contenders[label]
        overrides = (*(text for text in job.overrides if not text.startswith("seed=")), f"seed={seed}")
        return replace(job, config=replace(job.config, seed=seed), overrides=overrides)

    def done(self, label: str, seed: int) -> bool:
        """Whether that training has ended."""
        config = self.job(label, seed).config
        return RunFolder.of(config).ended(config.budget.steps) is not None

    def look(self) -> Comparison | None:
        """The comparison of what is there, with the look that is due; None until all have the first look's seeds."""
        if not all(self.done(label, seed) for label in self.contenders for seed in range(self.looks[0])):
            return None
        return compare(
            self.request.question,
            runs=self.names,
            where=(),
            at_epsilon=None,
            look_now=False,
            tracking=self.tracking,
            paths=self._first.config.paths,
            command=self.request.command,
        )

    def needed(self, comparison: Comparison | None) -> dict[str, list[int]]:
        """The seeds that each contender lacks for its next look; empty once there is none."""
        if comparison is None:
            lacking = {
                label: [seed for seed in range(self.looks[0]) if not self.done(label, seed)]
                for label in self.contenders
            }
            return {label: seeds for label, seeds in lacking.items() if seeds}
        needed = wanted(comparison.answers)
        most = _SPARE * self.request.question.seeds
        if spent := sorted(label for label, seeds in needed.items() if max(seeds) >= most):
            raise Fault(f"{spent[0]}: {most} seeds are not enough, since many play equal games; train it for longer")
        return needed

    def train(self, needed: Mapping[str, Sequence[int]]) -> None:
        """Train seeds of contenders, all contenders' first seed before their second ones."""
        if not self.request.launcher:
            order = sorted({seed for seeds in needed.values() for seed in seeds})
            jobs = [self.job(label, seed) for seed in order for label, seeds in needed.items() if seed in seeds]
            with ledger(jobs, self.request.several, command=self.request.command):
                for job in jobs:
                    train(job)
            return
        shared = {tuple(seeds) for seeds in needed.values()}
        if len(shared) == 1 and needed.keys() == self.contenders.keys():
            self._launch(shared.pop(), self.request.several)
            return
        for label, seeds in needed.items():
            self._launch(seeds, self.contenders[label][0])

    def _launch(self, seeds: Sequence[int], chosen: Sequence[str]) -> None:
        """Run a sweep by the launcher that was asked for. Raises: Fault."""
        overrides = [f"seed={','.join(map(str, seeds))}", *chosen, *self.request.fixed]
        command = [sys.executable, "-m", "atlantis_exp", "train", "-m", *self.request.launcher, *overrides]
        if code := subprocess.run(command, check=False).returncode:
            raise Fault(
                f"a sweep of the decision ended with exit code {code}; it goes on with: {self.request.command}",
                exit_code=code if code > 0 else 128 - code,
            )

    def say_what_it_takes(self) -> None:
        """Print how many runs there may be, the hours that they take here, and what difference they can find."""
        console = Console(highlight=False, soft_wrap=True)
        looks, question = self.looks, self.request.question
        at = " and ".join(map(str, looks))
        missing = {label: sum(not self.done(label, seed) for seed in range(looks[-1])) for label in self.contenders}
        there = len(self.contenders) * looks[-1] - sum(missing.values())
        console.print(
            f"{', '.join(self.contenders)}: looks at {at} seeds each, {len(self.contenders) * looks[0]} to "
            f"{len(self.contenders) * looks[-1]} runs, of which {there} are there",
            markup=False,
        )
        hours = 0.0
        for label, runs in missing.items():
            if runs == 0:
                continue
            job = self.job(label, 0)
            with tempfile.TemporaryDirectory() as aside:
                trainer = build_trainer(job.config, Path(aside), NullJournal(), Progress(Console(quiet=True)))
                with trainer.emulators:
                    forecast = expected(trainer, job.config, 0)
            hours += runs * forecast.hours
            console.print(f"{label}: {forecast.hours:,.2f} hours a run, one alone on this machine", markup=False)
        if hours:
            console.print(f"at most {hours:,.1f} hours if they run one after the other, evaluations not counted")
        spread, whence = self._spread()
        family = (
            len(self.contenders) - 1 if question.baseline else len(self.contenders) * (len(self.contenders) - 1) // 2
        )
        reach = detectable(Plan(looks, question.error), spread, family)
        console.print(
            f"a difference of {reach:.0%} of the score is found with 80 % at {looks[-1]} seeds, "
            f"if seeds differ as {whence}",
            markup=False,
        )

    def _spread(self) -> tuple[float, str]:
        """The standard deviation over seeds as a share of the score, and where that is known from."""
        shares = []
        for label in self.contenders:
            ended = [RunFolder.of(self.job(label, seed).config).result for seed in range(self.looks[-1])]
            scores = [
                result.evaluation["evaluation/interquartile_mean"] for result in ended if result and result.evaluation
            ]
            if len(scores) > 2 and np.mean(scores) > 0:
                shares.append(float(np.std(scores, ddof=1) / np.mean(scores)))
        if shares:
            return float(np.mean(shares)), "those that are there do"
        rows = [row for row in literature("curves") if row["mean"] > 0]
        # Of five seeds the range is 2.326 standard deviations on average.
        published = [(row["high"] - row["low"]) / 2.326 / row["mean"] for row in rows]
        return float(np.median(published)), "published ones do (Dopamine, five seeds)"

    def write(self, journal: Journal, comparison: Comparison) -> None:
        """Write the looks, what they spent and what they found to the decision's page."""
        lines = [comparison.verdict, *comparison.others, *comparison.beside]
        for answer in comparison.answers:
            decision = answer.decision
            for look in decision.looks:
                for verdict in look.verdicts:
                    pair = f"{verdict.group} over {verdict.other}"
                    measures = {"difference": verdict.difference, "low": verdict.low, "high": verdict.high}
                    journal.metrics(
                        {_metric(f"{name}/{answer.family.name}/{pair}"): value for name, value in measures.items()},
                        look.size,
                    )
            journal.metrics({_metric(f"error_spent/{answer.family.name}"): decision.spent}, len(decision.looks))
        journal.tags({"verdict": comparison.verdict})
        journal.note("\n\n".join([*lines, f"Continue or report: `{self.request.command}`"]))
        journal.flush()


def _metric(name: str) -> str:
    """A name in MLflow's alphabet."""
    return "".join(character if character.isalnum() or character in "_.- /" else "_" for character in name)
