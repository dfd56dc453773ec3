"""Talks to the Ray cluster, and turns its errors into ours. Only this file imports Ray."""

import contextlib
import json
import os
import re
import socket
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from typing import Any

import numpy as np

from offboard.cloud_server.executors.ray_actor import RayActor
from offboard.common.errors import ConfigError, MissingExtra, describe
from offboard.common.wire.blobs import StoredBlob

# How Ray behaves in a server; it reads this when it is imported.
RAY_SETTINGS = {
    # Ray ends this process if the head is away for this many seconds. The server must go on instead.
    "RAY_gcs_rpc_server_reconnect_timeout_s": str(10 * 365 * 24 * 3600),
    "RAY_DISABLE_FAILURE_SIGNAL_HANDLER": "1",  # SIGTERM is for the server, which then drains
    "RAY_ENABLE_AUTO_CONNECT": "0",  # no call starts a cluster of its own
}
for _name, _value in RAY_SETTINGS.items():
    os.environ.setdefault(_name, _value)

try:
    import ray
    from ray._raylet import GcsClient  # type: ignore[attr-defined, unused-ignore] # ray is not always there
    from ray.exceptions import RayError
except ImportError as error:
    raise MissingExtra("--executor ray", "ray") from error

CONTROL = "control"  # the group of the calls that an actor answers while its task runs
CONNECT_S_MAX = 5.0  # until the port of the head has answered
TEXT_MAX = 300  # characters of an error of Ray: its texts explain much, on many lines
NODES_SHOWN = 4
# What Ray says of an actor that died, and our word for it.
REASONS = {"node has died": "node", "out of memory": "memory", "memory pressure": "memory"}
# The class of the actor was not found, because a node has no Offboard or another one.
MISSING = re.compile("(ModuleNotFoundError|ImportError|AttributeError): .*")


class RayCluster:
    """A connection to a cluster, through the Ray node on this computer.

    Parameters: `address` is that of the head, or `auto`; `resources` is what each actor needs.
    """

    def __init__(self, address: str, resources: Mapping[str, float]) -> None:
        self.address = address
        self.resources = {"CPU": 1.0, **resources}
        self._connected = False
        self._head = ""
        self._id: Any = None  # Ray's name for the cluster that the head knows
        self._actor = ray.remote(concurrency_groups={CONTROL: 1})(RayActor)

    def connect(self) -> None:
        """ConfigError unless there is a cluster of the same versions."""
        try:
            if ":" in self.address:  # Ray itself would try for more than a minute
                host, _, port = self.address.rpartition(":")
                socket.create_connection((host.strip("[]"), int(port)), CONNECT_S_MAX).close()
            self._connected = True  # also if only a part of the following succeeds
            ray.init(self.address, log_to_driver=False, logging_level="ERROR", configure_logging=False)
            self._head = ray.get_runtime_context().gcs_address
            self._id = GcsClient(address=self._head).cluster_id
        except Exception as error:  # Ray says it in several ways
            self.disconnect()
            raise ConfigError(f"--ray-address: {self.address}: {_line(error)}") from error

    def disconnect(self) -> None:
        """End the actors of this server. Safe to call twice."""
        if self._connected:
            self._connected = False
            ray.shutdown()

    def check_resources(self) -> None:
        """ConfigError unless there is a node that has what an actor needs."""
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if any(all(node.get(name, 0) >= least for name, least in self.resources.items()) for node in nodes):
            return
        had = [json.dumps({name: node.get(name, 0) for name in self.resources}) for node in nodes]
        more = f" and {len(had) - NODES_SHOWN} more" if len(had) > NODES_SHOWN else ""
        raise ConfigError(
            f"--ray-resources: no node of the Ray cluster has {json.dumps(self.resources)}; "
            f"its {len(had)} nodes have {', '.join(had[:NODES_SHOWN])}{more}"
        )

    def answers(self) -> bool:
        """Whether the head answers, and still has our cluster. May wait for half a minute.

        `ray.nodes` would wait as long as the head is silent, and end this process if a new head answers.
        """
        try:
            return bool(GcsClient(address=self._head).cluster_id == self._id)
        except Exception:  # noqa: BLE001 - Ray says it in several ways
            return False

    def new_actor(self) -> Any:
        """An actor that starts as soon as a node has room for it. It never runs a task again."""
        others = dict(self.resources)
        cpus, gpus, memory = (others.pop(name, None) for name in ("CPU", "GPU", "memory"))
        return self._actor.options(
            num_cpus=cpus,
            num_gpus=gpus,
            memory=memory,
            resources=others,
            max_restarts=0,
            max_task_retries=0,
            scheduling_strategy="SPREAD",
        ).remote()

    def put(self, blob: StoredBlob) -> Any:
        """A reference to a copy of the blob that all nodes can read. OSError if there is no room for it."""
        try:
            return ray.put(np.frombuffer(blob.data, np.uint8))
        except RayError as error:
            raise OSError(_line(error)) from error


def call(
    method: Any, *args: Any, then: Callable[["Future[Any]"], None], control: bool = False, **named: Any
) -> None:
    """Call a method of an actor; `then` gets the future in a thread of Ray."""
    bound = method.options(concurrency_group=CONTROL) if control else method
    bound.remote(*args, **named).future().add_done_callback(then)


def end(actor: Any) -> None:
    with contextlib.suppress(Exception):  # it is dead already, or its cluster is
        ray.kill(actor)


def why(error: BaseException) -> tuple[str, str]:
    """Why an actor died: one word, and a text of one line."""
    text = str(error)
    if missing := MISSING.search(text):
        return "start", f"did not start: {missing[0][:TEXT_MAX]}"
    reason = next((word for part, word in REASONS.items() if part in text.lower()), "exit")
    said = {"node": "was lost with its node", "memory": "was ended by Ray because memory was short"}
    return reason, said.get(reason, "died, or its node does not answer")


def _line(error: BaseException) -> str:
    text = " ".join(describe(error).split())
    return text if len(text) <= TEXT_MAX else f"{text[:TEXT_MAX]} .."
