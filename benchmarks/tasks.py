"""Tasks that take no time or no CPU, to measure the way to the server and back; and one that computes."""

import hashlib
import time
from typing import Any

from offboard.common.tasks import task
from offboard.common.variants import CLOUD, ONBOARD

ONBOARD_FACTOR = 5


@task("nothing", size=lambda: 0.0)
def nothing() -> None:
    pass


@task("length", size=lambda array: array.nbytes)
def length(array: Any) -> int:
    return int(array.nbytes)


def _hash_slowly(rounds: int) -> bytes:
    """What the small computer of a robot would take, on the same CPU."""
    return hashlib.pbkdf2_hmac("sha256", b"offboard", b"benchmark", ONBOARD_FACTOR * rounds)


@task("hash_near_or_far", size=float, variants={ONBOARD: _hash_slowly}, quality={ONBOARD: 1.0, CLOUD: 1.0})
def hash_near_or_far(rounds: int) -> bytes:
    """PBKDF2 with this many rounds; onboard it takes ONBOARD_FACTOR times as long."""
    return hashlib.pbkdf2_hmac("sha256", b"offboard", b"benchmark", rounds)


@task("wait_20_ms", size=lambda: 0.0)
def wait_20_ms() -> None:
    """As a task that computes on a GPU: it needs its worker, and almost no CPU."""
    time.sleep(0.02)
