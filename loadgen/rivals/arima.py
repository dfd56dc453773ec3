"""A line on the size, and a time series of its residuals: ARIMA and SARIMA."""

import math
import threading
import warnings
from collections import deque
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
    raise MissingExtra("predictor arima or sarima", "learned") from error

REFIT_SHARE = 4  # the next fit comes after a quarter as many observations as the last one had
AHEAD_MAX = 200  # steps of a forecast; later tasks get the forecast of the last step
LIKELIHOODS_MAX = 300  # evaluations in one fit; 50 to 200 are usual
PARAMETER_MAX = 0.999  # if all parameters are smaller, the series is stationary and invertible
FLAT = 1e-9  # residuals below this share of the times are rounding errors, not a series
FITTING = threading.Lock()  # a fit changes threads and warnings of the whole process, and restores them
# With several threads the 12 x 12 matrices of a season took 7 times as long, and longer on a busy machine.
BLAS = ThreadpoolController()


class Arima(Refitted):
    """Least squares of seconds on size, plus ARIMA(1,0,1) on its residuals in the order of observation.

    The times of tasks depend mostly on their size, so the line comes first. Its residuals have mean 0, so the
    series has no constant.
    Both are fitted again after a quarter as many observations as the last fit had. Between fits, each
    observation updates the state of the series.
    The prediction is the line plus the forecast of the residual `ahead` steps later, which fades to 0. It is
    the line alone with fewer than `observations_min` observations, if the estimate fails, and if it is barely
    stationary or invertible.
    The spread is the standard deviation of the forecast errors one step ahead, over the window.
    """

    season = 0
    observations_min = 20

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        super().__init__(window, REFIT_SHARE)

    def _fit(self, sizes: Column, seconds: Column) -> None:
        self._line, left = fit_line(sizes, seconds)
        self._series: Series | None = None
        if len(left) >= self.observations_min and left.std() > FLAT * seconds.max():
            self._series, left = fit_series(left, self.season)
        self._spread = math.sqrt(float(left @ left) / (len(left) - 2)) if len(left) > 2 else None

    def _follow(self, size: float, seconds: float) -> None:
        if self._series:
            self._series.follow(seconds - self._line.at(size))

    def _estimate(self, size: float, ahead: int) -> Prediction:
        residual = self._series.forecast(ahead) if self._series else 0.0
        return Prediction(self._line.at(size) + residual, self._spread)


class Sarima(Arima):
    """The same with SARIMA(1,0,1)x(1,0,1) of ten tasks a season.

    Tasks have no natural season. Ten stands for anything that repeats, such as the rounds of a robot.
    """

    season = 10
    observations_min = 50  # five seasons


class Line(NamedTuple):
    """Through (size, seconds)."""

    size: float
    seconds: float
    slope: float

    def at(self, size: float) -> float:
        return self.seconds + self.slope * (size - self.size)


class Series:
    """Forecasts of a multiplicative ARMA(1,1)x(1,1) that follow each observation.

    phi(B) PHI(B^season) r = theta(B) THETA(B^season) e, where e are the errors one step ahead. Season 0 means
    no season. The multiplied polynomials reach back `season` + 1 steps, so that many r and e are kept.
    """

    def __init__(
        self, parameters: list[float], season: int, values: list[float], errors: list[float]
    ) -> None:
        """`parameters`: phi, theta, and with a season PHI, THETA; `values` and `errors`: r and e so far."""
        phi, theta, *seasonal = parameters
        self._weights = [(1, phi, theta)]  # lag, weight of r, weight of e
        if season:
            s_phi, s_theta = seasonal
            self._weights += [(season, s_phi, s_theta), (season + 1, -phi * s_phi, theta * s_theta)]
        self._values = deque(values[-season - 1 :], maxlen=season + 1)
        self._errors = deque(errors[-season - 1 :], maxlen=season + 1)

    def follow(self, value: float) -> None:
        """Take in the next r."""
        error = value - self._next(self._values, self._errors)
        self._values.append(value)
        self._errors.append(error)

    def forecast(self, ahead: int) -> float:
        """The expected r, `ahead` steps after the last observation."""
        values, errors = self._values.copy(), self._errors.copy()
        for _ in range(min(ahead, AHEAD_MAX)):
            values.append(self._next(values, errors))
            errors.append(0.0)
        return values[-1]

    def _next(self, values: deque[float], errors: deque[float]) -> float:
        return sum(ar * values[-lag] + ma * errors[-lag] for lag, ar, ma in self._weights)


def fit_line(sizes: Column, seconds: Column) -> tuple[Line, Column]:
    """The line of least squares and its residuals. The slope is 0 if all sizes are equal."""
    low, width = float(sizes.min()), float(np.ptp(sizes))
    x = (sizes - low) / width if width > SIZE_MIN else np.zeros(len(sizes))
    mean_x, mean_y = float(x.mean()), float((seconds - seconds[0]).mean())
    dx, dy = x - mean_x, seconds - seconds[0] - mean_y
    slope = float(dx @ dy) / float(dx @ dx) if width > SIZE_MIN else 0.0
    line = Line(low, float(seconds[0]) + mean_y - slope * mean_x, slope / (width or 1.0))
    return line, dy - slope * dx


def fit_series(residuals: Column, season: int) -> tuple[Series | None, Column]:
    """The series by maximum likelihood and its errors one step ahead; None if it cannot be used."""
    scale = float(residuals.std())
    seasonal = (1, 0, 1, season) if season else (0, 0, 0, 0)
    with FITTING, warnings.catch_warnings(), BLAS.limit(limits=1, user_api="blas"):
        # They warn of starting values, the limit, and 0/0. The check of the parameters below is enough.
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("ignore", RuntimeWarning)
        try:
            model = ARIMA(
                residuals / scale, order=(1, 0, 1), seasonal_order=seasonal, trend="n", concentrate_scale=True
            )
            found = model.fit(cov_type="none", method_kwargs={"maxfun": LIKELIHOODS_MAX})
        except (LinAlgError, ValueError):
            return None, residuals
    parameters = found.params.tolist()
    errors = scale * np.asarray(found.resid, dtype=np.float64)
    # Written as `not all(.. < ..)`, so that NaN fails too.
    if not all(abs(parameter) < PARAMETER_MAX for parameter in parameters) or not np.isfinite(errors).all():
        return None, residuals
    return Series(parameters, season, residuals.tolist(), errors.tolist()), errors
