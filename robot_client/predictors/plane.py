"""Multiple linear regression: seconds on several numbers, as `LeastSquares` does it where a size has them.

A line on one number is in `least_squares`.
"""

import math
from collections import deque
from typing import TYPE_CHECKING, NamedTuple

from offboard.robot_client.predictors.base import ROUNDING, SIZE_MIN, Prediction

if TYPE_CHECKING:  # --help loads every predictor, but not numpy
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[np.float64]

Numbers = tuple[float, ...]


class Plane:
    """p = c + m_1 d_1 + ... + m_k d_k by least squares over the last `window` executions.

    It is the solution of `numpy.linalg.lstsq` for the rows (1, z_1, ..., z_k), where z is d minus its mean,
    in units of its range. If the window does not determine all slopes (numbers that depend on each other, few
    rows), that is the solution with the smallest sum of squared slopes. A prediction that the window does
    determine is the same with z as with d. The others do not depend on the unit of a number with z, and a
    constant number has slope 0, as it has on a line.
    """

    def __init__(self, window: int) -> None:
        self._rows: deque[tuple[Numbers, float]] = deque(maxlen=window)
        self._fit: _Fit | None = None

    @property
    def full(self) -> bool:
        return len(self._rows) == self._rows.maxlen

    def __len__(self) -> int:
        return len(self._rows)

    def learn(self, numbers: Numbers, seconds: float) -> None:
        """ValueError if there are more or fewer numbers than before."""
        if self._rows and len(numbers) != len(self._rows[0][0]):
            raise ValueError(f"size {numbers} after sizes of {len(self._rows[0][0])} numbers")
        self._rows.append((numbers, seconds))
        self._fit = None

    def predict(self, numbers: Numbers) -> Prediction | None:
        if not self._rows:
            return None
        if self._fit is None:
            self._fit = _fit([row for row, _ in self._rows], [seconds for _, seconds in self._rows])
        return self._fit.at(numbers)


class _Fit(NamedTuple):
    """A fitted plane. `span` is the range of each number, and infinite if it is constant.

    `inverse`: the pseudo-inverse of the fitted rows, from which the standard error of a prediction follows.
    """

    lowest: "Array"
    span: "Array"
    mean: "Array"
    slopes: "Array"
    intercept: float
    spread_s: float | None
    inverse: "Array"

    def at(self, numbers: Numbers) -> Prediction:
        z = (numbers - self.lowest) / self.span - self.mean
        seconds = self.intercept + float(z @ self.slopes)
        if self.spread_s is None:
            return Prediction(seconds, None)
        weights = self.inverse[0] + z @ self.inverse[1:]  # of the learned times in this prediction
        return Prediction(seconds, self.spread_s, self.spread_s * math.sqrt(float(weights @ weights)))


def _fit(rows: list[Numbers], times_s: list[float]) -> _Fit:
    import numpy as np  # not for --help

    sizes, seconds = np.array(rows), np.array(times_s)
    lowest, highest = sizes.min(axis=0), sizes.max(axis=0)
    span = highest - lowest
    span[span <= np.maximum(ROUNDING * highest, SIZE_MIN)] = math.inf
    shares = (sizes - lowest) / span  # before the mean is taken, which would round small differences away
    mean = shares.mean(axis=0)
    known = np.column_stack([np.ones(len(seconds)), shares - mean])
    found, _, rank, _ = np.linalg.lstsq(known, seconds, rcond=None)
    free = len(seconds) - int(rank)
    rest = seconds - known @ found
    spread_s = math.sqrt(float(rest @ rest) / free) if free > 0 else None
    return _Fit(
        lowest=lowest,
        span=span,
        mean=mean,
        slopes=found[1:],
        intercept=float(found[0]),
        spread_s=spread_s,
        inverse=np.linalg.pinv(known),
    )
