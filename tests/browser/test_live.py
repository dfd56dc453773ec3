"""The pages /live of a robot, a server and a run, and /docs, in a real browser next to real processes.

With PICTURES=FOLDER the screenshots of docs/pictures are made there.
"""

import io
import os
import re
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest
from PIL import Image
from playwright.sync_api import Browser, Page, expect

from benchmarks.keyring import Keys
from benchmarks.servers import cloud_server
from offboard import Offloader
from offboard.cloud_server.http_api import LOOKS_A_STREAM
from offboard.common.live.live_port import LivePort
from offboard.loadgen.play.watch import RunLive
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from tests.browser.conftest import Opened
from tests.browser.test_report import CONTRAST, DESKTOP, LEAST_CONTRAST, LEAST_LETTERS, LETTERS_PX, PHONE
from tests.integration.test_live_robot import free_address
from tests.joint_tasks import joint_count
from tests.testbeds import MAP

pytestmark = [pytest.mark.browser, pytest.mark.timeout(240)]

TOKEN = "a-token-of-the-tests"
TASKS_MIN = 40  # before the pages are looked at
START_MS, SOON_MS, OUTAGE_MS = 90_000, 10_000, 2_000
COLOURS = 128
NARROW = {"width": 900, "height": 800}  # for pictures of parts of the page

Look = Callable[..., Opened]

# A value that changes when marks move or appear.
MARKS = (
    "() => [...document.querySelectorAll('#history .point')].map(one => one.getAttribute('transform')).join()"
)


class Demo:
    """A robot that plans paths, with its server and a relay, and the addresses of their pages."""

    def __init__(self, folder: Path) -> None:
        self.robots, token, keys = [free_address(), free_address()], folder / "token", Keys(folder)
        token.touch(0o600)
        token.write_text(f"{TOKEN}\n")
        robot = {
            **{"map": MAP, "resolution": 0.025, "jump": True, "tasks": 1_000_000, "timeout": 0.5},
            **{"connect": 30.0, "trace": folder / "trace.jsonl", "metrics": self.robots[0]},
            "keys": keys.add("robot"),
        }
        other = {"trace": folder / "trace-2.jsonl", "policy": "cloud", "metrics": self.robots[1]}
        setups = {
            "cloud": Setup({"token_file": token, "keys": keys.server, "robots": keys.robots}, cpus=1.0),
            "wan": Setup({"delay_ms": 5.0, "bandwidth_mbps": 400.0}),
            "robot": Setup(robot, command="drive", cpus=0.1),
            "robot-2": Setup({**robot, **other, "keys": keys.add("robot-2")}, command="drive", cpus=0.1),
        }
        self.bed = LocalTestbed(folder, setups)

    @contextmanager
    def second_robot(self) -> Iterator[str]:
        """The address of the page of a further robot, which sends all tasks to the cloud."""
        self.bed.start("robot-2")
        page, end = f"http://{self.robots[1]}/live", time.monotonic() + START_MS / 1000
        try:
            while not answers(page):
                assert time.monotonic() < end, "the second robot has no page"
                time.sleep(0.2)
            yield page
        finally:
            self.bed.kill("robot-2")

    @property
    def robot_page(self) -> str:
        return f"http://{self.robots[0]}/live"

    @property
    def server(self) -> str:
        return f"http://{self.bed.parts['cloud'].http}"


def answers(page: str) -> bool:
    try:
        return httpx.get(page).status_code == httpx.codes.OK
    except httpx.TransportError:
        return False


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Demo]:
    made = Demo(tmp_path_factory.mktemp("live"))
    with made.bed as bed:
        bed.start()
        bed.start("robot")
        end = time.monotonic() + START_MS / 1000
        trace = made.bed.out / "trace.jsonl"
        while not trace.exists() or len(trace.read_text().splitlines()) < TASKS_MIN:
            assert time.monotonic() < end, "the robot has made no tasks"
            time.sleep(0.2)
        yield made


