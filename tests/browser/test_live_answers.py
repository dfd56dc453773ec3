"""What the page /live answers to its questions, in a real browser, for tasks whose true answer is known."""

import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from datetime import timedelta

import pytest
from playwright.sync_api import Browser, Page, expect

from offboard.common.live.live_port import LivePort
from offboard.common.live.look import Look
from offboard.robot_client.learning.regret import Regret
from offboard.robot_client.policies import Decision, Hedge, Outlook
from offboard.robot_client.records.record import Record, as_dict
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Condition, Execution
from tests.browser.conftest import Opened
from tests.unit.test_trace import record

pytestmark = pytest.mark.browser

SOON_MS = 30_000
TASKS = 60
POLICY = "default"

Ask = Callable[..., Page]


class Told:
    """A source that tells the same tasks once, and then how things are."""

    def __init__(self, tasks: list[Record], budget: dict[str, float] | None) -> None:
        self._tasks, self._budget = tasks, budget

    def looks(self) -> Generator[Look]:
        tasks = [as_dict(task) for task in self._tasks]
        while True:
            yield Look("robot", self._tasks[-1].started_at.timestamp(), tasks, budget=self._budget)
            tasks = []


@pytest.fixture
def ask(browser: Browser) -> Iterator[Ask]:
    """Factory: a page that shows these tasks, in a browser of New York."""
    opened = []

    def factory(tasks: list[Record], budget: dict[str, float] | None = None) -> Page:
        port = LivePort("127.0.0.1:0", "--port", source=Told(tasks, budget))
        context = browser.new_context(timezone_id="America/New_York")
        opened.extend([context.close, port.close])
        one = Opened(context.new_page())
        one.page.on("requestfailed", lambda failed: one.complaints.append(f"{failed.url}: {failed.failure}"))
        one.page.goto(f"{port.url}/live", wait_until="domcontentloaded")
        try:
            expect(one.page.locator("#answer-why")).not_to_be_empty(timeout=SOON_MS)
        except AssertionError as error:
            raise AssertionError(f"the page shows nothing: {one.complaints}, {one.requests}") from error
        return one.page

    yield factory
    for close in opened:
        close()


def outlook(predicted_s: float, *, silent: bool = False) -> Outlook:
    band = {"low_s": 0.8 * predicted_s, "high_s": 1.2 * predicted_s}
    return Outlook(predicted_s=predicted_s, condition=Condition(0.01, silent=silent), **band)


def task(
    i: int,
    *,
    site: str = CLOUD,
    cloud: Outlook | None = None,
    parts: tuple[float, float, float] = (0.02, 0.0, 0.01),
    planned: bool = True,
    regret: Regret | None = None,
) -> Record:
    """A task of a second after the one before; `parts`: the seconds of link, queue and run of its answer."""
    sites = {ONBOARD: outlook(0.1)} | ({} if cloud is None else {CLOUD: cloud})
    seconds, (link, queue, run) = sum(parts), parts
    other = ONBOARD if site == CLOUD else CLOUD
    return replace(
        record(i),
        started_at=record().started_at + timedelta(seconds=i),
        sites=sites,
        decision=Decision(
            site, "the words of the policy", POLICY, second=Hedge(other, 1.0) if planned else None
        ),
        executions=(Execution(site, seconds, queue_s=queue, run_s=run, network_s=link),),
        used=site,
        waited_s=seconds,
        regret=regret,
    )


def tasks(**about: object) -> list[Record]:
    given = {"cloud": outlook(0.03), **about}
    return [task(i, **given) for i in range(TASKS)]  # type: ignore[arg-type]


def says(page: Page, question: str, text: str) -> None:
    expect(page.locator(f"#answer-{question}")).to_contain_text(text, timeout=SOON_MS)


def test_why_there_compares_the_predictions(ask: Ask) -> None:
    """Where both sites could take the task, both predictions are named, and the words of the policy."""
    page = ask(tasks())
    says(page, "why", "Cloud: it should take 30 ms there, and 100 ms on onboard.")
    says(page, "why-figures", "the words of the policy")


def test_why_onboard_names_the_silent_cloud(ask: Ask) -> None:
    """During an outage the answer is that the cloud is silent, and for how long."""
    silent = [task(TASKS + i, site=ONBOARD, cloud=outlook(0.03, silent=True)) for i in range(5)]
    page = ask(tasks() + silent)
    says(page, "why", "Onboard: cloud does not answer heartbeats, for 4 s so far.")
    expect(page.locator("#history .shapelayer path").first).to_be_visible(timeout=SOON_MS)
    until_s, plot, span = time.monotonic() + SOON_MS / 1000, None, None
    while (
        plot is None or span is None
    ) and time.monotonic() < until_s:  # a chart may be drawn again just now
        plot, span = (
            page.locator(f"#history {part}").bounding_box() for part in (".plot", ".shapelayer path")
        )
    assert plot is not None
    assert span is not None, "the outage is a red span"
    assert plot["x"] < span["x"] < span["x"] + span["width"] < plot["x"] + plot["width"]


