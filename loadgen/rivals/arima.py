"""A line on the size, and a time series of its residuals: ARIMA."""

import math
import threading
import warnings
from typing import NamedTuple

import numpy as np
from numpy.linalg import LinAlgError

from offboard.common.errors import MissingExtra
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction

try:
    from statsmodels.tsa.arima.model import ARIMA
    from threadpoolctl import ThreadpoolController  # type: ignore[import-untyped]
except ImportError as error:
    raise MissingExtra("predictor arima", "learned") from error

OBSERVATIONS_MIN = 20  # for a series
LIKELIHOODS_MAX = 300  # evaluations in one fit; 50 to 200 are usual
PARAMETER_MAX = 0.999  # if all parameters are smaller, the series is stationary and invertible
FLAT = 1e-9  # residuals below this share of the times are rounding errors, not a series
FITTING = threading.Lock()  # a fit changes threads and warnings of the whole process, and restores them
# With two threads, a fit on 50 observations took three times as long.
BLAS = ThreadpoolController()


class Arima(Refitted):
    """Least squares of seconds on size, plus ARIMA(1,0,1) on its residuals in the order of observation.

    The times of tasks depend mostly on their size, so the line comes first. Its residuals have mean 0, so the
    series has no constant.
    Both are fitted again after a quarter as many observations as the last fit had. Between fits, each
    observation updates the state of the series.
    The prediction is the line plus the forecast of the residual `ahead` steps later, which fades to 0. It is
    the line alone with fewer than OBSERVATIONS_MIN observations, if the estimate fails, and if it is barely
    stationary or invertible.
    The spread is the standard deviation of the forecast errors one step ahead, over the window.
    """

    refit_share = 4

    def _fit(self, sizes: Column, seconds: Column) -> None:
        self._line, left = fit_line(sizes, seconds)
        self._series: Series | None = None
        if len(left) >= OBSERVATIONS_MIN and left.std() > FLAT * seconds.max():
            self._series, left = fit_series(left)
        self._spread = math.sqrt(float(left @ left) / (len(left) - 2)) if len(left) > 2 else None

    def _follow(self, size: float, seconds: float) -> None:
        if self._series:
            self._series.follow(seconds - self._line.at(size))

    def _estimate(self, size: float, ahead: int) -> Prediction:
        residual = self._series.forecast(ahead) if self._series else 0.0
        return Prediction(self._line.at(size) + residual, self._spread)


class Line(NamedTuple):
    """Through (size, seconds)."""

    size: float
    seconds: float
    slope: float

    def at(self, size: float) -> float:
        return self.seconds + self.slope * (size - self.size)


class Series:
    """Forecasts of an ARMA(1,1) that follow each observation.

    r = phi r' + e + theta e', where r' and e' are one step earlier, and e are the errors one step ahead.
    """

    def __init__(self, phi: float, theta: float, value: float, error: float) -> None:
        """`value` and `error`: the last r and e."""
        self._phi, self._theta = phi, theta
        self._value, self._error = value, error

    def follow(self, value: float) -> None:
        self._error = value - self.forecast(1)
        self._value = value

    def forecast(self, ahead: int) -> float:
        """The expected r, `ahead` steps after the last observation."""
        following = self._phi * self._value + self._theta * self._error
        return following * self._phi ** (ahead - 1)


def fit_line(sizes: Column, seconds: Column) -> tuple[Line, Column]:
    """The line of least squares and its residuals. The slope is 0 if all sizes are equal."""
    low, width = float(sizes.min()), float(np.ptp(sizes))
    x = (sizes - low) / width if width > SIZE_MIN else np.zeros(len(sizes))
    mean_x, mean_y = float(x.mean()), float((seconds - seconds[0]).mean())
    dx, dy = x - mean_x, seconds - seconds[0] - mean_y
    slope = float(dx @ dy) / float(dx @ dx) if width > SIZE_MIN else 0.0
    line = Line(low, float(seconds[0]) + mean_y - slope * mean_x, slope / (width or 1.0))
    return line, dy - slope * dx


def fit_series(residuals: Column) -> tuple[Series | None, Column]:
    """The series by maximum likelihood and its errors one step ahead; None if it cannot be used."""
    scale = float(residuals.std())
    with FITTING, warnings.catch_warnings(), BLAS.limit(limits=1, user_api="blas"):
        # They warn of starting values, the limit, and 0/0. The check of the parameters below is enough.
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            model = ARIMA(residuals / scale, order=(1, 0, 1), trend="n", concentrate_scale=True)
            found = model.fit(cov_type="none", method_kwargs={"maxfun": LIKELIHOODS_MAX})
        except (LinAlgError, ValueError):
            return None, residuals
    phi, theta = found.params.tolist()
    errors = scale * np.asarray(found.resid, dtype=np.float64)
    # Written as `not all(.. < ..)`, so that NaN fails too.
    if not all(abs(one) < PARAMETER_MAX for one in (phi, theta)) or not np.isfinite(errors).all():
        return None, residuals
    return Series(phi, theta, float(residuals[-1]), float(errors[-1])), errors
