"""Search for the best values of any keys with Optuna.

A search is a folder: Optuna's journal of trials, a lock for each trial, and a page for their runs. Several processes
may share it. A running trial whose lock is free was killed: the next process continues it, and finds its runs by their
identity.
"""

import os
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import optuna
from optuna import Study, Trial, TrialPruned
from optuna.distributions import BaseDistribution
from optuna.pruners import MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.trial import FrozenTrial, TrialState
from pydantic import FiniteFloat
from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.build import stream
from atlantis_exp.checking import digest
from atlantis_exp.comparison.decision import mean_interval
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.files import ARTIFACT, checked, own, read_file
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import NOTE_LENGTH, Journal, Metrics, Status, adopt
from atlantis_exp.runs.lock import alone
from atlantis_exp.sessions.job import Job, fitted, labels, replaced
from atlantis_exp.sessions.page import ending, opened
from atlantis_exp.sessions.stopping import StopRequest
from atlantis_exp.sessions.training import train
from atlantis_exp.terminal import command_line
from atlantis_exp.tracking.store import first_line
from atlantis_exp.training.trainer import Trainer

_WAIT_SECONDS = 2.0  # between two looks at other processes' trials
_SHOWN = 10  # rows of the table at the end


@dataclass(frozen=True)
class Search:
    """A search that was asked for: space, training and rules."""

    space: Mapping[str, BaseDistribution]
    texts: Mapping[str, str]  # the space, as typed
    overrides: Sequence[str]  # of the training, as typed
    job_of: Callable[[Sequence[str]], Job]  # returns the training of some overrides; raises ConfigError
    corner: Job  # one of the trainings in the space
    trials: int
    seeds: int  # trainings per trial
    name: str | None  # of its folder; None: a hash of the space and the training
    startup: int  # trials drawn at random
    pruned_after: int | None  # trials that must end before any is pruned; None: never prune
    spared: int  # first evaluations, at which a trial is never pruned
    command: str  # continues the search


Train = Callable[[Job, Callable[[Trainer], bool]], int | None]


def search(asked: Search, train: Train = train) -> None:
    """Train one trial after the other, with the values that Optuna proposes.

    Raises:
        ConfigError: the folder belongs to another search.
        Fault: the disk fails, the time is up, or no trial finished.
    """
    config, again = asked.corner.config, f"continue the search with: {asked.command}"
    stop = StopRequest(config.budget.seconds)
    with stop.installed():
        trials = Trials(asked, train)
        folder = trials.folder
        print(f"search {folder.name} in {folder.path}: {trials.counts()}", flush=True)
        shown = labels(f"search {' '.join(asked.space)}", run_colour("search"), "search")
        page = partial(opened, folder, config.tracking, asked.corner.outputs, shown, asked.command)
        journal: Journal | None = None
        try:
            with ExitStack() as held:
                while True:
                    if journal is None and not folder.is_held:
                        with suppress(Fault):  # another process took it
                            journal = held.enter_context(page(ending=trials.ending))
                    if journal is not None:
                        trials.describe(journal)
                    if trials.have_ended or (stop() and not stop.was_a_warning()):
                        break
                    with trials.claimed() as trial:
                        if trial is not None:
                            trials.train(trial, stop)
                    if trial is None:
                        time.sleep(_WAIT_SECONDS)  # another process may drop its trial
        except SystemExit:
            terminal.warn(again)
            raise
        if not trials.have_ended:
            stop.end(again)
    trials.print_results()


