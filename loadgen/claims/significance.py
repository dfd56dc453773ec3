"""Claim 1: the time of a task is correlated with its size, on both sites.

The test is the t-test of Pearson's r, two-sided. It takes the rows for independent of each other.
"""

import math
from collections.abc import Iterator

import numpy as np

from offboard.loadgen.claims.claim import (
    POSITIVE,
    Claim,
    Claimed,
    Figure,
    bootstrapped,
    claim,
    mean_of,
    unknown,
)
from offboard.loadgen.claims.claims_settings import ClaimsConfig
from offboard.loadgen.table import confidence_intervals, published_table_two
from offboard.loadgen.table.measured_rows import Rows
from offboard.loadgen.table.table_settings import FULL_WINDOW
from offboard.loadgen.table.table_two_figures import window_r
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

CLAIM = 1
P_MAX = 0.005  # of the paper
SHARE_MIN = 95.0  # per cent of the windows in which r must be significant
TESTED_MIN = 3  # rows; two points always lie on a line
HALVINGS = 60  # of the range in which the smallest significant r is; more would change no digit
STEPS_MAX = 10_000  # of the continued fraction; for a million rows it takes a tenth of that
CONVERGED = 1e-15  # the continued fraction ends when a step changes it less


def significance(rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """r and its p over all rows, then the share of the windows of each length in which r is significant.

    The claim is about a positive r, so a significantly negative one does not count.
    """
    for site in (CLOUD, ONBOARD):
        yield from _all_rows(rows, config, site)
    for length in config.lengths():
        for site in (CLOUD, ONBOARD):
            yield _windows(rows, config, site, length)


def p_value(r: float, rows: int) -> float:
    """The probability of an r at least as far from 0 if size and time were independent and normal.

    It is I(1 - r^2; (rows - 2) / 2, 1 / 2), the regularised incomplete beta function, which is the same as
    the two-sided t-test of t = r sqrt((rows - 2) / (1 - r^2)).
    """
    if rows < TESTED_MIN:
        return 1.0
    return _beta(max(0.0, 1 - r * r), (rows - 2) / 2, 0.5)


def smallest_significant_r(rows: int, p: float = P_MAX) -> float:
    """The r whose p-value is `p`, by halving."""
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (low, middle) if p_value(middle, rows) <= p else (middle, high)
    return high


def _all_rows(rows: Rows, config: ClaimsConfig, site: str) -> Iterator[Claim]:
    seconds, count = getattr(rows, f"{site}_s"), len(rows)
    found = window_r(rows.size, seconds, count)
    if count < TESTED_MIN or not len(found):
        yield unknown(CLAIM, f"{site}: r, all rows", "too few different rows")
        return
    r = bootstrapped(
        config.blocks(count),
        lambda picks: confidence_intervals.mean_r(rows.size[picks], seconds[picks], count),
    )
    yield claim(CLAIM, f"{site}: r, all rows", r, theirs=_their_r(FULL_WINDOW, site), claimed=POSITIVE)
    p = Figure(p_value(float(found[0]), count), exact=True)
    yield claim(CLAIM, f"{site}: p of r, all rows", p, theirs=f"< {P_MAX}", claimed=Claimed(high=P_MAX))


def _windows(rows: Rows, config: ClaimsConfig, site: str, length: int) -> Claim:
    words = f"{site}: N = {length}, % with p < {P_MAX}"
    if length < TESTED_MIN or length > len(rows):
        why = "too few rows for a test" if length < TESTED_MIN else "not enough rows"
        return unknown(CLAIM, words, why)
    found = window_r(rows.size, getattr(rows, f"{site}_s"), length)
    if not len(found):
        return unknown(CLAIM, words, "too few different rows")
    significant = np.where(found >= smallest_significant_r(length), 100.0, 0.0)
    share = mean_of(config.blocks(len(found), overlap=length), significant)
    their_r = _their_r(str(length), site)
    theirs = None if their_r is None else f"p {p_value(their_r, length):.1g}"
    return claim(CLAIM, words, share, theirs=theirs, claimed=Claimed(low=SHARE_MIN))


def _their_r(window: str, site: str) -> float | None:
    return next(
        (getattr(score, f"r_{site}") for score in published_table_two.SCORES if score.window == window), None
    )


def _beta(x: float, a: float, b: float) -> float:
    """The regularised incomplete beta function I(x; a, b)."""
    if x <= 0 or x >= 1:
        return float(x >= 1)
    if x > (a + 1) / (a + b + 2):  # where the fraction converges slowly
        return 1 - _beta(1 - x, b, a)
    log = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    return math.exp(log) / (a * _fraction(x, a, b))


def _fraction(x: float, a: float, b: float) -> float:
    """1 + d1 / (1 + d2 / (1 + ..)), the continued fraction DLMF 8.17.22, by Lentz's method."""
    value, up, down = 1.0, 1.0, 0.0
    for step in range(1, STEPS_MAX):
        m, odd = divmod(step, 2)
        if odd:
            term = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        else:
            term = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        down = 1 / (1 + term * down)
        up = 1 + term / up
        value *= up * down
        if abs(up * down - 1) < CONVERGED:
            break
    return value
