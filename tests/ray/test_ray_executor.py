"""What the executor keeps and how it watches the head, without a cluster."""

from collections.abc import Callable
from typing import Any

import pytest

from offboard.cloud_server.executors.executor import Call
from offboard.cloud_server.executors.ray_actor import ActorSetup
from offboard.common.errors import ConfigError
from offboard.common.wire.blobs import StoredBlob
from tests.ray.handles import Clock, StandIn

PAUSE_S, LOOK_S = 40.0, 2.0
SETUP = ActorSetup((), (), 0)
BYTES_MAX = 100


@pytest.fixture
def make(stand_in: StandIn) -> Callable[[], Any]:
    """Makes executors of one worker whose thread does not run."""
    from offboard.cloud_server.executors.ray_executor import RayExecutor

    return lambda: RayExecutor(stand_in, 1, SETUP, BYTES_MAX)  # type: ignore[arg-type]


def with_blob(data: bytes) -> Call:
    return Call("any", (), {data[:1]: StoredBlob(data)})


def test_blobs_of_a_lost_cluster_do_not_count(stand_in: StandIn, make: Callable[[], Any]) -> None:
    """After all blobs were forgotten, as many bytes as before have room, and each is put once."""
    executor, old, new, small = make(), b"o" * 80, b"n" * 80, b"s"
    executor.submit(with_blob(old), lambda _: None)
    executor.close()
    for data in (new, small, new):
        executor.submit(with_blob(data), lambda _: None)
    assert stand_in.puts == [old, new, small]


def test_a_pause_of_the_server_is_no_silence_of_the_head(
    stand_in: StandIn, make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whoever pauses the server pauses its questions to the head too; real silence is noticed afterwards."""
    from offboard.cloud_server.executors import ray_executor

    clock = Clock()
    monkeypatch.setattr(ray_executor, "time", clock)
    executor, looks = make(), list[bool]()
    for pause_s in (LOOK_S, PAUSE_S, LOOK_S, LOOK_S, PAUSE_S):
        clock.now_s += pause_s
        executor._look(0.0)
        looks.append(executor._headless)
    assert looks == [False, False, False, True, True]
    assert stand_in.disconnected == 0


def test_blobs_of_a_connection_that_failed_are_put_again(
    stand_in: StandIn, make: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray may take blobs before the head is found dead again; the next cluster does not have them."""
    from offboard.cloud_server.executors import ray_executor

    executor, data, attempts = make(), b"data", [1, 2]

    def connect() -> None:
        executor.submit(with_blob(data), lambda _: None)
        if attempts.pop() == 2:
            raise ConfigError("the head died again")

    monkeypatch.setattr(ray_executor, "HEAD_EVERY_S", 0.001)
    monkeypatch.setattr(stand_in, "connect", connect)
    executor._connect_again()
    executor.close()
    assert attempts == []
    assert stand_in.puts == [data, data]
