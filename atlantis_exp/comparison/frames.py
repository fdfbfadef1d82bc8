"""Run folders to pandas data frames, for a notebook; docs/notebooks.md lists their columns."""

import csv
import json
import re
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from atlantis_exp.checking import flatten, to_dict
from atlantis_exp.comparison.gather import Training, fits, is_of_another, named_by, select
from atlantis_exp.components import facts_of, game_of, known
from atlantis_exp.faults import ConfigError, Fault
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.facts import read_facts
from atlantis_exp.runs.folder import EVALUATION, RESULT, Result, RunFolder, all_runs
from atlantis_exp.runs.journal import curve
from atlantis_exp.statistics import summarize

if TYPE_CHECKING:
    import pandas as pd

Row = dict[str, Any]
Array = npt.NDArray[Any]

_FRAMES, _HOURS, _UPDATES = "throughput/frames", "throughput/hours", "learning/updates"
_OWN_EVALUATION = re.compile(r"evaluation/(\d{1,18})\.csv")
_UNREADABLE = (Fault, ValueError, KeyError, TypeError, AttributeError, OSError, OverflowError, csv.Error)

_COLUMNS_OF_THEIR_OWN = ("mlflow.", "atlantis.", "group")  # tags that begin so
_RUN = ("run", "title", "kind", "group", "state", "error", "started", "updated")
_EVALUATION = (
    *("run", "step", "source", "folder", "final", "epsilon", "evaluation_seed", "episodes"),
    *("mean", "standard_error", "median", "iqm", "lower_quartile", "upper_quartile", "low", "high"),
    *("points_per_frame", "steps_mean", "truncated_share", "random_share"),
)
_PLACE = ("run", "step", "source", "folder")  # of an episode: the evaluation that it is of
_EPISODE = ("episode", "seed", "score", "steps", "frames", "truncated", "random_share")


@dataclass(frozen=True)
class Runs:
    """What run folders hold, as pandas data frames that share the column `run`.

    runs: a row a run: config leaves by their dotted keys, the result's numbers, tags as `tag.NAME`.
    evaluations: a row an evaluation; scores in points.
    episodes: a row an evaluated episode; scores in points, lengths in steps and emulator frames.
    curves: a row a value of a training's curve; `frames` (emulator frames of training), `hours` and `flops`
        (floating-point operations of gradient updates) say how far the training was.
    skipped: what was left out: a folder's name to the reason.
    """

    runs: "pd.DataFrame"
    evaluations: "pd.DataFrame"
    episodes: "pd.DataFrame"
    curves: "pd.DataFrame"
    skipped: dict[str, str]


@dataclass
class _Curve:
    """Points of a training's curve, and of each the keys and values that it has."""

    steps: list[int] = field(default_factory=list)
    frames: list[float] = field(default_factory=list)
    hours: list[float] = field(default_factory=list)
    flops: list[float] = field(default_factory=list)
    sizes: list[int] = field(default_factory=list)  # how many keys a point has
    keys: list[str] = field(default_factory=list)  # of all points
    values: list[float] = field(default_factory=list)


@dataclass
class _Run:
    """A run folder: its config, by which it is chosen, then all of it."""

    folder: RunFolder
    config: Row  # dotted keys
    is_training: bool
    row: Row = field(default_factory=dict)
    evaluations: list[tuple[Row, Mapping[str, Array]]] = field(default_factory=list)  # each with its episodes
    curve: _Curve = field(default_factory=_Curve)

    @property
    def sources(self) -> tuple[str, ...]:
        """What pays points in its game."""
        return facts_of(game_of(str(self.config.get("env.id")))).sources

    @property
    def facts(self) -> Row:
        """What it is chosen by."""
        return self.config


