"""`loadgen report`: the page, its files, and the errors; tests/browser opens the page in a browser."""

import base64
import gzip
import hashlib
import json
import random
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import matplotlib
import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.__main__ import main
from offboard.loadgen.play.run_files import find_source
from offboard.loadgen.report.report import ReportConfig, run_report
from offboard.loadgen.table.table_formats import render
from offboard.loadgen.table.table_two_figures import published_table
from tests.extras import needs
from tests.reports import CHARTS, write_rows
from tests.table_loops import PAGE, THOUSAND, csv_of
from tests.unit.test_replay import trace_of

ROOT = Path(__file__).parents[2]


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def packed_look(page: str) -> dict[str, Any]:
    """What the live page in a report shows."""
    packed = page.partition('id="packed-look">')[2].partition("<")[0]
    look: dict[str, Any] = json.loads(gzip.decompress(base64.b64decode(packed)))
    return look


def cells_of(markdown: str) -> list[list[str]]:
    lines = (line for line in markdown.splitlines() if line.startswith("|"))
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]


def test_the_table_of_the_paper_matches_the_docs() -> None:
    """Every line is that of docs/evaluation.md, to the five digits that tables have."""
    section = PAGE.split("## The paper's own table")[1].split("\n## ")[0]
    documented, printed = cells_of(section), cells_of(render([published_table()], "md"))
    assert printed[0] == documented[0]
    assert [[line[0], *map(float, line[1:])] for line in printed[2:]] == [
        [line[0], *(round(float(cell), 5) for cell in line[1:])] for line in documented[2:]
    ]


def test_a_report_has_every_chart_and_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The page has the charts of the paper, also as PNGs, and four tables; nothing is loaded or run."""
    out = tmp_path / "out"
    assert run_report(write_rows(tmp_path, THOUSAND[:100]), ReportConfig(out=out)) == 0
    assert capsys.readouterr().out == f"{out / 'report.html'}\n"
    text = (out / "report.html").read_text(encoding="utf-8")
    assert re.findall(r'<figure id="picture-(\w+)">', text) == list(CHARTS)
    assert [text.count(f"<{tag}") for tag in ("img", "figcaption", "table")] == [3, 3, 4]
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [*(f"{name}.png" for name in CHARTS), "report.html"]
    )
    for name in CHARTS:
        assert (out / f"{name}.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    ids = re.findall(r'\sid="([^"]+)"', text)
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'labelledby="([^"]+)', text)) <= set(ids)
    assert {address.partition(":")[0] for address in re.findall(r'\b(?:href|src)="([^"]*)"', text)} == {
        "data"
    }
    assert not re.search(r"<script|@import|http:|\son\w+=", text)
    assert text.count("<style>") == 1


def test_names_are_escaped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Markup in a file name or in a note is shown as text, in the title, the heading and every table."""
    monkeypatch.chdir(tmp_path)
    name = "<img src=x onerror=alert(1)>&\"'.csv"
    Path(name).write_text(csv_of(THOUSAND[:8]))
    Path(name).with_suffix(".json").write_text('{"notes": ["<b>loud</b>"]}')
    run_report(Path(name), ReportConfig(out=tmp_path))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "<img src=x" not in text
    assert "<b>" not in text
    shown = "&lt;img src=x onerror=alert(1)&gt;&amp;&quot;&#x27;.csv"
    assert text.count(shown) == 5  # title, heading, three tables
    assert text.count("<p>&lt;b&gt;loud&lt;/b&gt;</p>") == 1


def test_the_same_rows_give_the_same_bytes(tmp_path: Path) -> None:
    """Page and PNGs do not depend on the matplotlib settings of the user, and do not change them."""
    path = write_rows(tmp_path, THOUSAND[:80])
    run_report(path, ReportConfig(out=tmp_path / "one"))
    with matplotlib.rc_context({"font.size": 20, "axes.facecolor": "red", "svg.fonttype": "path"}):
        before = dict(matplotlib.rcParams)
        run_report(path, ReportConfig(out=tmp_path / "two"))
        assert dict(matplotlib.rcParams) == before
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    assert len(digests(tmp_path / "one")) == 1 + len(CHARTS)


def test_the_same_trace_gives_the_same_bytes(tmp_path: Path) -> None:
    """The live page in a report depends only on the tasks."""
    trace_of(tmp_path, *(("paper", "cloud", {"cloud": 0.1 + 0.001 * i}, 0.1) for i in range(9)))
    for name in ("one", "two"):
        run_report(tmp_path / "trace.jsonl", ReportConfig(out=tmp_path / name))
    assert digests(tmp_path / "one") == digests(tmp_path / "two")
    assert list(digests(tmp_path / "one")) == ["report.html"]


def test_a_report_of_many_tasks_is_below_6_mb(tmp_path: Path) -> None:
    """Of a long trace the page holds the last tasks, and says how many it leaves out."""
    path = trace_of(tmp_path, ("paper", "cloud", {"cloud": 0.1}, 0.1))
    line, numbers = json.loads(path.read_text()), random.Random(1)
    with path.open("w") as file:
        for i in range(16_000):
            noise = {f"feature-{n}": numbers.random() for n in range(16)}
            file.write(json.dumps({**line, "i": i, "id": f"x-{i}", "features": noise}) + "\n")
    run_report(path, ReportConfig(out=tmp_path))
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(text.encode()) < 6_000_000
    look = packed_look(text)
    assert look["tasks"][-1]["i"] == 15_999
    assert 5_000 < len(look["tasks"]) == 16_000 - look["left_out"] < 16_000