class Trials:
    """The trials of a search, shared with other processes. Raises: ConfigError, Fault, as `search`."""

    def __init__(self, asked: Search, train: Train = train) -> None:
        config = asked.corner.config
        facts: dict[str, Any] = {"space": dict(asked.texts), "training": config.science(), "budget.steps": None}
        facts |= config.budget.limits  # older searches lack budget.flops, and seeds
        if asked.seeds > 1:
            facts["seeds"] = asked.seeds
        name = asked.name or f"search-{digest(facts)}"
        self.asked, self._train = asked, train
        self.folder = RunFolder(asked.corner.outputs / "searches" / name)
        with alone(self.folder.path / "alone.lock"):
            if self.folder.has_started and self.folder.config != facts:
                raise ConfigError(f"name={name}: is a search of another space or training; choose another name")
            self.folder.write_config(facts)
            self.study = _study(self.folder.path / "trials.jsonl", asked)

    @property
    def all(self) -> list[FrozenTrial]:
        """All trials so far, in order of their numbers."""
        return self.study.get_trials(deepcopy=False)

    @property
    def have_ended(self) -> bool:
        trials = self.all
        return len(trials) >= self.asked.trials and all(trial.state.is_finished() for trial in trials)

    @property
    def ranking(self) -> list[tuple[FrozenTrial, list[float]]]:
        """The first trial of each set of values with the scores of all its trials, the best first."""
        tried: dict[str, tuple[FrozenTrial, list[float]]] = {}
        for trial in self.all:
            if trial.state == TrialState.COMPLETE:
                tried.setdefault(str(trial.params), (trial, []))[1].extend(trial.user_attrs["scores"])
        return sorted(tried.values(), key=lambda each: -np.mean(each[1]))

    def ending(self, error: BaseException | None) -> tuple[Status, str]:
        """Return the status of the page when this process leaves it."""
        return ending(error) if error or self.have_ended else ("KILLED", "")

    def counts(self) -> str:
        """Return the number of trials, in all and by state."""
        states = Counter(trial.state.name.lower() for trial in self.all)
        each = [f"{count} {state}" for state, count in states.items()]
        return ", ".join([f"{states.total()} of {self.asked.trials} trials", *each])

    @contextmanager
    def claimed(self) -> Iterator[Trial | None]:
        """Hold the next trial for the block: one that a killed process left, or a new one; None if none is left."""
        with ExitStack() as held:
            trial = None
            with alone(self.folder.path / "alone.lock"):
                trials = self.all
                left = [each for each in trials if not (each.state.is_finished() or self._lock(each.number).is_held)]
                if left or len(trials) < self.asked.trials:
                    number = left[0].number if left else len(trials)
                    held.enter_context(self._lock(number).held())
                    # One seed per trial: with a single one, all processes would propose the same values.
                    seed = stream(self.asked.corner.config.seed, f"trial {number}").generate_state(1).item()
                    self.study.sampler = TPESampler(seed=seed, n_startup_trials=self.asked.startup)
                    trial = Trial(self.study, left[0]._trial_id) if left else self.study.ask()
                    for key, distribution in self.asked.space.items():
                        trial._suggest(key, distribution)  # keeps values that a killed process drew
            yield trial

    def _lock(self, number: int) -> RunFolder:
        return RunFolder(self.folder.path / "trials" / f"{number:04}")

    def train(self, trial: Trial, stop: StopRequest) -> None:
        """Train or continue a trial's runs and tell Optuna the result, unless `stop` ended them."""
        scores: list[float] = []
        try:
            for index in range(self.asked.seeds):
                if (score := self._score(trial, index, stop)) is None:
                    return
                scores.append(score)
            trial.set_user_attr("scores", scores)
            self.study.tell(trial.number, float(np.mean(scores)))
        except TrialPruned:
            self.study.tell(trial.number, state=TrialState.PRUNED)
        except (RuntimeError, MemoryError) as error:  # a Fault, or torch's, mostly for lack of memory
            if isinstance(error.__cause__, OSError):
                raise  # the machine's error: every trial would fail
            if not isinstance(error, Fault):
                traceback.print_exc()
            trial.set_user_attr("error", first_line(error))
            self.study.tell(trial.number, state=TrialState.FAIL)
        print(f"\ntrial {trial.number}: {_described(self.all[trial.number])}; {self.counts()}\n", flush=True)

    def _score(self, trial: Trial, index: int, stop: StopRequest) -> float | None:
        """Train one of a trial's runs; return the mean of its last evaluation, None if `stop` ended it.

        The best evaluation would be the luckiest one. Raises: TrialPruned (first run only), Fault.
        """
        job = self.job(trial, index)
        # The search has the time limit. An existing run was left by a killed process.
        config = replace(job.config, resume="auto", budget=replace(job.config.budget, wall_clock=None))
        run = RunFolder.of(config)
        told = self.all[trial.number]
        trial.set_user_attr("runs", [*dict.fromkeys([*told.user_attrs.get("runs", []), run.name])])
        with suppress(Fault), run.held():  # unless it is trained elsewhere
            adopt(run.path, self.folder.path)
        seen, pruned, stopped = 0, False, False

        def watch(trainer: Trainer) -> bool:
            nonlocal seen, pruned, stopped
            recorder = trainer.recorder
            # By number, not by step: episodes of different trials differ in length.
            if index == 0 and recorder.done.evaluations > seen:
                seen = recorder.done.evaluations
                if seen not in told.intermediate_values:
                    trial.report(recorder.done.last_metrics["evaluation/mean"], seen)
                if pruned := trial.should_prune():
                    where = f"trial {trial.number} of {self.folder.name}, at step {trainer.counters.steps:,}"
                    recorder.journal.tags({"pruned": where})
            stopped = stop()
            return pruned or stopped

        if (late := self._train(replace(job, config=config), watch)) is not None:
            stop.signal = late  # it came after the run had ended
        if pruned:
            raise TrialPruned
        if stopped:
            return None
        result = run.result
        assert result is not None
        if (longer := run.beyond(config.budget.limits)) is not None:
            raise Fault(f"run {run.name} was already trained for {longer[1]}, more than {longer[0]}")
        return result.evaluation["evaluation/mean"]

    def job(self, trial: FrozenTrial | Trial, index: int) -> Job:
        """Return one of a trial's trainings; values drawn again get other seeds."""
        before = sum(other.params == trial.params for other in self.all[: trial.number])
        seed = self.asked.corner.config.seed + before * self.asked.seeds + index
        return self.asked.job_of([*replaced(self.asked.overrides, f"seed={seed}"), *_values(trial)])

    def conclusion(self) -> list[str]:
        """Return the ranking's caveats, and commands that test its best values with other seeds and train them."""
        if not (ranking := self.ranking):
            return []
        best, asked, lines = ranking[0][0], self.asked, []
        if all(len(scores) == 1 for _, scores in ranking):
            lines.append("One training each: other seeds may rank them differently; seeds=3 trains three per trial.")
        if len(ranking) > 1:
            lines.append(f"The best of {len(ranking)} is partly luck: its own mean is optimistic.")
        job = self.job(best, 0)
        with suppress(ConfigError):  # without the values the config may be invalid
            default = asked.job_of(replaced(asked.overrides, f"seed={job.config.seed}"))
            if default.config.run_name() != job.config.run_name():
                shared = _without(asked.overrides, "seed", "resume", "budget.wall_clock")
                against = f"against={','.join(_values(best))}"
                lines.append(f"Better than the default? {command_line('decide', *shared, against)}")
        full = _without(job.overrides, "resume", "budget.steps", "budget.flops", "budget.wall_clock")
        return [*lines, f"The best in full: {command_line(*full)}"]

    def describe(self, journal: Journal) -> None:
        """Write the trials to the search's page."""
        told = {record.step for record in self.folder.records() if isinstance(record, Metrics)}
        best, rows = float("-inf"), ["| trial | values and result | runs |", "| ---: | --- | --- |"]
        for trial in self.all:
            rows.append(f"| {trial.number} | {_described(trial)} | {', '.join(trial.user_attrs.get('runs', []))} |")
            if trial.state == TrialState.COMPLETE and trial.value is not None:
                best = max(best, trial.value)
                if trial.number not in told:
                    journal.metrics({"search/mean": trial.value, "search/best": best}, trial.number)
        more = f"{self.counts()}. Continue, or help from another terminal: `{self.asked.command}`"
        figures = f"Figures: `optuna-dashboard {self.folder.path / 'trials.jsonl'}`"
        above = "\n\n".join([more, *self.conclusion(), figures])
        journal.note(f"{above}\n\n{fitted(rows, NOTE_LENGTH - len(above), '`trials.jsonl`')}")
        journal.flush()

    def print_results(self) -> None:
        """Print the best values and their caveats. Raises: Fault if there are none."""
        if not (ranking := self.ranking):
            raise Fault(f"search {self.folder.name}: no trial finished; {self.counts()}")
        table = Table("trial", "mean", "95 %", *self.asked.space, "run", title=f"{self.folder.name}: {self.counts()}")
        for column in table.columns[:2]:
            column.justify = "right"
        for trial, scores in ranking[:_SHOWN]:
            values = (_short(trial.params[key]) for key in self.asked.space)
            mean = f"{np.mean(scores):,.0f}"
            table.add_row(str(trial.number), mean, _interval(scores), *values, trial.user_attrs["runs"][0])
        console = terminal.console(least=130)
        console.print(table)
        for line in self.conclusion():
            console.print(f"\n{line}", soft_wrap=True)


