"""An offloader with a server that is dropped without `close`, or used in a forked process."""

import gc
import os
import signal
import threading
import time
import warnings
import weakref
from collections.abc import Callable

import pytest

from offboard.common.errors import OffloadError
from offboard.common.wire.channel import make_context
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.offloader import Offloader
from tests.probes import echo, nap

pytestmark = pytest.mark.integration

WAIT_S = 5.0


def threads() -> list[str]:
    return sorted(thread.name for thread in threading.enumerate())


def sockets() -> int:
    """How many files and sockets are open."""
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - one of them is closed again when the list is made


def until(true: Callable[[], bool]) -> None:
    until_s = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < until_s, (threads(), sockets())
        time.sleep(0.02)


def use_and_drop(endpoint: str) -> None:
    """A run that lost its race is still under way in the cloud when the offloader is dropped."""
    made = [Offloader.connect(endpoint)]
    assert made[0].wait_for_sites(echo, WAIT_S) == {}
    assert made[0](echo, 1, where="cloud") == 1
    assert made[0](nap, 0.2, where="both") == 0.2
    assert made[0].map(echo, [1, 2, 3]) == [1, 2, 3]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        made.clear()
        until(lambda: bool(gc.collect() >= 0 and caught))
    assert str(caught[0].message).endswith("its sites: cloud, onboard")


def test_a_dropped_offloader_leaves_no_thread_and_no_socket(testbed: Callable[..., LocalTestbed]) -> None:
    """The first one does: pyzmq keeps a thread and its sockets for the rest of the process."""
    endpoint = testbed().endpoint
    make_context("test").term()
    names, count = threads(), sockets()  # what earlier tests have left may still go
    for _ in range(3):
        use_and_drop(endpoint)
    until(lambda: set(threads()) <= set(names) and sockets() <= count)


def test_a_forked_process_is_refused_and_can_connect_itself(testbed: Callable[..., LocalTestbed]) -> None:
    """It neither hangs nor disturbs the connection of its parent, even while the parent sends tasks."""
    endpoint = testbed().endpoint
    with Offloader.connect(endpoint) as offload:
        assert offload.wait_for_sites(echo, WAIT_S) == {}
        ends = threading.Event()

        def busy() -> None:
            while not ends.is_set():
                assert offload(echo, 1, where="cloud") == 1

        worker = threading.Thread(target=busy)
        worker.start()
        for _ in range(10):
            status = in_child(lambda: child(offload, endpoint))
            assert status == 0, status
            assert offload(echo, 2, where="cloud") == 2
        ends.set()
        worker.join(WAIT_S)
        record = offload.last
        assert record is not None
        assert record.used == "cloud"


def child(offload: Offloader, endpoint: str) -> None:
    for where in (None, "cloud", "onboard"):
        with pytest.raises(OffloadError, match="forked"):
            offload(echo, 1, where=where)
    offload.close()
    with Offloader.connect(endpoint) as own:
        assert own.wait_for_sites(echo, WAIT_S) == {}
        assert own(echo, 3, where="cloud") == 3


def test_a_forked_process_may_drop_the_offloader_of_its_parent(testbed: Callable[..., LocalTestbed]) -> None:
    """Its socket is collected without a wait and without a warning, and the parent keeps its connection."""
    made = [Offloader.connect(testbed().endpoint)]
    assert made[0].wait_for_sites(echo, WAIT_S) == {}

    def drop() -> None:
        warnings.simplefilter("error")
        dropped = weakref.ref(made[0])
        made.clear()
        gc.collect()
        assert dropped() is None

    assert in_child(drop) == 0
    assert made[0](echo, 2, where="cloud") == 2
    made[0].close()


def in_child(run: Callable[[], None]) -> int:
    """The exit status of a forked process that runs this; SIGALRM ends it if it is hung."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        pid = os.fork()
    if pid == 0:
        status = 1
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.setitimer(signal.ITIMER_REAL, 2 * WAIT_S)
            run()
            status = 0
        finally:
            os._exit(status)
    return os.waitpid(pid, 0)[1]
