"""The charts of a report: titles and captions that say what is drawn, and how odd data is drawn."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.loadgen import rivals
from offboard.loadgen.report import chart_data, charts
from offboard.loadgen.report.captions import all_charts
from offboard.loadgen.report.chart_styles import LOOKS, policy_look
from offboard.loadgen.report.findings import Findings
from offboard.loadgen.report.report import ReportConfig, facts
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
    """The replay table and the charts have the same mean time and cloud share of a policy."""
    findings = found(THOUSAND[:200], window=30, feedback=feedback, policies=("paper", "cloud"))
    line = findings.replayed.lines[0]
    assert line.policy == "paper"
    assert findings.spent_s["paper"].mean() == pytest.approx(line.mean_s, rel=1e-12)
    assert 100 * findings.decisions.to_cloud.mean() == pytest.approx(line.cloud_percent)
    assert findings.decisions.number.tolist() == list(range(31, 201))
    assert (len(findings.scores), findings.scores[0].window) == (8 + 1 + 3, "5")
    assert [table.about["feedback"] for table in findings.evaluated] == ["chosen", "full"]
    wanted = findings.evaluated[("chosen", "full").index(feedback)].lines
    assert [score for score in wanted if score.scored] == findings.scores


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        ([(1, 1, 2)], ["times"]),
        ([(1, 1, 2), (2, 2, 2), (3, 3, 2)], ["times", "errors", "accuracy"]),
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
    """Of 1,500 rows and 1,450 decisions 1,000 are drawn; the lines fit all rows."""
    findings = found((THOUSAND * 2)[:1500])
    said = captions(findings)
    assert said["times"].startswith("The same 1,500 tasks on both sites.")
    assert said["times"].endswith("1,000 of 1,500 points are drawn.")
    assert said["decisions"].endswith("1,000 of 1,450 points are drawn.")
    svg = charts.draw("times", findings.times).svg.decode()
    marks = svg[svg.index('id="points-cloud"') : svg.index('id="line-onboard"')]
    assert marks.count("<use") == chart_data.POINTS_MAX
    assert findings.times.cloud == chart_data.fit(findings.rows.size, findings.rows.cloud_s)


def test_a_trace_with_one_run_per_task_shows_its_decisions(
    found: Callable[..., Findings], tmp_path: Path
) -> None:
    """Decisions and times are drawn as recorded; the other charts say that no task ran on both sites."""
    sites = ["onboard", "cloud", "cloud"] * 4
    findings = found(trace_of(tmp_path, *(("paper", site, {site: 0.1}, 0.2) for site in sites)))
    assert drawn(findings) == ["decisions", "ecdf"]
    assert findings.decisions.policy == "as recorded"
    assert findings.decisions.to_cloud.tolist() == [site == "cloud" for site in sites]
    assert list(findings.spent_s) == ["as recorded"]
    said = captions(findings)
    assert said["times"] == "Not drawn: no task ran on both sites."
    assert "12 tasks as recorded, with the robot's own predictor and N; feedback chosen." in said["decisions"]
    assert findings.evaluated == []
    assert facts(findings) == {}


def test_captions_say_how_the_figures_were_computed(found: Callable[..., Findings]) -> None:
    """Predictor, N, feedback and rows are in the caption of every chart that depends on them."""
    findings = found(THOUSAND[:60], window=20, feedback="full", predictors=("theil-sen",))
    said = captions(findings)
    replayed = "Replay of 40 of 60 rows, after a warm-up of N = 20; predictor least-squares, feedback full."
    assert said["decisions"].endswith(replayed)
    assert said["ecdf"].endswith(replayed)
    for name in ("errors", "accuracy"):
        assert said[name].endswith("60 rows for every N; predictors least-squares, theil-sen; feedback full.")


def test_every_policy_has_its_own_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each policy has its own colour and line style, also policies that are added later."""
    later = tuple(f"later-{number}" for number in range(6))
    monkeypatch.setattr(rivals, "RULES", ("paper", "onboard", "cloud", *later))
    looks = [*LOOKS.values(), *map(policy_look, later)]
    assert len({look.colour for look in looks}) == len({str(look.line) for look in looks}) == len(looks)
    assert charts.draw("ecdf", {name: np.array([0.1, 0.2]) for name in ("paper", *later)}).png
