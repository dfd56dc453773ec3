"""Runs in a container: sends empty tasks to the cloud, and prints the seconds of each as JSON."""

import json

from offboard import Offloader
from tests.probes import echo

TASKS = 200

with Offloader.connect("tcp://wan:5555", policy="cloud", keys="/keys") as offload:
    assert offload.wait_for_sites(echo, 20.0) == {}
    seconds = []
    for _ in range(TASKS):
        offload(echo)
        assert offload.last is not None
        (execution,) = offload.last.executions
        assert execution.ok, execution.error
        seconds.append(execution.seconds)
print(json.dumps(seconds))
