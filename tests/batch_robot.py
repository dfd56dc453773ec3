"""A robot that runs the same batch on all sites, onboard only and in the cloud only, and prints the seconds.

The local testbed starts it instead of `loadgen drive`, with its CPU quota: `python -m tests.batch_robot`.
"""

import argparse
import json
import random
import time

from offboard.loadgen.scenario.hash_tasks import hash_rounds
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

TASKS = 40
ROUNDS = (10_000, 150_000)  # the work of a task, drawn evenly
CONNECT_S = 20.0
TIMEOUT_S = 20.0  # so long that no answer is given up


def main() -> None:
    flags = argparse.ArgumentParser()
    flags.add_argument("--cloud", required=True)
    flags.add_argument("--repeats", type=int, required=True)
    flags.add_argument("--seed", type=int, default=1)
    given = flags.parse_args()
    draws = random.Random(given.seed)
    rounds = [draws.randint(*ROUNDS) for _ in range(TASKS)]
    records: list[Record] = []
    with Offloader.connect(
        given.cloud,
        policy="default",
        timeout_s=TIMEOUT_S,
        observers=[records.append],
    ) as offload:
        assert offload.wait_for_sites(hash_rounds, CONNECT_S) == {}
        expected = offload.map(hash_rounds, rounds)
        ways: list[str | None] = [ONBOARD, CLOUD, None]
        for repeat in range(given.repeats):
            for way in ways[repeat % 3 :] + ways[: repeat % 3]:
                records.clear()
                began_s = time.perf_counter()
                assert offload.map(hash_rounds, rounds, where=way) == expected
                seconds = time.perf_counter() - began_s
                used = [record.used for record in records]
                twice = sum(len(record.executions) > 1 for record in records)
                line = {"where": way or "all", "seconds": seconds, "twice": twice}
                print(
                    json.dumps({**line, **{site: used.count(site) for site in (ONBOARD, CLOUD)}}), flush=True
                )


if __name__ == "__main__":
    main()