def _study(file: Path, asked: Search) -> Study:
    """Open or begin Optuna's record of the trials. Raises: Fault if it is damaged."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    after = asked.pruned_after
    try:
        if file.exists():
            own(file)  # Optuna writes it in place
            lock = JournalFileSymlinkLock(str(file))  # all processes write under it
            lock.acquire()
            try:  # drop a last line that a killed process left unfinished
                os.truncate(file, read_file(file, ARTIFACT).rfind(b"\n") + 1)
            finally:
                lock.release()
        study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(file))),
            study_name=file.parent.name,
            direction="maximize",
            pruner=NopPruner() if after is None else MedianPruner(after, asked.spared + 1),
            load_if_exists=True,
        )
        for trial in study.get_trials(deepcopy=False):
            _check(trial, asked.space)
        return study
    except OSError:
        raise
    except Exception as error:  # Optuna does not check its file
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise Fault(
            f"{file} is damaged ({reason}): restore it, or start a search with another name=, which reuses runs of "
            "the same values"
        ) from None


@dataclass(frozen=True)
class _Told:
    """A trial's result, as far as it has one."""

    value: FiniteFloat | None
    scores: list[FiniteFloat] = field(default_factory=list)
    runs: list[str] = field(default_factory=list)
    error: str = ""


