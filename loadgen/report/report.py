"""`loadgen report`: a run as one HTML page, and a PNG of each of its charts beside it.

The numbers come from `findings`, the looks from `charts` and `page`.
"""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.play.player import TRACE
from offboard.loadgen.report.chart_data import POINTS_MAX, Times
from offboard.loadgen.report.findings import Findings
from offboard.loadgen.report.html_page import Panel, page
from offboard.loadgen.table import paper_table as paper
from offboard.loadgen.table.replay import ORACLE, RECORDED, ReplayConfig
from offboard.loadgen.table.rows import write_whole
from offboard.loadgen.table.table_two import ALL, BOTH, CHOSEN, FULL, TableConfig
from offboard.robot_client import policies, predictors
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

PAGE = "report.html"
NO_WINDOW = "Not drawn: there is no row that a window of any N leaves to predict."


@dataclass(frozen=True)
class ReportConfig:
    """What to show, and where to write it."""

    out: Path | None = setting(
        None, "folder for report.html and PNGs; without it the run's own, out/NAME for a file", metavar="DIR"
    )
    predictor: str = setting(
        predictors.LEAST_SQUARES, f"what policies go by: {predictors.HELP}", metavar="NAME"
    )
    window: int = setting(WINDOW, "rows of warm-up before policies decide", minimum=2, maximum=WINDOW_MAX)
    predictors: tuple[str, ...] = setting(
        (), f"further predictors, in the tables and against N; or {ALL}", metavar="NAME,NAME,.."
    )
    policies: tuple[str, ...] = setting(
        ("paper", ONBOARD, CLOUD),
        f"policies to replay: {policies.HELP}; the decisions drawn are those of the first",
        metavar="NAME,NAME,..",
    )
    feedback: str = setting(
        CHOSEN,
        "who learns after warm-up, in charts and replay: the site that ran the task, or every site (full)",
        choices=(CHOSEN, FULL),
    )
    seed: int = setting(1, "of the bootstrap, of predictors that draw, and of thinned points", minimum=0)
    kind: str | None = setting(None, "kind of task, where a trace holds several")

    def __post_init__(self) -> None:
        check(self)
        predictors.check_name(self.predictor, "--predictor")
        self.replay()
        self.table()

    def table(self) -> TableConfig:
        """Of Table II: every predictor once, and both feedback modes."""
        names = tuple(dict.fromkeys((self.predictor, *self.predictors)))
        return TableConfig(predictors=names, feedback=BOTH, seed=self.seed)

    def replay(self) -> ReplayConfig:
        """Of the policies."""
        return ReplayConfig(
            policies=self.policies,
            predictor=self.predictor,
            window=self.window,
            feedback=self.feedback,
            seed=self.seed,
            kind=self.kind,
        )


@dataclass(frozen=True, slots=True)
class Chart:
    """What one chart shows, for `charts.draw`; None: it cannot be drawn, and the caption says why."""

    name: str
    title: str
    caption: str
    shown: Any = None


def run_report(path: Path, config: ReportConfig) -> int:
    """Write the report on a run's folder, a trace or a CSV, and print where it is."""
    source = find_source(path)
    out = config.out or (path if path.is_dir() else Path("out") / path.stem)
    findings = Findings(source, config.table(), config.replay())
    from offboard.loadgen.report import charts  # only now, for matplotlib takes its time

    shown = all_charts(findings)
    drawings = [None if chart.shown is None else charts.draw(chart.name, chart.shown) for chart in shown]
    panels = []
    for chart, drawing in zip(shown, drawings, strict=True):
        _write_png(out / f"{chart.name}.png", drawing.png if drawing else None)
        panels.append(Panel(chart.name, chart.title, chart.caption, drawing.svg if drawing else None))
    tables = [findings.replayed, *findings.evaluated, paper.table()]
    text = page(
        f"Report on {source}", [about(findings), *findings.rows.notes], facts(findings), panels, tables
    )
    write_whole(out / PAGE, text)
    print(out / PAGE)
    return 0


def find_source(path: Path) -> Path:
    """The trace of a run's folder, or the file itself."""
    if path.is_dir():
        if not (path / TRACE).is_file():
            raise DataError(f"{path}: no {TRACE} in this folder; `loadgen run` and `loadgen demo` write one")
        return path / TRACE
    if not path.exists():
        raise DataError(f"{path}: neither a run's folder nor a trace or CSV file")
    return path


def about(findings: Findings) -> str:
    """Where the figures come from."""
    settings = findings.settings
    return (
        f"{len(findings.rows):,} tasks measured on both sites, "
        f"{len(findings.lived.waited_s):,} decided live. Predictor {settings.predictor}, "
        f"N = {settings.window}, feedback {settings.feedback}, seed {settings.seed}."
    )


def facts(findings: Findings) -> Mapping[str, str]:
    """The few figures that most readers come for."""
    found: dict[str, str] = {}
    rows, times = findings.rows, findings.times
    if times is not None:
        found["Faster in the cloud"] = f"{100 * (rows.cloud_s < rows.onboard_s).mean():.0f} % of tasks"
        found["The lines cross at"] = (
            f"d = {times.crossing:.4g}" if times.crossing_inside else "no measured d"
        )
    for line in findings.replayed.lines:
        if line.time_over_oracle is not None and line.policy != ORACLE:
            found[f"Time over oracle, {line.policy}"] = f"{line.time_over_oracle:.3f}"
    return found


