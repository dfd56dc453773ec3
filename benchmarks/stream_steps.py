"""The time of `see` and `next` while an onboard policy computes, next to a thread that only sleeps."""

import os
import time
from collections.abc import Callable

import numpy as np

from benchmarks.measure import Requirement, Table
from offboard import Offloader, task

HZ, HORIZON = 200.0, 200
STEPS = 4_000
POLICY_S = 0.15  # for which the policy computes
WIDTH = 256  # of its matrices
SEE_US, NEXT_US, LATE_MS = 20.0, 10.0, 1.0
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


@task("act_in_numpy", size=lambda observation: observation.size)
def act_in_numpy(observation: np.ndarray) -> np.ndarray:
    """Matrix products, during which NumPy releases the interpreter."""
    until_s, weights = time.perf_counter() + POLICY_S, np.full((WIDTH, WIDTH), 1e-3)
    found = weights
    while time.perf_counter() < until_s:
        found = np.tanh(found @ weights)
    return np.full((HORIZON, 7), found[0, 0] + observation[0])


@task("act_in_python", size=lambda observation: observation.size)
def act_in_python(observation: np.ndarray) -> np.ndarray:
    """Pure Python, which holds the interpreter."""
    until_s, found = time.perf_counter() + POLICY_S, 0.0
    while time.perf_counter() < until_s:
        found += 1e-9
    return np.full((HORIZON, 7), found + observation[0])


def times(policy: Callable[..., np.ndarray] | None) -> tuple[np.ndarray, np.ndarray]:
    """The seconds of each `see` and of each `next` of a loop; without a policy, of two sleeps of 0."""
    seen, played = np.empty(STEPS), np.empty(STEPS)
    observation, see, advance = np.zeros(7), time.sleep, time.sleep
    with Offloader.connect() as offload:
        stream = None
        if policy is not None:
            stream = offload.stream(policy, hz=HZ, horizon=HORIZON)
        start_s = time.perf_counter()
        for n in range(STEPS):
            before_s = time.perf_counter()
            see(0) if stream is None else stream.see(observation)
            between_s = time.perf_counter()
            advance(0) if stream is None else stream.next()
            after_s = time.perf_counter()
            seen[n], played[n] = between_s - before_s, after_s - between_s
            time.sleep(max(0.0, start_s + (n + 1) / HZ - time.perf_counter()))
        if stream is not None:
            stream.close()
    return seen, played


def tables() -> list[Table]:
    rows, required = [], []
    for name, policy in (("a sleep of 0", None), ("NumPy", act_in_numpy), ("pure Python", act_in_python)):
        seen, played = times(policy)
        see_us, next_us = 1e6 * float(np.median(seen)), 1e6 * float(np.median(played))
        late_ms = 1e3 * float(np.quantile(played, 0.999))
        rows.append([name, f"{see_us:.1f}", f"{next_us:.1f}", f"{late_ms:.2f}"])
        if policy is act_in_numpy:
            required = [
                Requirement("see, median", see_us, SEE_US, "us"),
                Requirement("next, median", next_us, NEXT_US, "us"),
                Requirement("next, P99.9", late_ms, LATE_MS, "ms"),
            ]
    columns = ["policy onboard", "see, median us", "next, median us", "next, P99.9 ms"]
    return [Table(f"Steps of a stream at {HZ:g} Hz", columns, rows, required)]
