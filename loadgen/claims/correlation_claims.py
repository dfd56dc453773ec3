"""Claims 1 and 5: times follow sizes, and N rows in sequence say more about the next row than N other rows.

Claim 1 is tested with the t-test of Pearson's r, two-sided. It takes the rows for independent of each other.
For claim 5, every row after the first N is predicted by least squares from N other rows:

    sequential  the N rows before it
    shuffled    the N rows before it after the table was shuffled; before the first row comes the last one
    random      N rows drawn from all others

Both sites learn the same rows, and no predictor moves while a row is predicted.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np

from offboard.common.errors import MissingExtra
from offboard.loadgen.claims.claim import (
    POSITIVE,
    Claim,
    Claimed,
    ClaimsConfig,
    Figure,
    bootstrapped,
    claim,
    mean_of,
    unknown,
)
from offboard.loadgen.table import confidence_intervals
from offboard.loadgen.table.confidence_intervals import Picks
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_settings import FULL_WINDOW
from offboard.loadgen.table.table_two_figures import BLOCK_CELLS_MAX, PUBLISHED, Score, Scored, window_r
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

CORRELATED, IN_SEQUENCE = 1, 5  # the claims
P_MAX = 0.005  # of the paper
SHARE_MIN = 95.0  # per cent of the windows in which r must be significant
TESTED_MIN = 3  # rows; two points always lie on a line
DRAWS = 20  # of the other samples; their mean is compared, so that one lucky draw does not count

# The N rows from which each of these rows is predicted.
Sample = Callable[[Picks, np.random.Generator], Picks]


def significance(rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """r and its p over all rows, then the share of windows in which r is significant.

    The windows are the shortest, those of WINDOW rows and the longest. The claim is about a positive r, so
    a significantly negative one does not count.
    """
    for site in (CLOUD, ONBOARD):
        yield from _all_rows(rows, config, site)
    lengths = config.lengths()
    for length in (one for one in lengths if one in (lengths[0], WINDOW, lengths[-1])):
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
        yield unknown(CORRELATED, f"{site}: r, all rows", "too few different rows")
        return
    r = bootstrapped(
        config.blocks(count),
        lambda picks: confidence_intervals.mean_r(rows.size[picks], seconds[picks], count),
    )
    yield claim(CORRELATED, f"{site}: r, all rows", r, theirs=_their_r(FULL_WINDOW, site), claimed=POSITIVE)
    words = f"{site}: p of r, all rows"
    try:
        p = Figure(p_value(float(found[0]), count), exact=True)
    except MissingExtra as missing:
        yield unknown(CORRELATED, words, str(missing))
    else:
        yield claim(CORRELATED, words, p, theirs=f"< {P_MAX}", claimed=Claimed(high=P_MAX))


def _windows(rows: Rows, config: ClaimsConfig, site: str, length: int) -> Claim:
    words = f"{site}: N = {length}, % with p < {P_MAX}"
    if length < TESTED_MIN or length > len(rows):
        why = "too few rows for a test" if length < TESTED_MIN else "not enough rows"
        return unknown(CORRELATED, words, why)
    found = window_r(rows.size, getattr(rows, f"{site}_s"), length)
    if not len(found):
        return unknown(CORRELATED, words, "too few different rows")
    try:
        significant = np.where(found >= smallest_significant_r(length), 100.0, 0.0)
    except MissingExtra as missing:
        return unknown(CORRELATED, words, str(missing))
    share = mean_of(config.blocks(len(found), overlap=length), significant)
    their_r = _their_r(str(length), site)
    theirs = None if their_r is None else f"p {p_value(their_r, length):.1g}"
    return claim(CORRELATED, words, share, theirs=theirs, claimed=Claimed(low=SHARE_MIN))


def _their_r(window: str, site: str) -> float | None:
    r: float | None = getattr(PUBLISHED.get(window, Score("", window)), f"r_{site}")
    return r


@dataclass(frozen=True, slots=True)
class Sampled:
    """What the samples say, one value for each predicted row. NaN: a sample has no r.

    right: 1 if the site that is predicted to be faster is the faster one, otherwise 0.
    """

    r_cloud: Column
    r_onboard: Column
    right: Column


def sample_order(rows: Rows, config: ClaimsConfig, length: int = WINDOW) -> Iterator[Claim]:
    """Sequential minus shuffled and random samples: both correlations, and the accuracy in points."""
    count = len(rows)
    if count <= length:
        yield unknown(IN_SEQUENCE, f"sequential samples of {length}", "not enough rows")
        return
    random = np.random.default_rng(config.seed)
    sequential = _sampled(rows, length, lambda at, _: at[:, np.newaxis] - np.arange(length, 0, -1), random)
    for name in ("shuffled", "random"):
        drawn = [_sampled(rows, length, _other(name, count, length, random), random) for _ in range(DRAWS)]
        for words, field, factor in (
            ("r cloud", "r_cloud", 1.0),
            ("r onboard", "r_onboard", 1.0),
            ("accuracy", "right", 100.0),
        ):
            gain = getattr(sequential, field) - np.mean([getattr(one, field) for one in drawn], axis=0)
            gain = factor * gain[np.isfinite(gain)]
            figure = mean_of(config.blocks(len(gain), overlap=length), gain)
            yield claim(IN_SEQUENCE, f"sequential - {name}: {words}", figure, theirs="> 0", claimed=POSITIVE)


def _other(name: str, count: int, length: int, random: np.random.Generator) -> Sample:
    """How one shuffled table, or one set of random samples, is drawn."""
    if name == "random":
        return lambda at, draw: np.array(
            [(one + 1 + draw.choice(count - 1, length, replace=False, shuffle=False)) % count for one in at]
        )
    order = random.permutation(count)
    place = np.argsort(order)
    return lambda at, _: order[(place[at][:, np.newaxis] - np.arange(length, 0, -1)) % count]


def _sampled(rows: Rows, length: int, sample: Sample, random: np.random.Generator) -> Sampled:
    """Every row after the first `length`, a bounded number at a time."""
    step = max(1, BLOCK_CELLS_MAX // length)
    parts = []
    for first in range(length, len(rows), step):
        at = np.arange(first, min(first + step, len(rows)))
        picks = sample(at, random)
        sizes = rows.size[picks]
        p_onboard, r_onboard = _fit(sizes, rows.onboard_s[picks], rows.size[at])
        p_cloud, r_cloud = _fit(sizes, rows.cloud_s[picks], rows.size[at])
        right = Scored(rows.onboard_s[at], rows.cloud_s[at], p_cloud < p_onboard).right  # Eq. 1
        parts.append((r_cloud, r_onboard, right.astype(np.float64)))
    return Sampled(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _fit(sizes: Column, seconds: Column, asked: Column) -> tuple[Column, Column]:
    """The prediction of least squares for one size, and Pearson r, of each row of `sizes` and `seconds`."""
    mean_d, mean_t = sizes.mean(axis=1), seconds.mean(axis=1)
    d, t = sizes - mean_d[:, np.newaxis], seconds - mean_t[:, np.newaxis]
    sdd, sdt, stt = (d * d).sum(axis=1), (d * t).sum(axis=1), (t * t).sum(axis=1)
    varied = (np.ptp(sizes, axis=1) > 0) & (sdd > 0)
    slope = np.divide(sdt, sdd, out=np.zeros_like(sdd), where=varied)
    both = varied & (np.ptp(seconds, axis=1) > 0) & (stt > 0)
    r = np.divide(sdt, np.sqrt(sdd * stt), out=np.full_like(sdd, np.nan), where=both)
    return mean_t + slope * (asked - mean_d), r
