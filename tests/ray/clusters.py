"""A real Ray cluster on this computer: a head and nodes, each with its own processes and object store."""

import json
import os
from collections.abc import Mapping
from typing import Any

CLUSTER_NAMESPACE = b"cluster"
STORE_BYTES = 80 << 20  # of each node: the least that Ray accepts is 75 MiB


class RayNodes:
    """A head without room for workers, on which the server runs, and nodes with room for one worker each."""

    def __init__(self, count: int = 2, **head: Any) -> None:
        os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
        from ray.cluster_utils import Cluster

        settings = {"object_store_memory": STORE_BYTES, "include_dashboard": False}
        self._cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **settings, **head})
        self.address: str = self._cluster.address
        self.nodes = [self.add() for _ in range(count)]
        self._cluster.wait_for_nodes()

    def add(self, environ: Mapping[str, str] | None = None) -> Any:
        """A node joins, whose workers have these variables too."""
        return self._cluster.add_node(
            num_cpus=1, object_store_memory=STORE_BYTES, env_vars=dict(environ or {})
        )

    def kill(self, node: Any) -> None:
        """A node is lost: all its processes are killed."""
        self._cluster.remove_node(node, allow_graceful=False)

    def kill_head(self) -> None:
        """The process that knows the cluster is killed; the Ray node on the same computer goes on."""
        self._cluster.head_node.kill_gcs_server()

    def kill_all(self) -> None:
        """All processes of all nodes are killed."""
        for node in (self._cluster.head_node, *self._cluster.worker_nodes):
            node.kill_all_processes(check_alive=False, allow_graceful=False)

    def say_version(self, ray: str) -> None:
        """From now on the head says that it was started with this version of Ray."""
        from ray._common.usage import usage_lib

        client = self._cluster.head_node.get_gcs_client()
        said = json.dumps({**usage_lib.get_cluster_metadata(client), "ray_version": ray}).encode()
        client.internal_kv_put(usage_lib.usage_constant.CLUSTER_METADATA_KEY, said, True, CLUSTER_NAMESPACE)

    def close(self) -> None:
        self._cluster.shutdown()
