"""Robots that run empty tasks on a server, as fast as it answers.

`python -m benchmarks.robots raw|client ENDPOINT ROBOTS TASKS IN_FLIGHT` prints "ready" when all robots are
connected, begins when it reads a line, and prints the seconds of all tasks and the number of wrong answers.
"""

import sys
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import zmq

from benchmarks.servers import READY_S
from benchmarks.tasks import nothing
from offboard.common.tasks import Task, kind_of
from offboard.common.wire import messages as wire
from offboard.robot_client.cloud.cloud_runner import CloudRunner

BUDGET_S = 60.0


def main() -> None:
    way, endpoint, *numbers = sys.argv[1:]
    robots, tasks, in_flight = (int(number) for number in numbers)
    start = {"raw": raw, "client": client}[way]
    ask = [start(endpoint) for _ in range(robots)]
    wrong = sum(not one()() for one in ask)
    print("ready", flush=True)
    sys.stdin.readline()
    began, asked = time.perf_counter(), deque[Callable[[], bool]]()
    for n in range(tasks):
        if len(asked) == in_flight:
            wrong += not asked.popleft()()
        asked.append(ask[n % robots]())
    wrong += sum(not answered() for answered in asked)
    print(time.perf_counter() - began, wrong, flush=True)


def raw(endpoint: str) -> Callable[[], Callable[[], bool]]:
    """A plain DEALER socket that sends the bytes of a request; an echo of the request counts as an answer."""
    socket = zmq.Context.instance().socket(zmq.DEALER)
    socket.linger = 0
    socket.connect(endpoint)
    frames = request_frames(nothing, budget_s=BUDGET_S)

    def answered() -> bool:
        if not socket.poll(BUDGET_S * 1e3):
            return False
        message = wire.unpack([frame.buffer for frame in socket.recv_multipart(copy=False)])
        return not isinstance(message, wire.Reply) or message.status == "ok"

    def ask() -> Callable[[], bool]:
        socket.send_multipart(frames, copy=False)
        return answered

    return ask


def client(endpoint: str) -> Callable[[], Callable[[], bool]]:
    """The client of Offboard."""
    runner, kind = CloudRunner(endpoint), kind_of(nothing)
    until = time.monotonic() + READY_S
    while runner.unavailable(kind) and time.monotonic() < until:
        time.sleep(0.01)

    def ask() -> Callable[[], bool]:
        answer = runner.submit(Task(kind, (), 0.0), BUDGET_S)
        return lambda: answer.result().ok

    return ask


def request_frames(function: Callable[..., Any], *args: Any, budget_s: float = 1.0) -> list[Any]:
    """The frames that the client sends for this call."""
    kind = kind_of(function)
    body = wire.encode(list(args), kind.types)
    return list(wire.pack(wire.Request(1, kind.name, budget_s, body=body.frames)))


if __name__ == "__main__":
    main()
