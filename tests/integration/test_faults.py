"""If the cloud or the link fails during a run, every task is answered in bounded time."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import CloudTimeout
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from tests.probes import echo, mark_once, nap, process_id, total, zeros

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

TIMEOUT_S = 0.5
ONBOARD_S = 0.02  # duration of the task
SLACK_S = 0.5  # for a busy machine with two cores

Beds = Callable[..., LocalTestbed]
Connect = Callable[..., Offloader]


class Stream:
    """A caller that asks for one task after the other, in a thread, and keeps the records."""

    def __init__(self, offload: Offloader) -> None:
        self.records: list[Record] = []
        self.wrong = 0  # answers
        self._offload = offload
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run)

    @contextmanager
    def running(self) -> Iterator["Stream"]:
        self._thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            self._thread.join(TIMEOUT_S + ONBOARD_S + 10 * SLACK_S)
            assert not self._thread.is_alive(), "a task hangs"

    def _run(self) -> None:
        while not self._stop.is_set():
            self.wrong += self._offload(nap, ONBOARD_S) != ONBOARD_S
            assert self._offload.last is not None
            self.records.append(self._offload.last)

    def wait_for(self, what: Callable[[Record], bool], timeout_s: float = 20.0) -> Record:
        """The first record from now on for which `what` is true."""
        seen, until = len(self.records), time.monotonic() + timeout_s
        while time.monotonic() < until:
            for record in self.records[seen:]:
                if what(record):
                    return record
            time.sleep(0.01)
        pytest.fail(f"not seen in {timeout_s} s; last: {self.records[-1:]}")

    def check(self) -> None:
        """Check that every answer was right, and came within timeout plus onboard time."""
        assert self.wrong == 0
        worst = max(record.waited_s for record in self.records)
        bound = TIMEOUT_S + ONBOARD_S + SLACK_S
        assert worst <= bound, f"waited {worst:.3f} s, at most {bound:.3f} s expected"


def in_the_cloud(record: Record) -> bool:
    return record.used == CLOUD


def onboard(record: Record) -> bool:
    return record.used == ONBOARD


def test_a_killed_server_costs_no_task_and_is_used_after_its_restart(testbed: Beds, connect: Connect) -> None:
    """The server is killed and restarted 5 s later: no task is lost or hangs, and blobs are sent again."""
    bed = testbed()
    offload = connect(bed, policy=CLOUD, timeout_s=TIMEOUT_S)
    numbers = np.arange(100_000, dtype=np.float64)
    numbers.flags.writeable = False
    assert offload(total, numbers) == numbers.sum()
    stream = Stream(offload)
    with stream.running():
        stream.wait_for(in_the_cloud)
        bed.kill("cloud")
        stream.wait_for(onboard)
        time.sleep(5)
        bed.start("cloud")
        stream.wait_for(in_the_cloud)
        assert offload(total, numbers) == numbers.sum()  # the new server asks for the blob
        assert offload.last is not None
    stream.check()
    offload(total, numbers)
    assert offload.last.used == CLOUD
    assert offload.last.executions[0].bytes_out < numbers.nbytes


def test_an_outage_costs_no_task_and_the_cloud_is_used_after_it(testbed: Beds, connect: Connect) -> None:
    """During two seconds of silence each task waits, then runs onboard. After it the cloud answers."""
    bed = testbed()
    offload = connect(bed, policy=CLOUD, timeout_s=TIMEOUT_S)
    stream = Stream(offload)
    with stream.running():
        stream.wait_for(in_the_cloud)
        bed.set_link(outage=True)
        late = stream.wait_for(onboard)
        time.sleep(2)
        bed.set_link(outage=False)
        stream.wait_for(in_the_cloud)
    stream.check()
    assert [type(one.failure).__name__ for one in late.executions] == ["CloudTimeout", "NoneType"]
    assert late.executions[0].censored


def test_the_published_rule_stays_onboard_after_an_outage(testbed: Beds, connect: Connect) -> None:
    """Algorithm 1 learns the lost times and never tries the cloud again; later policies do."""
    bed = testbed()
    offload = connect(bed, policy="paper", settings=Settings(window=5), timeout_s=TIMEOUT_S)
    for _ in range(10):
        offload(nap, ONBOARD_S)
    bed.set_link(outage=True)
    for _ in range(6):
        assert offload(nap, ONBOARD_S, where=CLOUD) == ONBOARD_S
    bed.set_link(outage=False)
    for _ in range(10):
        offload(nap, ONBOARD_S)
        assert offload.last is not None
        assert offload.last.decision.site == ONBOARD
        assert offload.last.sites[CLOUD].predicted_s == pytest.approx(TIMEOUT_S, abs=0.2)


def test_a_hanging_server_costs_no_task_and_is_used_again(testbed: Beds, connect: Connect) -> None:
    """A stopped server (SIGSTOP) accepts tasks and does not answer: each task ends after the timeout."""
    bed = testbed()
    stream = Stream(connect(bed, policy=CLOUD, timeout_s=TIMEOUT_S))
    with stream.running():
        stream.wait_for(in_the_cloud)
        bed.pause("cloud")
        stream.wait_for(onboard)
        bed.resume("cloud")
        stream.wait_for(in_the_cloud)
    stream.check()


def test_a_killed_relay_is_a_lost_connection(testbed: Beds, connect: Connect) -> None:
    """Without the relay tasks run onboard. With a new relay on the same port the cloud is used again."""
    bed = testbed()
    stream = Stream(connect(bed, policy=CLOUD, timeout_s=TIMEOUT_S))
    with stream.running():
        stream.wait_for(in_the_cloud)
        bed.kill("wan")
        record = stream.wait_for(lambda record: "not connected" in record.decision.reason or onboard(record))
        assert record.used == ONBOARD
        bed.start("wan")
        stream.wait_for(in_the_cloud)
    stream.check()


def test_a_robot_that_connects_before_the_server_is_warm_is_served_later(tmp_path: Path) -> None:
    """The server answers `hello` once every kind is warm. The robot repeats it until then."""
    cloud = {"cloud": Setup({"tasks": "tests.slow_probe,tests.probes"})}
    with LocalTestbed(tmp_path, cloud) as bed:
        bed.start("wan")
        bed.start_part(replace(bed.parts["cloud"], ready="/health"))
        with Offloader.connect(bed.endpoint, policy=CLOUD) as offload:
            assert offload.wait_for_sites(echo, 0.5).keys() == {CLOUD}
            assert offload.wait_for_sites(echo, 20.0) == {}
            offload(echo)
            assert offload.last is not None
            assert offload.last.used == CLOUD


def test_late_answers_are_dropped(testbed: Beds, connect: Connect) -> None:
    """An answer that comes after its task was given up is never taken for another task."""
    offload = connect(testbed(), policy=CLOUD, timeout_s=0.1)
    assert (
        offload(nap, 0.3) == 0.3
    )  # given up after 0.1 s and run onboard; the answer of the server comes later
    assert [offload(echo, n, timeout_s=2.0) for n in range(20)] == list(range(20))


def test_a_task_without_duplicates_runs_at_most_once(
    testbed: Beds, connect: Connect, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """With duplicate=False a dead link is an error for the caller, and each call has run at most once."""
    bed = testbed()
    offload = connect(bed, policy=CLOUD, timeout_s=TIMEOUT_S)
    mark = tmp_path_factory.mktemp("mark") / "once"
    offload(mark_once, str(mark))
    bed.pause("cloud")
    with pytest.raises(CloudTimeout):
        offload(mark_once, str(mark))
    bed.resume("cloud")
    offload(echo, timeout_s=5.0)
    assert len(mark.read_text().splitlines()) <= 2


def test_a_worker_that_dies_costs_no_answer(testbed: Beds, connect: Connect) -> None:
    """If a worker is killed, its task is answered onboard, and the server starts a new worker."""
    offload = connect(testbed({"executor": "processes"}), policy=CLOUD, timeout_s=10.0)
    worker = offload(process_id)
    threading.Timer(0.3, os.kill, (worker, signal.SIGKILL)).start()
    assert offload(nap, 1.0) == 1.0
    assert offload.last is not None
    assert [type(one.failure).__name__ for one in offload.last.executions] == ["CloudBroken", "NoneType"]
    until = time.monotonic() + 20
    while offload(process_id) in (worker, os.getpid()):
        assert time.monotonic() < until, "no new worker"
        time.sleep(0.1)


def test_a_value_too_large_for_the_server_stays_onboard(testbed: Beds, connect: Connect) -> None:
    """A task with a too large argument or result is answered onboard, and the connection stays up."""
    offload = connect(testbed({"message_mib": 1, "blob_mib": 8}), policy=CLOUD, timeout_s=5.0)
    assert len(offload(zeros, 3_000_000)) == 3_000_000
    assert offload(total, np.ones(500_000)) == 500_000
    assert offload.last is not None
    assert "takes messages of 1048576" in str(offload.last.executions[0].failure)
    assert offload.last.used == ONBOARD
    offload(echo)
    assert offload.last.used == CLOUD


def test_a_blob_that_many_tasks_need_is_uploaded_once(testbed: Beds, connect: Connect) -> None:
    """Eight simultaneous tasks with the same new array of 2 MB send it once."""
    offload = connect(testbed(delay_ms=20.0), policy=CLOUD, timeout_s=5.0, observers=[(sent := []).append])
    numbers = np.frombuffer(np.random.default_rng(1).bytes(2_000_000), np.uint64)  # cannot be compressed
    numbers.flags.writeable = False
    threads = [threading.Thread(target=offload, args=(total, numbers)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [record.used for record in sent] == [CLOUD] * 8
    assert numbers.nbytes < sum(record.executions[0].bytes_out for record in sent) < 1.1 * numbers.nbytes


def test_a_full_queue_is_answered_onboard(testbed: Beds, connect: Connect) -> None:
    """The server answers `busy` at once, so that the task does not wait for the timeout."""
    bed = testbed({"queue_max": 1})
    offload = connect(bed, policy=CLOUD, timeout_s=10.0)
    threads = [threading.Thread(target=offload, args=(nap, 1.0), kwargs={"where": CLOUD}) for _ in range(3)]
    for thread in threads:
        thread.start()
        time.sleep(0.1)
    assert offload(echo, 1) == 1
    assert offload.last is not None
    assert [type(one.failure).__name__ for one in offload.last.executions] == ["CloudBusy", "NoneType"]
    for thread in threads:
        thread.join()
