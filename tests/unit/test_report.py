"""What a report says and shows, and what it is made of; tests/browser opens it."""

import hashlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pytest

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen.__main__ import main
from offboard.loadgen.report import chart_data as series
from offboard.loadgen.report import charts
from offboard.loadgen.report.findings import Findings
from offboard.loadgen.report.inline_svg import inline
from offboard.loadgen.report.report import ReportConfig, all_charts, facts, find_source, run_report
from offboard.loadgen.table import paper_table as paper
from offboard.loadgen.table.render import render
from offboard.loadgen.table.rows import Rows, read
from offboard.loadgen.table.table_two import Evaluation, TableConfig
from offboard.robot_client import policies
from tests.unit.test_evaluate import PAGE, THOUSAND, Line, csv_of
from tests.unit.test_replay import trace_of

ROOT = Path(__file__).parents[2]
CHARTS = ("times", "decisions", "errors", "accuracy", "ecdf")
SIZES = [0.0, 1.0, 2.0, 3.0]


@pytest.fixture
def dataset(tmp_path: Path) -> Callable[[list[Line]], Path]:
    """Writes rows.csv."""

    def write(rows: list[Line]) -> Path:
        path = tmp_path / "rows.csv"
        path.write_text(csv_of(rows))
        return path

    return write


@pytest.fixture
def found(dataset: Callable[[list[Line]], Path]) -> Callable[..., Findings]:
    """Findings on rows, or on a file."""

    def make(rows: list[Line] | Path, **settings: Any) -> Findings:
        config = ReportConfig(**settings)
        path = rows if isinstance(rows, Path) else dataset(rows)
        return Findings(path, config.table(), config.replay())

    return make


def rows_of(onboard_s: list[float], cloud_s: list[float], sizes: list[float] = SIZES) -> Rows:
    return Rows(np.array(sizes), np.array(onboard_s), np.array(cloud_s))


def captions(findings: Findings) -> dict[str, str]:
    return {chart.name: chart.caption for chart in all_charts(findings)}


