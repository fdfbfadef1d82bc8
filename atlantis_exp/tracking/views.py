"""Prepare the first pages of the MLflow UI.

A shared view is a tag of the experiment in an internal format of MLflow 3.17; a test opens them in a browser.
"""

import base64
import json
import os
import warnings
import zlib
from pathlib import Path
from typing import Any

from atlantis_exp.runs.journal import NOTE
from atlantis_exp.tracking.local import uri_of

_SECTIONS = {  # cards a row, and their height in pixels
    "score": (2, 360),
    "evaluation": (2, 360),
    "pictures": (1, 520),
    "actions": (2, 360),
    "learning": (2, 360),
    "throughput": (2, 360),
}
_COLUMNS = (
    *("params.`model.name`", "params.`sampler.name`", "params.`seed`", "metrics.`evaluation/mean`"),
    *("metrics.`evaluation/interquartile_mean`", "metrics.`evaluation/high`", "metrics.`actions/random_share`"),
)

START, SWEEP, COMPARISONS = "start", "sweep", "comparisons"
"""The keys of the shared views, for `viewStateShareKey` in an address."""

_APART = ("training sweep", "search", "decision", "comparison", "evaluation")
"""Kinds of runs without a curve, and external players, whose scores would dwarf every bar."""

_ABOUT = """\
**Does network B play better than network A, and how sure is that?**

- There are three views (share key in the address): **Start here** has a line a training, the best evaluation first;
  **Sweep** has a line a group of runs that differ only in their seed, with their mean and range; **Comparisons** has a
  line a comparison, the newest first, with its verdict.
- A run's name lists its network, samplers and seed, then other differences from the defaults. Blues are DQNCnn, reds
  ResNetDQN, paler for samplers other than uniform; grey is the random player.
- `score/` is the training's own play, with the exploration in `actions/epsilon`. `evaluation/` decides: episodes at a
  small fixed epsilon, on separate emulators.
- Under `pictures`, the slider counts windows of the training (histogram of the window, heat map of all up to it) and
  evaluations, from 0: each position shows the runs side by side.
- The description on a run's page has the result and how to continue it; *Artifacts* has `best_episode.mp4`,
  `episodes.csv` and every evaluation's table; *Models* has the weights of each evaluation, with `best` on the best.
- A sweep is a run, too, whose page has the table of its runs.
"""


def experiment_tags(newest: str | None) -> dict[str, str]:
    """Return an experiment's tags: description and views. newest: a link to its newest comparison."""
    note = f"{_ABOUT}- The newest comparison: {newest}\n" if newest else _ABOUT
    tags = {NOTE: note, "mlflow.experimentKind": "custom_model_development"}
    views = {
        START: ("Start here", _start_here()),
        SWEEP: ("Sweep", _sweep()),
        COMPARISONS: ("Comparisons", _verdicts()),
    }
    for key, (name, state) in views.items():
        packed = "deflate;" + base64.b64encode(zlib.compress(json.dumps(state).encode())).decode()
        view = {"name": name, "createdAt": 0, "updatedAt": 0, "state": packed}
        tags[f"mlflow.sharedViewState.{key}"] = json.dumps(view)
    return tags


def address(server: str, experiment_id: str, view: str) -> str:
    """Return the address of a view of an experiment on a server."""
    mode = "TABLE" if view == COMPARISONS else "CHART"
    return (
        f"{server}/#/experiments/{experiment_id}/runs?workflowType=machine_learning&compareRunsMode={mode}"
        f"&viewStateShareKey={view}"
    )


def site(outputs: Path, start: str) -> Any:
    """Return MLflow's server on the store of an outputs folder, which redirects its plain address to `start`."""
    os.environ["MLFLOW_SERVER_ENABLE_JOB_EXECUTION"] = "false"  # else it starts ten processes
    os.environ["_MLFLOW_SERVER_FILE_STORE"] = uri_of(outputs.resolve())  # read by the import: this is a server
    from mlflow.server import app as pages

    with warnings.catch_warnings(action="ignore"):  # of a library that MLflow will replace
        from mlflow.server.fastapi_app import app
    from starlette.responses import Response

    # Browsers do not send the part after '#' to a server, so the page must check it.
    lead = (
        f"<head><script>if (!location.hash) location.replace({json.dumps(start)});"
        "localStorage.setItem('mlflow.assistant.fab.autoOpenedOnFirstLoad_v1', 'true')</script>"
    )
    index = Path(str(pages.static_folder), "index.html").read_text().replace("<head>", lead, 1)
    pages.view_functions["serve"] = lambda: index

    async def without_assistant(scope: Any, receive: Any, send: Any) -> None:
        """Disable MLflow's assistant, which can run a shell and open an agent on this machine."""
        is_assistants = "/mlflow/assistant" in scope.get("path", "")
        await (Response(status_code=404) if is_assistants else app)(scope, receive, send)

    return without_assistant


