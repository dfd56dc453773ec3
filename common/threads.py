"""Waiting for threads that must end before the process does."""

import threading
import time
from collections.abc import Iterable


def join_all(threads: Iterable[threading.Thread], timeout_s: float) -> int:
    """Wait until these threads have ended, for at most `timeout_s` in total; returns how many still run.

    The calling thread is skipped. A thread that ends at the same time as the process can crash it: OpenSSL
    3.0 then frees the data of the thread twice, and glibc aborts the process. A thread that still runs native
    code can crash it too, because the library that it uses is taken down under it.
    """
    others = [thread for thread in threads if thread is not threading.current_thread()]
    until_s = time.monotonic() + timeout_s
    for thread in others:
        thread.join(max(0.0, until_s - time.monotonic()))
    return sum(thread.is_alive() for thread in others)
