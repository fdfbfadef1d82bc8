"""A search for the best values of any keys, by Optuna.

A search is a folder: Optuna's journal of the trials, a lock for each of them, and a run of its own that the trials'
runs are shown under. Any number of processes may work on it. A trial whose process was killed is known by its lock,
which nobody holds, and goes on with whoever looks for work next: its run is found again by its identity.
"""

import dataclasses
import io
import os
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import optuna
from optuna import Study, Trial
from optuna.pruners import MedianPruner, NopPruner
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend, JournalFileSymlinkLock
from optuna.trial import FrozenTrial, TrialState
from rich.table import Table

from atlantis_exp import terminal
from atlantis_exp.build import stream
from atlantis_exp.checking import digest
from atlantis_exp.config import TrackingConfig
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.media import run_colour
from atlantis_exp.runs.files import ARTIFACT, own, read_file
from atlantis_exp.runs.folder import RunFolder
from atlantis_exp.runs.journal import NOTE_LENGTH, Journal, Metrics, adopt
from atlantis_exp.runs.lock import alone
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.job import Job, command_line, fitted, labels
from atlantis_exp.sessions.space import Space, suggest
from atlantis_exp.sessions.stopping import StopRequest
from atlantis_exp.sessions.training import train
from atlantis_exp.tracking.publishing import publishing
from atlantis_exp.training.trainer import Trainer

_WAIT_SECONDS = 2.0  # between two looks at the trials of other processes
_SHOWN = 10  # trials in the table at the end
_STATES = {"COMPLETE": "done", "FAIL": "failed"}  # Optuna's words in ours


@dataclasses.dataclass(frozen=True)
class Request:
    """A search as it was asked for."""

    space: Space
    texts: Mapping[str, str]  # the space, as typed
    overrides: Sequence[str]  # of the training, as typed
    job_of: Callable[[Sequence[str]], Job]  # the training that overrides make; raises ConfigError
    corner: Job  # one of the trainings in the space
    trials: int
    name: str | None  # of its folder; None: made from what is searched, and over which training
    startup: int  # trials drawn at random
    pruned_after: int | None  # trials that have ended before any is cut short; None: none ever is
    spared: int  # evaluations of its own that a trial is spared
    command: str  # that continues it

    @property
    def seed(self) -> int:
        """Of all trials' trainings, and of what is proposed."""
        return self.corner.config.seed

    @property
    def tracking(self) -> TrackingConfig:
        """Where the search is mirrored to."""
        return self.corner.config.tracking


def search(request: Request) -> None:
    """Train one trial after the other, each with the values that Optuna proposes, until there are as many as asked for.

    Raises:
        ConfigError: where the folder is another search's.
        Fault: where the disk refuses, the time is over, or no trial has ended well.
    """
    stop = StopRequest(request.corner.config.budget.seconds)
    with stop.installed():
        session = _open(request)
        again = f"the search goes on with: {request.command}"
        print(f"search {session.folder.name} in {session.folder.path}: {session.counts()}", flush=True)
        page = _Page(session)
        try:
            with page.kept():
                has_ended = False
                while not has_ended and (not stop() or stop.was_a_warning()):
                    with session.claimed() as trial:
                        if trial is not None:
                            session.train(trial, stop)
                    if trial is not None:
                        page.update()
                    elif session.has_ended:
                        has_ended = True
                    else:
                        time.sleep(_WAIT_SECONDS)  # for the trials of other processes, one of which may be killed
        except SystemExit:
            terminal.warn(again)
            raise
        if not has_ended:
            stop.end(again)
    session.print_results()


def _open(request: Request) -> "_Session":
    """Open the search's folder, which other processes may work on."""
    config = request.corner.config
    facts = {"space": dict(request.texts), "training": config.science(), "budget.steps": config.budget.steps}
    name = request.name or f"search-{digest(facts)}"
    folder = RunFolder(Path(config.paths.outputs) / "searches" / name)
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    with alone(folder.path / "alone.lock"):
        if folder.has_started and folder.config != facts:
            raise ConfigError(f"name={name}: was begun for another space or another training; choose another name")
        folder.write_config(facts)
        after = request.pruned_after
        file = folder.path / "trials.jsonl"
        try:
            own(file)  # which Optuna writes where it is
            _mend(file)
            study = optuna.create_study(
                storage=JournalStorage(JournalFileBackend(str(file))),
                study_name=name,
                direction="maximize",
                pruner=NopPruner() if after is None else MedianPruner(after, request.spared + 1),
                load_if_exists=True,
            )
        except OSError:
            raise
        except Exception as error:  # Optuna checks nothing of what it reads
            reason = " ".join(f"{type(error).__name__}: {error}".split())
            raise Fault(
                f"{file} is damaged ({reason}): restore it, or begin anew with another name=, which finds the trials' "
                "runs where it draws the same values"
            ) from None
    return _Session(request, folder, study)


