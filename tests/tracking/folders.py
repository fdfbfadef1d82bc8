"""Run folders to publish, and what MLflow shows of them, straight from its tables and files."""

import io
import json
import re
import sqlite3
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import PIL.Image

from atlantis_exp.runs.journal import Journal, Metrics, read


def rows(root: Path, query: str, *values: Any) -> list[tuple[Any, ...]]:
    with closing(sqlite3.connect(root / "mlflow.db")) as database:
        return database.execute(query, values).fetchall()


def run_id(folder: Path) -> str:
    return str(json.loads((folder / "published.json").read_bytes())["run_id"])


def points(root: Path, folder: Path) -> list[tuple[Any, ...]]:
    return rows(
        root,
        "SELECT key, step, timestamp, value FROM metrics WHERE run_uuid = ? ORDER BY step, key, timestamp",
        run_id(folder),
    )


def journaled_points(folder: Path) -> list[tuple[Any, ...]]:
    return sorted(
        (
            (key, record.step, record.time, value)
            for _, record in read(folder)
            if isinstance(record, Metrics)
            for key, value in record.values.items()
        ),
        key=lambda point: (point[1], point[0], point[2]),
    )


def png(grey: int = 0) -> bytes:
    content = io.BytesIO()
    PIL.Image.new("L", (8, 4), grey).save(content, "PNG")
    return content.getvalue()


def commit(journal: Journal) -> dict[str, Any]:
    state = journal.state_dict()
    journal.commit()
    return state


def a_full_journal(folder: Path) -> Journal:
    journal = Journal(folder)
    journal.params({f"param_{i}": str(i) for i in range(150)})
    journal.tags({"mlflow.note.content": "# note"})
    for step in range(100):
        journal.metrics({f"train/metric_{i}": step + i / 8 for i in range(12)}, step)
    for step in (50, 100):
        journal.metrics({"evaluation/iqm": step}, step)
        journal.image("evaluation/q", png(step), step)
        journal.model("best", bytes(step), step, {"evaluation/iqm": step})
    journal.artifact("report/index.html", b"<p>")
    journal.artifact("top.txt", b"top")
    commit(journal)
    return journal


def everything(root: Path, folder: Path) -> dict[str, Any]:
    """All that MLflow shows of a folder, straight from its tables and files."""
    run = run_id(folder)
    [(status, location, name)] = rows(root, "SELECT status, artifact_uri, name FROM runs WHERE run_uuid = ?", run)
    models = rows(
        root, "SELECT model_id, name, status, artifact_location FROM logged_models WHERE source_run_id = ?", run
    )
    artifacts = _path(location)
    return {
        "status": status,
        "name": name,
        "metrics": points(root, folder),
        "params": rows(root, "SELECT key, value FROM params WHERE run_uuid = ? ORDER BY key", run),
        "tags": rows(root, "SELECT key, value FROM tags WHERE run_uuid = ? ORDER BY key", run),
        "files": {
            str(file.relative_to(artifacts)): file.read_bytes() for file in artifacts.rglob("*") if file.is_file()
        },
        "models": [(*model[:3], [file.read_bytes() for file in _path(model[3]).iterdir()]) for model in models],
        "model metrics": rows(
            root,
            "SELECT metric_name, metric_step, metric_value FROM logged_model_metrics WHERE run_id = ? ORDER BY 2, 1",
            run,
        ),
        "outputs": rows(root, "SELECT destination_id, step FROM inputs WHERE source_id = ? ORDER BY step", run),
    }


def _path(uri: str) -> Path:
    return Path(unquote(uri.removeprefix("file://")))


def same_but_for_ids(shown: dict[str, Any]) -> dict[str, Any]:
    return {
        **{table: shown[table] for table in ("status", "name", "metrics", "params", "model metrics")},
        "tags": [tag for tag in shown["tags"] if not tag[0].startswith("atlantis.")],
        "files": {re.sub(r"[0-9a-f-]{36}", "ID", path): content for path, content in shown["files"].items()},
        "models": sorted(model[1:] for model in shown["models"]),
        "outputs": [step for _, step in shown["outputs"]],
    }
