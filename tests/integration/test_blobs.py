"""When the client sends a large argument along, and when it asks first whether the server has it."""

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from threading import Thread
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors import Threads
from offboard.cloud_server.metrics import Metrics
from offboard.cloud_server.server import Server
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.sites.blob_uploads import INLINE_BYTES_MAX, INLINE_SHARE, NEW_AFTER
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.runner import Execution

pytestmark = pytest.mark.integration

WAIT_S = 8.0
NUMBERS = 50_000
MESSAGE_BYTES_MAX = 2**24


@task("both_sums", size=lambda *arrays: len(arrays))
def both_sums(*arrays: Any) -> list[float]:
    return [float(array.sum()) for array in arrays]


class Served:
    """A server in a thread of this process, and how often it asked for a blob."""

    def __init__(self) -> None:
        self.metrics = Metrics()
        bounds = {"queue_max": 8, "blob_bytes_max": 2**24, "message_bytes_max": MESSAGE_BYTES_MAX}
        bounds |= {"robot_bytes_a_s": 2**30, "drain_s": 1}
        self.server = Server("tcp://127.0.0.1:0", Threads(1), self.metrics, **bounds)  # type: ignore[arg-type]

    @property
    def asked(self) -> int:
        labels = {"kind": "both_sums", "status": "need_blob"}
        return int(self.metrics.registry.get_sample_value("offboard_requests_total", labels) or 0)

    @property
    def kept_bytes(self) -> float:
        return self.metrics.registry.get_sample_value("offboard_blob_bytes") or 0.0


@pytest.fixture
def served() -> Iterator[Served]:
    served = Served()
    thread = Thread(target=served.server.run)
    thread.start()
    yield served
    served.server.drain()
    thread.join(WAIT_S)


@contextmanager
def joined(served: Served) -> Iterator[CloudRunner]:
    with closing(CloudRunner(served.server.endpoint)) as runner:
        until = time.monotonic() + WAIT_S
        while runner.unavailable(kind_of(both_sums)) and time.monotonic() < until:
            time.sleep(0.01)
        yield runner


def run(runner: CloudRunner, *arrays: np.ndarray[Any, Any]) -> Execution:
    execution = runner.submit(Task(kind_of(both_sums), arrays, 0.0), WAIT_S).result()
    assert execution.value == [array.sum() for array in arrays]
    return execution


def new(n: int) -> np.ndarray[Any, Any]:
    return np.full(NUMBERS, float(n))


def test_arguments_that_are_always_new_go_along(served: Served) -> None:
    """After NEW_AFTER tasks whose blob the server did not have, none is named, asked for or kept."""
    with joined(served) as runner:
        for n in range(NEW_AFTER + 3):
            run(runner, new(n))
    assert served.asked == NEW_AFTER
    assert served.kept_bytes == NEW_AFTER * new(0).nbytes


def test_what_went_along_is_kept_once_it_comes_again(served: Served) -> None:
    """The second time it is uploaded, unasked; from the third on it is only named."""
    with joined(served) as runner:
        sent = [run(runner, new(n)).bytes_out for n in (*range(NEW_AFTER + 1), NEW_AFTER, NEW_AFTER)]
    assert served.asked == NEW_AFTER
    assert sent[-2] > new(0).nbytes
    assert sent[-1] < 1000


def test_no_more_goes_along_than_fits(served: Served) -> None:
    """Of one task; the rest are blobs, in messages of their own."""
    most = int(INLINE_SHARE * MESSAGE_BYTES_MAX)
    assert most <= INLINE_BYTES_MAX
    with joined(served) as runner:
        for n in range(NEW_AFTER):
            run(runner, new(n))
        run(runner, *(np.full(most // 2 // 8, float(n)) for n in range(10, 12)), new(12))
    assert served.kept_bytes == (NEW_AFTER + 1) * new(0).nbytes


def test_a_blob_that_is_used_again_is_asked_for_first(served: Served) -> None:
    """A known blob in between shows that the kind's blobs come again: the next new one is named only."""
    with joined(served) as runner:
        for n in (0, 1, 1, 2, 2, 3, 3):
            run(runner, new(n))
    assert served.asked == 4


def test_what_another_robot_has_sent_is_not_sent_again(served: Served) -> None:
    """A robot that is new asks first, and that the server had it lets it ask again."""
    with joined(served) as runner:
        for n in range(NEW_AFTER):
            run(runner, new(n))
    with joined(served) as other:
        for n in range(NEW_AFTER):
            assert run(other, new(n)).bytes_out < NUMBERS
    assert served.asked == NEW_AFTER


def test_of_two_blobs_the_known_one_is_not_sent_again(served: Served) -> None:
    """A map that stays and an image that changes: only the image goes along."""
    grid = new(-1)
    with joined(served) as runner:
        sent = [run(runner, grid, new(n)).bytes_out for n in range(NEW_AFTER + 3)]
    assert served.asked == NEW_AFTER
    assert all(grid.nbytes < each < 1.1 * grid.nbytes for each in sent[1:])
