"""`python -m atlantis_exp [train] overrides`: one run; the same command again continues or reports it."""

import dataclasses
import os
import shlex
import signal
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from math import inf
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from atlantis_exp.commands.app import Launcher, job_of, run_verb, swept
from atlantis_exp.config import Config, ConfigError, flatten, to_dict
from atlantis_exp.faults import Fault

if TYPE_CHECKING:
    from collections.abc import Iterator

    from atlantis_exp.commands.runs import Result, RunFolder
    from atlantis_exp.training.progress import Progress
    from atlantis_exp.training.trainer import Trainer

_LOOK_SECONDS = 1.0  # between two looks at whether the sweep goes on


class StopRequest:
    """Turns the first SIGINT, SIGTERM or SIGUSR2, or the end of the time, into a flag that the trainer looks at.

    So does the end of the sweep that the run is a job of, as `sweep_goes_on` tells it. A second SIGINT ends the process
    at once; what was committed stays. Under Slurm SIGTERM is a warning: the run is committed and goes on, since Slurm
    itself requeues or kills it.
    """

    def __init__(self, seconds: float | None = None, sweep_goes_on: Callable[[], bool] = lambda: True) -> None:
        self.signal: int | None = None
        self._is_warned = False  # by Slurm
        self._deadline = inf if seconds is None else time.monotonic() + seconds
        self._sweep_goes_on = sweep_goes_on
        self._sweep_has_ended = False
        self._looked = 0.0  # time
        self._before: dict[int, Any] = {}  # handlers

    def __call__(self) -> bool:
        now = time.monotonic()
        if now - self._looked >= _LOOK_SECONDS:
            self._looked = now
            self._sweep_has_ended = self._sweep_has_ended or not self._sweep_goes_on()
        return self.signal is not None or self._is_warned or self._sweep_has_ended or now >= self._deadline

    def was_a_warning(self) -> bool:
        """Whether the run is to go on once it is committed; forgets the warning."""
        was_warned, self._is_warned = self._is_warned, False
        return was_warned and self.signal is None

    def leave(self, message: str) -> NoReturn:
        """End the process as the request wants it; raises Fault for the end of the time, so that a sweep goes on."""
        if self.signal is None and self._sweep_has_ended:
            raise Fault(f"the sweep has ended: {message}", exit_code=128 + signal.SIGTERM)
        if self.signal is None:
            raise Fault(f"budget.wall_clock: {message}", exit_code=124)  # as of timeout(1)
        print(f"atlantis_exp: {signal.Signals(self.signal).name}: {message}", file=sys.stderr, flush=True)
        if self.signal == signal.SIGUSR2 and callable(handler := self._before[signal.SIGUSR2]):
            handler(self.signal, None)  # submitit's own requeues the job and exits
        sys.exit(128 + self.signal)

    @contextmanager
    def installed(self) -> "Iterator[None]":
        """Listen while the block runs."""
        signals = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
        self._before = {number: signal.signal(number, self._receive) for number in signals}
        signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)  # as inherited from a launcher's worker
        try:
            yield
        finally:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def _receive(self, number: int, _: FrameType | None) -> None:
        if self.signal is not None and number == signal.SIGINT:
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.raise_signal(signal.SIGINT)
        if number == signal.SIGTERM and "SLURM_JOB_ID" in os.environ:
            self._is_warned = True  # apart, as a SIGUSR2 before it still means that the job is to be requeued
        else:
            self.signal = number


def train(config: Config, watch: "Callable[[Trainer], bool]" = lambda _: False) -> None:
    """Start the run that this config is, continue it, or print its result if it has ended.

    As a job of a sweep that another process runs, it writes the run's folder only: that process publishes it.

    watch: asked after every step; where it says so, the run is committed and left to be continued.
    """
    from atlantis_exp.commands.runs import RunFolder, settle
    from atlantis_exp.tracking.journal import adopt

    outputs = Path(config.paths.outputs)
    folder = RunFolder.of(config)
    if job_of() is None:
        settle(outputs, folder.path if folder.result is None else None)
    sweep_goes_on = watch_of(folder)
    if not sweep_goes_on():
        raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
    if config.resume == "must" and not folder.has_started:
        raise ConfigError(f"resume=must: there is no run {folder.name} under {outputs / 'runs'}")
    parent = folder.parent
    if config.resume == "never" and folder.has_started:
        kept = next(
            path for n in range(1, 10_000) if not (path := folder.path.with_name(f"{folder.name}~{n}")).exists()
        )
        with folder.held():
            folder.path.rename(kept)
        if parent is not None:
            adopt(folder.path, parent)
        print(f"the run that was here is kept as {kept}")
    if (result := final_result(config, folder)) is not None:
        print(f"run {folder.name} has ended ({result.outcome} after {result.steps:,} steps):\n")
        print(result.report)
        return
    with folder.held():
        _train(config, folder, sweep_goes_on, watch)


def final_result(config: Config, folder: "RunFolder") -> "Result | None":
    """How the run has ended, None if it goes on: it has not, or it did by its budget and has now a larger one."""
    if not folder.has_started or (result := folder.result) is None:
        return None
    budget = config.budget.steps
    return None if result.outcome == "budget" and (budget is None or budget > result.steps) else result


def watch_of(folder: "RunFolder") -> Callable[[], bool]:
    """What tells whether the process that launched this job still wants it; Slurm's jobs do without that process."""
    name, parent = job_of(), folder.parent
    if parent is None or name not in ("joblib", "apart", "ray"):
        return lambda: True
    sweep = type(folder)(parent)
    if name == "ray":  # whose machines may not see each other's locks
        return lambda: sweep.status == "RUNNING"
    return lambda: sweep.status == "RUNNING" and sweep.is_held


