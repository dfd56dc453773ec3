"""`hostile_memory ENDPOINT KIND..`: the most MiB that a robot holds for bad answers of `groot_server`."""

import re
import sys
from pathlib import Path
from typing import Any

import numpy as np

from offboard import Offloader, task

START_S = 20.0
STATUS = Path("/proc/self/status")


@task("hostile_act", policy_server=True, size=lambda _: 1.0)
def act(observation: dict[str, Any]) -> Any:
    return observation["state"]


def peak_mib() -> float:
    found = re.search(r"VmHWM:\s+(\d+) kB", STATUS.read_text())
    assert found is not None
    return int(found[1]) / 1024


def main(endpoint: str, *kinds: str) -> None:
    with Offloader.connect(sites={"gpu": endpoint}) as offload:
        offload.wait_for_sites(act, START_S)
        state = np.zeros(3, np.float32)
        offload(act, {"state": state}, where="gpu")
        before = peak_mib()
        for kind in kinds:
            asked = False
            while not asked:  # a right answer before each: after three bad ones the site is left out
                for bad in ({}, {"bad": kind}):
                    _, record = offload.call(act, {"state": state} | bad, where="gpu", timeout_s=START_S)
                    asked = any(one.site == "gpu" and one.bytes_out for one in record.executions)
            print(kind, round(peak_mib() - before, 1))


if __name__ == "__main__":
    main(*sys.argv[1:])
