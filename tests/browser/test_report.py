"""The page of `loadgen report` in a real browser."""

import base64
import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from offboard.common.errors import CloudTimeout, Overtaken
from offboard.loadgen.report.report import ReportConfig, run_report
from offboard.loadgen.table.table_settings import PAPER_WINDOWS
from offboard.robot_client.policies import Hedge
from offboard.robot_client.records.record import ChunkRecord, Record, as_dict
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.browser.conftest import Opened
from tests.browser.test_live_answers import outlook, task
from tests.reports import CHARTS

pytestmark = [pytest.mark.browser, pytest.mark.timeout(120)]

Open = Callable[..., Opened]

PHONE, DESKTOP = {"width": 360, "height": 740}, {"width": 1280, "height": 800}
LETTERS_PX = 7.5  # smallest letters of a chart on a phone
CONTRAST = 4.5  # WCAG 2.2, level AA, for text
PRESSES_MAX = 20
SOON_MS = 30_000  # a loaded machine unpacks the charts in a few seconds

# For each named series: the number of its marks, and how many of them are visible inside the chart.
MARKS = """() => Object.fromEntries([...document.querySelectorAll('svg g[id]')].map(group => {
  const chart = group.ownerSVGElement.getBoundingClientRect();
  const marks = [...group.querySelectorAll('use, path')].filter(mark => !mark.closest('defs'));
  const seen = marks.filter(mark => {
    const box = mark.getBoundingClientRect(), style = getComputedStyle(mark);
    return Math.max(box.width, box.height) > 0.5 && style.visibility === 'visible'
      && (style.fill !== 'none' || style.stroke !== 'none')
      && box.left >= chart.left - 1 && box.right <= chart.right + 1
      && box.top >= chart.top - 1 && box.bottom <= chart.bottom + 1;
  });
  return [`${group.ownerSVGElement.parentElement.id}-${group.id}`, [marks.length, seen.length]];
}))"""

# The text with the lowest contrast to its background: [ratio, element].
LEAST_CONTRAST = """() => {
  const parse = text => (text.match(/[\\d.]+/g) || []).map(Number);
  const luminance = ([r, g, b]) => [r, g, b].map(v => v / 255)
    .map(v => v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const behind = element => {
    for (; element; element = element.parentElement) {
      const colour = parse(getComputedStyle(element).backgroundColor);
      if (colour.length === 3 || colour[3] === 1) return colour;
    }
    return [255, 255, 255];
  };
  const texts = [...document.querySelectorAll('body *')].filter(element =>
    !['title', 'style'].includes(element.tagName) && [...element.childNodes].some(
      node => node.nodeType === Node.TEXT_NODE && node.textContent.trim()));
  return texts.map(element => {
    const style = getComputedStyle(element);
    const colour = parse(element.tagName === 'text' ? style.fill : style.color);
    const [a, b] = [colour, behind(element)].map(luminance);
    return [(Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05), element.outerHTML.slice(0, 80)];
  }).sort((one, other) => one[0] - other[0])[0];
}"""

# The height of the smallest letters in the charts of the live page, in pixels of the screen.
LEAST_LETTERS = """() => Math.min(...[...document.querySelectorAll('.plot text')].map(text =>
  parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a || Infinity))"""


def drawings(page: Page) -> dict[str, str]:
    """The SVG of each chart of the paper."""
    found = {}
    for figure in page.locator("#pictures figure").all():
        data = (figure.locator("img").get_attribute("src") or "").removeprefix("data:image/svg+xml;base64,")
        svg = base64.b64decode(data).decode()
        found[(figure.get_attribute("id") or "").removeprefix("picture-")] = svg[svg.index("<svg") :]
    return found


def all_seen(page: Page) -> dict[str, int]:
    """The number of marks of each named series in the charts of the paper; all of them must be visible."""
    page.set_content("".join(f'<div id="{name}">{svg}</div>' for name, svg in drawings(page).items()))
    found: dict[str, list[int]] = page.evaluate(MARKS)
    hidden = {name: counts for name, counts in found.items() if counts[0] != counts[1]}
    assert hidden == {}, "series: number of marks, number of visible marks"
    return {name: seen for name, (_, seen) in found.items()}


