"""The page of `loadgen report` in a real browser."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Page

from offboard.loadgen.table.table_settings import PAPER_WINDOWS
from tests.browser.conftest import Opened

pytestmark = [pytest.mark.browser, pytest.mark.timeout(120)]

Open = Callable[..., Opened]

CHARTS = ("times", "decisions", "errors", "accuracy", "ecdf")
PHONE, DESKTOP = {"width": 360, "height": 740}, {"width": 1280, "height": 800}
LETTERS_PX = 7.5  # smallest letters of a chart on a phone
CONTRAST = 4.5  # WCAG 2.2, level AA, for text
PRESSES_MAX = 20

# For each named series: the number of its marks, and how many of them are visible inside the chart.
MARKS = """() => Object.fromEntries([...document.querySelectorAll('.chart svg g[id]')].map(group => {
  const chart = group.ownerSVGElement.getBoundingClientRect();
  const marks = [...group.querySelectorAll('use, path')].filter(mark => !mark.closest('defs'));
  const seen = marks.filter(mark => {
    const box = mark.getBoundingClientRect(), style = getComputedStyle(mark);
    return Math.max(box.width, box.height) > 0.5 && style.visibility === 'visible'
      && (style.fill !== 'none' || style.stroke !== 'none')
      && box.left >= chart.left - 1 && box.right <= chart.right + 1
      && box.top >= chart.top - 1 && box.bottom <= chart.bottom + 1;
  });
  return [group.id, [marks.length, seen.length]];
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

# The height of the smallest letters in the charts, in pixels of the screen.
LEAST_LETTERS = """() => Math.min(...[...document.querySelectorAll('.chart text')].map(text =>
  parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a || Infinity))"""


def all_seen(page: Page) -> dict[str, int]:
    """The number of marks of each named series; all of them must be visible."""
    found: dict[str, list[int]] = page.evaluate(MARKS)
    hidden = {name: counts for name, counts in found.items() if counts[0] != counts[1]}
    assert hidden == {}, "series: number of marks, number of visible marks"
    return {name: seen for name, (_, seen) in found.items()}


def body_rows(page: Page) -> list[int]:
    """The number of rows in the body of each table."""
    return [section.locator("tbody tr").count() for section in page.locator("section").all()]


def test_a_page_from_the_disk_makes_no_requests(opened: Open, dataset_report: Path) -> None:
    """The page itself is the only request; there are no warnings, no scripts, and no pictures."""
    report = opened(dataset_report.as_uri())
    assert report.requests == [dataset_report.as_uri()]
    assert report.complaints == []
    assert report.page.locator("script, img, iframe, object, link[href]:not([href='data:,'])").count() == 0
    assert report.page.title() == f"Report on {dataset_report.parent / 'rows.csv'}"


def test_a_served_page_makes_no_further_requests(opened: Open, served: tuple[str, list[str]]) -> None:
    """The server gets one request, for the page."""
    address, asked = served
    report = opened(address)
    assert report.requests == [address]
    assert asked == ["/report.html"]
    assert report.complaints == []


def test_the_content_security_policy_refuses_foreign_content(
    opened: Open, dataset_report: Path, tmp_path: Path
) -> None:
    """A picture and a script that are added to the page are refused, and the browser reports it."""
    text = dataset_report.read_text(encoding="utf-8")
    spoilt = tmp_path / "spoilt.html"
    outside = '<img src="http://127.0.0.1:9/x.png"><script>document.title = "run"</script></main>'
    spoilt.write_text(text.replace("</main>", outside), encoding="utf-8")
    report = opened(spoilt.as_uri())
    assert [message.count("Content Security Policy") > 0 for message in report.complaints] == [True, True]
    assert report.page.title() != "run"


def test_every_chart_of_a_dataset_has_its_marks(opened: Open, dataset_report: Path) -> None:
    """Of 300 rows the page shows 300 points per site, 250 decisions, and every line, band and crossing."""
    page = opened(dataset_report.as_uri(), viewport=DESKTOP).page
    assert [figure.get_attribute("id") for figure in page.locator("figure").all()] == list(CHARTS)
    seen = all_seen(page)
    assert (seen["times-points-onboard"], seen["times-points-cloud"]) == (300, 300)
    assert seen["decisions-chosen-onboard"] + seen["decisions-chosen-cloud"] == 250
    # A line, and a marker for each N. There are too few rows for N = 500, which only the paper has.
    windows = len(PAPER_WINDOWS) - 1
    for name in ("errors-mae-onboard-0", "errors-residual-cloud-1", "accuracy-accuracy-1"):
        assert seen[name] == 1 + windows, name
    assert seen["accuracy-accuracy-printed"] == 1 + len(PAPER_WINDOWS)
    single = (
        *("times-line-onboard", "times-line-cloud", "times-crossing", "decisions-share"),
        *("decisions-share-oracle", "accuracy-interval", "accuracy-interval-full"),
        *("accuracy-accuracy-always-onboard", "accuracy-accuracy-always-cloud", "accuracy-accuracy-oracle"),
        *("ecdf-ecdf-paper", "ecdf-ecdf-onboard", "ecdf-ecdf-cloud", "ecdf-ecdf-oracle"),
    )
    assert {name: seen.get(name) for name in single} == dict.fromkeys(single, 1)


def test_every_chart_of_a_run_has_its_marks(opened: Open, run_folder_report: Path) -> None:
    """Of 60 measured and 40 decided tasks the page shows the recorded decisions and their distribution."""
    seen = all_seen(opened(run_folder_report.as_uri(), viewport=DESKTOP).page)
    assert (seen["times-points-onboard"], seen["times-points-cloud"]) == (60, 60)
    assert (seen["decisions-chosen-onboard"], seen["decisions-chosen-cloud"]) == (20, 20)
    assert "decisions-share-oracle" not in seen
    assert (seen["ecdf-ecdf-as-recorded"], seen["ecdf-ecdf-paper"]) == (1, 1)


@pytest.mark.parametrize("viewport", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_page_fits_the_screen(opened: Open, dataset_report: Path, viewport: Any) -> None:
    """The page is not wider than the screen; charts fill their cards; letters are large enough."""
    page = opened(dataset_report.as_uri(), viewport=viewport).page
    assert page.evaluate("document.documentElement.scrollWidth") <= viewport["width"]
    for name in CHARTS:
        chart, card = (page.locator(f"#{name}{part}").bounding_box() for part in (" svg", ""))
        assert chart is not None
        assert card is not None
        assert 0.85 * card["width"] < chart["width"] < card["width"]
        assert card["x"] + card["width"] <= viewport["width"]
    assert page.evaluate(LEAST_LETTERS) >= LETTERS_PX
    all_seen(page)


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
def test_text_has_enough_contrast(opened: Open, dataset_report: Path, scheme: str) -> None:
    """All text, also in the charts, has the contrast of WCAG AA; a dark colour scheme gives a dark page."""
    page = opened(dataset_report.as_uri(), color_scheme=scheme).page
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
