"""The input and the result of a search: hits of a scan, and routes, both in cells.

`planner` turns scans in metres into hits, and routes into plans.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Cell = tuple[int, int]  # row, column


@dataclass(frozen=True, slots=True)
class Hits:
    """Cells that a scan saw occupied. The robot cannot be within `reach` cells of them."""

    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    reach: NDArray[np.float64]


NO_HITS = Hits(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.float64))


@dataclass(frozen=True, slots=True)
class Route:
    """A path over cells, or the reason why there is none.

    `cells` are (row, column) from start to goal; they are empty unless `status` is NONE. `cost` is in cells.
    """

    status: str
    cells: NDArray[np.int32]
    cost: float
    expanded: int


def no_route(status: str, expanded: int = 0) -> Route:
    return Route(status, np.zeros((0, 2), np.int32), 0.0, expanded)
