"""Processes that compute for a command: they end without a word at Ctrl-C, and when the command is killed."""

import contextlib
import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from multiprocessing import parent_process, resource_tracker

PR_SET_PDEATHSIG = 1  # prctl(2)


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
    """Called first in a child: from now on Ctrl-C ends it. The command says that it was interrupted.

    A child would wait for work for ever if the command were killed: it holds both ends of its pipe.
    So it is killed when the thread ends that started it, which must be the main thread of the command.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
        command = parent_process()
        if command is not None and os.getppid() != command.pid:  # it was killed before
            signal.raise_signal(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
