"""While a server fails in one way or another, a stream plays no stale action, and comes back after it."""

import os
import random
from collections.abc import Callable
from dataclasses import replace

import pytest

from offboard import Offloader
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.chunk_tasks import HORIZON, act
from tests.control_loop import HZ, Loop, fresh
from tests.integration.test_streams import POLICY

CHAOS = os.environ.get("CHAOS") == "1"
ROUNDS = 20 if CHAOS else 1
FROZEN_S = 10.0 if CHAOS else 3.0
BACK_S = 3.0  # after the server, the stream is back within this time
EMPTY = 0.1  # at most, of the steps without the server

pytestmark = [pytest.mark.integration, pytest.mark.timeout(1_200 if CHAOS else 120)]


def killed(bed: LocalTestbed, loop: Loop) -> None:
    bed.kill("cloud")
    loop.play(5.0, until=fresh(ONBOARD))
    without(loop, 2.0)
    bed.start_part(replace(bed.parts["cloud"], ready="/health"))


def frozen(bed: LocalTestbed, loop: Loop) -> None:
    bed.pause("cloud")
    loop.play(5.0, until=fresh(ONBOARD))
    without(loop, FROZEN_S)
    bed.resume("cloud")


def slow(_: LocalTestbed, loop: Loop) -> None:
    """Its chunks take longer than the horizon, so that all of them are lost."""
    loop.observation = {"cloud_s": 1.5 * HORIZON / HZ}
    loop.play(5.0, until=fresh(ONBOARD))
    without(loop, 3.0)
    loop.observation = {}


def out_of_order(_: LocalTestbed, loop: Loop) -> None:
    """Both sites take longer or shorter, so that answers to older observations come after newer ones."""
    draw = random.Random(1)
    for _ in range(10):
        loop.observation = {"cloud_s": draw.uniform(0.01, 0.6), "onboard_s": draw.uniform(0.01, 0.4)}
        loop.play(0.3)
    loop.observation = {}


def closed_in_the_middle(bed: LocalTestbed, loop: Loop) -> None:
    """The link is cut while answers are on their way."""
    bed.cut("cloud")
    loop.play(5.0, until=fresh(ONBOARD))
    without(loop, 2.0)
    bed.join("cloud")


def without(loop: Loop, seconds: float) -> None:
    played = loop.play(seconds)
    empty = sum(step.held for step in played)
    print(f"without the server: {empty} of {len(played)} steps empty")
    assert empty <= EMPTY * len(played)


@pytest.mark.parametrize("fault", [killed, frozen, slow, out_of_order, closed_in_the_middle])
def test_no_stale_action_is_played(
    testbed: Callable[..., LocalTestbed],
    connect: Callable[..., Offloader],
    fault: Callable[[LocalTestbed, Loop], None],
) -> None:
    """Onboard takes over, and BACK_S after the fault the actions are the server's again."""
    bed = testbed(POLICY)
    offload = connect(bed, settings=Settings(s_per_quality=1.0))
    assert offload.wait_for_sites(act, 10.0) == {}
    with offload.stream(act, hz=HZ, horizon=HORIZON, blend=0) as actions:
        loop = Loop(actions)
        loop.play(5.0, until=fresh(CLOUD))
        for _ in range(ROUNDS):
            loop.play(1.0)
            fault(bed, loop)
            back = loop.play(20.0, until=fresh(CLOUD))
            print(f"back after {len(back) / HZ:.2f} s; {actions.counts}")
            assert len(back) / HZ <= BACK_S
