"""A value that cannot cross between robot and server is answered onboard, whichever site was chosen."""

import logging
import re
import time
from collections.abc import Callable

import numpy as np
import pytest

from offboard.common.errors import CannotCross
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests.crossing_tasks import (
    TOO_LARGE,
    UNSENDABLE,
    crossing_echo,
    crossing_make,
    crossing_zeros,
    same,
)

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

TASKS = {"tasks": "tests.probes,tests.crossing_tasks"}
CALLS_MAX = 1000
PAUSE_S = 0.005  # between two of them

Beds = Callable[..., LocalTestbed]
Connect = Callable[..., Offloader]


def of_the_cloud(offload: Offloader) -> Execution:
    """What the cloud did for the last task, which onboard answered."""
    assert offload.last is not None
    assert offload.last.used == ONBOARD
    (execution,) = [one for one in offload.last.executions if one.site == CLOUD]
    assert isinstance(execution.failure, CannotCross), execution.error
    return execution


def used_for(offload: Offloader, function: Callable[[object], object], value: object) -> None:
    """The cloud answers the next call, with a value that can be sent."""
    assert offload(function, value) == 1
    assert offload.last is not None
    assert offload.last.used == CLOUD


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_every_value_that_cannot_be_sent_is_answered_onboard(
    testbed: Beds, connect: Connect, executor: str, caplog: pytest.LogCaptureFixture
) -> None:
    """As an argument or a result, and wherever the call is pinned to; the failure names the bad part."""
    offload = connect(testbed(TASKS | {"executor": executor}), policy=CLOUD)
    with caplog.at_level(logging.WARNING):
        for name, (make, said) in UNSENDABLE.items():
            value = make()
            for where in (None, CLOUD, BOTH):
                assert offload(crossing_echo, value, where=where) is value, name
                refused = of_the_cloud(offload)
                assert not refused.started
                assert said in str(refused.failure), name
                assert str(refused.failure).startswith("arguments"), name
                assert same(offload(crossing_make, name, where=where), value), name
                lost = of_the_cloud(offload)
                assert said in str(lost.failure), name
                assert str(lost.failure).startswith("result"), name
                used_for(offload, crossing_echo, 1)
                used_for(offload, crossing_make, "a number")
    texts = [one.getMessage() for one in caplog.records]
    assert [text.partition(":")[0] for text in texts] == ["crossing_echo"] * 2 + ["crossing_make"], texts
    values = [UNSENDABLE[name][0]() for name in UNSENDABLE]
    assert all(map(same, offload.map(crossing_echo, values), values))


@pytest.mark.parametrize("policy", ["paper", "default", CLOUD])
@pytest.mark.parametrize(("function", "value"), [(crossing_echo, {1}), (crossing_make, "a set")])
def test_a_kind_whose_values_never_cross_stays_onboard(
    testbed: Beds, connect: Connect, policy: str, function: Callable[[object], object], value: object
) -> None:
    """After three calls in vain, the cloud is left out for a while: no call waits for it.

    The default sends no call there while another one is under way.
    """
    records: list[Record] = []
    offload = connect(testbed(TASKS), policy=policy, observers=[records.append])
    told = "could not be sent, or their answers not be read; next try in "
    while len(records) < CALLS_MAX and (not records or told not in records[-1].decision.reason):
        assert same(offload(function, value), function(value))
        time.sleep(PAUSE_S)
    asked = [len(record.executions) == 2 for record in records]
    print(asked)
    assert sum(asked) == 3
    assert not asked[-1]
    assert told in records[-1].decision.reason


def test_what_is_larger_than_a_message_is_answered_onboard(testbed: Beds, connect: Connect) -> None:
    """Both sizes are in the failure, and the next task of this kind runs in the cloud."""
    offload = connect(testbed(TASKS | {"message_mib": 1, "blob_mib": 1}), policy=CLOUD)
    for _ in range(2):
        assert offload(crossing_zeros, TOO_LARGE).size == TOO_LARGE
        assert re.search(r"result takes 20971\d\d bytes, at most 1048576", str(of_the_cloud(offload).failure))
        array = np.zeros(TOO_LARGE, np.uint8)
        assert offload(crossing_echo, array) is array
        refused = of_the_cloud(offload)
        assert str(refused.failure) == (
            f"arguments of {TOO_LARGE} bytes; the server takes messages of 1048576"
        )
        assert not refused.started
        for one in (offload(crossing_zeros, 5), offload(crossing_echo, np.zeros(5))):
            assert one.size == 5
            assert offload.last is not None
            assert offload.last.used == CLOUD