def _start_here() -> dict[str, Any]:
    parallel = {
        "selectedParams": ["model.name", "sampler.name", "seed"],
        "selectedMetrics": ["evaluation/interquartile_mean"],
        "showAllRuns": True,
    }
    charts = [
        _line("score", "score/mean_100"),
        _line("score", "score/episode"),
        _chart("BAR", "evaluation", metricKey="evaluation/interquartile_mean"),
        _line("evaluation", "evaluation/mean"),
        _chart("PARALLEL", "evaluation", **parallel),  # not among groups, which have only numbers for params
        _images("score/histogram", "score/heatmap"),
        _images("evaluation/histogram"),
        _line("actions", "actions/epsilon"),
        _line("actions", "actions/network_share"),
        _line("learning", "learning/loss"),
        _line("learning", "learning/updates"),
        _line("throughput", "throughput/steps_per_second"),
        _line("throughput", "throughput/episodes"),
    ]
    return {
        **_page(START, charts),
        # Sorted by anything but time MLflow shows a sweep's runs themselves, else their collapsed parent.
        "orderByKey": "metrics.`evaluation/interquartile_mean`",
        "searchFilter": " AND ".join(f"tags.`atlantis.kind` != '{kind}'" for kind in _APART),
    }


def _sweep() -> dict[str, Any]:
    charts = [
        _chart("BAR", "evaluation", metricKey="evaluation/interquartile_mean"),
        _line("evaluation", "evaluation/mean"),
        _line("score", "score/mean_100"),
    ]
    return {
        **_page(SWEEP, charts),
        "groupBy": {"aggregateFunction": "average", "groupByKeys": [{"mode": "tag", "groupByData": "group"}]},
        "orderByKey": "metrics.`evaluation/interquartile_mean`",
        "searchFilter": "tags.`atlantis.kind` = 'training'",
    }


def _verdicts() -> dict[str, Any]:
    return {
        **_page(COMPARISONS, []),
        "selectedColumns": ["tags.`verdict`", "attributes.`Created`"],
        "searchFilter": "tags.`atlantis.kind` = 'comparison'",
    }


def _page(view: str, charts: list[dict[str, Any]]) -> dict[str, Any]:
    shown = {"display": True, "isReordered": True, "deleted": False, "isGenerated": False}
    sections = [
        {"uuid": name, "name": name, "columns": columns, "cardHeight": height, **shown}
        for name, (columns, height) in _SECTIONS.items()
    ]
    # MLflow adds a chart for a picture that has none of its own; a deleted one prevents it.
    covered = {key for chart in charts for key in chart.get("imageKeys", [])}
    charts = [*charts, *({**_images(key), "deleted": True} for key in sorted(covered))]
    return {
        "selectedColumns": list(_COLUMNS),
        "runsHiddenMode": "FIRST_20_RUNS",
        "compareRunCharts": [{**chart, "uuid": f"{view}-{index}"} for index, chart in enumerate(charts)],
        "compareRunSections": sections,
        "isAccordionReordered": True,
    }


def _line(section: str, key: str) -> dict[str, Any]:
    axes = {"xAxisKey": "step", "xAxisScaleType": "linear", "scaleType": "linear", "yAxisKey": "metric"}
    return _chart("LINE", section, metricKey=key, selectedMetricKeys=[key], lineSmoothness=0, **axes)


def _images(*keys: str) -> dict[str, Any]:
    return _chart("IMAGE", "pictures", imageKeys=list(keys), step=0, showRunParams=False)


def _chart(kind: str, section: str, **settings: Any) -> dict[str, Any]:
    shown = {"runsCountToCompare": 20, "deleted": False, "isGenerated": False}
    return {"type": kind, "metricSectionId": section, **shown, **settings}