def _mend(file: Path) -> None:
    """Drop the end of a line that a process was killed in: the next one would be written behind it, both unreadable."""
    if not file.exists():
        return
    lock = JournalFileSymlinkLock(str(file))  # the one that all processes write under
    lock.acquire()
    try:
        content = read_file(file, ARTIFACT)
        os.truncate(file, content.rfind(b"\n") + 1)
    finally:
        lock.release()


@dataclasses.dataclass(frozen=True)
class _Session:
    """One process's share of a search."""

    request: Request
    folder: RunFolder
    study: Study

    @property
    def trials(self) -> list[FrozenTrial]:
        """All trials so far, as Optuna knows them; each at its number."""
        return self.study.get_trials(deepcopy=False)

    @property
    def has_ended(self) -> bool:
        """Whether there is nothing left to train, here or elsewhere."""
        trials = self.trials
        return len(trials) >= self.request.trials and "running" not in map(_state, trials)

    @property
    def ranking(self) -> list[FrozenTrial]:
        """The trials that were trained to their end, the best first."""
        done = [trial for trial in self.trials if _state(trial) == "done"]
        return sorted(done, key=lambda trial: -(trial.value or 0.0))

    def counts(self) -> str:
        """How many trials there are, and in which states."""
        states = Counter(_state(trial) for trial in self.trials)
        each = [f"{count} {state}" for state, count in states.items()]
        return ", ".join([f"{states.total()} of {self.request.trials} trials", *each])

    @contextmanager
    def claimed(self) -> Iterator[Trial | None]:
        """The trial to be trained next, held until the block ends: one that a killed process left, or a new one."""
        with ExitStack() as held:
            with alone(self.folder.path / "alone.lock"):
                trial = self._next()
                if trial is not None:
                    held.enter_context(self._lock(trial.number).held())
            yield trial

    def _next(self) -> Trial | None:
        trials = self.trials
        left = [trial for trial in trials if _state(trial) == "running" and not self._lock(trial.number).is_held]
        if not left and len(trials) >= self.request.trials:
            return None
        number = left[0].number if left else len(trials)
        # A seed a trial: processes that worked with one seed would propose the same, and so would a restarted one.
        seed = stream(self.request.seed, f"trial {number}").generate_state(1).item()
        self.study.sampler = TPESampler(seed=seed, n_startup_trials=self.request.startup)
        trial = Trial(self.study, left[0]._trial_id) if left else self.study.ask()
        suggest(trial, self.request.space)  # what the killed process drew already stays
        return trial

    def _lock(self, number: int) -> RunFolder:
        return RunFolder(self.folder.path / "trials" / f"{number:04}")

    def train(self, trial: Trial, stop: StopRequest) -> None:
        """Train a trial's run, from where it is, and tell Optuna how it ended; nothing where `stop` ended it."""
        overrides = [*self.request.overrides, *_values(trial)]
        watch = _Watch(trial, stop, set(self.trials[trial.number].intermediate_values), self.folder.name)
        score, error = None, ""
        try:
            score = self._score(trial, overrides, watch, stop)
        except Fault as fault:
            if isinstance(fault.__cause__, OSError):
                raise  # of the machine: no trial would fare better
            error = str(fault)
        except (RuntimeError, MemoryError) as unforeseen:  # of torch, above all where memory is short
            traceback.print_exc()
            error = f"{type(unforeseen).__name__}: {unforeseen}"
        if error:
            trial.set_user_attr("error", error)
            self.study.tell(trial.number, state=TrialState.FAIL)
        elif score is not None:
            self.study.tell(trial.number, score)
        elif watch.pruned:
            self.study.tell(trial.number, state=TrialState.PRUNED)
        else:
            return
        self._print(trial.number)

    def _score(self, trial: Trial, overrides: Sequence[str], watch: "_Watch", stop: StopRequest) -> float | None:
        """Train a trial's run; the mean of its last evaluation, None where `watch` has ended it.

        The mean is what all tables compare. Of the last evaluation, not of the best: the best of many is the luckiest.
        """
        for other in self.trials[: trial.number]:
            if other.params == trial.params and _state(other) == "running":
                raise Fault(f"trial {other.number}, which is under way, has the same values")
        try:
            job = self.request.job_of(overrides)
        except ConfigError as error:
            raise Fault(str(error)) from None
        # The time is the search's, and whatever is there of a trial is what its killed process left.
        budget = dataclasses.replace(job.config.budget, wall_clock=None)
        config = dataclasses.replace(job.config, resume="auto", budget=budget)
        run = RunFolder.of(config)
        trial.set_user_attr("run", run.name)
        with suppress(Fault), run.held():  # what runs elsewhere stays where it is
            adopt(run.path, self.folder.path)
        if (late := train(dataclasses.replace(job, config=config), watch)) is not None:
            stop.signal = late  # it came when the run had nothing left to stop
        if watch.pruned or watch.stopped:
            return None
        result = run.result
        assert result is not None
        most = config.budget.steps
        if most is not None and result.steps >= most + config.env.num_envs:
            raise Fault(f"run {run.name} was trained for {result.steps:,} steps already, more than budget.steps={most}")
        return result.evaluation["evaluation/mean"]

    def _print(self, number: int) -> None:
        trial, ranking = self.trials[number], self.ranking
        best = f"; best {ranking[0].value:,.0f} (trial {ranking[0].number})" if ranking else ""
        print(f"\ntrial {number}: {_describe(trial)}, {_outcome(trial)}{best}; {self.counts()}\n", flush=True)

    def best_command(self) -> str:
        """The command that trains the best trial's config in full, empty before there is one."""
        if not (ranking := self.ranking):
            return ""
        overrides = [
            text for text in self.request.overrides if not text.startswith(("budget.steps", "budget.wall_clock"))
        ]
        return command_line(*overrides, *_values(ranking[0]))

    def print_results(self) -> None:
        """Print the best trials, and how to train the best one in full. Raises: Fault where there is none."""
        ranking = self.ranking
        if not ranking:
            raise Fault(f"search {self.folder.name}: no trial was trained to its end; {self.counts()}")
        table = Table("trial", "mean", *self.request.space, "run", title=f"{self.folder.name}: {self.counts()}")
        for column in table.columns[:2]:
            column.justify = "right"
        for trial in ranking[:_SHOWN]:
            values = (_short(trial.params[key]) for key in self.request.space)
            table.add_row(str(trial.number), f"{trial.value:,.0f}", *values, trial.user_attrs["run"])
        console = terminal.console(least=130)
        console.print(table)
        console.print(f"\nthe best in full: {self.best_command()}", soft_wrap=True)


