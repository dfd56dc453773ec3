"""Lines that outliers do not bend: Theil-Sen and Huber."""

import math
from typing import NamedTuple

import numpy as np

from offboard.common.errors import ConfigError
from offboard.loadgen.rivals.refitted import Column, Refitted
from offboard.robot_client.predictors.base import SIZE_MIN, Prediction

SAMPLE = 1_000  # values that show roughly where the median of many more lies


class _Line(NamedTuple):
    """Through (size, seconds)."""

    size: float
    seconds: float
    slope: float
    spread_s: float | None


class _Straight(Refitted):
    """Base of the predictors whose model is one line."""

    _line: _Line

    def _estimate(self, size: float, ahead: int) -> Prediction:  # noqa: ARG002 - not a time series
        line = self._line
        return Prediction(line.seconds + line.slope * (size - line.size), line.spread_s)


class TheilSen(_Straight):
    """The median of the slopes between all pairs of different sizes, through the medians of size and seconds.

    It tolerates up to 29 % outliers. A fit compares N (N - 1) / 2 pairs, so the window is at most WINDOW_MAX.
    The spread is 1.4826 times the median absolute deviation of the residuals, which is the standard deviation
    of normal residuals.
    """

    WINDOW_MAX = 2_000
    PAIR_ROWS = 64  # rows of the table of pairs that are computed at a time, to stay in the cache
    MAD_TO_DEVIATION = 1.4826

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        super().__init__(window)
        if window > self.WINDOW_MAX:
            raise ConfigError(f"window {window}: theil-sen compares all pairs, so at most {self.WINDOW_MAX}")

    def _fit(self, sizes: Column, seconds: Column) -> None:
        slopes = self._slopes(sizes, seconds)
        slope = median(slopes) if len(slopes) else 0.0
        size, middle = median(sizes), median(seconds)
        spread = None
        if len(sizes) > 2:
            residuals = seconds - middle - slope * (sizes - size)
            spread = self.MAD_TO_DEVIATION * median(np.abs(residuals - median(residuals)))
        self._line = _Line(size, middle, slope, spread)

    def _slopes(self, sizes: Column, seconds: Column) -> Column:
        order = np.argsort(sizes)
        d, t = sizes[order], seconds[order]
        found = []
        for start in range(0, len(d), self.PAIR_ROWS):
            rows = slice(start, start + self.PAIR_ROWS)
            run, rise = d[start:] - d[rows, np.newaxis], t[start:] - t[rows, np.newaxis]
            with np.errstate(all="ignore"):  # pairs of equal sizes divide by 0
                found.append((rise / run)[run > SIZE_MIN])
        return np.concatenate(found)


class Huber(_Straight):
    """Huber's loss with line and scale estimated together: Owen (2007), "A robust hybrid of lasso and ridge".

    It minimises sum(sigma + H(r / sigma) sigma) over line and sigma. H(z) is z^2 up to EPSILON and a straight
    line beyond. This is the estimate of scikit-learn's HuberRegressor without its penalty.
    The spread is sigma, scaled to the standard deviation of normal residuals.
    """

    # The a with E min((a z)^2, EPSILON^2) = 1 for a standard normal z, from the condition on sigma.
    SIGMA_TO_DEVIATION = 1.4678769535134695

    def __init__(self, window: int, seed: int = 0) -> None:  # noqa: ARG002 - nothing is random
        super().__init__(window)

    def _fit(self, sizes: Column, seconds: Column) -> None:
        low_d, low_t = float(sizes.min()), float(seconds.min())
        width, height = float(sizes.max()) - low_d, float(seconds.max()) - low_t
        x = (sizes - low_d) / width if width > SIZE_MIN else np.zeros(len(sizes))
        y = (seconds - low_t) / (height or 1.0)
        intercept, slope, sigma = huber_line(x, y)
        spread = self.SIGMA_TO_DEVIATION * height * sigma if len(x) > 2 else None
        self._line = _Line(low_d, low_t + height * intercept, height * slope / (width or 1.0), spread)


EPSILON = 1.35  # residuals beyond this many sigma are outliers
STEPS_MAX = 50  # 3 to 8 are usual
HALVINGS_MAX = 30
TOLERANCE = 1e-10  # the last step moves no parameter by more sigmas than this
SHRINK_MAX = 0.1  # one step leaves at least this share of sigma: the first inliers may lie on a line
SINGULAR = 1e-8  # inliers with less than this share of the variance of all sizes do not fix the slope ...
DAMPING = 1e-5  # ... which then moves as if they had this share
EXACT = 2.0**-48  # residuals below this share of the values are rounding errors


class _Fit(NamedTuple):
    intercept: float
    slope: float
    sigma: float