def body_rows(page: Page) -> list[int]:
    """The number of rows in the body of each table of the paper."""
    return [section.locator("tbody tr").count() for section in page.locator("section[id^=table]").all()]


def happened(i: int, what: str) -> Record:
    """A task of second `i`, of which `what` went wrong."""
    usual = task(i, cloud=outlook(0.03, silent=what == "outage"), planned=False)
    lost = Execution(CLOUD, 0.5, failure=CloudTimeout("no answer"), censored=True)
    overtaken = Execution(CLOUD, 0.2, failure=Overtaken("another site answered"), censored=True)
    onboard, hedge = Execution(ONBOARD, 0.1), usual.decision._replace(second=Hedge(ONBOARD, 0.1))
    wrong: dict[str, dict[str, Any]] = {
        "late": {
            "executions": (Execution(CLOUD, 0.4, network_s=0.3, queue_s=0.06, run_s=0.04),),
            "waited_s": 0.4,
        },
        "fallback": {"executions": (lost, onboard), "used": ONBOARD, "waited_s": 0.03},
        "hedge": {"decision": hedge, "executions": (overtaken, onboard), "used": ONBOARD, "waited_s": 0.03},
    }
    return replace(usual, deadline_s=None, **wrong.get(what, {}))


@pytest.fixture(scope="module")
def trace_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report on a trace of 50 tasks: one was late, one fell back, one was hedged, five saw an outage."""
    folder = tmp_path_factory.mktemp("trace")
    wrong = {10: "late", 20: "fallback", 25: "hedge", **dict.fromkeys(range(40, 45), "outage")}
    lines = [json.dumps(as_dict(happened(i, wrong.get(i, "")))) for i in range(50)]
    (folder / "robot.jsonl").write_text("\n".join([*lines, ""]))
    run_report(folder / "robot.jsonl", ReportConfig(out=folder))
    return folder / "report.html"


def test_a_report_of_a_trace_is_the_live_page(opened: Open, trace_report: Path) -> None:
    """Without a server the page shows all tasks; the file is below 6 MB, and without the paper's tables."""
    report = opened(trace_report.as_uri(), viewport=DESKTOP)
    page = report.page
    expect(page.locator("#answer-place")).to_have_text(
        "Always cloud: 0.80 times as long. Always onboard: 2.67 times as long.", timeout=SOON_MS
    )
    assert page.locator("#times .point").count() > 50
    expect(page.locator("#answer-predictions")).to_contain_text("% of 50 answers were inside")
    assert page.locator("#decision-rows tr").count() == 30
    assert (page.locator("#pictures figure").count(), page.locator("#terms").count()) == (0, 0)
    assert {address.partition(":")[0] for address in report.requests[1:]} == {"blob"}
    assert report.complaints == []
    assert trace_report.stat().st_size < 6_000_000


def test_a_report_draws_the_queue_of_a_stream(opened: Open, tmp_path: Path) -> None:
    """Over time, with the chunks that were not played, and says how often it was empty."""
    chunks = [
        ChunkRecord("played", 10.0, 10 * i, 10 * i, None, 0.1, left=3, actions=15, dropped=1)
        for i in range(6)
    ]
    chunks[3] = ChunkRecord("lost", 10.0, 30, 30, 0.2, 1.5, left=4)
    lines = [json.dumps(as_dict(replace(happened(i, ""), chunk=chunk))) for i, chunk in enumerate(chunks)]
    (tmp_path / "robot.jsonl").write_text("\n".join([*lines, ""]))
    run_report(tmp_path / "robot.jsonl", ReportConfig(out=tmp_path))
    page = opened((tmp_path / "report.html").as_uri(), viewport=DESKTOP).page
    expect(page.locator("#queue p")).to_have_text(
        "The queue was empty once; 1 chunk was not played.", timeout=SOON_MS
    )
    assert page.locator("#queue .legendtext").all_text_contents() == ["queue", "not played"]
    assert page.locator("#queue .scatterlayer .js-line").count() == 1