def test_why_onboard_names_the_absent_cloud(ask: Ask) -> None:
    """A cloud that cannot take the task is named, too."""
    absent = [task(TASKS + i, site=ONBOARD) for i in range(3)]
    says(ask(tasks() + absent), "why", "Onboard: cloud cannot take this task, for 2 s so far.")


@pytest.mark.parametrize(
    ("parts", "answer"),
    [
        ((0.06, 0.01, 0.03), "The link: 60 %"),
        ((0.01, 0.06, 0.03), "The server: tasks wait in its queue for 60 %"),
        ((0.01, 0.03, 0.06), "The server: its workers take 60 %"),
    ],
)
def test_the_longest_part_is_the_bottleneck(ask: Ask, parts: tuple[float, float, float], answer: str) -> None:
    """Link, queue or workers: where answers of the server lost most of their time."""
    says(ask(tasks(parts=parts)), "part", answer)


def test_without_a_remote_answer_the_bottleneck_is_unknown(ask: Ask) -> None:
    """Tasks that all ran onboard say nothing about link and server."""
    says(ask(tasks(site=ONBOARD)), "part", "Unknown: no server answered.")


@pytest.mark.parametrize(
    ("seconds", "verdict"), [(0.03, "Yes, and more careful"), (0.06, "No, too sure of themselves: 0 % of 60")]
)
def test_predictions_are_judged_by_their_bands(ask: Ask, seconds: float, verdict: str) -> None:
    """All answers inside is more than the 90 % that a band promises; none is far less."""
    page = ask(tasks(parts=(seconds, 0.0, 0.0)))
    says(page, "predictions", verdict)
    says(page, "predictions-figures", "cloud: ")


def test_more_budget_helps_only_if_it_was_used_up(ask: Ask) -> None:
    """If each task could have a second run, no; if some could not, perhaps, and at most by the regret."""
    says(ask(tasks(), {"duplicates": 6.0}), "budget", "No: a second run was allowed for each of 60 tasks")
    some = [
        task(i, cloud=outlook(0.03), planned=i % 2 == 0, regret=Regret(0.004, 0.001, 0.007, 9))
        for i in range(TASKS)
    ]
    page = ask(some, {"duplicates": 0.5})
    says(page, "budget", "Perhaps: 50 % of 60 tasks could not have a second run.")
    says(page, "budget-figures", "each would be 4.00 ms faster (90 %: 1.00 ms to 7.00 ms)")


def test_a_policy_without_second_runs_needs_no_budget(ask: Ask) -> None:
    """The published rule never starts a second run."""
    paper = task(0).decision._replace(policy="paper", second=None)
    asked = [replace(one, decision=paper) for one in tasks()]
    says(ask(asked), "budget", "No: the policy paper plans no second runs.")


def test_one_place_alone_is_compared_by_the_predictions(ask: Ask) -> None:
    """The constants cost what the robot predicted. If only one site has predictions, nothing is compared."""
    page = ask(tasks())
    says(page, "place", "Always cloud: 1.00 times as long. Always onboard: 3.33 times as long.")
    says(page, "place-figures", "onboard 100 ms in place of 30 ms (60 tasks)")
    says(ask(tasks(site=ONBOARD, cloud=None)), "place", "Unknown: only one site has predictions.")


def test_the_charts_show_the_time_of_the_reader(ask: Ask) -> None:
    """In New York a task of 03:04 UTC is shown at 22:04, in the charts as in the table."""
    page = ask(tasks())
    expect(page.locator("#decision-rows tr").first.locator("td").first).to_have_text("22:05:04")
    labels = page.locator("#history .xtick text").all_text_contents()
    assert labels
    assert all(label.startswith("22:0") for label in labels), labels


def test_axes_of_time_move_in_steps(ask: Ask) -> None:
    """A quarter of an hour of looks needs few axes: plotly remembers each label at each of its places."""
    page = ask([record()])
    axes = page.evaluate(
        """async () => {
          const { timeAxis } = await import("/live/charts.js"), now = Date.parse("2026-11-26T12:00:00Z");
          const looks = [...Array(900).keys()].map(i => now + 1000 * i);
          return looks.map(to => timeAxis([to - 900000, to - 1000, to]).range.concat(to));
        }"""
    )
    assert all(first <= to - 900_000 and to <= last for first, last, to in axes)
    assert len({first for first, _, _ in axes}) <= 900 / 16
    assert page.evaluate("""async () => (await import("/live/charts.js")).timeAxis([])""") == {"type": "date"}
