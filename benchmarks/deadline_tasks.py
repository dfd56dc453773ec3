"""Tasks made of sleeps, for `deadlines`: the better variant is at the server, and now and then it stalls."""

import random
import time

from offboard import task

STALLS = 1 / 8  # share of the runs at the server
STALL_S = 1.5
SLEEP_ONBOARD_S, SLEEP_SERVER_S = 0.01, 0.1
RUN_ONBOARD_S, RUN_SERVER_S = 0.015, 0.02


def stalls(number: int) -> bool:
    """The same for each number, on both sides."""
    return random.Random(number).random() < STALLS


def sleep_shortly(number: int) -> int:
    time.sleep(SLEEP_ONBOARD_S)
    return number


@task(
    "sleep_or_stall",
    size=lambda number: 1.0,  # noqa: ARG005 - all are equal
    variants={"onboard": sleep_shortly},
    quality={"onboard": 0.7, "cloud": 1.0},
)
def sleep_or_stall(number: int) -> int:
    time.sleep(STALL_S if stalls(number) else SLEEP_SERVER_S)
    return number


def run_shortly(number: int) -> int:
    time.sleep(RUN_ONBOARD_S)
    return number


@task(
    "over_a_bad_link",
    size=lambda number: 1.0,  # noqa: ARG005 - all are equal
    variants={"onboard": run_shortly},
    quality={"onboard": 0.7, "cloud": 1.0},
)
def over_a_bad_link(number: int) -> int:
    time.sleep(RUN_SERVER_S)
    return number


@task("sleep_alike", size=lambda number: 1.0)  # noqa: ARG005 - all are equal
def sleep_alike(number: int) -> int:
    time.sleep(SLEEP_SERVER_S)
    return number
