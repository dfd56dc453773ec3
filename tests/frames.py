"""A task that takes frames, and inputs for it. Its answers count as the same within a tolerance."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.common.tasks import task

SHAPE = (480, 640)
BRIGHTER = 0.5  # grey levels by which two answers may differ

Frame = NDArray[np.uint8]


@task("brightness", size=lambda frame, gain=1.0: frame.size)  # noqa: ARG005 - the gain changes no time
def brightness(frame: Frame, gain: float = 1.0) -> dict[str, float]:
    return {"mean": gain * float(frame.mean())}


@task("copied", size=lambda frame: frame.size)
def copied(frame: Frame) -> Frame:
    """An answer that is too large to be kept whole."""
    return frame.copy()


def same(a: Any, b: Any) -> bool:
    """Whether two answers of a task are equal within the tolerance."""
    if isinstance(a, dict):
        return abs(a["mean"] - b["mean"]) <= BRIGHTER
    return bool(np.array_equal(a, b))


def frames(seed: int) -> Iterator[Frame]:
    """Endless frames, dark and bright ones, each one the only argument."""
    random = np.random.default_rng(seed)
    while True:
        yield random.integers(0, random.integers(50, 255), SHAPE, np.uint8)


def with_gain(seed: int) -> list[tuple[Frame, float]]:
    """Three calls with two arguments."""
    given = frames(seed)
    return [(next(given), gain) for gain in (1.0, 2.0, 3.0)]


def broken(seed: int) -> Iterator[Frame]:
    """Two frames, and then the camera is gone."""
    given = frames(seed)
    yield next(given)
    yield next(given)
    raise OSError("no camera")


def unfit(seed: int) -> Iterator[tuple[Any, ...]]:
    """The second call has too many arguments."""
    frame = next(frames(seed))
    yield (frame,)
    yield frame, 1.0, "too many"


def no_seed() -> list[int]:
    return []


def nothing(seed: int) -> list[Frame]:  # noqa: ARG001 - a camera that is off
    """No input."""
    return []
