"""`loadgen report A B ..`: one HTML page that compares what robots waited in several runs.

`html_page` writes the page, `charts` draws the chart.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common.config import REQUIRED
from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.play.run_files import PICTURE, SUMMARY, find_source
from offboard.loadgen.progress import progress
from offboard.loadgen.report.chart_styles import RUN_LOOKS
from offboard.loadgen.report.html_page import Panel, page
from offboard.loadgen.report.report import PAGE, PLAN, ReportConfig
from offboard.loadgen.table.measured_rows import Column, is_csv, read_lived, write_whole
from offboard.loadgen.table.table_formats import Table, column, headings_of
from offboard.loadgen.table.table_two_figures import Sides, quantile

FOLDER = Path("out/comparison")
RUNS_MAX = len(RUN_LOOKS)  # each has a line of its own in the chart
CHART = "runs"
CAPTION = "Tasks that the policy placed; lost, late and time / oracle are those of the whole run."


@dataclass(frozen=True, slots=True)
class Run:
    """One run: the tasks that its policy placed, and its summary, if the folder has one."""

    path: Path
    name: str
    waited_s: Column
    to_cloud: Sides
    summary: dict[str, Any]


@dataclass(frozen=True, slots=True)
class RunLine:
    """One line of the table; None: undefined, or not known without a summary."""

    run: str = column("run", default=REQUIRED)
    policy: str = column("policy", default=REQUIRED)
    tasks: int = column("tasks", 0, default=REQUIRED)
    mean_ms: float = column("mean ms", 1, default=REQUIRED)
    over_first: float = column("mean / first run", 3, default=REQUIRED)
    p95_ms: float = column("P95 ms", 1, default=REQUIRED)
    p99_ms: float = column("P99 ms", 1, default=REQUIRED)
    cloud_percent: float = column("to cloud %", 1, default=REQUIRED)
    lost: float | None = column("lost", 0)
    late_percent: float | None = column("late %", 1)
    time_over_oracle: float | None = column("time / oracle", 3)
    note: str = ""


HEADINGS = headings_of(RunLine)


def run_comparison(paths: Sequence[Path], config: ReportConfig) -> int:
    """Write the page about all runs, and print where it is."""
    if len(paths) > RUNS_MAX:
        raise ConfigError(f"{len(paths)} runs are too many for one page: at most {RUNS_MAX} are allowed")
    with progress("runs", len(paths)) as shown:
        runs = []
        for path in paths:
            runs.append(_read(path, config.kind))
            shown.step()
    runs = [_renamed(run, runs) for run in runs]
    from offboard.loadgen.report import charts  # only now, because matplotlib takes long to import

    drawing = charts.draw(CHART, {run.name: run.waited_s for run in runs})
    panels = [Panel(CHART, "Distribution of the waiting time", _caption(runs), drawing.svg), *_plans(runs)]
    first_s = float(runs[0].waited_s.mean())
    lines = [_line(run, first_s) for run in runs]
    text = page(
        f"{len(runs)} runs compared",
        about=[f"{run.name}: {run.path}{_settings(run)}." for run in runs],
        facts={f"Mean time, {line.run}": f"{line.mean_ms:.1f} ms" for line in lines},
        panels=panels,
        tables=[Table(CAPTION, {}, HEADINGS, lines)],
    )
    out = (config.out or FOLDER) / PAGE
    write_whole(out, text)
    print(out)
    return 0


def _read(path: Path, kind: str | None) -> Run:
    source = find_source(path)
    if is_csv(source):
        raise DataError(
            f"{path}: a CSV file has no decisions; a comparison needs the folders or traces of runs"
        )
    lived = read_lived(source, kind)
    if not len(lived.waited_s):
        raise DataError(f"{path}: no task of this run was placed by a policy")
    summary = source.parent / SUMMARY
    try:
        about = json.loads(summary.read_text()) if path.is_dir() and summary.is_file() else {}
    except (ValueError, RecursionError) as error:
        raise DataError(f"{summary}: not JSON: {error}") from None
    name = path.name if path.is_dir() else path.stem
    return Run(path, name, waited_s=lived.waited_s, to_cloud=lived.to_cloud, summary=about)


def _renamed(run: Run, runs: Sequence[Run]) -> Run:
    """A run with the name of its folder; with its whole path, if another folder has the same name."""
    alone = sum(other.name == run.name for other in runs) == 1
    return run if alone else replace(run, name=str(run.path))


def _line(run: Run, first_s: float) -> RunLine:
    figures, mean_s = run.summary.get("figures", {}), float(run.waited_s.mean())
    return RunLine(
        run.name,
        str(run.summary.get("policy", "")),
        tasks=len(run.waited_s),
        mean_ms=1e3 * mean_s,
        over_first=mean_s / first_s,
        p95_ms=1e3 * float(quantile(run.waited_s, 95)),
        p99_ms=1e3 * float(quantile(run.waited_s, 99)),
        cloud_percent=100 * float(np.mean(run.to_cloud)),
        lost=figures.get("lost"),
        late_percent=figures.get("late_percent"),
        time_over_oracle=figures.get("time_over_oracle"),
    )


def _settings(run: Run) -> str:
    named = [f"{name} {run.summary[name]}" for name in ("name", "policy", "seed") if name in run.summary]
    return f" ({', '.join(named)})" if named else ""


def _caption(runs: Sequence[Run]) -> str:
    counts = ", ".join(f"{run.name}: {len(run.waited_s):,}" for run in runs)
    return f"The share of tasks that were answered within a given time. Tasks: {counts}."


def _plans(runs: Sequence[Run]) -> list[Panel]:
    pictures = [(run, run.path / PICTURE) for run in runs if (run.path / PICTURE).is_file()]
    return [
        Panel(f"plan-{number}", f"A plan on the map, {run.name}", PLAN, picture.read_bytes())
        for number, (run, picture) in enumerate(pictures, 1)
    ]
