"""A stand-in for a cluster: its actors are real, but in this process, and answer when the test says so.

With it a test decides in which order calls arrive, and which of them fails. `clusters` has real ones.
"""

from collections.abc import Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors.ray_actor import RayActor, Started
from offboard.common.wire.blobs import StoredBlob

HOST, PID = "a-node", 1


class Sent:
    """A call that an actor has not answered yet."""

    def __init__(self, actor: RayActor, method: str, args: tuple[Any, ...], named: Mapping[str, Any]) -> None:
        self.method, self.args, self.named = method, args, named
        self._actor = actor
        self._future: Future[Any] = Future()

    def future(self) -> "Future[Any]":
        return self._future

    def answer(self) -> None:
        """The actor does what it was asked for. Only its start is made up: it would limit this process."""
        if self.method == "start":
            self._future.set_result(Started(host=HOST, pid=PID))
        else:
            self._future.set_result(getattr(self._actor, self.method)(*self.args, **self.named))


class Handle:
    """What a server has of an actor."""

    def __init__(self) -> None:
        self.sent: list[Sent] = []
        self.refuses = False
        self.process = RayActor()

    def __getattr__(self, method: str) -> "_Method":
        return _Method(self, method)

    def send(self, method: str, args: tuple[Any, ...], named: Mapping[str, Any]) -> Sent:
        if self.refuses:
            raise RuntimeError("this process is not connected")
        self.sent.append(Sent(self.process, method, args, named))
        return self.sent[-1]

    def take(self, method: str) -> list[Sent]:
        """The calls of this method that were sent since the last time."""
        taken = [one for one in self.sent if one.method == method]
        self.sent = [one for one in self.sent if one.method != method]
        return taken


class _Method:
    def __init__(self, handle: Handle, name: str) -> None:
        self._handle, self._name = handle, name

    def options(self, *, concurrency_group: str) -> "_Method":  # noqa: ARG002
        return self

    def remote(self, *args: Any, **named: Any) -> Sent:
        return self._handle.send(self._name, args, named)


class StandIn:
    """The cluster. `put` holds the digests that were put, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        from offboard.cloud_server.executors import ray_cluster

        self.actors: list[Handle] = []
        self.ended: list[Handle] = []
        self.refuses = False
        self.puts: list[bytes] = []
        self.disconnected = 0
        monkeypatch.setattr(ray_cluster, "end", self.ended.append)

    def new_actor(self) -> Handle:
        if self.refuses:
            raise RuntimeError("the head does not answer")
        self.actors.append(Handle())
        return self.actors[-1]

    def put(self, blob: StoredBlob) -> Any:
        self.puts.append(bytes(blob.data))
        return np.frombuffer(blob.data, np.uint8)

    def answers(self) -> bool:
        return False

    def connect(self) -> None:
        pass

    def disconnect(self) -> None:
        self.disconnected += 1


class Clock:
    """The time that the module under test reads; the test sets it."""

    def __init__(self) -> None:
        self.now_s = 100.0

    def monotonic(self) -> float:
        return self.now_s
