"""Policies that several robots share: one on a simulated GPU, and a real network on the CPU.

A run on the simulated GPU takes 130 ms and 22 ms more for each input, and no CPU time. So eight inputs in one
run take 306 ms, and one after the other 1,216 ms. The two numbers stand for a large policy; a real one takes
its own. `cloud-server --tasks examples.shared_gpu --workers 1` serves both.
"""

import time
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from offboard import Together, task

RUN_S, INPUT_S = 0.130, 0.022
UNITS, LAYERS = 2048, 12  # of the network: 200 MB of weights

Floats = NDArray[np.float32]


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


class Network:
    """A real network with random weights: a run reads all of them, however many inputs it has."""

    def __init__(self) -> None:
        draw = np.random.default_rng(1)
        self._layers = [draw.standard_normal((UNITS, UNITS), np.float32) / UNITS**0.5 for _ in range(LAYERS)]

    def run(self, inputs: Sequence[Floats]) -> list[Floats]:
        values = np.stack(inputs)
        for layer in self._layers:
            values = np.tanh(values @ layer)
        return list(values)


def run_all(network: Network, inputs: list[Floats]) -> list[Floats]:
    return network.run(inputs)


@task(
    "network",
    size=lambda _: 1.0,
    setup=Network,
    together=Together(run_all, at_most=8, wait_s=0.01),
    covers=(Network,),
)
def network(state: Network, one: Floats) -> Floats:
    return state.run([one])[0]


@task("network_alone", size=lambda _: 1.0, setup=Network, covers=(Network,))
def network_alone(state: Network, one: Floats) -> Floats:
    return state.run([one])[0]
