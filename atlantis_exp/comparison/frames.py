"""Read run folders as pandas data frames for notebooks; docs/columns.md lists the columns."""

import json
import sys
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from atlantis_exp.checking import share
from atlantis_exp.comparison.choosing import select
from atlantis_exp.comparison.estimands import score_of
from atlantis_exp.comparison.gather import (
    NOT_STARTED,
    PUT_ASIDE,
    UNREADABLE,
    Evaluated,
    StoredRun,
    named_by,
    read_runs,
    refuse_unknown,
)
from atlantis_exp.comparison.published import Row
from atlantis_exp.components import facts_of, known
from atlantis_exp.faults import ConfigError
from atlantis_exp.runs.episodes import EpisodeTable
from atlantis_exp.runs.folder import fits
from atlantis_exp.runs.journal import curve
from atlantis_exp.statistics import summarize

if TYPE_CHECKING:
    import pandas as pd

_TAGS_LEFT_OUT = ("mlflow.", "atlantis.", "group")  # prefixes of tags with columns of their own
_RUN = ("run", "title", "kind", "group", "state", "error", "started", "updated", "score")
_EVALUATION = (
    *("run", "step", "source", "folder", "final", "epsilon", "evaluation_seed", "episodes"),
    *("mean", "standard_error", "median", "iqm", "lower_quartile", "upper_quartile", "low", "high"),
    *("points_per_frame", "steps_mean", "truncated_share", "random_share"),
)
_EPISODE = (
    *("run", "step", "source", "folder"),  # of its evaluation
    *("episode", "seed", "score", "steps", "frames", "truncated", "random_share"),
)
_FRAMES, _HOURS, _UPDATES = "throughput/frames", "throughput/hours", "learning/updates"
_POINT = ("run", "step", "frames", "hours", "flops")

_Parts = tuple[Row, list[Row], list["pd.DataFrame"], list["pd.DataFrame"]]
"""A run's row, evaluations, episodes and curve."""


@dataclass(frozen=True)
class Runs:
    """Run folders as pandas data frames that share the column `run`.

    runs: one row per run: its score in comparisons, config by dotted keys, the result's numbers, tags as `tag.NAME`.
    evaluations: one row per evaluation; scores in points.
    episodes: one row per evaluated episode; scores in points, lengths in steps and emulator frames.
    curves: one row per value of a training's curve, with `frames` (emulator frames of training), `hours` and `flops`
        (floating-point operations of gradient updates) so far.
    skipped: reasons by the names of the folders left out.
    """

    runs: "pd.DataFrame"
    evaluations: "pd.DataFrame"
    episodes: "pd.DataFrame"
    curves: "pd.DataFrame"
    skipped: dict[str, str]


def load_runs(
    outputs: str | Path = "outputs",
    *,
    runs: str | Sequence[str] = (),
    where: str | Sequence[str] = (),
    points: int | None = 500,
    score: Literal["last", "training"] = "last",
    window: str | float = 0.2,
) -> Runs:
    """Read the committed data of all runs under `outputs`, including unfinished ones.

    Unreadable runs are left out with a warning; runs that `resume=never` put aside are left out silently.

    Args:
        outputs: the folder of `paths.outputs`.
        runs: names, starts of names, patterns or a decision's name, as `compare runs=` takes them; none means all.
        where: KEY=VALUE of configs or tags, all required, as `compare where=` takes them. A string is split at commas.
        points: about how many points to read of a long curve, evenly spaced, with the first and the last; None means
            all.
        score: the score of a finished training, as in `compare score=`, for the column `score` of the runs.
        window: for score="training", the last share of the steps, as a number or a string such as "20%".

    Raises:
        ConfigError: if the folder is missing, an item of `runs` or a key of `where` fits no run, or `window` is wrong.
        ValueError: if points is below one, or there is no such score.
    """
    if score not in ("last", "training"):
        raise ValueError(f"score={score}: should be last or training")
    end = share("window", window)
    if points is not None and points < 1:
        raise ValueError(f"points={points}: should be at least 1; None reads all")
    outputs = Path(outputs)
    if not (outputs / "runs").is_dir():
        raise ConfigError(f"{outputs / 'runs'}: no such folder; load_runs takes the folder of paths.outputs")
    refuse_unknown(outputs, _listed(runs))
    stored, patterns = read_runs(outputs, _listed(runs)), named_by(outputs, _listed(runs))
    skipped = dict(stored.skipped)
    read = list[_Parts]()
    for run in select([run for run in stored.runs if fits(run.name, patterns)], _listed(where)):
        try:
            parts = _read(run, sys.maxsize if points is None else points, skipped)
            if score == "training" and run.trained is not None and run.folder.final_result is not None:
                parts[0]["score"] = _training_score(run, end)
            read.append(parts)
        except UNREADABLE as error:
            skipped[run.name] = f"broken: {error}"
    for name, reason in skipped.items():
        if reason not in (PUT_ASIDE, NOT_STARTED):
            warnings.warn(f"left out {name}: {reason}", stacklevel=2)
    return _assemble(read, skipped)


def _training_score(run: StoredRun, window: float) -> float:
    """Return the training score; NaN with a warning if there is none."""
    try:
        return score_of(run.folder, window)
    except (ValueError, OSError) as error:
        warnings.warn(f"{run.name} has no training score: {error}", stacklevel=3)
        return float("nan")


def _listed(texts: str | Sequence[str]) -> list[str]:
    return texts.split(",") if isinstance(texts, str) and texts else list(texts)


