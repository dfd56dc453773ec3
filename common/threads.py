"""Threads that must have ended before the process does."""

import threading
import time
from collections.abc import Iterable


def join_all(threads: Iterable[threading.Thread], timeout_s: float) -> None:
    """Wait until they have ended, at most so long for all of them together; the caller's own is left out.

    A thread that ends while the process does may take it down: OpenSSL (3.0) frees what it keeps for each
    thread at the end of both, and glibc aborts at the second time.
    """
    until_s = time.monotonic() + timeout_s
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join(max(0.0, until_s - time.monotonic()))
