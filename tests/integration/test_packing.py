"""Arguments are packed on their way to a server only, or compressed where the link is slow."""

import json
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.common.errors import CannotCross, CloudTimeout
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import BOTH
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Execution
from tests import packing_tasks

pytestmark = pytest.mark.integration

TASKS = {"tasks": "tests.probes,tests.packing_tasks"}
SLOW = {"bandwidth_mbps": 20.0, "delay_ms": 5.0}
PIXELS = 300_000
CALLS = 10

Beds = Callable[..., LocalTestbed]
Connect = Callable[..., Offloader]


def execution(offload: Offloader, site: str = CLOUD) -> Execution:
    assert offload.last is not None
    (found,) = [one for one in offload.last.executions if one.site == site]
    return found


def noisy(rng: np.random.Generator, values: int) -> Any:
    """An image of noise that has this many values."""
    return rng.integers(0, values, PIXELS, dtype=np.uint8)


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_onboard_gets_the_original_and_the_server_what_was_unpacked(
    testbed: Beds, connect: Connect, executor: str
) -> None:
    """The robot packs for the server alone, and half as many bytes cross the link."""
    offload, array = connect(testbed(TASKS | {"executor": executor})), np.linspace(0.0, 1.0, 5000)
    packing_tasks.packed.clear()
    assert offload(packing_tasks.half, array, where=ONBOARD) == [array.sum(), "float64", os.getpid()]
    assert packing_tasks.packed == []
    total, dtype, process = offload(packing_tasks.half, array, where=CLOUD)
    assert packing_tasks.packed == [5000]
    assert total == pytest.approx(array.sum(), rel=1e-3)
    assert (dtype, process != os.getpid()) == ("float64", True)
    ((argument, how, raw_bytes, count, seconds),) = execution(offload).packed
    assert (argument, how, raw_bytes, count) == (None, "pack", 40_000, 10_000)
    assert 0.0 < seconds < execution(offload).seconds
    assert 10_000 < execution(offload).bytes_out < 11_000
    assert offload(packing_tasks.two, "a", where=CLOUD)[:2] == ["a", 5]
    assert [one[:2] for one in offload.map(packing_tasks.two, [(1, 2), (3, 4)])] == [[1, 2], [3, 4]]


def test_a_task_on_two_servers_is_packed_once(testbed: Beds) -> None:
    """The second server gets the same bytes, and its packing takes no time."""
    bed = testbed(TASKS)
    with Offloader.connect(bed.endpoint, sites={"edge": bed.endpoint}) as offload:
        assert offload.wait_for_sites(packing_tasks.half, 10.0) == {}
        packing_tasks.packed.clear()
        offload(packing_tasks.half, np.ones(5000), where=BOTH)
        seconds = [execution(offload, site).pack_s for site in (CLOUD, "edge")]
    assert packing_tasks.packed == [5000]
    assert sorted(one > 0.0 for one in seconds) == [False, True]


@pytest.mark.parametrize("executor", ["threads", "processes"])
@pytest.mark.parametrize(
    ("function", "said"),
    [
        (packing_tasks.unreadable, "unpack of task packing_unreadable: ValueError: no picture: 7"),
        (packing_tasks.raises, "pack of task packing_raises: ValueError: no picture: 7"),
    ],
)
def test_packing_that_raises_is_answered_onboard(
    testbed: Beds,
    connect: Connect,
    executor: str,
    function: Callable[[Any], list[Any]],
    said: str,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """No call is lost, also of a task that never runs twice, and the log says why, once."""
    offload = connect(testbed(TASKS | {"executor": executor}), policy=CLOUD)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            assert offload(function, 7) == [7, os.getpid()]
            failed = execution(offload)
            assert isinstance(failed.failure, CannotCross)
            assert (str(failed.failure).removeprefix("ProtocolError: "), failed.started) == (said, False)
    assert len([one for one in caplog.records if said in one.getMessage()]) == 1


def test_packing_that_takes_longer_than_the_timeout_is_answered_onboard(
    testbed: Beds, connect: Connect
) -> None:
    """Nothing was sent, so this also holds for a task that never runs twice."""
    offload = connect(testbed(TASKS))
    assert offload(packing_tasks.slow, 7, where=CLOUD, timeout_s=packing_tasks.PACK_S / 2) == [7, os.getpid()]
    late = execution(offload)
    assert isinstance(late.failure, CloudTimeout)
    assert (late.started, late.bytes_out) == (False, 0)
    assert late.seconds >= packing_tasks.PACK_S


def test_arguments_are_compressed_on_a_slow_link_if_they_shrink(
    testbed: Beds, connect: Connect, tmp_path: Path
) -> None:
    """Images that shrink always are, noise that does not is tried once; the trace has choice and bytes."""
    trace, rng = tmp_path / "trace.jsonl", np.random.default_rng(1)
    offload = connect(testbed(TASKS, **SLOW), trace=trace)
    for function, values in ((packing_tasks.image, 4), (packing_tasks.noise, 256)):
        for _ in range(CALLS):
            one = noisy(rng, values)
            assert offload(function, one, where=CLOUD) == one.sum(dtype=np.int64)
    offload.close()
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    runs = [line["executions"][0] for line in lines]
    shrunk, noise = runs[:CALLS], runs[CALLS:]
    for run in shrunk:
        ((packed),) = run["packed"]
        assert (packed["argument"], packed["how"], packed["raw_bytes"]) == (0, "zstd", PIXELS)
        assert packed["bytes"] < run["bytes_out"] < PIXELS / 2
        assert 0.0 < packed["seconds"] < run["seconds"]
    plans = [line["sites"]["cloud"]["packing"] for line in lines]
    assert plans[0] == {"compress": [0], "raw_bytes": PIXELS, "bytes": PIXELS, "seconds": 0.0}
    assert plans[2]["bytes"] == pytest.approx(shrunk[2]["bytes_out"], rel=0.1)
    assert [bool(run["packed"]) for run in noise] == [True] + [False] * (CALLS - 1)


@pytest.mark.parametrize("policy", ["default", CLOUD])
def test_the_constant_cloud_compresses_as_the_default_does(
    testbed: Beds, connect: Connect, policy: str
) -> None:
    """So a comparison of the two is one of sites, and not of bytes."""
    offload, rng = connect(testbed(TASKS, **SLOW), policy=policy), np.random.default_rng(1)
    for _ in range(CALLS):
        one = noisy(rng, 4)
        assert offload(packing_tasks.image, one, where=None if policy == CLOUD else CLOUD) == one.sum()
        assert execution(offload).bytes_out < PIXELS / 2


def test_nothing_is_compressed_if_the_settings_say_so(testbed: Beds) -> None:
    """Also on a slow link."""
    with Offloader.connect(testbed(TASKS, **SLOW).endpoint, settings=Settings(compress=False)) as offload:
        assert offload.wait_for_sites(packing_tasks.image, 10.0) == {}
        offload(packing_tasks.image, np.zeros(PIXELS, np.uint8), where=CLOUD)
        assert execution(offload).packed == ()
        assert execution(offload).bytes_out > PIXELS
