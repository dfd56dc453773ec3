"""Hash tasks for scenarios: real CPU work that depends on one number, with an answer that can be verified.

The server loads them with `--tasks offboard.loadgen.scenario.hash_tasks`.
The robot takes one with `--task offboard.loadgen.scenario.hash_tasks:NAME`.
"""

import hashlib
import os
import zlib

from offboard.common.tasks import task
from offboard.common.wanted import check_wanted
from offboard.loadgen.testbed.testbed import PART

ROUNDS_MAX = 10_000_000
RARE = 25  # on each computer, one in this many sizes ...
MUCH = 20  # ... takes this many times as long
EVERYWHERE = "everywhere"  # stands for the computer where all have the same slow sizes


@task("hash_rounds", size=float)
def hash_rounds(rounds: int) -> bytes:
    """PBKDF2-HMAC-SHA256 (RFC 8018) with this many rounds: the time is linear in the size."""
    return hashed(rounds)


@task("hash_pairs", size=float)
def hash_pairs(count: int) -> bytes:
    """One round for every thousand pairs of `count` things: the time grows with the square of the size."""
    return hashed(count * count // 1000)


@task("hash_rarely_long", size=float)
def hash_rarely_long(rounds: int) -> bytes:
    """Like `hash_rounds`, but 1 in RARE sizes takes MUCH times as long.

    Each computer has its own slow sizes.
    """
    return hashed_in_steps(rounds, rounds_on(os.environ.get(PART, ""), rounds))


@task("hash_rarely_long_everywhere", size=float)
def hash_rarely_long_everywhere(rounds: int) -> bytes:
    """Like `hash_rarely_long`, but every computer has the same slow sizes."""
    return hashed_in_steps(rounds, rounds_on(EVERYWHERE, rounds))


def rounds_on(part: str, rounds: int) -> int:
    """The rounds that `hash_rarely_long` computes on this part of a testbed; the tail is unpredictable."""
    rare = zlib.crc32(f"{part}/{rounds}".encode()) % RARE == 0
    return rounds * MUCH if rare else rounds


def hashed_in_steps(rounds: int, total: int) -> bytes:
    """The hash of `rounds`, after other hashes until `total` rounds are done."""
    for _ in range(total // max(rounds, 1) - 1):
        check_wanted()
        hashed(rounds)
    return hashed(rounds)


def hashed(rounds: int) -> bytes:
    """Runs without Python's interpreter lock."""
    if rounds > ROUNDS_MAX:
        raise ValueError(f"{rounds} rounds are over {ROUNDS_MAX}")
    return hashlib.pbkdf2_hmac("sha256", b"offboard", b"scenario", max(rounds, 1))
