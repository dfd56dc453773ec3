"""A task that is slower in one process than in another, by any factor."""

import hashlib

from offboard.common.tasks import task

times = 1  # how much slower the task is in this process


@task("hash_slowly", size=float)
def hash_slowly(rounds: int) -> bytes:
    """Compute PBKDF2 `times` times, without holding the interpreter's lock."""
    for _ in range(times):
        found = hashlib.pbkdf2_hmac("sha256", b"offboard", b"three sites", rounds)
    return found
