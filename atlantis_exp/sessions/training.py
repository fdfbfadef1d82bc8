"""Run a training as a session; the same job again continues it, or prints its result."""

import dataclasses
import signal
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from atlantis_exp import terminal
from atlantis_exp.build import build_trained_network, build_trainer, choose_device, described, import_components
from atlantis_exp.checking import absolute, flatten, to_dict
from atlantis_exp.config import Config
from atlantis_exp.faults import ConfigError, Fault, in_words
from atlantis_exp.game.vector import WorkerDied
from atlantis_exp.runs.files import write_file
from atlantis_exp.runs.folder import CONFIG, LOST, TRACEBACK, Result, RunFolder, all_runs
from atlantis_exp.runs.journal import Journal, adopt, has_lost_commit
from atlantis_exp.runs.provenance import provenance
from atlantis_exp.sessions.cards import read_card
from atlantis_exp.sessions.job import Job, labels, replaced
from atlantis_exp.sessions.processor import processor_name, set_up_torch
from atlantis_exp.sessions.stopping import StopRequest, sweep_goes_on
from atlantis_exp.terminal import command_line, quoted
from atlantis_exp.tracking.publishing import catch_up, publishing
from atlantis_exp.training.checkpoint import unforged
from atlantis_exp.training.forecast import Forecast, forecast
from atlantis_exp.training.plan import Counters, Plan
from atlantis_exp.training.progress import Progress
from atlantis_exp.training.trainer import Outcome, Trainer

_FIXED = ("constant", "linear_steps")  # schedules that do not depend on a training's length


def train(job: Job, watch: Callable[[Trainer], bool] = lambda _: False) -> int | None:
    """Start a job's run, continue it, or print its result if it has ended.

    If another process runs its sweep, the job only writes the run's folder, which that process publishes.

    watch: called after every step; True commits the run and stops it.

    Returns a signal that came too late to stop the run and should stop the next one.
    """
    config, folder = job.config, RunFolder.of(job.config)
    if folder.status != "SCHEDULED":  # else a sweep has begun it and records its failure
        choose_device(config.device)  # before anything is put aside or written
        import_components(config)
        if not folder.has_started or config.resume == "never":
            _initial_weights(config)
    if _has_ended(job, folder):
        return None
    progress = Progress()
    stop = StopRequest(
        config.budget.seconds, sweep_goes_on(folder, job.launcher), job.machine.slurm_restarts is not None
    )
    tracking = config.tracking if job.launcher is None else dataclasses.replace(config.tracking, name="none")
    about = f"Network `{config.model.name}` on {config.env.id}, seed {config.seed}. Continue or report: `{job.command}`"
    with folder.held(), stop.installed(), publishing(folder, tracking, job.outputs, _labels(job)) as journal:
        with _faults_recorded(job, folder, journal), closing(progress):
            with terminal.working("making the network and the emulators"):
                set_up_torch(config, config.device)
                trainer = build_trainer(config, job.machine.cores, folder.path, journal, progress, about)
            with trainer.emulators:
                _open(trainer, job, folder, journal, progress)
                watched = partial(watch, trainer)
                outcome = trainer.run(lambda: stop() or watched())
                while outcome == "interrupted" and stop.was_a_warning():
                    at = f"{trainer.counters.steps:,}"
                    progress.say(f"SIGTERM: committed at step {at}, going on until Slurm ends it")
                    outcome = trainer.run(lambda: stop() or watched())
        if not folder.has_started:
            moved = f"{folder.path} was moved or deleted meanwhile"
            raise Fault(f"run {folder.name}: {moved}; finish it with: {job.command}")
        result = _close(trainer, folder, journal, outcome)
    steps = f"{trainer.counters.steps:,}"
    if outcome != "interrupted":
        print(f"\n{result.report}\n\nrun {folder.name}: {steps} steps, {trainer.counters.seconds:,.0f} s")
    elif stop():
        stop.end(f"run {folder.name} is committed at step {steps}; continue with: {job.command}")
    return stop.signal


def _labels(job: Job) -> dict[str, str]:
    return {**labels(job.title, job.colour, "training"), "group": job.group}