def all_charts(findings: Findings) -> list[Chart]:
    """In the order of the page."""
    return [
        _times(findings),
        _decisions(findings),
        _errors(findings),
        _accuracy(findings),
        _distributions(findings),
    ]


def _times(findings: Findings) -> Chart:
    name, title, shown = "times", "Execution time against input size", findings.times
    if shown is None:
        return Chart(name, title, "Not drawn: no task ran on both sites.")
    count = len(findings.rows)
    caption = (
        f"The same tasks on both sites, and the least-squares lines over all of them, {_met(shown)}. "
        f"{count:,} rows; no predictor, N or feedback is involved{_thinned(count)}."
    )
    return Chart(name, title, caption, shown)


def _decisions(findings: Findings) -> Chart:
    name, title, shown = "decisions", "Decisions over time", findings.decisions
    if shown is None:
        return Chart(name, title, _too_few(findings))
    share = f"and the share of the cloud among the latest {shown.over} tasks"
    if shown.policy == RECORDED:
        caption = (
            f"What the robot waited for each task that it decided, the site it chose, {share}. "
            f"{shown.of:,} tasks as recorded, with the robot's own predictor and N, feedback chosen"
            f"{_thinned(shown.of)}."
        )
        return Chart(name, title, caption, shown)
    caption = (
        f"The time of each task at the site that policy {shown.policy} chose, {share}. "
        f"{_replay_of(findings)}{_thinned(shown.of)}."
    )
    return Chart(name, title, caption, shown)


def _errors(findings: Findings) -> Chart:
    name, title = "errors", "Prediction error against N"
    shown = [score for score in findings.scores if None not in (score.onboard_mae_s, score.cloud_mae_s)]
    if not shown:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "Mean absolute error (MAE) of the predictions, and the paper's residual without its sign: "
        f"a difference of means, in which errors cancel. {_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _accuracy(findings: Findings) -> Chart:
    name, title, shown = "accuracy", "Accuracy against N", findings.accuracies
    if shown is None:
        return Chart(name, title, NO_WINDOW)
    caption = (
        "Share of tasks sent to the truly faster site, with a 95 % interval for "
        f"{findings.settings.predictor}, beside the paper's own from other machines; "
        f"rules that predict nothing are level lines, over all rows. {_every_n(findings)}."
    )
    return Chart(name, title, caption, shown)


def _distributions(findings: Findings) -> Chart:
    name, title, shown = "ecdf", "Time of a task under each policy", findings.spent_s
    if not shown:
        return Chart(name, title, _too_few(findings))
    basis = [_replay_of(findings)] if ORACLE in shown else []
    if RECORDED in shown:
        basis.append(
            f"{RECORDED}: the {len(shown[RECORDED]):,} tasks that the robot decided, feedback chosen"
        )
    caption = f"Share of tasks that took no longer than a given time. {'; '.join(basis)}."
    return Chart(name, title, caption, shown)


def _met(times: Times) -> str:
    """Where the lines cross, as the end of a sentence."""
    if times.low == times.high:
        return "which are level, for every task has the same size"
    if times.crossing is None:
        return "which are parallel"
    if not times.crossing_inside:
        faster = ONBOARD if times.onboard.mean_seconds < times.cloud.mean_seconds else CLOUD
        return f"which cross outside these sizes, at d = {times.crossing:.4g}: {faster} is faster on average"
    below, above = (ONBOARD, CLOUD) if times.onboard.slope > times.cloud.slope else (CLOUD, ONBOARD)
    return f"which cross at d = {times.crossing:.4g}: {below} is faster on average below it, {above} above"


def _replay_of(findings: Findings) -> str:
    settings = findings.settings
    return (
        f"Replay of {len(findings.scored):,} of {len(findings.rows):,} rows after a warm-up of "
        f"N = {settings.window}, predictor {settings.predictor}, feedback {settings.feedback}"
    )


def _every_n(findings: Findings) -> str:
    names = ", ".join(dict.fromkeys(score.predictor for score in findings.scores if score.predictor))
    return (
        f"{len(findings.rows):,} rows for every N, predictor {names}, feedback {findings.settings.feedback}"
    )


def _too_few(findings: Findings) -> str:
    return (
        f"Not drawn: a warm-up of N = {findings.settings.window} leaves none of {len(findings.rows):,} rows, "
        "and no task was decided live."
    )


def _thinned(count: int) -> str:
    return f"; {POINTS_MAX:,} points of {count:,} are drawn" if count > POINTS_MAX else ""


def _write_png(path: Path, png: bytes | None) -> None:
    """As `write_whole`; None takes away the chart of an earlier report."""
    part = path.with_name(f".{path.name}.part")
    try:
        if png is None:
            path.unlink(missing_ok=True)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(png)
        part.replace(path)
    except OSError as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