def load_runs(
    outputs: str | Path = "outputs",
    *,
    runs: str | Sequence[str] = (),
    where: str | Sequence[str] = (),
    points: int | None = 500,
) -> Runs:
    """Read the runs under `outputs`, also those that still go on, from their folders.

    Runs that cannot be read are left out with a warning that names them; those that `resume=never` put aside are left
    out without one. Only what is committed counts.

    Args:
        outputs: the folder of `paths.outputs`.
        runs: starts or patterns of names, or a decision's name, as `compare runs=` takes them; none means all.
        where: KEY=VALUE of configs, all of which must hold, as `compare where=` takes them. A text is cut at its
            commas.
        points: about how many points of a long curve are read, evenly spaced and with the first and the last; None
            means all.

    Raises:
        ConfigError: where there is no such folder, or a key of `where` that no run has.
        ValueError: on points below one.
    """
    if points is not None and points < 1:
        raise ValueError(f"points={points}: should be at least 1, or None for all")
    outputs = Path(outputs)
    if not (outputs / "runs").is_dir():
        raise ConfigError(f"{outputs / 'runs'} is no folder: load_runs takes the folder that paths.outputs names")
    skipped: dict[str, str] = {}

    def leave_out(name: str, reason: str) -> None:
        skipped[name] = reason
        warnings.warn(f"left out {name}: {reason}", stacklevel=3)

    found, patterns = list[_Run](), named_by(outputs, _listed(runs))
    for folder in all_runs(outputs):
        if patterns and not fits(folder.name, patterns):
            continue
        if "~" in folder.name:
            skipped[folder.name] = "put aside by resume=never"
            continue
        try:
            found.append(_open(folder))
        except _UNREADABLE as error:
            leave_out(folder.name, str(error))
    if texts := _listed(where):
        found = cast(list[_Run], select(cast(list[Training], found), texts))  # it looks at configs alone
    read = []
    for run in found:
        try:
            _read(run, sys.maxsize if points is None else points)
            read.append(run)
        except _UNREADABLE as error:
            leave_out(run.folder.name, f"broken: {error}")
    by_name = {run.folder.name: run for run in read}
    for folder in _evaluations(outputs):
        try:
            facts = folder.config
            run_of = by_name.get(facts.get("run", ""))
            if run_of is not None and not is_of_another(folder, run_of.folder):
                evaluation = facts["evaluation"]
                of = (int(facts["step"]), "evaluate", evaluation["epsilon"], evaluation.get("seed"))
                _add_evaluation(run_of, folder, EVALUATION, *of)
        except _UNREADABLE as error:
            leave_out(f"evaluations/{folder.name}", f"broken: {error}")
    return _assemble(read, skipped)


def _listed(texts: str | Sequence[str]) -> list[str]:
    return texts.split(",") if isinstance(texts, str) and texts else list(texts)


def _open(folder: RunFolder) -> _Run:
    """A run by its config. Raises: ConfigError on one that is not ours."""
    tree = folder.config
    if "model" in tree:
        return _Run(folder, flatten(to_dict(folder.trained_config)), True)
    if "agent" in tree or "player" in tree:
        return _Run(folder, flatten(tree), False)
    raise ConfigError("foreign: its config.json is not one of ours")


def _read(run: _Run, points: int) -> None:
    """Fill in all that a run's folder holds. Raises: as _UNREADABLE."""
    folder, facts = run.folder, read_facts(run.folder.path)
    result, commit, tags = folder.final_result, folder.commit, facts.tags
    run.row = {
        **run.config,
        **(_numbers(result) if result else {}),
        **{f"tag.{key}": value for key, value in tags.items() if not key.startswith(_COLUMNS_OF_THEIR_OWN)},
        "run": folder.name,
        "title": folder.title,
        "kind": tags.get("atlantis.kind", "training" if run.is_training else "baseline"),
        "group": tags.get("group", ""),
        "state": folder.state,
        "error": folder.error,
        "started": commit and commit.started,
        "updated": commit and commit.updated,
    }
    seed = run.config.get("evaluation.seed")
    for name in facts.artifacts:
        if run.is_training and (own := _OWN_EVALUATION.fullmatch(name)):
            _add_evaluation(run, folder, name, int(own[1]), "training", run.config["evaluation.epsilon"], seed)
        elif not run.is_training and name == EVALUATION:
            _add_evaluation(run, folder, name, 0, run.row["kind"], np.nan, seed)
    if run.is_training:
        run.curve = _curve(folder, tags, points)


def _numbers(result: Result) -> Row:
    """A result's numbers: how far the run came, and its last evaluation under the names of its metrics."""
    counts = {f"result.{key}": value for key, value in result.counts.items()}
    return {"result.outcome": result.outcome, "result.steps": result.steps, **counts, **result.evaluation}


def _curve(folder: RunFolder, tags: Mapping[str, str], points: int) -> _Curve:
    flops, read = float(tags.get("flops_per_update", "nan")), _Curve()
    for point in curve(folder.path, (_FRAMES,), points):
        values = dict(point.values)
        read.steps.append(point.step)
        read.frames.append(values.pop(_FRAMES))
        read.hours.append(values.pop(_HOURS, np.nan))
        read.flops.append(values.get(_UPDATES, np.nan) * flops)
        read.sizes.append(len(values))
        read.keys += map(sys.intern, values)
        read.values += values.values()
    return read


