"""`loadgen report`: writes one HTML page about a run, and a PNG of each chart of the paper.

The tasks of a run are shown by the live page. Where tasks were measured on both sites, the numbers and the
captions come from `findings.py`, the page from `html_page.py`.
"""

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from offboard.common.config import check, part_of, setting
from offboard.loadgen import rivals
from offboard.loadgen.play.run_files import PICTURE, TRACE, find_source
from offboard.loadgen.progress import progress
from offboard.loadgen.replay.replay import ORACLE
from offboard.loadgen.replay.replay_settings import ReplayConfig
from offboard.loadgen.report.findings import Chart, Findings, all_charts
from offboard.loadgen.report.html_page import Panel, live_part, page
from offboard.loadgen.table.measured_rows import is_csv, write_whole
from offboard.loadgen.table.table_settings import ALL, BOTH, CHOSEN, FULL, TableConfig
from offboard.loadgen.table.table_two_figures import published_table, quantile
from offboard.robot_client import policies, predictors
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

if TYPE_CHECKING:
    from offboard.loadgen.report.chart_parts import Drawing

PAGE = "report.html"
PLAN = (
    "The last plan of the run that found a path: where the robot asked for it, what its LiDAR saw there, and"
    " the path to its goal."
)


@dataclass(frozen=True)
class ReportConfig:
    """What a report shows, and where it is written."""

    out: Path | None = setting(
        None,
        "folder for report.html and the PNGs (default: the folder of the run, out/NAME for a file, or "
        "out/comparison for several runs)",
        metavar="DIR",
    )
    predictor: str = setting(
        predictors.LEAST_SQUARES, f"predictor of the policies: {rivals.PREDICTOR_HELP}", metavar="NAME"
    )
    window: int = setting(WINDOW, "rows of warm-up before the policies decide", minimum=2, maximum=WINDOW_MAX)
    predictors: tuple[str, ...] = setting(
        (),
        f"more predictors for the tables and for the charts over N; {ALL} means every predictor",
        metavar="NAME,NAME,..",
    )
    policies: tuple[str, ...] = setting(
        ("paper", ONBOARD, CLOUD), f"policies to replay: {policies.HELP}", metavar="NAME,NAME,.."
    )
    feedback: str = setting(
        CHOSEN,
        "sites that learn after the warm-up: the one that ran the task (chosen), or every site (full)",
        choices=(CHOSEN, FULL),
    )
    seed: int = setting(
        1, "seed of the bootstrap, of random predictors, and of the points that are drawn", minimum=0
    )
    kind: str | None = setting(None, "kind of task, if a trace holds several")

    def __post_init__(self) -> None:
        check(self)
        rivals.predictor(self.predictor, "--predictor")
        self.replay()
        self.table()

    def table(self) -> TableConfig:
        """The settings of Table II: every predictor once, and both feedback modes."""
        names = tuple(dict.fromkeys((self.predictor, *self.predictors)))
        return part_of(TableConfig, self, predictors=names, feedback=BOTH)

    def replay(self) -> ReplayConfig:
        return part_of(ReplayConfig, self)


def run_report(path: Path, config: ReportConfig) -> int:
    """Write the report on the folder of a run, on a trace, or on a CSV file, and print where it is."""
    source = find_source(path)
    out = config.out or (path if path.is_dir() else Path("out") / path.stem)
    findings = Findings(source, config.table(), config.replay())
    live = None if is_csv(source) else live_part(path, config.kind)
    panels = _panels(findings, out)
    if (source.parent / PICTURE).is_file() and source.name == TRACE:
        panels.append(Panel("plan", "A plan on the map", PLAN, (source.parent / PICTURE).read_bytes()))
    text = page(
        f"Report on {source}",
        about=[about(findings), *findings.rows.notes],
        facts=facts(findings),
        panels=panels,
        tables=[findings.replayed, *findings.evaluated, published_table()] if findings.for_paper else [],
        live=live,
    )
    write_whole(out / PAGE, text)
    print(out / PAGE)
    return 0


def about(findings: Findings) -> str:
    """What the figures are computed from."""
    settings, decided = findings.settings, len(findings.lived.waited_s)
    live = f"{decided:,} tasks were decided live. " if decided else ""
    if findings.no_table:
        return f"{live}There are no tables: {findings.no_table}."
    counts = f"{live}{len(findings.rows):,} tasks were measured on both sites."
    if not findings.for_paper:
        needed = f"need more than N = {settings.length} of these (--window)"
        return f"{counts} The charts and tables of the paper {needed}."
    return (
        f"{counts} Predictor {settings.predictor}, window size N = {settings.length}, "
        f"feedback {settings.feedback}, seed {settings.seed}."
    )


def facts(findings: Findings) -> Mapping[str, str]:
    """The most important figures, by name."""
    found: dict[str, str] = {}
    rows, times, waited_s = findings.rows, findings.times, findings.lived.waited_s
    if len(waited_s):
        found["Mean time as recorded"] = f"{1e3 * waited_s.mean():.1f} ms"
        for percent in (95, 99):
            found[f"P{percent} as recorded"] = f"{1e3 * quantile(waited_s, percent):.1f} ms"
        found["Sent to the cloud"] = f"{100 * findings.lived.to_cloud.mean():.0f} % of tasks"
    if times is None or not findings.for_paper:
        return found
    found["Faster in the cloud"] = f"{100 * (rows.cloud_s < rows.onboard_s).mean():.0f} % of tasks"
    found["The lines cross at"] = f"d = {times.crossing:.4g}" if times.crossing_inside else "no measured size"
    for line in findings.replayed.lines:
        if line.time_over_oracle is not None and line.policy != ORACLE:
            found[f"Mean time, {line.policy}"] = f"{line.time_over_oracle:.3f} × oracle"  # noqa: RUF001
    return found


def _panels(findings: Findings, out: Path) -> list[Panel]:
    """Draw the charts of the paper, and write the PNG of each; without rows for them there are no panels."""
    charts, panels = all_charts(findings), []
    with progress("charts", len(charts)) as drawn:
        for chart in charts:
            drawing = _draw(chart) if findings.for_paper and chart.shown is not None else None
            _write_png(out / f"{chart.name}.png", drawing.png if drawing else None)
            panels.append(Panel(chart.name, chart.title, chart.caption, drawing.svg if drawing else None))
            drawn.step()
    return panels if findings.for_paper else []


def _draw(chart: Chart) -> "Drawing":
    from offboard.loadgen.report.charts import draw  # only now, because matplotlib takes long to import

    return draw(chart.name, chart.shown)


def _write_png(path: Path, png: bytes | None) -> None:
    """Write the whole file at once; None removes the chart of an earlier report."""
    if png is not None:
        write_whole(path, png)
        return
    with suppress(OSError):  # if the folder is to blame, the page cannot be written either
        path.unlink()
