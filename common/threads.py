"""Waiting for threads that must end before the process does."""

import threading
import time
from collections.abc import Iterable


def join_all(threads: Iterable[threading.Thread], timeout_s: float) -> None:
    """Wait until these threads have ended, for at most `timeout_s` in total. The calling thread is skipped.

    A thread that ends at the same time as the process can crash it: OpenSSL 3.0 then frees the data of the
    thread twice, and glibc aborts the process.
    """
    until_s = time.monotonic() + timeout_s
    for thread in threads:
        if thread is not threading.current_thread():
            thread.join(max(0.0, until_s - time.monotonic()))