def _read(run: StoredRun, points: int, skipped: dict[str, str]) -> _Parts:
    """Read a run's folder; add later evaluations that are damaged to `skipped`. Raises: UNREADABLE errors."""
    folder, commit, result = run.folder, run.folder.commit, run.folder.final_result
    row = dict(run.config)
    if result is not None:
        row |= {f"result.{key}": value for key, value in result.counts.items()}
        row |= {"result.outcome": result.outcome, "result.steps": result.steps, **result.evaluation}
    row |= {f"tag.{key}": value for key, value in run.tags.items() if not key.startswith(_TAGS_LEFT_OUT)}
    row |= {
        "run": run.name,
        "title": folder.title,
        "kind": run.tags.get("atlantis.kind", "training" if run.trained else "baseline"),
        "group": run.tags.get("group", ""),
        "state": folder.state,
        "error": folder.error,
        "started": commit and commit.started,
        "updated": commit and commit.updated,
        "sources": facts_of(run.game).sources,
    }
    evaluations, episodes = list[Row](), list["pd.DataFrame"]()
    for each in sorted(run.evaluations, key=lambda each: each.step):
        try:
            table = EpisodeTable.read(each.path, row["sources"])
        except UNREADABLE as error:
            if each.folder == folder:
                raise
            skipped[f"evaluations/{each.folder.name}"] = f"broken: {error}"
            continue
        place = {"run": run.name, "step": each.step, "source": each.source}
        place["folder"] = f"{each.folder.path.parent.name}/{each.folder.name}"
        final = result is not None and each.step == result.steps
        evaluations.append({**place, "final": final, **_evaluation(each, table)})
        if final and run.trained:
            row["score"] = evaluations[-1]["iqm"]
        episodes.append(_episodes(place, table))
    return row, evaluations, episodes, _curve(run, points) if run.trained else []


def _evaluation(evaluated: Evaluated, table: EpisodeTable) -> Row:
    summary = asdict(summarize(table.scores))
    return {
        "epsilon": float(evaluated.epsilon),
        "evaluation_seed": evaluated.seed,
        **summary,
        "iqm": summary["interquartile_mean"],
        "points_per_frame": float(table.scores.sum() / table.frames.sum()),
        "steps_mean": float(table.steps.mean()),
        "truncated_share": float(table.truncated.mean()),
        "random_share": float(table.counts[:, :, 1].sum() / table.steps.sum()),
        **dict(zip(table.sources, table.points.mean(axis=0).tolist(), strict=True)),
    }


def _episodes(place: Row, table: EpisodeTable) -> "pd.DataFrame":
    import pandas as pd

    columns = {
        "episode": np.arange(len(table.scores)),
        "seed": table.seeds,
        "score": table.scores,
        "steps": table.steps.astype(np.int64),
        "frames": table.frames.astype(np.int64),
        "truncated": table.truncated.astype(np.bool_),
        "random_share": table.counts[:, :, 1].sum(axis=1) / table.steps,
        **dict(zip(table.sources, table.points.T, strict=True)),
    }
    return pd.DataFrame({**place, **columns})


def _curve(run: StoredRun, points: int) -> list["pd.DataFrame"]:
    import pandas as pd

    flops = float(run.tags.get("flops_per_update", "nan"))
    rows = []
    for point in curve(run.folder.path, (_FRAMES,), points):
        values = dict(point.values)
        so_far = (values.pop(_FRAMES), values.pop(_HOURS, np.nan), values.get(_UPDATES, np.nan) * flops)
        rows.append({**dict(zip(_POINT, (run.name, point.step, *so_far), strict=True)), **values})
    if not rows:
        return []
    long = pd.DataFrame(rows).melt([*_POINT], var_name="key").dropna(subset="value")
    return [long.sort_values("step", kind="stable")]


def _assemble(read: Sequence[_Parts], skipped: dict[str, str]) -> Runs:
    import pandas as pd

    rows = [row for row, *_ in read]
    pays = [row.pop("sources") for row in rows] or [facts_of(game).sources for game in known("env").values()]
    sources = [*dict.fromkeys(source for each in pays for source in each)]
    keys = sorted(dict.fromkeys(key for row in rows for key in row if key not in _RUN), key=_section)
    runs = pd.DataFrame({key: _column([row.get(key) for row in rows]) for key in (*_RUN, *keys)})
    for key in ("started", "updated"):
        runs[key] = pd.to_datetime(runs[key], unit="ms", utc=True)
    evaluations = pd.DataFrame([row for _, rows, *_ in read for row in rows], columns=[*_EVALUATION, *sources])
    return Runs(
        runs=runs,
        evaluations=evaluations.astype({"final": bool}),
        episodes=_joined([frame for *_, frames, _ in read for frame in frames], [*_EPISODE, *sources]),
        curves=_joined([frame for *_, frames in read for frame in frames], [*_POINT, "key", "value"]),
        skipped=skipped,
    )


def _section(key: str) -> int:
    """Return a column's place: config, then result and evaluation, then tags."""
    return 2 if key.startswith("tag.") else 1 if key.startswith("result.") or "/" in key else 0


def _joined(frames: Sequence["pd.DataFrame"], columns: list[str]) -> "pd.DataFrame":
    import pandas as pd

    return pd.concat(frames, ignore_index=True).reindex(columns=columns) if frames else pd.DataFrame(columns=columns)


def _column(values: Sequence[Any]) -> list[Any]:
    """Return values of one type, to group by and to store: lists and mixed values as JSON."""
    present = [value for value in values if value is not None]
    kinds = {"number" if type(value) in (int, float) else type(value).__name__ for value in present}
    if len(kinds) <= 1 and "list" not in kinds:
        return list(values)
    return [value if value is None or isinstance(value, str) else json.dumps(value) for value in values]
