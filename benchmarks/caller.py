"""A process that calls one server as often as it is asked to, with new data in each call.

It needs only NumPy, so that it also runs in the environment of a peer with an old NumPy.
"""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

Call = Callable[[Any], int]  # with an array, or None for an empty call; returns the bytes that the server got

ARRAYS = 2  # that a thread sends in turns
KEYS_MAX = 2**63


def answer_orders(connect: Callable[[], Call]) -> None:
    """Print "ready"; for each line `SIZE COUNT TOGETHER`, make the calls and print the seconds of one.

    `TOGETHER` threads make them, each on a connection of its own from `connect`.
    """
    print("ready", flush=True)
    calls: list[Call] = []
    for line in sys.stdin:
        size, count, together = map(int, line.split())
        calls += [connect() for _ in range(together - len(calls))]
        print(_seconds(calls[:together], size, count), flush=True)


def _seconds(calls: Sequence[Call], size: int, count: int) -> float:
    """The seconds of one call. Making the data counts only if several threads call at once."""
    each, took_s, wrong = count // len(calls), list[float](), list[object]()
    begin = threading.Barrier(len(calls) + 1)
    threads = [
        threading.Thread(target=_make, args=(call, (n, size, each), begin, took_s, wrong), daemon=True)
        for n, call in enumerate(calls)
    ]
    for thread in threads:
        thread.start()
    begin.wait()
    began_s = time.perf_counter()
    for thread in threads:
        thread.join()
    all_s = took_s[0] if len(calls) == 1 else time.perf_counter() - began_s
    if wrong:
        raise RuntimeError(f"{len(wrong)} of {count} answers were wrong, for example {wrong[0]!r}")
    return all_s / (each * len(calls))


def _make(
    call: Call,
    what: tuple[int, int, int],
    begin: threading.Barrier,
    took_s: list[float],
    wrong: list[object],
) -> None:
    seed, size, count = what
    random = np.random.default_rng(seed)
    noise = random.integers(0, KEYS_MAX, size // 8, np.uint64)
    arrays, all_s = [noise.copy() for _ in range(ARRAYS)], 0.0
    begin.wait()
    for n in range(count):
        array = arrays[n % ARRAYS]
        np.bitwise_xor(noise, random.integers(0, KEYS_MAX, dtype=np.uint64), out=array)
        began_s = time.perf_counter()
        try:
            got = call(array.view(np.uint8) if size else None)
        except Exception as error:  # noqa: BLE001 - the process must end
            wrong.append(error)
            break
        all_s += time.perf_counter() - began_s
        if got != size:
            wrong.append(got)
    took_s.append(all_s)