def drawn(findings: Findings) -> list[str]:
    return [chart.name for chart in all_charts(findings) if chart.shown is not None]


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def cells_of(markdown: str) -> list[list[str]]:
    lines = (line for line in markdown.splitlines() if line.startswith("|"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


# What is shown, by hand.


def test_lines_and_their_crossing_by_hand() -> None:
    """d = 0..3: sum (d - 1.5)^2 = 5, so slopes 3/5 and 1/5 through means 2 and 2.2 meet 0.5 beyond 1.5."""
    found = series.times(rows_of([1, 2, 2, 3], [2.2, 1.2, 3.2, 2.2]), seed=1)
    assert (found.onboard.slope, found.cloud.slope) == pytest.approx((0.6, 0.2))
    assert (found.onboard.at(0.0), found.cloud.at(3.0)) == pytest.approx((1.1, 2.5))
    assert found.crossing == pytest.approx(2.0)
    assert found.crossing_inside
    assert (found.low, found.high) == (0, 3)


@pytest.mark.parametrize(
    ("onboard_s", "cloud_s", "sizes", "said"),
    [
        ([1, 2, 2, 3], [2.2, 1.2, 3.2, 2.2], SIZES, "cross at d = 2: onboard is faster on average below it"),
        (
            [3, 2, 1, 0],
            [1, 1, 1, 1],
            SIZES,
            "cross at d = 2: cloud is faster on average below it, onboard above",
        ),
        (
            [1, 2, 3, 4],
            [9, 9, 9, 9],
            SIZES,
            "cross outside these sizes, at d = 8: onboard is faster on average",
        ),
        ([2, 3, 4, 5], [1, 2, 3, 4], SIZES, "which are parallel"),
        ([1, 2, 3, 4], [2, 2, 2, 2], [7, 7, 7, 7], "which are level, for every task has the same size"),
    ],
)
def test_where_the_lines_cross_is_said(
    found: Callable[..., Findings],
    onboard_s: list[float],
    cloud_s: list[float],
    sizes: list[float],
    said: str,
) -> None:
    """Inside, outside, nowhere: each is said in the caption, and only a crossing inside is a fact."""
    findings = found(list(zip(sizes, onboard_s, cloud_s, strict=True)))
    assert said in captions(findings)["times"]
    inside = "average below" in said
    assert facts(findings)["The lines cross at"] == ("d = 2" if inside else "no measured d")
    svg = charts.draw("times", findings.times).svg.decode()
    assert ('id="crossing"' in svg) == inside


def test_share_of_the_cloud_by_hand() -> None:
    """Over two tasks; nothing is said before there are two."""
    sides = np.array([True, True, False, False, True])
    np.testing.assert_array_equal(series.share_percent(sides, 2), [np.nan, 100, 50, 0, 50])
    np.testing.assert_array_equal(series.share_percent(sides, 1), [100, 100, 0, 0, 100])


@pytest.mark.parametrize(("tasks", "over"), [(1, 1), (7, 3), (39, 19), (40, 20), (999, 20), (2000, 40)])
def test_share_is_taken_over_20_tasks_or_what_fits_the_run(tasks: int, over: int) -> None:
    """Half of a short run, a fiftieth of a long one."""
    found = series.decisions("paper", np.ones(tasks), np.ones(tasks, dtype=bool), first=1, seed=1)
    assert (found.over, found.of) == (over, tasks)


def test_distribution_by_hand() -> None:
    """Of 3 1 2 2 a quarter took no longer than 1, three quarters than 2, and all than 3."""
    seconds, percent = series.ecdf(np.array([3.0, 1.0, 2.0, 2.0]))
    assert seconds.tolist() == [1, 1, 2, 2, 3]
    assert percent.tolist() == [0, 25, 50, 75, 100]


def test_a_long_distribution_is_thinned_and_keeps_its_ends() -> None:
    """Of 12,345 times as many steps as points are drawn; each is where it belongs."""
    seconds, percent = series.ecdf(np.random.default_rng(3).permutation(12_345).astype(np.float64))
    assert len(seconds) == series.POINTS_MAX + 1
    assert (seconds[0], seconds[-1], percent[-1]) == (0, 12_344, 100)
    np.testing.assert_allclose(percent[1:], 100 * (seconds[1:] + 1) / 12_345)


def test_points_are_thinned_evenly_and_by_seed() -> None:
    """One of each part of equal length, in order, the same for the same seed."""
    assert series.thin(series.POINTS_MAX, 1).tolist() == list(range(series.POINTS_MAX))
    picks = series.thin(100_000, 1)
    assert (picks // 100).tolist() == list(range(series.POINTS_MAX))
    assert picks.tolist() == series.thin(100_000, 1).tolist() != series.thin(100_000, 2).tolist()
    assert len(set(series.thin(series.POINTS_MAX + 1, 1))) == series.POINTS_MAX


def test_accuracy_intervals_are_those_of_the_table(dataset: Callable[[list[Line]], Path]) -> None:
    """`loadgen table --bootstrap` and the chart resample alike."""
    rows = read(dataset(THOUSAND[:400]))
    config = TableConfig(windows=("5", "50", "full"), bootstrap=True, seed=4)
    lines = [line for line in Evaluation(rows, config).scores("chosen") if line.predictor]
    expected = [(line.window, line.accuracy_percent) for line in lines if line.bound]

    def ends(seed: int) -> list[tuple[str, float]]:
        plain = [line for line in lines if not line.bound]
        found = series.accuracy_intervals(Evaluation(rows, TableConfig()), plain, "chosen", seed)
        return [(window, end) for window, one in found.items() for end in (one.low, one.high)]

    assert ends(4) == expected
    assert ends(1) != expected


@pytest.mark.parametrize("feedback", ["chosen", "full"])
def test_charts_and_tables_agree(found: Callable[..., Findings], feedback: str) -> None:
    """Mean time and share of a policy are the same in the replay table and in the charts."""
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


def test_the_papers_table_is_that_of_the_docs() -> None:
    """Line for line as in docs/evaluation.md, to the five digits that tables have."""
    section = PAGE.split("## The paper's own table")[1].split("\n## ")[0]
    documented, printed = cells_of(section), cells_of(render([paper.table()], "md"))
    assert printed[0] == documented[0]
    assert [[line[0], *map(float, line[1:])] for line in printed[2:]] == [
        [line[0], *(round(float(cell), 5) for cell in line[1:])] for line in documented[2:]
    ]


# The page and its files.


def test_page_and_pictures_hold_every_chart_and_table(
    dataset: Callable[[list[Line]], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Five charts, four tables; each chart is a PNG too; ids are unique; nothing is fetched or run."""
    out = tmp_path / "out"
    assert run_report(dataset(THOUSAND[:100]), ReportConfig(out=out)) == 0
    assert capsys.readouterr().out == f"{out / 'report.html'}\n"
    text = (out / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'<figure id="(\w+)">', text) == list(CHARTS)
    assert [text.count(f"<{tag}") for tag in ("svg", "figcaption", "table", "section")] == [5, 5, 4, 4]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [*(f"{name}.png" for name in CHARTS), "report.html"]
    )
    for name in CHARTS:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    ids = re.findall(r'\sid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    used = re.findall(r'(?:href="#|url\(#|labelledby=")([^")]+)', text)
    assert set(used) <= set(ids)
    assert set(re.findall(r'\b(?:href|src)="([^#"][^"]*)"', text)) == {"data:,"}
    assert not re.search(r"<script|@import|http:|\son\w+=", text)
    assert text.count("<style>") == 1


def test_names_are_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file name full of markup is text on the page, in its title and in every table; so are notes."""
    monkeypatch.chdir(tmp_path)
    name = "<img src=x onerror=alert(1)>&\"'.csv"
    Path(name).write_text(csv_of(THOUSAND[:8]))
    Path(name).with_suffix(".json").write_text('{"notes": ["<b>loud</b>"]}')
    run_report(Path(name), ReportConfig(out=tmp_path))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<img" not in text
    assert "<b>" not in text
    shown = "&lt;img src=x onerror=alert(1)&gt;&amp;&quot;&#x27;.csv"
    assert text.count(shown) == 5  # title, heading, three tables
    assert text.count("<p>&lt;b&gt;loud&lt;/b&gt;</p>") == 1


@pytest.mark.timeout(60)  # ten charts
def test_the_same_rows_give_the_same_bytes(dataset: Callable[[list[Line]], Path], tmp_path: Path) -> None:
    """Page and pictures, whatever the user has set in matplotlib, which is left as it was."""
    path = dataset(THOUSAND[:80])
    run_report(path, ReportConfig(out=tmp_path / "one"))
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "red", "svg.fonttype": "path"}):
        before = dict(matplotlib.rcParams)
        run_report(path, ReportConfig(out=tmp_path / "two"))
        assert dict(matplotlib.rcParams) == before
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    assert len(digests(tmp_path / "one")) == 6


def test_out_is_the_runs_folder_or_named_as_the_file(
    dataset: Callable[[list[Line]], Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run's report lies in its folder; that of rows.csv in out/rows, as `loadgen run` writes to out/run."""
    monkeypatch.chdir(tmp_path)
    run_report(dataset(THOUSAND[:4]), ReportConfig())
    assert (tmp_path / "out" / "rows" / "report.html").is_file()
    run = tmp_path / "run"
    run.mkdir()
    trace_of(run, ("paper", "cloud", {"cloud": 0.1}, 0.1))
    run_report(run, ReportConfig())
    assert (run / "report.html").is_file()


def test_a_later_report_replaces_all_of_an_earlier_one(
    dataset: Callable[[list[Line]], Path], tmp_path: Path
) -> None:
    """A chart that can no longer be drawn leaves no picture of the rows before."""
    out = tmp_path / "out"
    run_report(dataset(THOUSAND[:60]), ReportConfig(out=out))
    assert (out / "ecdf.png").is_file()
    run_report(dataset(THOUSAND[:9]), ReportConfig(out=out))
    assert sorted(path.name for path in out.iterdir()) == [
        "accuracy.png",
        "errors.png",
        "report.html",
        "times.png",
    ]


def test_a_folder_that_cannot_be_written_is_named(dataset: Callable[[list[Line]], Path]) -> None:
    """A file where the folder should be is one line, and stays as it is."""
    path = dataset(THOUSAND[:4])
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"rows\.csv/times\.png: cannot be written: "):
        run_report(path, ReportConfig(out=path))
    assert path.read_bytes() == before


def test_svg_is_made_fit_for_a_page() -> None:
    """Ids and references get the prefix, styles of the whole page and metadata go, marks share one style."""
    svg = b"""<?xml version="1.0"?><!DOCTYPE svg>
    <svg xmlns="http://www.w3.org/2000/svg" xmlns:xlink="http://www.w3.org/1999/xlink" viewBox="0 0 4 3">
      <metadata>made today</metadata>
      <defs><style>* {fill: red}</style><path id="dot" d="M 0.123456 1"/></defs>
      <g id="points">
        <use xlink:href="#dot" x="1.987654" style="fill: blue"/><use xlink:href="#dot" style="fill: blue"/>
      </g>
      <g clip-path="url(#box)"><text style="a">1 &lt; 2</text></g>
    </svg>"""
    assert inline(svg, "times", "Time & size") == (
        '<svg viewBox="0 0 4 3" role="img" aria-labelledby="times-title">'
        '<title id="times-title">Time &amp; size</title>'
        '<defs><path id="times-dot" d="M 0.12 1" /></defs>'
        '<g id="times-points" style="fill: blue"><use href="#times-dot" x="1.99" /><use href="#times-dot" />'
        "</g>"
        '<g clip-path="url(#times-box)"><text style="a">1 &lt; 2</text></g></svg>'
    )


# Little, odd and much data.


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
def test_little_and_odd_data_is_drawn_or_said_not_to_be(
    found: Callable[..., Findings], rows: list[Line], expected: list[str]
) -> None:
    """Every chart is drawn without a warning, or one line says why it is not."""
    findings = found(rows)
    assert drawn(findings) == expected
    for chart in all_charts(findings):
        if chart.shown is None:
            assert chart.caption.startswith("Not drawn: ")
        else:
            assert len(charts.draw(chart.name, chart.shown).svg) > 0


def test_much_data_is_thinned_and_said_to_be(found: Callable[..., Findings]) -> None:
    """Of 1,500 rows 1,000 points a site are drawn, of 1,450 decisions 1,000; lines are over all."""
    findings = found((THOUSAND * 2)[:1500])
    said = captions(findings)
    assert (
        "1,500 rows; no predictor, N or feedback is involved; 1,000 points of 1,500 are drawn."
        in said["times"]
    )
    assert "1,000 points of 1,450 are drawn" in said["decisions"]
    svg = charts.draw("times", findings.times).svg.decode()
    marks = svg[svg.index('id="points-cloud"') : svg.index('id="line-onboard"')]
    assert marks.count("<use") == series.POINTS_MAX
    assert findings.times.cloud == series.fit(findings.rows.size, findings.rows.cloud_s)


def test_a_trace_of_chosen_sides_shows_what_it_knows(found: Callable[..., Findings], tmp_path: Path) -> None:
    """Decisions and times as recorded; the other charts say that no task ran on both sites."""
    sites = ["onboard", "cloud", "cloud"] * 4
    findings = found(trace_of(tmp_path, *(("paper", site, {site: 0.1}, 0.2) for site in sites)))
    assert drawn(findings) == ["decisions", "ecdf"]
    assert findings.decisions.policy == "as recorded"
    assert findings.decisions.to_cloud.tolist() == [site == "cloud" for site in sites]
    assert list(findings.spent_s) == ["as recorded"]
    said = captions(findings)
    assert said["times"] == "Not drawn: no task ran on both sites."
    assert "12 tasks as recorded, with the robot's own predictor and N, feedback chosen." in said["decisions"]
    assert findings.evaluated == []
    assert facts(findings) == {}


def test_captions_say_what_was_replayed_how(found: Callable[..., Findings]) -> None:
    """Predictor, N, feedback and rows stand below each chart that depends on them."""
    findings = found(THOUSAND[:60], window=20, feedback="full", predictors=("theil-sen",))
    said = captions(findings)
    replayed = "Replay of 40 of 60 rows after a warm-up of N = 20, predictor least-squares, feedback full."
    assert said["decisions"].endswith(replayed)
    assert said["ecdf"].endswith(replayed)
    for name in ("errors", "accuracy"):
        assert said[name].endswith("60 rows for every N, predictor least-squares, theil-sen, feedback full.")


def test_every_policy_has_a_look_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """Policies that come later are drawn too, each in its own colour and dashes."""
    from offboard.loadgen.report.chart_styles import LOOKS, policy_look

    later = tuple(f"later-{number}" for number in range(6))
    monkeypatch.setattr(policies, "names", lambda: ("paper", "onboard", "cloud", *later))
    looks = [*LOOKS.values(), *map(policy_look, later)]
    assert len({look.colour for look in looks}) == len({str(look.line) for look in looks}) == len(looks)
    assert charts.draw("ecdf", {name: np.array([0.1, 0.2]) for name in ("paper", *later)}).png


# Mistakes.


def test_what_is_no_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nothing there, a folder without a trace, and an empty trace are one line each and exit code 2."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "trace.jsonl").touch()
    (tmp_path / "other").mkdir()
    for name, said in (
        ("none", "none: neither a run's folder nor a trace or CSV file"),
        ("other", "other: no trace.jsonl in this folder; `loadgen run` and `loadgen demo` write one"),
        ("empty", "no task ran well on both sites"),
    ):
        assert main(["report", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("loadgen report: ")
        assert error.count("\n") == 1
        assert said in error
    assert find_source(tmp_path / "empty") == tmp_path / "empty" / "trace.jsonl"


def test_a_trace_of_several_kinds_needs_one(tmp_path: Path) -> None:
    """As in `loadgen table`."""
    path = trace_of(tmp_path, *[("pinned", "cloud", {"onboard": 0.2, "cloud": 0.1}, 0.2)] * 4)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], *(line.replace('"plan"', '"walk"') for line in lines[2:]), ""]))
    with pytest.raises(DataError, match=r"several kinds: plan .* choose one with --kind"):
        run_report(path, ReportConfig(out=tmp_path))
    run_report(path, ReportConfig(out=tmp_path, kind="walk"))
    assert "2 tasks measured on both sites" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"predictor": "guess"}, "--predictor: 'guess' is not one of"),
        ({"predictors": ("huber", "guess")}, "--predictors: 'guess' is not one of"),
        ({"policies": ("guess",)}, "--policies: 'guess' is not one of"),
        ({"feedback": "both"}, "--feedback: 'both' is not one of chosen, full"),
        ({"window": 1}, "--window: 1 is below 2"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(said)):
        ReportConfig(**settings)


def test_without_matplotlib_the_extra_is_named(dataset: Callable[[list[Line]], Path]) -> None:
    """One line and exit code 2 where it is absent; --help does not load it."""
    block = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from offboard.loadgen.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", block, "report", *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=30)

    done = run(str(dataset(THOUSAND[:4])))
    assert done.stderr == (
        "loadgen report: loadgen report needs the extra 'report': pip install 'offboard[report]'\n"
    )
    assert done.returncode == 2
    assert run("--help").returncode == 0