@pytest.fixture
def look(browser: Browser) -> Iterator[Look]:
    """Factory: opens a page that never stops loading, in a new context; waits until it is live."""
    made = []

    def factory(address: str, *, live: bool = True, **options: Any) -> Opened:
        made.append(browser.new_context(**options))
        one = Opened(made[-1].new_page())
        one.page.goto(address, wait_until="domcontentloaded")
        if live:
            expect(one.page.locator("#state")).to_have_text("live", timeout=SOON_MS)
        return one

    yield factory
    for context in made:
        context.close()


def enter_token(page: Page) -> None:
    """By keyboard alone: the field has the focus."""
    expect(page.locator("#token")).to_be_focused(timeout=SOON_MS)
    page.keyboard.type(TOKEN)
    page.keyboard.press("Enter")


def picture(page: Page, name: str, *parts: str) -> None:
    """Keep a picture of the whole page, or of these parts below each other, if pictures are wanted."""
    folder = os.environ.get("PICTURES")
    if folder is None:
        return
    shots = [page.locator(part).screenshot() for part in parts] or [page.screenshot(full_page=True)]
    images = [Image.open(io.BytesIO(png)).convert("RGB") for png in shots]
    size = max(image.width for image in images), sum(image.height for image in images)
    whole, top = Image.new("RGB", size, "white"), 0
    for image in images:
        whole.paste(image, (0, top))
        top += image.height
    whole.quantize(COLOURS).save(Path(folder) / f"{name}.png", optimize=True)


def becomes(page: Page, true: str) -> None:
    """Wait for an expression. The page's policy refuses `wait_for_function`, which evaluates a text in it."""
    end = time.monotonic() + SOON_MS / 1000
    while not page.evaluate(true):
        assert time.monotonic() < end, f"within {SOON_MS} ms it is not true: {true}"
        page.wait_for_timeout(50)


def has_points(page: Page, chart: str, least: int) -> None:
    becomes(page, f"document.querySelectorAll('#{chart} .point').length >= {least}")


def test_the_page_of_a_robot_in_an_outage(demo: Demo, look: Look) -> None:
    """Marks move; an outage shows within 2 s; nothing leaves the machine; the console stays empty."""
    opened = look(demo.robot_page, viewport=DESKTOP)
    page = opened.page
    has_points(page, "times", TASKS_MIN)
    before = page.evaluate(MARKS)
    becomes(page, f"({MARKS})() !== {before!r}")
    cloud = page.locator("[data-site=cloud] p").first
    expect(cloud).to_have_text("there", timeout=SOON_MS)
    picture(page, "live-robot")
    demo.bed.set_link(outage=True)
    try:
        expect(cloud).to_have_class("bad", timeout=OUTAGE_MS)
        page.wait_for_timeout(3_000)  # some decisions are made in the outage
        why = re.compile(r"Onboard: cloud does not answer heartbeats, for \d+ s so far")
        expect(page.locator("#answer-why")).to_contain_text(why)
        page.wait_for_selector("#history .shapelayer path", state="attached", timeout=SOON_MS)
        picture(page, "live-outage")
        picture(page, "answer-why", "#answers", "#history")
    finally:
        demo.bed.set_link(outage=False)
    expect(cloud).to_have_text("there", timeout=SOON_MS)
    assert {address.partition("/live")[0] for address in opened.requests} == {
        demo.robot_page.removesuffix("/live")
    }
    assert opened.complaints == []


