"""Claim 2: N rows in sequence say more about the next row than N rows of a shuffled table, or N random ones.

Every row after the first N is predicted by least squares from N other rows:

    sequential  the N rows before it
    shuffled    the N rows before it after the table was shuffled; before the first row comes the last one
    random      N rows drawn from all others

Both sites learn the same rows, and no predictor moves while a row is predicted.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from offboard.loadgen.claims.claim import POSITIVE, Claim, claim, mean_of, unknown
from offboard.loadgen.claims.claims_settings import ClaimsConfig
from offboard.loadgen.table.confidence_intervals import Picks
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_two_figures import BLOCK_CELLS_MAX
from offboard.robot_client.predictors.window import WINDOW

CLAIM = 2
DRAWS = 20  # of the other samples; their mean is compared, so that one lucky draw does not count

Sample = Callable[
    [Picks, np.random.Generator], Picks
]  # the N rows from which each of these rows is predicted


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
        yield unknown(CLAIM, f"sequential samples of {length}", "not enough rows")
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
            yield claim(CLAIM, f"sequential - {name}: {words}", figure, theirs="> 0", claimed=POSITIVE)


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
        # Eq. 1; if both sites took equally long, either one is right.
        chosen_s = np.where(p_cloud < p_onboard, rows.cloud_s[at], rows.onboard_s[at])
        right = chosen_s == np.minimum(rows.cloud_s[at], rows.onboard_s[at])
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
