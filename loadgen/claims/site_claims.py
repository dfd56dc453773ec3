"""Claims 2, 3 and 4: r of short and long windows, r of both sites, and how each time grows with the size."""

from collections.abc import Iterator

import numpy as np

from offboard.loadgen.claims.claim import (
    BELOW_ONE,
    POSITIVE,
    Claim,
    Claimed,
    ClaimsConfig,
    bootstrapped,
    claim,
    unknown,
)
from offboard.loadgen.table.confidence_intervals import Picks, mean_r
from offboard.loadgen.table.measured_rows import Column, Rows
from offboard.loadgen.table.table_settings import FULL_WINDOW
from offboard.loadgen.table.table_two_figures import PUBLISHED
from offboard.robot_client.sites.runner import CLOUD, ONBOARD

BY_WINDOW, BY_SITE, SLOPES = 2, 3, 4  # the claims
R_MOVES_MAX = 0.05  # for an r that "does not depend on N"; in the paper it moves by 0.04
SITES = (CLOUD, ONBOARD)


def r_by_window(rows: Rows, config: ClaimsConfig) -> Iterator[Claim]:
    """The mean r of the shortest window minus that of the longest one, of each site."""
    lengths = [length for length in config.lengths() if length <= len(rows) // 2]
    if len(lengths) < 2:
        yield unknown(BY_WINDOW, "r, short - long windows", "not enough rows or windows")
        return
    short, long = lengths[0], lengths[-1]
    for site in SITES:
        seconds = getattr(rows, f"{site}_s")

        def moved(picks: Picks, seconds: Column = seconds) -> Column:
            size, taken_s = rows.size[picks], seconds[picks]
            found: Column = mean_r(size, taken_s, short) - mean_r(size, taken_s, long)
            return found

        theirs = _published_r(str(short), site), _published_r(str(long), site)
        yield claim(
            BY_WINDOW,
            f"{site}: r, N = {short} - N = {long}",
            bootstrapped(config.blocks(len(rows)), moved),
            theirs=None if None in theirs else theirs[0] - theirs[1],  # type: ignore[operator]
            claimed=Claimed(-R_MOVES_MAX, R_MOVES_MAX),
        )


def r_by_site(rows: Rows, config: ClaimsConfig) -> Claim:
    """r of the onboard times minus r of the cloud times, over all rows."""

    def more(picks: Picks) -> Column:
        size, count = rows.size[picks], len(rows)
        found: Column = mean_r(size, rows.onboard_s[picks], count) - mean_r(size, rows.cloud_s[picks], count)
        return found

    published = PUBLISHED[FULL_WINDOW]
    theirs = (published.r_onboard or 0.0) - (published.r_cloud or 0.0)
    figure = bootstrapped(config.blocks(len(rows)), more)
    return claim(BY_SITE, "r onboard - r cloud", figure, theirs=theirs, claimed=POSITIVE)


def slopes(rows: Rows, config: ClaimsConfig) -> Claim:
    """The slope of the line through all cloud times, as a share of that through all onboard times."""

    def share(picks: Picks) -> Column:
        size = rows.size[picks]
        away = size - size.mean(-1, keepdims=True)
        with np.errstate(divide="ignore", invalid="ignore"):
            found: Column = (away * rows.cloud_s[picks]).sum(-1) / (away * rows.onboard_s[picks]).sum(-1)
        return found

    figure = bootstrapped(config.blocks(len(rows)), share)
    return claim(SLOPES, "slope cloud / slope onboard", figure, theirs="< 1", claimed=BELOW_ONE)


def _published_r(window: str, site: str) -> float | None:
    published = PUBLISHED.get(window)
    found: float | None = getattr(published, f"r_{site}") if published else None
    return found