def test_the_page_of_a_robot_answers_questions(demo: Demo, look: Look) -> None:
    """Why there, server or link, are predictions good, would budget help: each has a verdict and figures."""
    page = look(demo.robot_page, viewport=NARROW).page
    has_points(page, "times", TASKS_MIN)
    said = {
        "why": r"(Onboard|Cloud|On all sites)[:,] ",
        "why-figures": r"Task \d+.*, took [\d.]+ m?s\. ",
        "part": r"The (link|server): .* of the time of \d+ answers",
        "predictions": r"(Yes|No).*: \d+ % of \d+ answers were inside",
        "budget": r"(No|Perhaps): .* tasks",
        "budget-figures": r"Left now: .+ second runs",
    }
    for question, text in said.items():
        expect(page.locator(f"#answer-{question}")).to_contain_text(re.compile(text))
    expect(page.locator("#decision-rows tr").first.locator("td.long")).not_to_be_empty()
    picture(page, "answer-predictions", "#answers", "#times")
    picture(page, "answer-budget", "#answers", "#history")


def test_the_page_finds_the_bottleneck(demo: Demo, look: Look) -> None:
    """A narrow link is named as the bottleneck; on a fast link, so are slow workers of the server."""
    with demo.second_robot() as address:
        page = look(address, viewport=NARROW).page
        part = page.locator("#answer-part")
        try:
            demo.bed.set_link(delay_ms=60.0)
            many = re.compile(r"The link: \d+ % of the time of \d{2,} answers")
            expect(part).to_contain_text(many, timeout=START_MS)
            picture(page, "answer-link", "#answers", "#parts")
            demo.bed.set_link(delay_ms=0.0)
            demo.bed.set_cpus("cloud", 0.1)
            expect(part).to_contain_text("The server: ", timeout=START_MS)
            picture(page, "answer-server", "#answers", "#parts")
        finally:
            demo.bed.set_link(delay_ms=5.0)
            demo.bed.set_cpus("cloud", 1.0)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_page_is_legible_on_a_phone(demo: Demo, look: Look, scheme: str) -> None:
    """At 360 px nothing is wider than the screen, letters are large, and contrasts are those of WCAG AA."""
    page = look(demo.robot_page, viewport=PHONE, color_scheme=scheme).page
    has_points(page, "times", TASKS_MIN)
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE["width"]
    assert page.evaluate(LEAST_LETTERS) >= LETTERS_PX
    ratio, element = page.evaluate(LEAST_CONTRAST)
    assert ratio >= CONTRAST, element
    dark = page.evaluate("getComputedStyle(document.body).backgroundColor.match(/\\d+/g).every(v => v < 64)")
    assert dark == (scheme == "dark")
    if scheme == "dark":
        picture(page, "live-phone-dark")


def test_the_page_is_used_by_keyboard(demo: Demo, look: Look) -> None:
    """Tab reaches each control in order; arrows move the slider into the past; Space follows again."""
    page = look(demo.robot_page, viewport=PHONE).page
    has_points(page, "times", TASKS_MIN)
    reached = []
    for _ in range(4):
        page.keyboard.press("Tab")
        reached.append(page.evaluate("document.activeElement.id || document.activeElement.className"))
    assert reached == ["group", "until", "follow", "scroll"]
    page.locator("#until").focus()
    for _ in range(5):
        page.keyboard.press("PageDown")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")
    page.keyboard.press("Tab")
    page.keyboard.press("Space")
    expect(page.locator("#follow")).to_have_attribute("aria-pressed", "true")


def test_the_page_of_a_server(demo: Demo, look: Look) -> None:
    """The token is entered once; then the page shows queue, workers and both robots, also after a reload."""
    with demo.second_robot():
        opened = look(f"{demo.server}/live", live=False, viewport=DESKTOP)
        page = opened.page
        enter_token(page)
        expect(page.locator("#state")).to_have_text("live", timeout=SOON_MS)
        loaded = re.compile(r"robot(-2)?: \d+ % of the time of the workers")
        expect(page.locator("#answer-load")).to_contain_text(loaded, timeout=3 * SOON_MS)
        expect(page.locator("#answer-part")).to_contain_text(
            re.compile(r"(Not t|T)he server: its workers were busy")
        )
        expect(page.locator("#robot-rows tr")).to_have_count(2, timeout=START_MS)
        page.wait_for_timeout(10_000)  # longer than a stream of looks: the counts go on in the next one
        assert int(page.locator("#robot-rows tr:first-child td:nth-child(3)").inner_text()) > LOOKS_A_STREAM
        picture(page, "live-server")
        picture(page, "answer-robots", "#answers", "#robots")
    page.reload(wait_until="domcontentloaded")
    expect(page.locator("#state")).to_have_text("live", timeout=SOON_MS)
    assert {address.partition("/live")[0] for address in opened.requests} == {demo.server}
    assert [one for one in opened.complaints if "401" not in one] == []


