"""A task of perception: it finds the brightest spot of an image. Robot and server load this module."""

import numpy as np
from numpy.typing import NDArray

from offboard import task

BLUR = 9  # pixels: a single bright pixel is noise


@task("brightest_spot", size=lambda image: image.size)
def brightest_spot(image: NDArray[np.uint8]) -> list[int]:
    sums = np.cumsum(np.cumsum(image.astype(np.int64), axis=0), axis=1)
    boxes = sums[BLUR:, BLUR:] - sums[:-BLUR, BLUR:] - sums[BLUR:, :-BLUR] + sums[:-BLUR, :-BLUR]
    row, col = np.unravel_index(boxes.argmax(), boxes.shape)
    return [int(row) + 1 + BLUR // 2, int(col) + 1 + BLUR // 2]