def _train(
    config: Config, folder: "RunFolder", sweep_goes_on: Callable[[], bool], watch: "Callable[[Trainer], bool]"
) -> None:
    from atlantis_exp.build import build_trainer, count_update_flops
    from atlantis_exp.commands.runs import Result, provenance, published
    from atlantis_exp.commands.titles import colour, group, labels, title
    from atlantis_exp.game.vector import WorkerDied
    from atlantis_exp.tracking.journal import JournalError
    from atlantis_exp.tracking.store import TRACEBACK
    from atlantis_exp.training.checkpoint import CheckpointError
    from atlantis_exp.training.progress import Progress
    from atlantis_exp.training.trainer import Diverged

    progress = Progress()
    outputs = Path(config.paths.outputs)
    command = shlex.join(["python", "-m", "atlantis_exp", *sys.argv[1:]])
    stop = StopRequest(config.budget.seconds, sweep_goes_on)
    tracking = config.tracking if job_of() is None else dataclasses.replace(config.tracking, name="none")
    shown = {**labels(title(config), colour(config)), "group": group(config), "atlantis.kind": "training"}
    about = f"Network `{config.model.name}` on {config.env.id}, seed {config.seed}. Continue or report: `{command}`"
    with stop.installed(), published(folder, tracking, outputs, shown) as journal:
        trainer: Trainer | None = None
        try:
            trainer = build_trainer(config, folder.path, journal, progress, about)
            state = trainer.checkpoints.load(trainer.memory, progress.say)
            folder.write_config(to_dict(config))
            if state is not None:
                trainer.load_state_dict(state)
                progress.say(f"continuing run {folder.name} at step {trainer.counters.steps:,}")
            else:
                journal.params({key: str(value) for key, value in flatten(to_dict(config)).items()})
                journal.artifact("config.json", (folder.path / "config.json").read_bytes())
                journal.tags({"flops_per_update": str(count_update_flops(config))})
                progress.say(f"starting run {folder.name} in {folder.path}")
            journal.tags({**provenance(), **_facts(trainer)})
            if config.budget.forecast != "off":
                # Before there is anything to publish: MLflow's import beside it took three quarters of the speed.
                _check_forecast(config, trainer.counters.steps, progress)
            journal.status("RUNNING")
            watched = partial(watch, trainer)

            def ends() -> bool:
                return stop() or watched()

            outcome = trainer.run(ends)
            while outcome == "interrupted" and stop.was_a_warning():
                progress.say(f"SIGTERM: committed at step {trainer.counters.steps:,}, going on until Slurm ends it")
                outcome = trainer.run(ends)
        except BaseException as error:
            with suppress(OSError):  # a full disk takes no status either; the next command sees that nobody holds it
                (folder.path / TRACEBACK).write_text(traceback.format_exc())
                journal.status("FAILED", str(error) or type(error).__name__)
            if isinstance(error, WorkerDied | CheckpointError | Diverged | OSError | JournalError):
                raise Fault(f"run {folder.name}: {error}; continue with: {command}") from error
            if config.compile and _is_of_compilation(error):
                reason = str(error).strip().partition("\n")[0]
                raise Fault(f"run {folder.name}: torch.compile failed, {reason}; compile=false does without") from error
            raise
        finally:
            progress.close()
            if trainer is not None:
                trainer.emulators.close()
        report = trainer.last_report or "no evaluation (evaluation.at_end=false)"
        counts = {
            "episodes": trainer.counters.episodes,
            "frames": trainer.counters.frames,
            "updates": trainer.learner.updates,
            "hours": trainer.counters.seconds / 3600,
        }
        journal.status("KILLED" if outcome == "interrupted" else "FINISHED")
        if outcome != "interrupted":  # while it is still published: a server is sent the result, too
            folder.write_result(Result(outcome, trainer.counters.steps, counts, trainer.last_metrics, report))
    if outcome == "interrupted":
        if not stop():
            return
        stop.leave(f"run {folder.name} is committed at step {trainer.counters.steps:,}; continue with: {command}")
    print(f"\n{report}\n\nrun {folder.name}: {trainer.counters.steps:,} steps, {trainer.counters.seconds:,.0f} s")


def _check_forecast(config: Config, steps_done: int, progress: "Progress") -> None:
    from atlantis_exp.build import build_forecast

    forecast = build_forecast(config, steps_done)
    progress.say(str(forecast))
    if forecast.shortage is not None:
        if config.budget.forecast == "refuse":
            raise Fault(f"{forecast.shortage}; budget.forecast=warn starts all the same")
        progress.say(f"warning: {forecast.shortage}")


def _is_of_compilation(error: BaseException) -> bool:
    from torch._dynamo.exc import TorchDynamoException  # takes a second to import

    return isinstance(error, TorchDynamoException)


def _facts(trainer: "Trainer") -> dict[str, str]:
    """What the config leaves to the machine, as tags."""
    import torch

    return {
        "device": str(trainer.learner.device),
        "precision": str(trainer.learner.dtype).removeprefix("torch."),
        "threads": str(trainer.learner.shards * torch.get_num_threads()),
    }


def sweep_ledger(configs: Sequence[Config], launcher: Launcher) -> AbstractContextManager[None]:
    """A sweep's table of runs, before and after it, and its page in MLflow."""
    from atlantis_exp.commands.sweeps import ledger

    return ledger(configs, swept(sys.argv[1:]), launcher)


def main() -> None:
    """Compose and train."""
    from atlantis_exp.commands.jobs import train_job

    run_verb("config", Config, train_job, sweep_ledger)
