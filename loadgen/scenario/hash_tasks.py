"""Tasks of one number for scenarios: real CPU work whose answer tells whether it was done.

Server: `--tasks offboard.loadgen.scenario.hash_tasks`. Robot: `--task` with the same and `:NAME`.
"""

import hashlib
import os
import zlib

from offboard.common.tasks import task
from offboard.common.wanted import check_wanted
from offboard.loadgen.testbed.testbed import PART

ROUNDS_MAX = 10_000_000
RARE = 25  # on a computer one in so many sizes ...
MUCH = 20  # ... takes so many times the work


@task("hash_rounds", size=float)
def hash_rounds(rounds: int) -> bytes:
    """So many rounds of PBKDF2-HMAC-SHA256 (RFC 8018): time is linear in the size."""
    return _hashed(rounds)


@task("hash_pairs", size=float)
def hash_pairs(count: int) -> bytes:
    """A round for every thousand pairs of so many things: time grows with the square of the size."""
    return _hashed(count * count // 1000)


@task("hash_rarely_long", size=float)
def hash_rarely_long(rounds: int) -> bytes:
    """As `hash_rounds`, but takes MUCH times as long for one in RARE sizes, others on each computer."""
    for _ in range(rounds_on(os.environ.get(PART, ""), rounds) // max(rounds, 1) - 1):
        check_wanted()
        _hashed(rounds)
    return _hashed(rounds)


def rounds_on(part: str, rounds: int) -> int:
    """What `hash_rarely_long` takes on a part of a testbed: a tail that nothing foretells."""
    rare = zlib.crc32(f"{part}/{rounds}".encode()) % RARE == 0
    return rounds * MUCH if rare else rounds


def _hashed(rounds: int) -> bytes:
    """Runs without the interpreter's lock."""
    if rounds > ROUNDS_MAX:
        raise ValueError(f"{rounds} rounds are over {ROUNDS_MAX}")
    return hashlib.pbkdf2_hmac("sha256", b"offboard", b"scenario", max(rounds, 1))
