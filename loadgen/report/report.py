"""`loadgen report`: writes one HTML page about a run, and a PNG of each chart.

The numbers come from `findings.py`, the captions from `captions.py`, the page from `html_page.py`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.common.security.plain_files import replace_file
from offboard.loadgen import rivals
from offboard.loadgen.play.run_files import PICTURE, TRACE, find_source
from offboard.loadgen.progress import progress
from offboard.loadgen.replay.replay import ORACLE, ReplayConfig
from offboard.loadgen.report.captions import all_charts
from offboard.loadgen.report.findings import Findings
from offboard.loadgen.report.html_page import Panel, page
from offboard.loadgen.table import published_table_two as paper
from offboard.loadgen.table.measured_rows import write_whole
from offboard.loadgen.table.table_settings import ALL, BOTH, CHOSEN, FULL, TableConfig
from offboard.robot_client import predictors
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

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
        ("paper", ONBOARD, CLOUD),
        f"policies to replay: {rivals.POLICY_HELP}; the chart of decisions shows the first one",
        metavar="NAME,NAME,..",
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
        return TableConfig(predictors=names, feedback=BOTH, seed=self.seed)

    def replay(self) -> ReplayConfig:
        """The settings with which the policies are replayed."""
        return ReplayConfig(
            policies=self.policies,
            predictor=self.predictor,
            window=self.window,
            feedback=self.feedback,
            seed=self.seed,
            kind=self.kind,
        )


def run_report(path: Path, config: ReportConfig) -> int:
    """Write the report on the folder of a run, on a trace, or on a CSV file, and print where it is."""
    source = find_source(path)
    out = config.out or (path if path.is_dir() else Path("out") / path.stem)
    findings = Findings(source, config.table(), config.replay())
    from offboard.loadgen.report import charts  # only now, because matplotlib takes long to import

    shown = all_charts(findings)
    panels = []
    with progress("charts", len(shown)) as drawn:
        for chart in shown:
            drawing = None if chart.shown is None else charts.draw(chart.name, chart.shown)
            _write_png(out / f"{chart.name}.png", drawing.png if drawing else None)
            panels.append(Panel(chart.name, chart.title, chart.caption, drawing.svg if drawing else None))
            drawn.step()
    if (source.parent / PICTURE).is_file() and source.name == TRACE:
        panels.append(
            Panel("plan", "A plan on the map", PLAN, svg=None, png=(source.parent / PICTURE).read_bytes())
        )
    text = page(
        f"Report on {source}",
        about=[about(findings), *findings.rows.notes],
        facts=facts(findings),
        panels=panels,
        tables=[findings.replayed, *findings.evaluated, paper.table()],
    )
    write_whole(out / PAGE, text)
    print(out / PAGE)
    return 0


def about(findings: Findings) -> str:
    """What the figures are computed from."""
    settings = findings.settings
    return (
        f"{len(findings.rows):,} tasks were measured on both sites, and "
        f"{len(findings.lived.waited_s):,} were decided live. Predictor {settings.predictor}, "
        f"window size N = {settings.window}, feedback {settings.feedback}, seed {settings.seed}."
    )


def facts(findings: Findings) -> Mapping[str, str]:
    """The most important figures, by name."""
    found: dict[str, str] = {}
    rows, times = findings.rows, findings.times
    if times is not None:
        found["Faster in the cloud"] = f"{100 * (rows.cloud_s < rows.onboard_s).mean():.0f} % of tasks"
        found["The lines cross at"] = (
            f"d = {times.crossing:.4g}" if times.crossing_inside else "no measured size"
        )
    for line in findings.replayed.lines:
        if line.time_over_oracle is not None and line.policy != ORACLE:
            found[f"Mean time, {line.policy}"] = f"{line.time_over_oracle:.3f} × oracle"  # noqa: RUF001
    return found


def _write_png(path: Path, png: bytes | None) -> None:
    """Write the whole file at once; None removes the chart of an earlier report."""
    try:
        if png is None:
            path.unlink(missing_ok=True)
            return
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_file(path, png)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error