def test_a_report_says_what_went_wrong_and_why(opened: Open, trace_report: Path) -> None:
    """Late answers, fallbacks, hedges and outages are marked in the time line, and listed with reasons."""
    page = opened(trace_report.as_uri(), viewport=DESKTOP).page
    expect(page.locator("#incident-rows tr")).to_have_count(4, timeout=SOON_MS)
    rows = [row.locator("td").all_inner_texts()[1:] for row in page.locator("#incident-rows tr").all()]
    assert rows[0][:2] == ["outage", ""]
    assert re.fullmatch(r"cloud was silent or absent, until \d\d:\d\d:\d\d", rows[0][2])
    assert rows[1:] == [
        ["hedge", "25", "cloud had not answered after 100 ms, so onboard started too; answered by onboard"],
        ["fallback", "20", "cloud: CloudTimeout: no answer; answered by onboard"],
        [
            "late",
            "10",
            "400 ms, above the 90 % band, which ended at 36 ms; cloud: link 300 ms, queue 60 ms, run 40 ms",
        ],
    ]
    keys = page.locator("#history .legendtext").all_text_contents()
    assert keys == ["onboard", "cloud", "hedge", "fallback", "late"]
    assert page.locator("#history .shapelayer path").count() == 1
    assert [row.locator("td").all_inner_texts() for row in page.locator("#calibration-rows tr").all()] == [
        ["onboard", "2", "2", "100 ms", "0 %", "100 %", "0 %", "0 %", "no variants"],
        ["cloud", "50", "48", "38 ms", "0 %", "98 %", "2 %", "0 %", "no variants"],
    ]


def test_a_page_from_the_disk_makes_no_requests(opened: Open, dataset_report: Path) -> None:
    """The page itself is the only request; there are no warnings, and of a dataset no scripts."""
    report = opened(dataset_report.as_uri())
    assert report.requests == [dataset_report.as_uri()]
    assert report.complaints == []
    assert (
        report.page.locator(
            "script, iframe, object, img:not([src^='data:']), link:not([href='data:,'])"
        ).count()
        == 0
    )
    assert report.page.title() == f"Report on {dataset_report.parent / 'rows.csv'}"


def test_a_served_page_makes_no_further_requests(opened: Open, served: tuple[str, list[str]]) -> None:
    """The server gets one request, for the page."""
    address, asked = served
    report = opened(address)
    assert report.requests == [address]
    assert asked == ["/report.html"]
    assert report.complaints == []


