"""The charts of a report: titles and captions that say what is drawn, and how odd data is drawn."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from offboard.loadgen.report import chart_data, charts
from offboard.loadgen.report.chart_styles import COLOURS, LOOKS, NEUTRAL, PRINTED, RUN_LOOKS
from offboard.loadgen.report.findings import Findings, all_charts
from offboard.loadgen.report.report import ReportConfig, about, facts
from tests.reports import CHARTS, write_rows
from tests.table_loops import THOUSAND, Line
from tests.unit.test_replay import trace_of

SIZES = [0.0, 1.0, 2.0, 3.0]


@pytest.fixture
def found(tmp_path: Path) -> Callable[..., Findings]:
    """Factory: the findings of a report on these rows, or on a file."""

    def make(rows: list[Line] | Path, **settings: Any) -> Findings:
        config = ReportConfig(**settings)
        path = rows if isinstance(rows, Path) else write_rows(tmp_path, rows)
        return Findings(path, config.table(), config.replay())

    return make


def captions(findings: Findings) -> dict[str, str]:
    return {chart.name: chart.caption for chart in all_charts(findings)}


def drawn(findings: Findings) -> list[str]:
    return [chart.name for chart in all_charts(findings) if chart.shown is not None]


@pytest.mark.parametrize(
    ("onboard_s", "cloud_s", "sizes", "fact", "said"),
    [
        (
            [1, 2, 2, 3],
            [2.2, 1.2, 3.2, 2.2],
            SIZES,
            "d = 2",
            "They cross at d = 2: on average, onboard is faster for smaller tasks and cloud for larger ones.",
        ),
        (
            [3, 2, 1, 0],
            [1, 1, 1, 1],
            SIZES,
            "d = 2",
            "They cross at d = 2: on average, cloud is faster for smaller tasks and onboard for larger ones.",
        ),
        (
            [1, 2, 3, 4],
            [9, 9, 9, 9],
            SIZES,
            "no measured size",
            "They cross at d = 8, outside the measured sizes: onboard is faster on average.",
        ),
        ([2, 3, 4, 5], [1, 2, 3, 4], SIZES, "no measured size", "They are parallel."),
        (
            [1, 2, 3, 4],
            [2, 2, 2, 2],
            [7, 7, 7, 7],
            "no measured size",
            "They are level, because all tasks have the same size.",
        ),
    ],
)
def test_the_caption_says_where_the_lines_cross(
    found: Callable[..., Findings],
    onboard_s: list[float],
    cloud_s: list[float],
    sizes: list[float],
    fact: str,
    said: str,
) -> None:
    """The caption names every crossing; the chart marks a crossing that is inside the measured sizes."""
    findings = found(list(zip(sizes, onboard_s, cloud_s, strict=True)))
    assert captions(findings)["times"].endswith(said)
    assert facts(findings)["The lines cross at"] == fact
    svg = charts.draw("times", findings.times).svg.decode()
    assert ('id="crossing"' in svg) == (fact != "no measured size")


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_charts_and_tables_agree(found: Callable[..., Findings], feedback: str) -> None:
    """The charts over N show the lines of Table II that have the feedback of the report."""
    findings = found(THOUSAND[:200], window=30, feedback=feedback)
    assert (len(findings.scores), findings.scores[0].window) == (8 + 1 + 3, "5")
    assert [table.about["feedback"] for table in findings.evaluated] == ["chosen", "full"]
    wanted = findings.evaluated[("chosen", "full").index(feedback)].lines
    assert [score for score in wanted if score.scored] == findings.scores


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([(1, 1, 2)], ["times"]),
        ([(1, 1, 2), (2, 2, 2), (3, 3, 2)], list(CHARTS)),
        ([(2.0, 0.1 + 0.01 * (i % 7), 0.12) for i in range(60)], list(CHARTS)),
        ([(1.0 + i % 5, 0.1, 0.05 + 0.03 * (i % 5)) for i in range(60)], list(CHARTS)),
        ([(1.0 + i % 5, 0.0, 0.0) for i in range(60)], list(CHARTS)),
        ([(1.0 + i % 5, 0.01, 0.2 + 0.01 * (i % 3)) for i in range(60)], list(CHARTS)),
        ([(1.0 + i % 5, 0.05, 2.5 if i % 9 == 0 else 0.03) for i in range(60)], list(CHARTS)),
        ([(1e14 * (i % 5), 1e14 * (i % 5), 1e14) for i in range(60)], list(CHARTS)),
    ],
    ids=["one", "three", "equal sizes", "constant", "zero", "onboard faster", "outage", "huge"],
)
def test_odd_data_is_drawn_or_the_caption_says_why_not(
    found: Callable[..., Findings], rows: list[Line], expected: list[str]
) -> None:
    """Every chart is drawn without a warning, or its caption says why it is not drawn."""
    findings = found(rows)
    assert drawn(findings) == expected
    for chart in all_charts(findings):
        if chart.shown is None:
            assert chart.caption.startswith("Not drawn: ")
        else:
            assert len(charts.draw(chart.name, chart.shown).svg) > 0


def test_the_caption_says_how_many_points_are_drawn(found: Callable[..., Findings]) -> None:
    """Of 1,500 rows 1,000 are drawn; the lines fit all rows."""
    findings = found((THOUSAND * 2)[:1500])
    said = captions(findings)
    assert said["times"].startswith("The same 1,500 tasks on both sites.")
    assert said["times"].endswith("1,000 of 1,500 points are drawn.")
    svg = charts.draw("times", findings.times).svg.decode()
    marks = svg[svg.index('id="points-cloud"') : svg.index('id="line-onboard"')]
    assert marks.count("<use") == chart_data.POINTS_MAX
    assert findings.times.cloud == chart_data.fit(findings.rows.size, findings.rows.cloud_s)


def test_a_trace_without_rows_for_the_paper_says_so(found: Callable[..., Findings], tmp_path: Path) -> None:
    """The figures are those of the decisions, and the page says what the charts of the paper would need."""
    sites = ["onboard", "cloud", "cloud"] * 4
    findings = found(trace_of(tmp_path, *(("paper", site, {site: 0.1}, 0.2) for site in sites)))
    assert drawn(findings) == []
    assert not findings.for_paper
    assert about(findings) == (
        "12 tasks were decided live. 0 tasks were measured on both sites. "
        "The charts and tables of the paper need more than N = 50 of these (--window)."
    )
    assert facts(findings) == {
        "Mean time as recorded": "200.0 ms",
        "P95 as recorded": "200.0 ms",
        "P99 as recorded": "200.0 ms",
        "Sent to the cloud": "67 % of tasks",
    }


def test_captions_say_how_the_figures_were_computed(found: Callable[..., Findings]) -> None:
    """Predictor, N, feedback and rows are in the caption of every chart that depends on them."""
    findings = found(THOUSAND[:60], window=20, feedback="full", predictors=("parts",))
    said = captions(findings)
    for name in ("errors", "accuracy"):
        assert said[name].endswith("60 rows for every N; predictors least-squares, parts; feedback full.")


def test_sites_and_runs_can_be_told_apart() -> None:
    """Each site, and each run of a comparison, has its own colour and its own line style."""
    for looks in (tuple(LOOKS.values()), RUN_LOOKS):
        assert len({look.colour for look in looks}) == len({str(look.line) for look in looks}) == len(looks)


def test_all_charts_have_the_palette_of_the_page() -> None:
    """Onboard is blue and the cloud orange, as in `live.css`; on white each colour has a contrast of 3:1."""
    assert (LOOKS["onboard"].colour, LOOKS["cloud"].colour) == ("#0072b2", "#d55e00")
    used = {look.colour for look in (*LOOKS.values(), *RUN_LOOKS, PRINTED, NEUTRAL)}
    assert used <= set(COLOURS.values())
    assert min(1.05 / (luminance(colour) + 0.05) for colour in used) > 3


def luminance(colour: str) -> float:
    """The relative luminance of WCAG 2.2."""
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(share * part for share, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))