def _has_ended(job: Job, folder: RunFolder) -> bool:
    """Return whether a run has ended, and print its result; put aside a run that is to start over."""
    config = job.config
    if folder.result is not None and has_lost_commit(folder.path):
        with folder.held():
            Journal(folder.path, _labels(job)).recover()
    if job.launcher is None:
        catch_up(job.outputs, config.tracking.uri, folder.path if folder.result is None else None)
    if not sweep_goes_on(folder, job.launcher)():
        raise Fault(f"run {folder.name}: the sweep has ended", exit_code=128 + signal.SIGTERM)
    if config.resume == "must" and not folder.has_started:
        raise ConfigError(f"resume=must: no run {folder.name} under {job.outputs / 'runs'}")
    # A sweep's launcher has already put the old run aside; its or Slurm's next try of a job continues the run.
    is_first = job.launcher is None and not job.machine.slurm_restarts
    if config.resume == "never" and is_first and folder.has_started:
        parent = folder.parent
        print(f"the earlier run is kept as {folder.put_aside()}")
        if parent is not None:
            adopt(folder.path, parent)
    if (result := folder.ended(config.budget.limits)) is None:
        if folder.has_lost_checkpoints:
            raise Fault(
                f"run {folder.name}: its checkpoints are gone from {folder.checkpoints}: restore them, or start over "
                "with resume=never, which keeps the rest of the run"
            )
        return False
    how = f"{result.outcome} after {result.steps:,} steps"
    print(f"run {folder.name} has ended ({how}):\n\n{result.report}")
    limits = config.budget.limits
    unspent = [f"{key}={limit}" for key, limit in limits.items() if key not in result.spent(limits)]
    if result.outcome == "finished" and unspent:
        print(f"\n{' '.join(unspent)} has no effect: the run's plan has ended. {_begin_with(job, folder)}")
    return True


def _initial_weights(config: Config) -> Mapping[str, torch.Tensor] | None:
    """Return the exported weights that a training begins with; None for random ones. Raises: ConfigError, Fault."""
    if config.training.pinned is None:
        return None
    folder, digits = config.training.pinned
    card, content = read_card(absolute("training.weights", folder))
    if not card.sha256.startswith(digits):
        raise ConfigError(f"training.weights={config.training.weights}: its weights are @{card.sha256[:16]}")
    try:
        return build_trained_network(config, content).state_dict()
    except Fault:
        theirs = f"model={card.config.model.name}, env.size={card.config.env.size}, {card.config.objective.name}"
        raise ConfigError(f"training.weights={folder}: weights of another network ({theirs})") from None


def _open(trainer: Trainer, job: Job, folder: RunFolder, journal: Journal, progress: Progress) -> None:
    """Restore a trainer to its run's last commit, and record config, params and tags."""
    config = job.config
    with terminal.working("reading the checkpoint and the replay memory"):
        state = trainer.checkpoints.load(trainer.memory, progress.say)
    folder.write_config(to_dict(config))
    done = Counters()
    if state is None:
        if (weights := _initial_weights(config)) is not None:
            trainer.learner.begin_with(weights)
        progress.say(f"starting run {folder.name} in {folder.path}{_kin(job, folder)}")
    else:
        with unforged(folder.checkpoints):
            done = Counters.of(state["counters"])
        progress.say(f"continuing run {folder.name} at step {done.steps:,}")
    if (steps := config.budget.steps) is not None:
        names = f"epsilon={config.epsilon.name}", f"lr_schedule={config.lr_schedule.name}"
        if cut := _cut_by_budget(trainer.plan, steps, names):
            progress.say(cut)
    if config.budget.forecast != "off":
        # Before there is anything to publish: importing MLflow meanwhile costs three quarters of the speed.
        _check_forecast(trainer, config, done, progress)
    if state is None:
        journal.params({key: str(value) for key, value in flatten(to_dict(config)).items()})
        journal.artifact(CONFIG, (folder.path / CONFIG).read_bytes())
        journal.tags({"flops_per_update": str(trainer.flops_per_update)})
    else:
        with unforged(folder.checkpoints), terminal.working("playing the games up to where they were"):
            trainer.load_state_dict(state)
    if lost := trainer.checkpoints.lost:
        journal.tags({LOST: f"{lost:,} observations of the replay memory, at step {done.steps:,}"})
    facts = {
        "device": str(trainer.learner.device),
        "precision": str(trainer.learner.dtype).removeprefix("torch."),
        "processor": processor_name(trainer.learner.device),
        "threads": str(trainer.learner.shards * torch.get_num_threads()),
    }
    journal.tags({**provenance(job.command), **facts})
    journal.status("RUNNING")


def _cut_by_budget(plan: Plan, steps: int, names: tuple[str, str]) -> str:
    """Return a hint at schedules that are not where they end when the budget ends; empty if there are none.

    names: of the schedules of epsilon and of the learning rate.
    """
    if plan.unit == "episodes" or steps >= plan.length:
        return ""
    share, schedules = steps / plan.length, zip(names, (plan.epsilon, plan.learning_rate), strict=True)
    cut = [name for name, value in schedules if value(share, steps) != value(1.0, plan.length)]
    told = f"budget.steps={steps:,} ends at {share:.0%} of {' and '.join(cut)}: set the phase's steps to finish it"
    return told if cut else ""


