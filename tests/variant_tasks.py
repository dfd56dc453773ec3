"""Tasks with a variant for each site, which say in their answer which of them ran and with which model."""

import hashlib
import os
import time
from typing import Any

from offboard import task

ONBOARD_S, SERVER_S = 0.02, 0.01  # how long the variants take


def small_model() -> str:
    return "small"


def large_model() -> str:
    return "large"


def grade_roughly(model: str, number: int) -> list[Any]:
    time.sleep(ONBOARD_S)
    return [model, "rough", number, os.getpid()]


@task(
    "grade",
    size=float,
    setup={"onboard": small_model, "cloud": large_model},
    variants={"onboard": grade_roughly},
    quality={"onboard": 0.8, "cloud": 1.0},
)
def grade(model: str, number: int) -> list[Any]:
    time.sleep(SERVER_S)
    return [model, "fine", number, os.getpid()]


def sort_on_the_edge(number: int) -> str:
    return f"edge {number}"


def sort_onboard(number: int) -> str:
    return f"onboard {number}"


def sort_in_the_cloud(number: int) -> str:
    return f"cloud {number}"


@task(
    "sort_out",
    size=float,
    variants={"onboard": sort_onboard, "edge": sort_on_the_edge, "cloud": sort_in_the_cloud},
    quality={"onboard": 0.5, "edge": 0.75, "cloud": 1.0},
)
def sort_out(number: int) -> str:
    return f"called {number}"


@task(
    "only_there",
    size=float,
    variants={"onboard": sort_onboard, "cloud": None},
    quality={"onboard": 0.5, "cloud": 1.0},
)
def only_there(number: int) -> str:
    return hashlib.sha256(str(number).encode()).hexdigest()
