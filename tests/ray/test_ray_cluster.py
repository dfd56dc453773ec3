"""A connection to a cluster whose head dies while the server connects."""

import socket

import pytest

from offboard.common.errors import ConfigError


@pytest.mark.integration
def test_a_head_that_dies_right_after_ray_connected_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each attempt is a ConfigError, as when nobody listens, and none leaves Ray half connected."""
    ray = pytest.importorskip("ray", reason="Ray is not installed here: make ray runs this test")
    from offboard.cloud_server.executors import ray_cluster

    connected = list[str]()

    def connect(address: str, **_: object) -> None:
        if connected:
            raise RuntimeError("Maybe you called ray.init twice by accident?")
        connected.append(address)

    def ask(address: str) -> None:
        raise ray.exceptions.RpcError(f"Timed out while waiting for {address}")

    monkeypatch.setattr(ray, "init", connect)
    monkeypatch.setattr(ray, "shutdown", connected.clear)
    monkeypatch.setattr(ray_cluster, "GcsClient", ask)
    with socket.create_server(("127.0.0.1", 0)) as head:
        address = f"127.0.0.1:{head.getsockname()[1]}"
        context = type("Context", (), {"gcs_address": address})
        monkeypatch.setattr(ray, "get_runtime_context", context)
        cluster = ray_cluster.RayCluster(address, {})
        for _ in range(2):
            with pytest.raises(ConfigError, match=f"--ray-address: {address}: RpcError: Timed out"):
                cluster.connect()
            assert not connected