@pytest.mark.parametrize("name", ["dataset_report", "trace_report"])
def test_the_content_security_policy_refuses_foreign_content(
    opened: Open, name: str, request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """A picture and a script that are added to the page are refused, and the browser reports it."""
    text = request.getfixturevalue(name).read_text(encoding="utf-8")
    spoilt = tmp_path / "spoilt.html"
    outside = '<img src="http://127.0.0.1:9/x.png"><script>document.title = "run"</script></main>'
    spoilt.write_text(text.replace("</main>", outside), encoding="utf-8")
    report = opened(spoilt.as_uri())
    assert [message.count("Content Security Policy") > 0 for message in report.complaints] == [True, True]
    assert report.page.title() != "run"


def test_every_chart_of_a_dataset_has_its_marks(opened: Open, dataset_report: Path) -> None:
    """Of 300 rows the page shows 300 points per site, and every line, band and crossing."""
    page = opened(dataset_report.as_uri(), viewport=DESKTOP).page
    assert tuple(drawings(page)) == CHARTS
    seen = all_seen(page)
    assert (seen["times-points-onboard"], seen["times-points-cloud"]) == (300, 300)
    # A line, and a marker for each N. There are too few rows for N = 500, which only the paper has.
    windows = len(PAPER_WINDOWS) - 1
    for name in ("errors-mae-onboard-0", "errors-residual-cloud-1", "accuracy-accuracy-1"):
        assert seen[name] == 1 + windows, name
    assert seen["accuracy-accuracy-printed"] == 1 + len(PAPER_WINDOWS)
    single = (
        *("times-line-onboard", "times-line-cloud", "times-crossing"),
        *("accuracy-interval", "accuracy-interval-full"),
        *("accuracy-accuracy-always-onboard", "accuracy-accuracy-always-cloud", "accuracy-accuracy-oracle"),
    )
    assert {name: seen.get(name) for name in single} == dict.fromkeys(single, 1)


def test_a_run_that_measured_both_sites_has_both_parts(opened: Open, run_folder_report: Path) -> None:
    """Of 60 measured and 40 decided tasks the page has the live page and the charts of the paper."""
    report = opened(run_folder_report.as_uri(), viewport=DESKTOP)
    expect(report.page.locator("#answer-why")).not_to_be_empty(timeout=SOON_MS)
    assert report.page.locator("#history .point").count() == 100
    assert report.complaints == []
    seen = all_seen(report.page)
    assert (seen["times-points-onboard"], seen["times-points-cloud"]) == (60, 60)


@pytest.mark.parametrize("viewport", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_page_fits_the_screen(opened: Open, dataset_report: Path, viewport: Any) -> None:
    """The page is not wider than the screen; charts fill their cards; letters are large enough."""
    page = opened(dataset_report.as_uri(), viewport=viewport).page
    assert page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]
    for name, svg in drawings(page).items():
        chart, card = (page.locator(f"#picture-{name}{part}").bounding_box() for part in (" img", ""))
        assert chart is not None
        assert card is not None
        assert 0.85 * card["width"] < chart["width"] < card["width"]
        assert card["x"] + card["width"] <= viewport["width"]
        scale = chart["width"] / float(re.findall(r'viewBox="0 0 ([\d.]+) ', svg)[0])
        assert scale * min(map(float, re.findall(r"font-size: ([\d.]+)px", svg))) >= LETTERS_PX
    all_seen(page)


@pytest.mark.parametrize("viewport", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_live_page_of_a_report_fits_the_screen(opened: Open, trace_report: Path, viewport: Any) -> None:
    """Nothing is wider than the screen, and letters are large enough."""
    page = opened(trace_report.as_uri(), viewport=viewport).page
    expect(page.locator("#answer-why")).not_to_be_empty(timeout=SOON_MS)
    assert page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]
    assert page.evaluate(LEAST_LETTERS) >= LETTERS_PX


def test_tables_have_their_rows_and_scroll_by_keyboard(opened: Open, dataset_report: Path) -> None:
    """The page has four tables; the arrow keys scroll a table that is wider than the screen of a phone."""
    page = opened(dataset_report.as_uri(), viewport=PHONE).page
    table = 2 * len(PAPER_WINDOWS) + 3  # two predictors, three constant policies
    assert body_rows(page) == [4, table, table, len(PAPER_WINDOWS)]
    wide = page.locator("#table-2 .scroll")
    wide.focus()
    for _ in range(PRESSES_MAX):  # the page may not listen yet
        page.keyboard.press("ArrowRight")
        page.wait_for_timeout(100)
        if wide.evaluate("element => element.scrollLeft") > 0:
            break
    else:
        pytest.fail("the arrow key does not scroll the table")
    page.wait_for_timeout(500)  # scrolling is smooth
    first = wide.locator("tbody th").first.bounding_box()
    frame = wide.bounding_box()
    assert first is not None
    assert frame is not None
    assert first["x"] == frame["x"], "the first column does not move"


def test_the_replay_table_of_a_run_has_a_recorded_row(opened: Open, run_folder_report: Path) -> None:
    """The replay table of a run begins with the run as recorded."""
    page = opened(run_folder_report.as_uri()).page
    assert page.locator("#table-1 tbody th").all_inner_texts() == [
        *("as recorded", "paper", "onboard", "cloud", "oracle")
    ]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_text_has_enough_contrast(opened: Open, run_folder_report: Path, scheme: str) -> None:
    """All text has the contrast of WCAG AA; a dark colour scheme gives a dark page."""
    page = opened(run_folder_report.as_uri(), color_scheme=scheme).page
    expect(page.locator("#answer-why")).not_to_be_empty(timeout=SOON_MS)
    ratio, element = page.evaluate(LEAST_CONTRAST)
    assert ratio >= CONTRAST, element
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).every(v => v < 64)")
    assert dark == (scheme == "dark")


def test_charts_have_names_for_screen_readers(opened: Open, dataset_report: Path) -> None:
    """The page has a language and one main heading, and each chart is an image with a name."""
    page = opened(dataset_report.as_uri()).page
    assert page.locator("html").get_attribute("lang") == "en"
    assert page.locator("h1").count() == 1
    for figure in page.locator("figure").all():
        title = figure.locator("h2").inner_text()
        assert figure.get_by_role("img", name=title, exact=True).count() == 1
