"""A task whose work a process multiplies: what is quick on a server is slow onboard, by any factor."""

import hashlib

from offboard.common.tasks import task

times = 1  # as much work here


@task("hash_slowly", size=float)
def hash_slowly(rounds: int) -> bytes:
    """So many rounds of PBKDF2, without the interpreter's lock, as many times as this process is slow."""
    for _ in range(times):
        found = hashlib.pbkdf2_hmac("sha256", b"offboard", b"three sites", rounds)
    return found
