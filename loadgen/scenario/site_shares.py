"""The share of each site over a run: where its tasks went before, during and after an event."""

import itertools
from collections.abc import Mapping, Sequence

from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.table.table_formats import UNDEFINED

SPANS = 10  # equal parts of a run


def site_shares(run: Outcome, sites: Sequence[str]) -> Mapping[str, Sequence[float | None]]:
    """The percentage of each site in each of SPANS equal parts of the tasks, by site.

    Tasks that ran on all sites count in no share; None: no other task is in this part.
    """
    tasks = max(run.asked.values(), default=0)
    edges = [tasks * n // SPANS for n in range(SPANS + 1)]
    spans = [
        [one.chosen for one in run.answered if low <= one.i < high and one.chosen and not one.both]
        for low, high in itertools.pairwise(edges)
    ]
    return {site: [100 * span.count(site) / len(span) if span else None for span in spans] for site in sites}


def share_lines(shares: Mapping[str, Sequence[float | None]]) -> list[str]:
    """One line for each site, for people."""
    width = max(map(len, shares))
    lines = [f"share of each site in % of the tasks, in {SPANS} equal parts of the run:"]
    for site, found in shares.items():
        cells = [f"{UNDEFINED if one is None else round(one):>3}" for one in found]
        lines.append(f"{site:<{width}}  {'  '.join(cells)}")
    return lines
