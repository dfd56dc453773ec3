"""Every value of the documented types, sent through onboard and a real server, keeps type and value."""

import asyncio
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, note, settings
from hypothesis import strategies as st

from offboard import Offloader
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.crossing_values import as_sent, foreign, odd, values
from tests.curves import Served
from tests.value_tasks import FOREIGN, Point, described, made, seen

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

BUDGET_S = 30.0  # of a call: a slow machine must not bring it onboard
MIB = 1 << 20
LEVELS = 32
DATACLASSES = 10  # one in the other: each takes three levels

many = settings(max_examples=200, suppress_health_check=list(HealthCheck))
few = settings(many, max_examples=40)
wheres = st.sampled_from([CLOUD, CLOUD, ONBOARD, "both", None])


@pytest.fixture(scope="module", params=["threads", "processes"])
def served(request: pytest.FixtureRequest) -> Iterator[Served]:
    """A server of each executor."""
    flags = ["--tasks", "tests.value_tasks", "--executor", request.param, "--robot-mib-s", "1024"]
    started = Served(*flags)
    yield started
    died = started.process.poll()
    started.close()
    assert died is None


@pytest.fixture
def offload(served: Served) -> Iterator[Offloader]:
    with Offloader.connect(served.endpoint, timeout_s=BUDGET_S) as offload:
        assert offload.wait_for_sites(seen, 20.0) == {}
        yield offload


def used(offload: Offloader, answer: list[Any], value: Any) -> str:
    """The site that answered `seen`, whose answer must be right for that site."""
    assert offload.last is not None
    site = offload.last.used
    assert site is not None
    arrived = as_sent(value) if site == CLOUD else value
    words, returned = answer
    assert words == described(arrived), "the argument"
    assert described(returned) == described(arrived), "the result"
    assert site == CLOUD or returned is value
    return site


def once(offload: Offloader, value: Any, where: str | None) -> list[Any]:
    return offload(seen, value, where=where)


def in_a_batch(offload: Offloader, value: Any, where: str | None) -> list[Any]:
    return offload.map(seen, [value], where=where)[0]


def from_asyncio(offload: Offloader, value: Any, where: str | None) -> list[Any]:
    return asyncio.run(offload.run(seen, value, where=where))


ways = st.sampled_from([once, once, once, in_a_batch, from_asyncio])
Way = Callable[[Offloader, Any, str | None], list[Any]]


@many
@given(value=values, where=wheres, way=ways)
def test_a_value_of_the_documented_types_is_the_same_on_each_site(
    offload: Offloader, value: Any, where: str | None, way: Way
) -> None:
    """The task gets it and returns it with its type, order and bits, and a call to the cloud runs there."""
    note(f"{way.__name__}, where={where}: {described(value)}")
    site = used(offload, way(offload, value, where), value)
    assert where not in (CLOUD, ONBOARD) or site == where


@few
@given(value=odd, where=wheres, way=ways)
def test_a_dataclass_that_its_constructor_does_not_describe_is_the_same(
    offload: Offloader, value: Any, where: str | None, way: Way
) -> None:
    """No field, no attribute and no `__post_init__` makes a difference between the sites."""
    whole = [value]
    note(f"{way.__name__}, where={where}: {described(whole)}")
    used(offload, way(offload, whole, where), whole)


@few
@given(before=st.lists(values, max_size=2), value=foreign, where=wheres, way=ways)
def test_a_value_that_cannot_be_sent_is_answered_onboard(
    offload: Offloader,
    before: list[Any],
    value: Any,
    where: str | None,
    way: Way,
) -> None:
    """It raises nothing, wherever the call was meant to run and wherever in the arguments it is."""
    whole = [*before, {"a": value}]
    note(f"{way.__name__}, where={where}: {described(whole)}")
    assert used(offload, way(offload, whole, where), whole) == ONBOARD


@pytest.mark.parametrize("name", FOREIGN)
def test_each_value_that_cannot_be_sent_is_answered_onboard(offload: Offloader, name: str) -> None:
    """As an argument, and as a result that the server cannot send."""
    for where in (CLOUD, "both", None):
        value = FOREIGN[name]()
        assert used(offload, offload(seen, value, where=where), value) == ONBOARD
        assert described(offload(made, name, where=where)) == described([FOREIGN[name]()])
        assert offload.last is not None
        assert offload.last.used == ONBOARD


def nested(levels: int, make: Callable[[Any], Any]) -> Any:
    value: Any = b""
    for _ in range(levels):
        value = make(value)
    return value


def blobs(count: int) -> list[Any]:
    return [np.full(MIB // 8, number, np.uint8) for number in range(count)]


@pytest.mark.parametrize(
    ("value", "site"),
    [
        pytest.param([np.zeros(1)] * 1000, CLOUD, id="1000 arrays"),
        pytest.param([np.zeros(1)] * 1001, ONBOARD, id="1001 arrays"),
        pytest.param(nested(LEVELS, lambda one: [one]), CLOUD, id="32 levels"),
        pytest.param(nested(LEVELS + 1, lambda one: [one]), ONBOARD, id="33 levels"),
        pytest.param(nested(DATACLASSES, Point), CLOUD, id="nested dataclasses"),
        pytest.param(nested(LEVELS, Point), ONBOARD, id="too many nested dataclasses"),
        pytest.param(nested(5000, lambda one: [one]), ONBOARD, id="5000 levels"),
        pytest.param(blobs(64), CLOUD, id="64 blobs"),
        pytest.param(blobs(65), ONBOARD, id="65 blobs"),
        pytest.param([b"x" * MIB] * 70, ONBOARD, id="one blob 70 times"),
        pytest.param("x" * (15 * MIB), CLOUD, id="15 MiB of text"),
        pytest.param("x" * (17 * MIB), ONBOARD, id="17 MiB of text"),
        pytest.param(b"x" * (15 * MIB), CLOUD, id="15 MiB of bytes"),
        pytest.param(b"x" * (17 * MIB), ONBOARD, id="17 MiB of bytes"),
        pytest.param(np.zeros(60 * MIB, np.uint8), CLOUD, id="array of 60 MiB"),
        pytest.param(np.zeros(70 * MIB, np.uint8), ONBOARD, id="array of 70 MiB"),
        pytest.param([np.zeros(40 * MIB, np.uint8), np.ones(40 * MIB, np.uint8)], ONBOARD, id="2 x 40 MiB"),
        pytest.param(list(range(2**16)), CLOUD, id="many numbers"),
        pytest.param(dict.fromkeys(range(2**16)), CLOUD, id="many keys"),
    ],
)
def test_a_value_beyond_a_limit_is_answered_onboard(offload: Offloader, value: Any, site: str) -> None:
    """Up to the limits the cloud answers; beyond them onboard does, with the same answer."""
    assert used(offload, offload(seen, value, where=CLOUD), value) == site
    assert used(offload, offload(seen, value), value) in (ONBOARD, site)