def test_the_page_says_how_many_requests_run_together(look: Look) -> None:
    """In the mean, and how long they were held for it; a server where none do says nothing of it."""
    with (
        cloud_server("tests.joint_tasks", CLOUD_WORKERS="1") as server,
        Offloader.connect(server.endpoint, policy="cloud") as offload,
    ):
        page = look(f"http://127.0.0.1:{server.http_port}/live", viewport=DESKTOP).page
        expect(page.locator("#figures")).to_contain_text("Workers replaced: 0", timeout=SOON_MS)
        expect(page.locator("#figures")).not_to_contain_text("Requests in a run")
        offload.wait_for_sites(joint_count, START_MS / 1000)
        calls = [offload.submit(joint_count, 1.0, where="cloud") for _ in range(4)]
        assert [one.result() for one in calls] == [4, 4, 4, 4]
        said = re.compile(r"Requests in a run: 4, held for [\d.]+ m?s, in the mean")
        expect(page.locator("#figures")).to_contain_text(said, timeout=SOON_MS)


def test_the_page_comes_back_after_the_server_was_killed(demo: Demo, look: Look) -> None:
    """It says that it has no connection, asks each second, and is live again with the new server."""
    page = look(f"{demo.server}/live", live=False).page
    enter_token(page)
    state = page.locator("#state")
    expect(state).to_have_text("live", timeout=SOON_MS)
    demo.bed.kill("cloud")
    try:
        expect(state).to_have_attribute("data-state", "lost", timeout=SOON_MS)
    finally:
        demo.bed.start("cloud")
    expect(state).to_have_text("live", timeout=SOON_MS)


def test_docs_work_offline_and_behind_the_token(demo: Demo, look: Look) -> None:
    """/docs lists every path and shows an answer, with nothing from another machine."""
    opened = look(f"{demo.server}/docs", live=False)
    page = opened.page
    enter_token(page)
    headings = page.locator("#paths h2")
    expect(headings.first).to_be_visible(timeout=SOON_MS)
    assert {"GET /health", "GET /config", "GET /tasks", "GET /metrics"} <= set(headings.all_inner_texts())
    box = page.locator("section", has_text="GET /tasks")
    box.get_by_role("button").press("Enter")
    expect(box.locator("pre")).to_contain_text("plan_path", timeout=SOON_MS)
    assert all(address.startswith(demo.server) for address in opened.requests)


def test_the_page_of_a_run_has_a_past(demo: Demo, look: Look) -> None:
    """With the slider at its start, the page shows the first tasks, and how the sites were then."""
    port = LivePort("127.0.0.1:0", "--port", source=RunLive(demo.bed.out))
    try:
        opened = look(f"{port.url}/live", viewport=DESKTOP)
        page = opened.page
        has_points(page, "history", TASKS_MIN)
        many = page.locator("#history .point").count()
        page.locator("#until").focus()
        page.keyboard.press("Home")
        page.keyboard.press("ArrowRight")
        page.wait_for_function(
            f"document.querySelectorAll('#history .point').length < {many}", timeout=SOON_MS
        )
        expect(page.locator("#follow")).to_have_attribute("aria-pressed", "false")
        assert opened.complaints == []
    finally:
        port.close()