def _kin(job: Job, folder: RunFolder) -> str:
    """Return a hint at a run that differs only in its plugins or its plan's length; empty if there is none."""
    config, science = job.config, job.config.science()
    alike = folder.name.rpartition("-")[0]
    for other in all_runs(folder.path.parents[1]):
        if other.name.startswith(f"{alike}-") and "~" not in other.name and other.name != folder.name:
            with suppress(Fault):
                trained = other.trained_config
                theirs = trained.science()
                if config.plugins and {**theirs, "plugins": None} == {**science, "plugins": None}:
                    return f"; run {other.name} used {described(trained)}, this one uses {described(config)}"
                if _any_length(theirs) == _any_length(science) and other.result is not None:
                    parts = {"epsilon": config.epsilon, "lr_schedule": config.lr_schedule}
                    follow = [f"{kind}={each.name}" for kind, each in parts.items() if each.name not in _FIXED]
                    why = f" ({' and '.join(follow)} follow the length)" if follow else ""
                    told = f"run {other.name}, of {other.result.steps:,} steps, has another plan{why}"
                    return f"; {told}: this one begins at step 0.\n{_begin_with(job, other)}"
    return ""


def _any_length(science: Mapping[str, Any]) -> dict[str, Any]:
    return {**science, "phase": [{**phase, "steps": None, "episodes": None} for phase in science["phase"]]}


def _begin_with(job: Job, folder: RunFolder) -> str:
    """Return the commands that begin a training with a run's weights."""
    weights = f"pretrained/{folder.name}"
    own = [text for text in job.overrides if not text.startswith(("budget.steps=", "budget.flops="))]
    export = command_line("export", f"run={folder.name}", f"to={weights}", f"paths.outputs={quoted(job.outputs)}")
    begin = command_line(*replaced(own, f"training.weights={weights}"))
    return f"To begin a training with its weights:\n  {export}\n  {begin}"


def measure(
    job: Job, cores: int | None = None, said: str = "measuring how fast it goes here"
) -> tuple[Trainer, Forecast]:
    """Build a training and measure its cost on so many cores; None for those of this process."""
    config = dataclasses.replace(job.config, threads=job.config.threads or cores)
    set_up_torch(config, config.device)
    with terminal.working(said), tempfile.TemporaryDirectory() as aside:
        progress = Progress(Console(quiet=True))
        trainer = build_trainer(config, cores or job.machine.cores, Path(aside), Journal(Path(aside)), progress)
        with trainer.emulators:
            return trainer, _expected(trainer, config, Counters())


def _expected(trainer: Trainer, config: Config, done: Counters) -> Forecast:
    """Return the cost of the rest of a training; leave its parts unchanged."""
    return forecast(trainer, capacity=config.replay.capacity, max_bytes=config.replay.max_bytes, done=done)


def _check_forecast(trainer: Trainer, config: Config, done: Counters, progress: Progress) -> None:
    with terminal.working("measuring how fast it goes here"):
        cost = _expected(trainer, config, done)
    progress.say(str(cost))
    if cost.shortage is not None:
        if config.budget.forecast == "refuse":
            raise Fault(f"{cost.shortage}; budget.forecast=warn starts anyway")
        progress.say(f"warning: {cost.shortage}")


@contextmanager
def _faults_recorded(job: Job, folder: RunFolder, journal: Journal) -> Iterator[None]:
    """Record why the block failed; add to a fault the command that continues the run."""
    try:
        yield
    except BaseException as error:
        with suppress(OSError):  # the disk may be full; the next command sees that no process holds the run
            write_file(folder.path / TRACEBACK, traceback.format_exc().encode())
            journal.status("FAILED", str(error) or type(error).__name__)
        if isinstance(error, WorkerDied | OSError):
            reason = in_words(error) if isinstance(error, OSError) else error
            raise Fault(f"run {folder.name}: {reason}; continue with: {job.command}") from error
        if job.config.compile and _is_of_compilation(error):
            reason = str(error).strip().partition("\n")[0]
            raise Fault(f"run {folder.name}: torch.compile failed, {reason}; set compile=false") from error
        raise


def _close(trainer: Trainer, folder: RunFolder, journal: Journal, outcome: Outcome) -> Result:
    """Record how the session ended and, if the run did, its result."""
    counters, done = trainer.counters, trainer.recorder.done
    counts = {
        "episodes": counters.episodes,
        "frames": counters.frames,
        "updates": trainer.learner.updates,
        "flops": trainer.learner.updates * trainer.flops_per_update,
        "hours": counters.seconds / 3600,
    }
    report = done.last_report or "no evaluation (evaluation.at_end=false)"
    earlier = None
    if done.last_report and done.evaluated_at != counters.steps:
        earlier = done.evaluated_at
        report = f"evaluated last at step {earlier:,} of {counters.steps:,} (evaluation.at_end=false):\n{report}"
    if outcome != "interrupted" and not trainer.learner.updates:
        report = f"no update was made in {counters.steps:,} steps: see training.learn_start and learn_every\n{report}"
    result = Result(outcome, counters.steps, counts, done.last_metrics, report, earlier)
    journal.status("KILLED" if outcome == "interrupted" else "FINISHED")
    if outcome != "interrupted":  # before publishing ends, so that a server gets the result, too
        folder.write_result(result)
    return result


def _is_of_compilation(error: BaseException) -> bool:
    from torch._dynamo.exc import TorchDynamoException  # takes a second to import

    return isinstance(error, TorchDynamoException)