class _Watch:
    """Tells Optuna of a training's evaluations, and says when it is to end."""

    def __init__(self, trial: Trial, stop: StopRequest, reported: set[int], search: str) -> None:
        self.pruned = self.stopped = False
        self._trial, self._stop, self._reported, self._search = trial, stop, reported, search
        self._evaluations = 0

    def __call__(self, trainer: Trainer) -> bool:
        recorder = trainer.recorder
        if recorder.evaluations > self._evaluations:
            # Counted, not by their step: trials whose episodes have other lengths are compared all the same.
            self._evaluations = recorder.evaluations
            if self._evaluations not in self._reported:
                self._trial.report(recorder.last_metrics["evaluation/mean"], self._evaluations)
            if self._trial.should_prune():
                self.pruned = True
                where = f"trial {self._trial.number} of {self._search}, at step {trainer.counters.steps:,}"
                recorder.tracker.tags({"pruned": where})
        self.stopped = self._stop()
        return self.pruned or self.stopped


class _Page:
    """The search's own run, written by whichever of its processes holds it."""

    def __init__(self, session: _Session) -> None:
        self._session = session
        self._held = ExitStack()
        self._journal: Journal | None = None
        self._drawn = 0  # trials in the figures

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Write the page before and after the block."""
        error: BaseException | None = None
        with self._held:
            try:
                self.update()
                yield
            except BaseException as raised:
                error = raised
                raise
            finally:
                self.update()
                if self._journal is not None:
                    if self._session.has_ended:
                        self._journal.status("FINISHED")
                    elif isinstance(error, Exception):
                        self._journal.status("FAILED", str(error))
                    else:
                        self._journal.status("KILLED")

    def update(self) -> None:
        """Write what state the trials are in, if no other process does."""
        if self._journal is None and not self._session.folder.is_held:
            self._take()
        if self._journal is not None:
            self._write(self._journal)

    def _take(self) -> None:
        session, request = self._session, self._session.request
        try:
            self._held.enter_context(session.folder.held())
        except Fault:
            return  # another process was faster
        shown = labels(f"search {' '.join(request.space)}", run_colour("search"), "search")
        journal = self._held.enter_context(publishing(session.folder, request.tracking, request.corner.outputs, shown))
        if not journal.resume():
            journal.params({f"space/{key}": text for key, text in request.texts.items()})
        journal.tags(provenance(request.command))
        journal.status("RUNNING")
        self._journal = journal

    def _write(self, journal: Journal) -> None:
        session = self._session
        told = {record.step for record in session.folder.records() if isinstance(record, Metrics)}
        ranking = session.ranking
        for trial in sorted(ranking, key=lambda trial: trial.number):
            if trial.number not in told:
                best = max(other.value or 0.0 for other in ranking if other.number <= trial.number)
                journal.metrics({"search/mean": trial.value or 0.0, "search/best": best}, trial.number)
        rows = [
            f"| {trial.number} | {_describe(trial)} | {_outcome(trial)} | {trial.user_attrs.get('run', '')} |"
            for trial in [*ranking, *(trial for trial in session.trials if trial not in ranking)]
        ]
        parts = [
            f"{session.counts()}. Continue, or help along from another terminal: `{session.request.command}`",
            f"The best in full: `{session.best_command()}`" if ranking else "",
        ]
        above = "\n\n".join(part for part in parts if part)
        table = ["| trial | values | result | run |", "| ---: | --- | --- | --- |", *rows]
        journal.note(f"{above}\n\n{fitted(table, NOTE_LENGTH - len(above), '`trials.jsonl`')}")
        if len(ranking) > max(1, self._drawn):
            self._drawn = len(ranking)
            for name, picture in _draw(session.study).items():
                journal.artifact(f"{name}.png", picture)
        journal.flush()


def _draw(study: Study) -> dict[str, bytes]:
    """Which keys matter, which values go together, and how the search went, as PNGs by name.

    Importance is Optuna's default, PED-ANOVA: it asks what tells the better trials from all, in milliseconds, and needs
    no forest of trees to be fitted as fANOVA does.
    """
    import matplotlib as mpl

    mpl.use("agg")
    from matplotlib import pyplot as plt
    from optuna.visualization import matplotlib as drawing

    drawers: dict[str, Callable[[Study], Any]] = {
        "importance": drawing.plot_param_importances,
        "parallel_coordinates": drawing.plot_parallel_coordinate,
        "history": drawing.plot_optimization_history,
    }
    pictures = {}
    with mpl.rc_context(), warnings.catch_warnings():  # Optuna sets a style of its own, and calls it experimental
        warnings.simplefilter("ignore")
        for name, draw in drawers.items():
            figure = draw(study).figure
            figure.set_size_inches(9, 5)
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", dpi=100, bbox_inches="tight")
            plt.close(figure)
            pictures[name] = buffer.getvalue()
    return pictures


def _values(trial: Trial | FrozenTrial) -> list[str]:
    return [f"{key}={value}" for key, value in trial.params.items()]


def _describe(trial: FrozenTrial) -> str:
    return " ".join(f"{key}={_short(value)}" for key, value in trial.params.items())


def _outcome(trial: FrozenTrial) -> str:
    match _state(trial):
        case "done":
            return f"mean {trial.value:,.0f}"
        case "pruned":
            return f"pruned at evaluation {trial.last_step} with mean {trial.value:,.0f}"
        case "failed":
            return f"failed: {trial.user_attrs['error']}"
        case state:
            return state


def _state(trial: FrozenTrial) -> str:
    return _STATES.get(trial.state.name, trial.state.name.lower())


def _short(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
