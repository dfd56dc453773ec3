"""A policy on a simulated GPU: a run takes 130 ms and 22 ms more for each input, and no CPU time.

So eight inputs in one run take 306 ms, and one after the other 1,216 ms. The two numbers stand for a large
policy; a real one takes its own. `cloud-server --tasks examples.shared_gpu --workers 1` serves it.
"""

import time

from offboard import Together, task

RUN_S, INPUT_S = 0.130, 0.022


def infer_all(inputs: list[float]) -> list[float]:
    time.sleep(RUN_S + INPUT_S * len(inputs))
    return [2.0 * one for one in inputs]


@task("infer", size=lambda _: 1.0, together=Together(infer_all, at_most=8, wait_s=0.01))
def infer(one: float) -> float:
    return infer_all([one])[0]


@task("infer_at_once", size=lambda _: 1.0, together=Together(infer_all, at_most=8, wait_s=0.0))
def infer_at_once(one: float) -> float:
    return infer_all([one])[0]


@task("infer_alone", size=lambda _: 1.0)
def infer_alone(one: float) -> float:
    return infer_all([one])[0]