def test_the_default_folder_is_that_of_the_run_or_out_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The report on a run is written to its folder, and the report on rows.csv to out/rows."""
    monkeypatch.chdir(tmp_path)
    run_report(write_rows(tmp_path, THOUSAND[:4]), ReportConfig())
    assert (tmp_path / "out" / "rows" / "report.html").is_file()
    run = tmp_path / "run"
    run.mkdir()
    trace_of(run, ("paper", "cloud", {"cloud": 0.1}, 0.1))
    run_report(run, ReportConfig())
    assert (run / "report.html").is_file()


def test_a_later_report_replaces_the_whole_earlier_one(tmp_path: Path) -> None:
    """The PNG of a chart that can no longer be drawn is removed."""
    out = tmp_path / "out"
    run_report(write_rows(tmp_path, THOUSAND[:60]), ReportConfig(out=out))
    assert (out / "accuracy.png").is_file()
    run_report(write_rows(tmp_path, THOUSAND[:1]), ReportConfig(out=out))
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "times.png"]


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    """A file where the folder should be gives one line, and is not changed."""
    path = write_rows(tmp_path, THOUSAND[:4])
    before = path.read_bytes()
    with pytest.raises(ConfigError, match=r"rows\.csv/times\.png: cannot be written: "):
        run_report(path, ReportConfig(out=path))
    assert path.read_bytes() == before


def test_a_path_that_is_not_a_run_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A missing path, a folder without a trace and an empty trace give one line each, and exit code 2."""
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "trace.jsonl").touch()
    (tmp_path / "other").mkdir()
    for name, said in (
        ("none", "none: no such file or folder; give the folder of a run, a trace, or a CSV file"),
        ("other", "other: this folder has no trace.jsonl; `loadgen run` and `loadgen demo` write one"),
        ("empty", "no task was answered by both sites"),
    ):
        assert main(["report", str(tmp_path / name)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("loadgen report: ")
        assert error.count("\n") == 1
        assert said in error
    assert find_source(tmp_path / "empty") == tmp_path / "empty" / "trace.jsonl"


def test_tables_of_several_kinds_need_the_flag_kind(tmp_path: Path) -> None:
    """Without --kind the page shows all tasks, and says why it has no tables; with it one kind is shown."""
    path = trace_of(tmp_path, *[("pinned", "cloud", {"onboard": 0.2, "cloud": 0.1}, 0.2)] * 4)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:2], *(line.replace('"plan"', '"walk"') for line in lines[2:]), ""]))
    run_report(path, ReportConfig(out=tmp_path))
    text = (tmp_path / "report.html").read_text()
    assert re.search(r"<p>.* several kinds: plan .* choose one with --kind\.</p>", text)
    assert {task["kind"] for task in packed_look(text)["tasks"]} == {"plan", "walk"}
    run_report(path, ReportConfig(out=tmp_path, kind="walk", window=2))
    text = (tmp_path / "report.html").read_text()
    assert "2 tasks were measured on both sites" in text
    assert {task["kind"] for task in packed_look(text)["tasks"]} == {"walk"}


def test_a_task_whose_size_has_several_numbers_is_counted(tmp_path: Path) -> None:
    """The page shows the tasks, and counts those that were measured."""
    path = trace_of(tmp_path, ("pinned", "cloud", {"onboard": 0.2, "cloud": 0.1}, 0.2))
    path.write_text(json.dumps(json.loads(path.read_text()) | {"size": [1.0, 2.0]}) + "\n")
    run_report(path, ReportConfig(out=tmp_path))
    assert "1 tasks were measured on both sites" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"predictor": "guess"}, "--predictor: 'guess' is not one of"),
        ({"predictors": ("parts", "guess")}, "--predictors: 'guess' is not one of"),
        ({"policies": ("guess",)}, "--policies: 'guess' is not one of"),
        ({"feedback": "both"}, "--feedback: 'both' is not one of chosen, full"),
        ({"window": 1}, "--window: 1 is below 2"),
    ],
)
def test_wrong_settings_are_refused(settings: dict[str, Any], said: str) -> None:
    """The error names the flag, the value, and what is allowed."""
    with pytest.raises(ConfigError, match=re.escape(said)):
        ReportConfig(**settings)


def test_without_matplotlib_the_extra_is_named(tmp_path: Path) -> None:
    """Without matplotlib the command prints one line with the extra, and exits with 2; --help still works."""
    block = (
        "import sys; sys.modules['matplotlib'] = None\n"
        "from offboard.loadgen.__main__ import main; sys.exit(main(sys.argv[1:]))"
    )

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", block, "report", *arguments]
        return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=30)

    done = run(str(write_rows(tmp_path, THOUSAND[:4])))
    assert done.stderr == (f"loadgen report: {needs('loadgen report', 'report')}\n")
    assert done.returncode == 2
    assert run("--help").returncode == 0
