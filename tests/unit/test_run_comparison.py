"""`loadgen report A B`: one page about several runs."""

import base64
import json
import re
from pathlib import Path

import pytest

from offboard.loadgen.__main__ import main
from offboard.loadgen.map_picture import LastPlan
from offboard.loadgen.report.run_comparison import RUNS_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.unit.test_map_picture import a_plan
from tests.unit.test_replay import trace_of

pytestmark = pytest.mark.timeout(90)  # the first plan compiles the planner


def run_in(folder: Path, policy: str, waited_s: float) -> Path:
    """The folder of a run of four tasks, three of which went to the cloud."""
    folder.mkdir(parents=True)
    sites = (CLOUD, CLOUD, CLOUD, ONBOARD)
    trace_of(folder, *((policy, site, {site: waited_s}, waited_s) for site in sites))
    about = {"name": "calm", "policy": policy, "seed": 3, "figures": {"lost": 0, "late_percent": 12.5}}
    (folder / "summary.json").write_text(json.dumps(about))
    return folder


def lines_of(page: str) -> list[list[str]]:
    """The cells of each line of the table."""
    body = page.partition("<tbody>")[2].partition("</tbody>")[0]
    lines = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", line) for line in body.split("</tr>")]
    return [line for line in lines if line]


def test_runs_are_compared_on_one_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Each run has a line in the table and one in the chart, and its last plan is shown."""
    first, second = run_in(tmp_path / "a", "paper", 0.2), run_in(tmp_path / "b", "default", 0.1)
    last = LastPlan(second / "plan.png")
    last.keep(*a_plan())
    last.write()
    out = tmp_path / "out"
    assert main(["report", str(first), str(second), "--out", str(out)]) == 0
    assert capsys.readouterr().out == f"{out / 'report.html'}\n"
    page = (out / "report.html").read_text()
    assert lines_of(page) == [
        ["a", "paper", "4", "200.0", "1.000", "200.0", "200.0", "75.0", "0", "12.5", "–"],  # noqa: RUF001
        ["b", "default", "4", "100.0", "0.500", "100.0", "100.0", "75.0", "0", "12.5", "–"],  # noqa: RUF001
    ]
    (chart,) = re.findall(r'<img src="data:image/svg\+xml;base64,([^"]+)"', page)
    assert re.findall(rb'<g id="(run-\d)">', base64.b64decode(chart)) == [b"run-1", b"run-2"]
    assert re.findall(r'<figure id="picture-([\w-]+)">', page) == ["runs", "plan-1"]
    assert page.count('<img src="data:image/png;base64,') == 1
    assert "A plan on the map, b" in page


def test_folders_of_the_same_name_are_told_apart(tmp_path: Path) -> None:
    """Their lines have the whole path."""
    runs = [str(run_in(tmp_path / name / "demo", "paper", 0.2)) for name in ("x", "y")]
    assert main(["report", *runs, "--out", str(tmp_path / "out")]) == 0
    assert [line[0] for line in lines_of((tmp_path / "out" / "report.html").read_text())] == runs


def test_a_report_on_one_run_shows_its_plan(tmp_path: Path) -> None:
    """The picture is the last panel of the page."""
    run = run_in(tmp_path / "a", "paper", 0.2)
    last = LastPlan(run / "plan.png")
    last.keep(*a_plan())
    last.write()
    assert main(["report", str(run)]) == 0
    page = (run / "report.html").read_text()
    assert re.findall(r'<figure id="picture-([\w-]+)">', page) == ["plan"]
    assert page.count("data:image/png;base64,") == 1


@pytest.mark.parametrize(
    ("names", "said"),
    [
        (["a", "d.csv"], "d.csv: a CSV file has no decisions; a comparison needs the folders or traces"),
        (["a", "none"], "none: no such file or folder"),
        (["a"] * (RUNS_MAX + 1), f"{RUNS_MAX + 1} runs are too many for one page: at most {RUNS_MAX}"),
    ],
)
def test_what_is_not_a_run_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], names: list[str], said: str
) -> None:
    """A mistake of the user is one line on stderr and exit code 2."""
    run_in(tmp_path / "a", "paper", 0.2)
    (tmp_path / "d.csv").write_text("size,onboard_s,cloud_s\n1,2,3\n")
    assert main(["report", *(str(tmp_path / name) for name in names)]) == 2
    shown = capsys.readouterr()
    assert said in shown.err
    assert shown.err.count("\n") == 1
