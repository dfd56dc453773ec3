"""Measures an application by itself: times, bytes, the cost of a link, correlations, the interpreter lock.

`taskset -c 0 python -m examples.measure apriltags` uses one core. Nothing is sent.
"""

import importlib
import itertools
import sys
import threading
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numpy as np

from offboard.common.command_line import run_command
from offboard.common.errors import ConfigError
from offboard.common.tasks import Kind, first_number, kinds
from offboard.common.wire.messages import byte_count
from offboard.common.wire.values import encode

CALLS = 60
MBIT_S = 50
LOCK_CALLS = 10
REPEATS = 2  # of each call; the fastest one counts
NAMES = ("apriltags", "registration", "signs", "pose_graph", "arm")


def main() -> int:
    """Measure the applications that are named, or all."""
    for name in sys.argv[1:]:
        if name not in NAMES:
            raise ConfigError(f"{name!r} is not one of {', '.join(NAMES)}")
    for name in sys.argv[1:] or NAMES:
        measure(importlib.import_module(f"examples.{name}"))
    return 0


def measure(module: ModuleType) -> None:
    """Print the figures of one application."""
    kind = next(one for one in kinds() if one.function.__module__ == module.__name__)
    began = time.perf_counter()
    engine = () if kind.setup is None else (kind.setup(),)
    setup_s = time.perf_counter() - began
    rows = [row(kind, engine, args) for args in itertools.islice(module.inputs(1), CALLS)]
    out, back, times, sizes, work = np.array(rows).T
    link_ms = (out + back) * 8 / MBIT_S / 1e3
    print(f"{kind.name}: {len(rows)} calls, setup {setup_s:.2f} s")
    print(f"  CPU time     {spread(times * 1e3)} ms")
    print(f"  request      {spread(out / 1e3)} kB, reply {spread(back / 1e3)} kB")
    print(f"  link         {spread(link_ms)} ms at {MBIT_S} Mbit/s, without the delay")
    print(f"  time with    payload {correlation(out, times)}, size {correlation(sizes, times)}, "
          f"work {correlation(work, times)}")  # fmt: skip
    print(f"  payload with size {correlation(out, sizes)}, work {correlation(out, work)}")
    args = next(module.inputs(2))
    share, call_ms = lock_free_share(lambda: [kind.function(*engine, *args) for _ in range(LOCK_CALLS)])
    print(f"  lock         another thread ran in {share:.0%} of the milliseconds of {call_ms:.0f} ms")


def row(kind: Kind, engine: tuple[Any, ...], args: tuple[Any, ...]) -> tuple[float, ...]:
    """Bytes out, bytes back, seconds of CPU, size and work of one call.

    The engines have one thread, so the seconds of CPU are the time on a core that does nothing else.
    """
    times = []
    for _ in range(REPEATS):
        began = time.process_time()
        result = kind.function(*engine, *args)
        times.append(time.process_time() - began)
    out, back = (byte_count(encode(value, kind.types).frames) for value in (list(args), result))
    return out, back, min(times), first_number(kind.size_of(args)), kind.work_of(result) or np.nan


def spread(values: np.ndarray[Any, Any]) -> str:
    """The least, the median and the greatest of them."""
    return f"{values.min():.3g} / {np.median(values):.3g} / {values.max():.3g}"


def correlation(a: np.ndarray[Any, Any], b: np.ndarray[Any, Any]) -> str:
    """Pearson's r, or `-` where one of them is constant or unknown."""
    if not (np.isfinite(a).all() and np.ptp(a) > 0 and np.ptp(b) > 0):
        return "-"
    return f"{np.corrcoef(a, b)[0, 1]:.2f}"


def lock_free_share(call: Callable[[], object]) -> tuple[float, float]:
    """The share of milliseconds of a call in which another Python thread ran, and the call in ms."""
    over, seen = threading.Event(), []

    def tick() -> None:
        while not over.is_set():
            time.sleep(0.0005)
            seen.append(int(time.perf_counter() * 1e3))

    thread = threading.Thread(target=tick)
    thread.start()
    began = time.perf_counter()
    call()
    ended = time.perf_counter()
    over.set()
    thread.join()
    inside = {ms for ms in seen if began * 1e3 <= ms < ended * 1e3}
    return len(inside) / max(1e3 * (ended - began), 1), 1e3 * (ended - began)


if __name__ == "__main__":
    sys.exit(run_command("examples.measure", main))
