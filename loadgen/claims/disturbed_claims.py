"""Claims 6 and 14: what the last N times make of loads that last, of no correlation, and of outliers.

A load lasts if the errors of one line through all times are alike in neighbouring rows.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from offboard.loadgen.claims.claim import (
    ABOVE_ONE,
    BELOW_ONE,
    NEGATIVE,
    Claim,
    ClaimsConfig,
    Figure,
    bootstrapped,
    claim,
    mean_of,
    ratio,
    unknown,
)
from offboard.loadgen.claims.prediction_claims import errors_of
from offboard.loadgen.table.confidence_intervals import Picks
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_settings import CHOSEN, FULL
from offboard.loadgen.table.table_two import predict
from offboard.loadgen.table.table_two_figures import Scored
from offboard.robot_client.predictors import LEAST_SQUARES
from offboard.robot_client.predictors.window import WINDOW
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

LASTING, DISTURBED = 6, 14  # the claims
LAGS = 10  # rows between neighbours, at most
LASTING_MIN = 0.1  # mean r of the errors of neighbours: with less, nothing lasts
SHORT = 10
OUTLIER_SHARE, OUTLIER_TIMES = 0.02, 10.0
OUTLIERS = f"{100 * OUTLIER_SHARE:g} % outliers"


def lasting_loads(rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """How alike neighbours are; if a load lasts, the choices and the time with the last N times."""
    alike = {site: _alike(rows, config, site) for site in (CLOUD, ONBOARD)}
    for site, figure in alike.items():
        yield claim(LASTING, f"{site}: r of neighbouring errors", figure)
    if not any((figure.low or 0.0) > LASTING_MIN for figure in alike.values()):
        known = all(figure.low is not None for figure in alike.values())
        why = "no load lasts for many rows here" if known else "not enough rows"
        yield unknown(LASTING, "with loads that last", why)
        return
    for feedback in (CHOSEN, FULL):
        for length in (SHORT, WINDOW):
            if length >= len(rows):
                yield unknown(LASTING, f"N = {length}, {feedback}", "not enough rows")
                continue
            yield from _with_lasting_load(rows, config, length, feedback)


def no_correlation_and_outliers(rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """What least squares loses when sizes say nothing, and when a few tasks take much longer."""
    if len(rows) <= WINDOW:
        yield unknown(DISTURBED, "no correlation, outliers", "not enough rows")
        return
    random = np.random.default_rng(config.seed)
    plain = _scored(rows, WINDOW, CHOSEN, config)
    blocks = config.blocks(len(plain.to_cloud))
    unrelated = _scored(replace(rows, size=random.permutation(rows.size), more=None), WINDOW, CHOSEN, config)
    points = 100.0 * (unrelated.right.astype(float) - plain.right)
    words = "sizes shuffled: accuracy points"
    yield claim(DISTURBED, words, mean_of(blocks, points), theirs="< 0", claimed=NEGATIVE)
    usual = np.ones(len(rows), dtype=bool)
    longer = {}
    for site in (ONBOARD, CLOUD):
        held_up = random.permutation(len(rows)) < max(1, round(OUTLIER_SHARE * len(rows)))
        usual &= ~held_up
        longer[f"{site}_s"] = np.where(held_up, OUTLIER_TIMES, 1.0) * getattr(rows, f"{site}_s")
    slowed, shown = _scored(replace(rows, **longer), WINDOW, CHOSEN, config), usual[WINDOW:].astype(float)
    # Rows with an outlier of their own are not scored: nobody can predict them.
    points = 100.0 * (slowed.right.astype(float) - plain.right) * shown
    figure = ratio(blocks, points, shown)
    yield claim(DISTURBED, f"{OUTLIERS}: accuracy points", figure, theirs="< 0", claimed=NEGATIVE)
    for site in (CLOUD, ONBOARD):
        (error_s, _), (usual_s, _) = errors_of(slowed, site), errors_of(plain, site)
        figure = ratio(blocks, abs(error_s) * shown, abs(usual_s) * shown)
        yield claim(DISTURBED, f"{OUTLIERS}: {site} MAE, ratio", figure, theirs="> 1", claimed=ABOVE_ONE)


def _alike(rows: Rows, config: ClaimsConfig, site: str) -> Figure:
    """The mean correlation of the errors of two rows that are at most LAGS apart."""
    seconds: Column = getattr(rows, f"{site}_s")
    if len(rows) <= LAGS or np.ptp(rows.size) == 0 or np.ptp(seconds) == 0:
        return Figure(None)
    slope, start = np.polyfit(rows.size, seconds, 1)
    error_s = seconds - (slope * rows.size + start)
    firsts = error_s[:-LAGS]
    neighbours = np.mean([np.roll(error_s, -lag)[:-LAGS] for lag in range(1, LAGS + 1)], axis=0)
    return ratio(config.blocks(len(firsts), overlap=LAGS), firsts * neighbours, firsts * firsts)


def _with_lasting_load(rows: Rows, config: ClaimsConfig, length: int, feedback: str) -> Iterator[Claim]:
    """Only with feedback chosen, as on a robot, it is a claim of the paper."""
    scored = _scored(rows, length, feedback, config)
    blocks, claimed = config.blocks(len(scored.to_cloud)), feedback == CHOSEN
    right = mean_of(blocks, np.where(scored.right, 100.0, 0.0))
    yield claim(LASTING, f"accuracy %, N = {length}, {feedback}", right)

    def share(picks: Picks) -> Column:
        one_site = np.minimum(scored.onboard_s[picks].sum(-1), scored.cloud_s[picks].sum(-1))
        found: Column = scored.spent_s[picks].sum(-1) / one_site
        return found

    yield claim(
        LASTING,
        f"time / better site, N = {length}, {feedback}",
        bootstrapped(blocks, share),
        theirs="< 1" if claimed else None,
        claimed=BELOW_ONE if claimed else None,
    )


def _scored(rows: Rows, length: int, feedback: str, config: ClaimsConfig) -> Scored:
    predicted = predict(rows, length, predictor=LEAST_SQUARES, feedback=feedback, seed=config.seed)
    return Scored.predicted(rows.since(length), *predicted)
