"""A real browser, and the reports that it opens."""

import os
from collections.abc import Callable, Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

from offboard.loadgen.report.report import ReportConfig, run_report
from tests.browser import chromium
from tests.table_loops import THOUSAND, csv_of
from tests.unit.test_replay import trace_of


class Opened:
    """An open page, with all of its requests, errors and warnings."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.requests: list[str] = []
        self.complaints: list[str] = []
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("console", self._console)
        page.on("pageerror", lambda error: self.complaints.append(str(error)))

    def _console(self, message: ConsoleMessage) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(message.text)


@pytest.fixture(scope="session")
def chromium_path() -> str:
    """The path of Chromium; without it the test is skipped, and in CI it fails."""
    path = chromium.find()
    if path is None and os.environ.get("CI") == "true":
        pytest.fail(f"CI has no Chromium: none of {', '.join(chromium.NAMES)}")
    if path is None:
        pytest.skip(f"no Chromium: none of {', '.join(chromium.NAMES)}")
    return path


# Not for the session: Playwright keeps an event loop running, which disturbs asyncio in other tests.
@pytest.fixture(scope="module")
def browser(chromium_path: str) -> Iterator[Browser]:
    with sync_playwright() as playwright:
        started = chromium.launch(playwright, chromium_path)
        yield started
        started.close()


@pytest.fixture
def opened(browser: Browser) -> Iterator[Callable[..., Opened]]:
    """Factory: opens an address in a new context, with the options of Playwright's `new_context`."""
    made = []

    def factory(address: str, **options: Any) -> Opened:
        made.append(browser.new_context(**options))
        one = Opened(made[-1].new_page())
        one.page.goto(address)
        one.page.wait_for_load_state("networkidle")
        return one

    yield factory
    for context in made:
        context.close()


@pytest.fixture(scope="module")
def dataset_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report on a CSV file of 300 rows, with one more predictor."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "rows.csv").write_text(csv_of(THOUSAND[:300]))
    run_report(folder / "rows.csv", ReportConfig(out=folder, predictors=("parts",)))
    return folder / "report.html"


@pytest.fixture(scope="module")
def run_folder_report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The report on a run: 60 tasks measured on both sites, then 40 decided live."""
    folder = tmp_path_factory.mktemp("run")
    both = [
        ("pinned", "onboard", {"onboard": t_onboard, "cloud": t_cloud}, 0.5)
        for _, t_onboard, t_cloud in THOUSAND[:60]
    ]
    sites = ["onboard", "cloud", "cloud", "onboard"] * 10
    decided = [("paper", site, {site: 0.1 + 0.001 * i}, 0.11 + 0.001 * i) for i, site in enumerate(sites)]
    trace_of(folder, *both, *decided)
    run_report(folder, ReportConfig(window=20))
    return folder / "report.html"


@pytest.fixture
def served(dataset_report: Path) -> Iterator[tuple[str, list[str]]]:
    """The address of the report on loopback, and the paths that were requested from the server."""
    asked: list[str] = []

    class Handler(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:  # noqa: ARG002 - the base class calls it so
            asked.append(self.path)

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(dataset_report.parent)))
    thread = Thread(target=server.serve_forever)
    thread.start()
    yield f"http://127.0.0.1:{server.server_address[1]}/{dataset_report.name}", asked
    server.shutdown()
    thread.join()
    server.server_close()
