"""When a robot sends a large argument with its request, and when it first asks whether the server has it."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Thread
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors.thread_executor import ThreadExecutor
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Limits, Server
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.sites.outgoing import INLINE_BYTES_MAX, INLINE_SHARE, NEW_AFTER
from offboard.robot_client.sites.runner import Execution

pytestmark = pytest.mark.integration

WAIT_S = 8.0
NUMBERS = 50_000
MESSAGE_BYTES_MAX = 2**24


@task("both_sums", size=lambda *arrays: len(arrays))
def both_sums(*arrays: Any) -> list[float]:
    return [float(array.sum()) for array in arrays]


class Served:
    """A server in this process, and how often it asked for a blob."""

    def __init__(self) -> None:
        self.metrics = Metrics()
        limits = Limits(
            queue_max=8,
            blob_bytes_max=2**24,
            message_bytes_max=MESSAGE_BYTES_MAX,
            robot_bytes_per_s=2**30,
            drain_s=1.0,
        )
        self.server = Server("tcp://127.0.0.1:0", ThreadExecutor(1), self.metrics, limits)

    @property
    def asked(self) -> int:
        labels = {"kind": "both_sums", "status": "need_blob"}
        return int(self.metrics.registry.get_sample_value("offboard_server_requests_total", labels) or 0)

    @property
    def kept_bytes(self) -> float:
        return self.metrics.registry.get_sample_value("offboard_server_blob_bytes") or 0.0


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    thread = Thread(target=served.server.run)
    thread.start()
    yield served
    served.server.drain()
    thread.join(WAIT_S)


@contextmanager
def joined(served: Served, *, compress: bool = True) -> Iterator[CloudRunner]:
    with closing(CloudRunner(served.server.endpoint, compress=compress)) as runner:
        until = time.monotonic() + WAIT_S
        while runner.unavailable(kind_of(both_sums)) and time.monotonic() < until:
            time.sleep(0.01)
        yield runner


def run(runner: CloudRunner, *arrays: np.ndarray[Any, Any], compress: tuple[int, ...] = ()) -> Execution:
    one = Task(kind_of(both_sums), arrays, 0.0, compress=compress)
    execution = runner.submit(one, WAIT_S).result()
    assert execution.value == [array.sum() for array in arrays]
    return execution


def new(n: int) -> np.ndarray[Any, Any]:
    return np.full(NUMBERS, float(n))


def test_arguments_that_always_change_are_sent_at_once(served: Served) -> None:
    """After NEW_AFTER tasks with unknown blobs, the robot sends arguments at once; they are not stored."""
    with joined(served) as runner:
        for n in range(NEW_AFTER + 3):
            run(runner, new(n))
    assert served.asked == NEW_AFTER
    assert served.kept_bytes == NEW_AFTER * new(0).nbytes


def test_an_argument_that_comes_again_is_stored(served: Served) -> None:
    """The second time it is uploaded unasked; from the third time on only its name is sent."""
    with joined(served) as runner:
        sent = [run(runner, new(n)).bytes_out for n in (*range(NEW_AFTER + 1), NEW_AFTER, NEW_AFTER)]
    assert served.asked == NEW_AFTER
    assert sent[-2] > new(0).nbytes
    assert sent[-1] < 1000


def test_a_request_carries_no_more_than_fits(served: Served) -> None:
    """The other arguments of the task are blobs in messages of their own."""
    most = int(INLINE_SHARE * MESSAGE_BYTES_MAX)
    assert most <= INLINE_BYTES_MAX
    with joined(served) as runner:
        for n in range(NEW_AFTER):
            run(runner, new(n))
        run(runner, *(np.full(most // 2 // 8, float(n)) for n in range(10, 12)), new(12))
    assert served.kept_bytes == (NEW_AFTER + 1) * new(0).nbytes


def test_a_blob_that_is_used_again_is_asked_for_first(served: Served) -> None:
    """A known blob shows that blobs of this kind come again, so the next unknown one is only named."""
    with joined(served) as runner:
        for n in (0, 1, 1, 2, 2, 3, 3):
            run(runner, new(n))
    assert served.asked == 4


def test_a_blob_from_another_robot_is_not_sent_again(served: Served) -> None:
    """A new robot asks first; as long as the server has the blobs, it goes on asking."""
    with joined(served) as runner:
        for n in range(NEW_AFTER):
            run(runner, new(n))
    with joined(served) as other:
        for n in range(NEW_AFTER):
            assert run(other, new(n)).bytes_out < NUMBERS
    assert served.asked == NEW_AFTER


def test_a_compressed_argument_is_stored_whole_and_known_again(served: Served) -> None:
    """It crosses in few bytes, once; its digest is that of the array itself."""
    with joined(served) as runner:
        first, again = run(runner, new(1), compress=(0,)), run(runner, new(1))
        assert first.bytes_out < 5000
        assert [(one.argument, one.how, one.raw_bytes) for one in first.packed] == [
            (0, "zstd", new(1).nbytes)
        ]
        assert again.bytes_out < 1000
        assert again.packed == ()
        assert served.kept_bytes == new(1).nbytes
        for n in range(2, 2 + NEW_AFTER):
            run(runner, new(n))
        inside = run(runner, new(0), new(-1), compress=(1,))
    assert new(0).nbytes < inside.bytes_out < new(0).nbytes + 5000
    assert [one.argument for one in inside.packed] == [1]
    assert inside.network_s is not None
    assert inside.network_s < inside.seconds - inside.pack_s


def test_a_robot_may_be_told_not_to_compress(served: Served) -> None:
    """It then knows of nothing to compress, and compresses nothing."""
    task = Task(kind_of(both_sums), (new(1), 5, new(2)), 0.0)
    with joined(served) as runner:
        assert runner.to_send(task).large == ((0, new(1).nbytes), (2, new(2).nbytes))
    with joined(served, compress=False) as runner:
        assert runner.to_send(task).large == ()
        plain = run(runner, new(1), compress=(0,))
    assert plain.bytes_out > new(1).nbytes
    assert plain.packed == ()


def test_of_two_blobs_the_known_one_is_not_sent_again(served: Served) -> None:
    """With a constant map and a changing image, only the image is sent."""
    grid = new(-1)
    with joined(served) as runner:
        sent = [run(runner, grid, new(n)).bytes_out for n in range(NEW_AFTER + 3)]
    assert served.asked == NEW_AFTER
    assert all(grid.nbytes < each < 1.1 * grid.nbytes for each in sent[1:])