def huber_line(x: Column, y: Column) -> tuple[float, float, float]:
    """Intercept, slope and sigma of the joint estimate, for x and y within 0..1. An exact fit has sigma 0.

    The objective is convex and made of pieces. A piece is given by which residuals are outliers, and on which
    side of the line. Its minimum has a closed form. Newton's method steps towards that minimum, and halves a
    step that does not lower the objective.
    """
    fit = _step(x, y, _Fit(0.0, 0.0, 0.0), np.zeros(len(x)), sigma_min=0.0)
    last = None
    for _ in range(STEPS_MAX):
        if fit.sigma == 0:
            break
        residuals = y - fit.intercept - fit.slope * x
        sides = np.sign(residuals) * (np.abs(residuals) > EPSILON * fit.sigma)
        same = last is not None and np.array_equal(sides, last)
        aim = _step(x, y, fit, sides, sigma_min=0.0 if same else SHRINK_MAX * fit.sigma)
        new = _shorten(x, y, fit, aim)
        moved = max(abs(now - was) for now, was in zip(new, fit, strict=True))
        settled = moved <= TOLERANCE * fit.sigma
        fit, last = new, sides
        if settled:
            break
    return fit


def _step(x: Column, y: Column, fit: _Fit, sides: Column, *, sigma_min: float) -> _Fit:
    """The minimum of one piece: inliers count by squares, outliers by a constant pull.

    `sides` is -1 or 1 for outliers and 0 for inliers. For a given sigma, the line is that of least squares on
    the inliers plus sigma times a tilt from the pull. That leaves `room` sigma + rss / sigma to minimise.
    """
    inliers = (sides == 0).astype(np.float64)
    count = float(inliers.sum())
    if not count:
        return fit._replace(sigma=2 * fit.sigma)
    mean_x, mean_y = float(inliers @ x) / count, float(inliers @ y) / count
    dx = x - mean_x
    inner = inliers * dx
    sxx, all_sxx = float(inner @ dx), float(dx @ dx)
    damping = DAMPING * all_sxx if sxx < SINGULAR * all_sxx else 0.0
    pull, torque = float(sides.sum()), float(sides @ dx)
    lift, tilt, slope = EPSILON * pull / count, 0.0, 0.0
    if sxx + damping > 0:
        tilt = EPSILON * torque / (sxx + damping)
        slope = (float(inner @ (y - mean_y)) + damping * fit.slope) / (sxx + damping)
    residuals = inliers * (y - mean_y - slope * dx)
    rss = float(residuals @ residuals) + damping * (slope - fit.slope) ** 2
    room = len(x) - (len(x) - count) * EPSILON**2 - EPSILON * (pull * lift + torque * tilt)
    if room <= 0:
        sigma = 2 * fit.sigma  # the piece has no minimum: move on to the next one
    elif rss <= EXACT**2 * float(inliers @ (y * y)):
        sigma = 0.0
    else:
        sigma = math.sqrt(rss / room)
    sigma = max(sigma, sigma_min)
    slope += sigma * tilt
    return _Fit(mean_y + sigma * lift - slope * mean_x, slope, sigma)


def _shorten(x: Column, y: Column, fit: _Fit, aim: _Fit) -> _Fit:
    """The first of `aim`, half the step, a quarter .. that costs no more than `fit`; else `fit`."""
    most = _cost(x, y, fit) * (1 + EXACT)
    for _ in range(HALVINGS_MAX):
        if _cost(x, y, aim) <= most:
            return aim
        aim = _Fit(*((old + new) / 2 for old, new in zip(fit, aim, strict=True)))
    return fit


def _cost(x: Column, y: Column, fit: _Fit) -> float:
    """The objective. At sigma = 0 it is the limit, the sum of absolute residuals."""
    far = np.abs(y - fit.intercept - fit.slope * x)
    if fit.sigma == 0:
        return 2 * EPSILON * float(far.sum())
    near = np.minimum(far, EPSILON * fit.sigma)
    return len(x) * fit.sigma + float(near @ near) / fit.sigma + 2 * EPSILON * float((far - near).sum())


def median(values: Column) -> float:
    """The exact median. Among many values, only those near the middle of a sample are sorted."""
    half, even = len(values) // 2, len(values) % 2 == 0
    if len(values) > 5 * SAMPLE:
        sample = np.sort(values[:: len(values) // SAMPLE])
        low, high = sample[len(sample) * 44 // 100], sample[len(sample) * 56 // 100]
        below = int(np.count_nonzero(values < low))
        between = values[(values >= low) & (values <= high)]
        if below < half < below + len(between):  # otherwise the sample misled
            values, half = between, half - below
    parted = np.partition(values, half)
    upper = float(parted[half])
    return (float(parted[:half].max()) + upper) / 2 if even else upper
