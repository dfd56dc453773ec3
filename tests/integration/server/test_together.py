"""Requests that run together on a real server: right answers, whatever one of them does."""

import contextlib
import os
import re
import signal
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.servers import Server, cloud_server
from offboard import CloudError, Offloader, TaskFailed
from tests.executor_tasks import ON_THIS_COMPUTER
from tests.joint_tasks import DEADLY, POISON, joint_count, joint_double, joint_key, joint_once, joint_short

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROBOTS = 8
START_S = 20.0
LONG_S = 30.0

Start = Callable[..., Server]


@pytest.fixture
def start() -> Iterator[Start]:
    """Starts a server with one worker."""
    with contextlib.ExitStack() as stack:

        def server(executor: str = "threads", **environ: str) -> Server:
            environ = {"CLOUD_WORKERS": "1", "CLOUD_EXECUTOR": executor} | environ
            return stack.enter_context(cloud_server("tests.joint_tasks", **environ))

        yield server


@pytest.fixture
def robots() -> Iterator[Callable[..., list[Offloader]]]:
    """Connects robots to a server."""
    with contextlib.ExitStack() as stack:

        def connect(server: Server, function: Any, count: int = ROBOTS) -> list[Offloader]:
            made = [
                stack.enter_context(Offloader.connect(server.endpoint, policy="cloud")) for _ in range(count)
            ]
            for one in made:
                assert one.wait_for_sites(function, START_S) == {}
            return made

        yield connect


def at_once(robots: list[Offloader], function: Any, items: list[Any]) -> list[Any]:
    """Each robot asks for its item; the answer, or the error, of each."""

    def ask(robot: Offloader, item: Any) -> Any:
        try:
            args = item if isinstance(item, tuple) else (item,)
            return robot(function, *args, where="cloud", timeout_s=LONG_S)
        except (TaskFailed, CloudError) as error:
            return error

    with ThreadPoolExecutor(len(robots)) as pool:
        return list(pool.map(ask, robots, items))


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_poisoned_input_fails_alone(start: Start, robots: Any, executor: str) -> None:
    """Of 1,000 inputs from eight robots, 999 have the right answer, and one the error of its function."""
    made, found = robots(start(executor), joint_double), dict[int, Any]()

    def drive(number: int) -> None:
        for n in range(number, 1000, ROBOTS):
            (found[n],) = at_once([made[number]], joint_double, [POISON if n == 500 else float(n)])

    with ThreadPoolExecutor(ROBOTS) as pool:
        list(pool.map(drive, range(ROBOTS)))
    error = found.pop(500)
    assert isinstance(error, TaskFailed)
    assert str(error).endswith("ValueError: poisoned")
    assert found == {n: 2.0 * n for n in range(1000) if n != 500}


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_requests_of_several_robots_run_in_one_call(start: Start, robots: Any, executor: str) -> None:
    """As many as are allowed, and those of one robot too; the metrics count them."""
    server = start(executor)
    made = robots(server, joint_count, 4)
    assert at_once(made, joint_count, [(1.0, "a"), (2.0, "b"), (3.0,), (4.0,)]) == [4, 4, 4, 4]
    rounds = [at_once([made[0]] * 4, joint_count, [1.0, 2.0, 3.0, 4.0]) for _ in range(20)]
    assert [4, 4, 4, 4] in rounds
    with urllib.request.urlopen(f"http://127.0.0.1:{server.http_port}/metrics") as page:
        found = re.findall(r'run_requests_(?:sum|count)\{kind="joint_count"\} (\S+)', page.read().decode())
    runs, requests = sorted(map(float, found))
    assert requests == 84
    assert runs < 84


def test_only_equal_keys_run_together(start: Start, robots: Any) -> None:
    """Arrays of two lengths come in turn; the function would raise for a mixture."""
    made = robots(start(), joint_key, 4)
    arrays = [np.full(2 + number % 2, float(number)) for number in range(4)]
    for _ in range(5):
        assert at_once(made, joint_key, arrays) == [float(one.sum()) for one in arrays]


def test_a_result_too_few_is_no_result(start: Start, robots: Any) -> None:
    """Each request then runs alone."""
    made = robots(start(), joint_short, 4)
    for _ in range(3):
        assert at_once(made, joint_short, [1.0, 2.0, 3.0, 4.0]) == [1.0, 2.0, 3.0, 4.0]


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_what_must_not_run_twice_is_not_repeated(
    start: Start, robots: Any, executor: str, tmp_path: Path
) -> None:
    """With `duplicate=False` all requests of a run that raises fail, and each ran once."""
    made = robots(start(executor), joint_once, 4)
    files = [tmp_path / str(number) for number in range(4)]
    found = at_once(made, joint_once, [str(one) for one in files])
    assert [type(one) for one in found] == [TaskFailed] * 4
    assert [one.read_text() for one in files] == ["run\n"] * 4


def test_a_deadly_input_kills_only_its_own_runs(start: Start, robots: Any) -> None:
    """The worker of a run dies; the others of the run are answered by the next ones."""
    made = robots(start("processes", JOINT_DEADLY="1"), joint_double)
    items = [float(number) for number in range(ROBOTS - 1)]
    for _ in range(3):
        *others, _ = at_once(made, joint_double, [*items, DEADLY])
        assert others == [2.0 * one for one in items]


def test_killed_workers_lose_nothing(start: Start, robots: Any) -> None:
    """`kill -9` of a worker while requests run together, 20 times: every answer is right."""
    server, over = start("processes", CLOUD_WORKERS="2"), threading.Event()
    made = robots(server, joint_double)
    right = [0] * ROBOTS

    def drive(number: int) -> None:
        while not over.is_set():
            one = float(1000 * number + right[number])
            assert made[number](joint_double, one, timeout_s=LONG_S) == 2.0 * one
            right[number] += 1

    with ThreadPoolExecutor(ROBOTS) as pool:
        drives = [pool.submit(drive, number) for number in range(ROBOTS)]
        for _ in range(20):
            time.sleep(0.1)
            before = sum(right)
            for worker in children(server.pid)[:1]:
                os.kill(worker, signal.SIGKILL)
            until_s = time.monotonic() + LONG_S
            while sum(right) <= before + ROBOTS:
                assert time.monotonic() < until_s
                time.sleep(0.01)
        over.set()
        for one in drives:
            one.result(LONG_S)


def children(pid: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()] or [
        int(one)
        for task in Path(f"/proc/{pid}/task").iterdir()
        for one in (task / "children").read_text().split()
    ]
