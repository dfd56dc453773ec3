"""Processes that compute for a command: at Ctrl-C, which reaches them too, they end without a word."""

import contextlib
import signal
from collections.abc import Iterator
from multiprocessing import resource_tracker


@contextlib.contextmanager
def starting() -> Iterator[None]:
    """Children that start in this block hear no Ctrl-C before they call `end_quietly`.

    A child that is still importing its modules would print a traceback.
    """
    resource_tracker.ensure_running()  # else the first child starts it, which unblocks the signal
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def end_quietly() -> None:
    """Called first in a child: from now on Ctrl-C ends it. The command says that it was interrupted."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
