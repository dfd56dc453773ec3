"""Claim 1: the time of a task is correlated with its size, on both sites.

The test is the t-test of Pearson's r, two-sided. It takes the rows for independent of each other.
"""

import math
from collections.abc import Iterator
from importlib import import_module
from types import ModuleType

import numpy as np

from offboard.common.errors import MissingExtra
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
    return float(_special().betainc((rows - 2) / 2, 0.5, max(0.0, 1 - r * r)))


def smallest_significant_r(rows: int, p: float = P_MAX) -> float:
    """The r whose p-value is `p`."""
    return math.sqrt(1 - _special().betaincinv((rows - 2) / 2, 0.5, p))


def _special() -> ModuleType:
    """scipy.special, which takes long to import and is needed by `loadgen claims` alone."""
    try:
        return import_module("scipy.special")
    except ImportError as error:
        raise MissingExtra("the p-value of r", "learned") from error


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
    words = f"{site}: p of r, all rows"
    try:
        p = Figure(p_value(float(found[0]), count), exact=True)
    except MissingExtra as missing:
        yield unknown(CLAIM, words, str(missing))
    else:
        yield claim(CLAIM, words, p, theirs=f"< {P_MAX}", claimed=Claimed(high=P_MAX))


def _windows(rows: Rows, config: ClaimsConfig, site: str, length: int) -> Claim:
    words = f"{site}: N = {length}, % with p < {P_MAX}"
    if length < TESTED_MIN or length > len(rows):
        why = "too few rows for a test" if length < TESTED_MIN else "not enough rows"
        return unknown(CLAIM, words, why)
    found = window_r(rows.size, getattr(rows, f"{site}_s"), length)
    if not len(found):
        return unknown(CLAIM, words, "too few different rows")
    try:
        significant = np.where(found >= smallest_significant_r(length), 100.0, 0.0)
    except MissingExtra as missing:
        return unknown(CLAIM, words, str(missing))
    share = mean_of(config.blocks(len(found), overlap=length), significant)
    their_r = _their_r(str(length), site)
    theirs = None if their_r is None else f"p {p_value(their_r, length):.1g}"
    return claim(CLAIM, words, share, theirs=theirs, claimed=Claimed(low=SHARE_MIN))


def _their_r(window: str, site: str) -> float | None:
    return next(
        (getattr(score, f"r_{site}") for score in published_table_two.SCORES if score.window == window), None
    )
