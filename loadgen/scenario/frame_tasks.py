"""Tasks on camera frames for scenarios: many bytes that cannot be compressed, and real CPU work.

The robot takes them with `--task offboard.loadgen.scenario.frame_tasks:NAME` and `--inputs ..:frames`.
"""

import os
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from offboard.common.tasks import task
from offboard.loadgen.scenario.hash_tasks import hashed, hashed_in_steps
from offboard.loadgen.testbed.testbed import PART, ROBOT, kind_of

FRAME_BYTES = (100_000, 1_000_000)  # smallest and largest
IMAGE_BYTES = 900_000
BYTES_PER_ROUND = 10  # 1 MB takes about 25 ms on a whole CPU
IMAGE_ROUNDS = 80_000  # about 20 ms
WITHOUT_ACCELERATOR = 20  # times as many rounds on a robot

Bytes = NDArray[np.uint8]


@task("look_at_frame", size=lambda frame: float(frame.nbytes))
def look_at_frame(frame: Bytes) -> bytes:
    """Looks for something in a frame, as AprilTags or registration do: the time grows with the bytes."""
    return hashed(frame_rounds(frame))


@task("judge_image", size=lambda image: float(image.nbytes))
def judge_image(image: Bytes) -> bytes:  # noqa: ARG001 - the time does not depend on it
    """A network on an image: WITHOUT_ACCELERATOR times slower on a robot than on the server."""
    return hashed_in_steps(IMAGE_ROUNDS, image_rounds(os.environ.get(PART, "")))


def frames(seed: int) -> Iterator[Bytes]:
    """Frames of 0.1 to 1 MB."""
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, 256, random.integers(*FRAME_BYTES), np.uint8)


def images(seed: int) -> Iterator[Bytes]:
    """Images of 0.9 MB."""
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, 256, IMAGE_BYTES, np.uint8)


def frame_rounds(frame: Bytes) -> int:
    return frame.nbytes // BYTES_PER_ROUND


def image_rounds(part: str) -> int:
    return IMAGE_ROUNDS * (WITHOUT_ACCELERATOR if kind_of(part) == ROBOT else 1)
