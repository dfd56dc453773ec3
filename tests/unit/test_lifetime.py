"""How an offloader ends: dropped without `close`, in a forked process, with cancelled calls in asyncio."""

import asyncio
import gc
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard import Offloader, OffloadError, Settings
from offboard.common.tasks import task
from offboard.robot_client.lifetime import ASYNC_CALLS_MAX

WAIT_S = 5.0

hold, begun = threading.Event(), threading.Event()


@task("square", size=float)
def square(number: int) -> int:
    return number * number


@task("wait_for_test", size=float)
def wait_for_test(number: int) -> int:
    begun.set()
    assert hold.wait(WAIT_S)
    return number


def in_child(run: Callable[[], None]) -> None:
    """Run this in a forked process, which must end by itself within WAIT_S and without an error."""
    reader, writer = os.pipe()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # Python 3.12 warns of a fork beside threads
        child = os.fork()
    if child == 0:
        signal.setitimer(signal.ITIMER_REAL, WAIT_S)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        status = 1
        try:
            run()
            status = 0
        except BaseException:  # noqa: BLE001 - the parent gets it
            os.write(writer, traceback.format_exc().encode()[-4000:])
        finally:
            os._exit(status)
    os.close(writer)
    with os.fdopen(reader) as said:
        _, status = os.waitpid(child, 0)
        assert status == 0, said.read() or "the forked process was hung"


USES: dict[str, Callable[[Offloader], object]] = {
    "call": lambda offload: offload(square, 3),
    "pinned": lambda offload: offload(square, 3, where="onboard"),
    "map": lambda offload: offload.map(square, [1, 2]),
    "asyncio": lambda offload: asyncio.run(offload.run(square, 3)),
    "submit": lambda offload: offload.submit(square, 3),
    "deadline": lambda offload: offload(square, 3, deadline_s=WAIT_S),
    "expect": lambda offload: offload.expect(square, 3),
    "savings": lambda offload: offload.savings(),
    "wait_for_sites": lambda offload: offload.wait_for_sites(square, WAIT_S),
}


@pytest.mark.parametrize("held", [False, True], ids=["free", "locked"])
@pytest.mark.parametrize("use", USES)
def test_a_forked_process_gets_one_clear_error(use: str, held: bool, tmp_path: Path) -> None:
    """Every use raises OffloadError at once, even if a lock was held during the fork; the parent goes on."""
    settings = Settings(memory=tmp_path / "memory.json")
    with Offloader.connect(settings=settings, trace=tmp_path / "trace.jsonl") as offload:
        assert offload(square, 2) == 4
        asyncio.run(offload.run(square, 2))

        def child() -> None:
            with pytest.raises(OffloadError, match="this process was forked after its offloader was made"):
                USES[use](offload)
            offload.close()
            with Offloader.connect() as own:
                assert own(square, 3) == 9

        if held:
            with offload._lock:
                in_child(child)
        else:
            in_child(child)
        assert offload(square, 5) == 25


def test_a_forked_process_leaves_the_files_alone(tmp_path: Path) -> None:
    """Its end, the end of a block and a dropped offloader write no trace and no memory, without warnings."""
    trace, memory = tmp_path / "trace.jsonl", tmp_path / "memory.json"
    with Offloader.connect(settings=Settings(memory=memory), trace=trace) as offload:
        for number in range(10):
            offload(square, number)

        def child() -> None:
            import atexit

            nonlocal offload
            warnings.simplefilter("error")
            with offload:
                pass
            del offload
            gc.collect()
            assert not memory.exists()
            atexit._run_exitfuncs()

        in_child(child)
    assert len(trace.read_text().splitlines()) == 10
    assert memory.exists()


def names() -> list[str]:
    return sorted(thread.name for thread in threading.enumerate())


def until(true: Callable[[], bool], what: str) -> None:
    until_s = time.monotonic() + WAIT_S
    while not true():
        assert time.monotonic() < until_s, what
        time.sleep(0.01)


@pytest.mark.parametrize("cycle", [False, True])
def test_a_dropped_offloader_is_collected(cycle: bool, tmp_path: Path) -> None:
    """It warns, its threads end, trace and memory are written, also if only the collector finds it."""
    before, memory = names(), tmp_path / "memory.json"
    trace = tmp_path / "trace.jsonl"
    offload = Offloader.connect(settings=Settings(memory=memory), trace=trace, metrics="127.0.0.1:0")
    assert offload(square, 3) == 9
    asyncio.run(offload.run(square, 3))
    assert offload.map(square, [3]) == [9]
    assert names() != before
    if cycle:
        offload.itself = offload  # type: ignore[attr-defined]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        del offload
        # A thread that has just made a call may still hold it.
        until(lambda: bool(gc.collect() >= 0 and caught), "no warning")
    assert [one.category for one in caught] == [ResourceWarning]
    assert str(caught[0].message) == "an offloader was dropped without close(); its sites: onboard"
    until(lambda: names() == before, f"{names()} are left")
    assert len(trace.read_text().splitlines()) == 3
    assert memory.exists()


def test_an_offloader_that_was_closed_warns_of_nothing() -> None:
    """With or without tasks, a closed offloader is dropped silently."""
    for count in range(2):
        offload = Offloader.connect()
        for number in range(count):
            offload(square, number)
        offload.close()
        del offload
        gc.collect()


def test_a_cancelled_call_in_asyncio_returns_at_once() -> None:
    """Neither the caller nor the end of the event loop waits for the task, which ends by itself."""
    hold.clear()
    begun.clear()

    async def give_up() -> None:
        call = asyncio.create_task(offload.run(wait_for_test, 1))
        while not begun.is_set():
            await asyncio.sleep(0.001)
        call.cancel()
        with pytest.raises(asyncio.CancelledError):
            await call

    with Offloader.connect() as offload:
        began_s = time.monotonic()
        asyncio.run(give_up())
        assert time.monotonic() - began_s < WAIT_S / 2
        hold.set()
        assert offload(square, 2) == 4


def test_so_many_calls_in_asyncio_are_made_at_a_time() -> None:
    """ASYNC_CALLS_MAX calls have begun, the others wait, and all are answered."""
    hold.clear()
    begun.clear()

    async def many(count: int) -> list[int]:
        calls = [asyncio.create_task(offload.run(wait_for_test, number)) for number in range(count)]
        while not begun.is_set():
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.05)
        threads = [name for name in names() if name.startswith("run_")]
        assert len(threads) == ASYNC_CALLS_MAX
        hold.set()
        return await asyncio.gather(*calls)

    with Offloader.connect() as offload:
        count = ASYNC_CALLS_MAX + 8
        assert asyncio.run(many(count)) == list(range(count))