def _add_evaluation(
    run: _Run, folder: RunFolder, table: str, step: int, source: str, epsilon: float, seed: int | None
) -> None:
    """Add the evaluation of a run whose episodes a folder holds. Raises: as _UNREADABLE."""
    episodes = EpisodeTable.read(folder.artifact(table), run.sources)
    summary = summarize(episodes.scores)
    random = episodes.counts[:, :, 1].sum(axis=1)
    row = {
        "run": run.folder.name,
        "step": step,
        "source": source,
        "folder": f"{folder.path.parent.name}/{folder.name}",
        "final": step == run.row.get("result.steps"),
        "epsilon": float(epsilon),
        "evaluation_seed": seed,
        "episodes": summary.episodes,
        "mean": summary.mean,
        "standard_error": summary.standard_error,
        "median": summary.median,
        "iqm": summary.interquartile_mean,
        "lower_quartile": summary.lower_quartile,
        "upper_quartile": summary.upper_quartile,
        "low": summary.low,
        "high": summary.high,
        "points_per_frame": float(episodes.scores.sum() / episodes.frames.sum()),
        "steps_mean": float(episodes.steps.mean()),
        "truncated_share": float(episodes.truncated.mean()),
        "random_share": float(random.sum() / episodes.steps.sum()),
        **dict(zip(run.sources, episodes.points.mean(axis=0).tolist(), strict=True)),
    }
    columns = {
        "episode": np.arange(summary.episodes),
        "seed": episodes.seeds,
        "score": episodes.scores,
        "steps": episodes.steps.astype(np.int64),
        "frames": episodes.frames.astype(np.int64),
        "truncated": episodes.truncated.astype(np.bool_),
        "random_share": random / episodes.steps,
        **dict(zip(run.sources, episodes.points.T, strict=True)),
    }
    run.evaluations.append((row, columns))


def _evaluations(outputs: Path) -> list[RunFolder]:
    """The finished runs of the verb `evaluate`, the latest last."""

    def age(folder: RunFolder) -> tuple[int, str]:
        try:
            return (folder.commit.updated if folder.commit else 0), folder.name
        except Fault:  # who reads it names it
            return 0, folder.name

    return sorted((RunFolder(path.parent) for path in (outputs / "evaluations").glob(f"*/{RESULT}")), key=age)


def _assemble(read: Sequence[_Run], skipped: dict[str, str]) -> Runs:
    import pandas as pd

    # Of configs, results and tags the columns of all runs together, whatever the first run has.
    keys: dict[str, None] = {key: None for run in read for key in run.config}
    keys |= {key: None for run in read for key in run.row if not key.startswith("tag.") and key not in _RUN}
    keys |= {key: None for run in read for key in run.row if key.startswith("tag.")}
    runs = pd.DataFrame({key: _column([run.row.get(key) for run in read]) for key in (*_RUN, *keys)})
    for key in ("started", "updated"):
        runs[key] = pd.to_datetime(runs[key], unit="ms", utc=True)

    # By step, and of one step the training's own first, then the others by their age.
    evaluations = [pair for run in read for pair in sorted(run.evaluations, key=lambda pair: int(pair[0]["step"]))]
    pays = [run.sources for run in read] or [facts_of(game).sources for game in known("env").values()]
    sources = [*dict.fromkeys(source for each in pays for source in each)]
    columns = [*_EVALUATION, *sources]
    sizes = [row["episodes"] for row, _ in evaluations]
    episodes = {key: np.repeat(np.array([row[key] for row, _ in evaluations], object), sizes) for key in _PLACE}
    episodes |= {key: _joined([columns[key] for _, columns in evaluations]) for key in _EPISODE}
    for source in sources:  # of a run of another game there is none
        episodes[source] = _joined(
            [columns.get(source, np.full(len(columns["score"]), np.nan)) for _, columns in evaluations]
        )

    curves = [run.curve for run in read]
    values = {
        "run": np.repeat(np.array([run.folder.name for run in read], object), [len(each.keys) for each in curves]),
        **{
            key: _joined([np.repeat(np.array(getattr(each, name)), each.sizes) for each in curves if each.sizes])
            for key, name in (("step", "steps"), ("frames", "frames"), ("hours", "hours"), ("flops", "flops"))
        },
        "key": [key for each in curves for key in each.keys],
        "value": [value for each in curves for value in each.values],
    }
    return Runs(
        runs=runs,
        evaluations=pd.DataFrame([row for row, _ in evaluations], columns=columns).astype({"final": bool}),
        episodes=pd.DataFrame(episodes).infer_objects().astype({"truncated": bool}),
        curves=pd.DataFrame(values).infer_objects(),
        skipped=skipped,
    )


def _joined(arrays: Sequence[Array]) -> Array:
    return np.concatenate(arrays) if arrays else np.array([])


def _column(values: Sequence[Any]) -> list[Any]:
    """Values of one type, to group by and to keep in a file: lists, and what else numbers are mixed with, as JSON."""
    present = [value for value in values if value is not None]
    kinds = {"number" if type(value) in (int, float) else type(value).__name__ for value in present}
    if len(kinds) <= 1 and "list" not in kinds:
        return list(values)
    return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
