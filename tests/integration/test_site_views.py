"""What `offload.sites` says of a real server: where it is, what is under way there, and what happened."""

import time
from collections.abc import Callable

import pytest

from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.conversation import STORY_MAX
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.probes import echo, nap

pytestmark = pytest.mark.integration

WAIT_S = 10.0


def test_a_task_under_way_is_seen(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """Its site counts it while it runs, and the story tells how it was sent and answered."""
    bed = testbed()
    offload = connect(bed)
    napping = offload.submit(nap, 0.5, where=CLOUD)
    end_s = time.monotonic() + WAIT_S
    while not offload.sites[CLOUD].in_flight:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    assert repr(offload).startswith("<Offloader ")
    assert f"cloud: connected to {bed.endpoint}, 1 in flight" in repr(offload)
    assert "onboard: 0 in flight" in repr(offload)
    napping.result(WAIT_S)
    view = offload.sites[CLOUD]
    assert (view.endpoint, view.connected, view.why_absent, view.in_flight) == (bed.endpoint, True, None, 0)
    told = [one.what for one in view.story if one.what not in ("ping", "pong")]
    assert told == ["up", "submit", "send", "answer"]
    assert len({one.id for one in view.story if one.what in ("submit", "send", "answer")}) == 1
    assert offload.sites[ONBOARD].story == ()


def test_a_server_that_dies_is_seen(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """It is not connected any more, and the story ends with that; it stays short."""
    bed = testbed()
    offload = connect(bed)
    for number in range(STORY_MAX):
        assert offload(echo, number, where=CLOUD) == number
    assert len(offload.sites[CLOUD].story) == STORY_MAX
    bed.kill("cloud")
    end_s = time.monotonic() + WAIT_S
    while offload.sites[CLOUD].connected:
        assert time.monotonic() < end_s
        time.sleep(0.01)
    view = offload.sites[CLOUD]
    assert view.why_absent is not None
    assert f"cloud: {view.why_absent}, 0 in flight" in repr(offload)
    assert [one.what for one in view.story][-1] == "down"


def test_sites_are_read_only() -> None:
    """A program cannot change what it is shown."""
    with Offloader.connect() as offload:
        with pytest.raises(TypeError):
            offload.sites[CLOUD] = offload.sites[ONBOARD]  # type: ignore[index]
        with pytest.raises(AttributeError):
            offload.sites[ONBOARD].connected = False  # type: ignore[misc]
        assert list(offload.sites) == [ONBOARD]