def _check(trial: FrozenTrial, space: Mapping[str, BaseDistribution]) -> None:
    """Raise an error for a trial that no search of this space has recorded."""
    told, state = checked(_Told, {**trial.user_attrs, "value": trial.value}), trial.state
    has_ended = {
        TrialState.COMPLETE: told.value is not None and bool(told.scores and told.runs),
        TrialState.PRUNED: told.value is not None,
        TrialState.FAIL: "error" in trial.user_attrs,
    }.get(state, True)
    if not (has_ended and trial.distributions.items() <= space.items()):
        raise ValueError(f"trial {trial.number} lacks its result, or is of another space")


def _interval(scores: Sequence[float]) -> str:
    """Return the 95 % interval of a mean over trainings."""
    low, high = mean_interval(scores)
    return "one training" if len(scores) == 1 else f"{low:,.0f} to {high:,.0f}"


def _without(overrides: Sequence[str], *keys: str) -> list[str]:
    return [text for text in overrides if text.partition("=")[0] not in keys]


def _values(trial: Trial | FrozenTrial) -> list[str]:
    return [f"{key}={value}" for key, value in trial.params.items()]


def _described(trial: FrozenTrial) -> str:
    """Return a trial's values and its result."""
    match trial.state:
        case TrialState.COMPLETE:
            result = f"mean {trial.value:,.0f}"
        case TrialState.PRUNED:
            result = f"pruned at evaluation {trial.last_step} with mean {trial.value:,.0f}"
        case TrialState.FAIL:
            result = f"failed: {trial.user_attrs['error']}"
        case state:
            result = state.name.lower()
    return f"{' '.join(f'{key}={_short(value)}' for key, value in trial.params.items())}, {result}"


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
