"""The share of each site over a run: in equal parts of it, and after an outage, when it must come back.

The outage is read from the events of the run, the shares from its outcome.
"""

import itertools
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.outcome_files import read_lines
from offboard.loadgen.table.table_formats import UNDEFINED
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import ONBOARD

SPANS = 10  # equal parts of a run
SPAN = 10  # tasks over which a share is computed
WITHIN_PERCENT = 10.0  # recovered: the share differs from the one before the outage by at most this


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


def read_outage(path: Path) -> tuple[int, int] | None:
    """How many tasks the first robot had answered when the link first fell silent, and when it was back.

    None if the link never fell silent, or never came back. `path` is the file of the run's events.
    """
    began: int | None = None
    ended: int | None = None
    for event in read_lines(path):
        silent = _silenced(event) if event.get("happened_s") is not None and "skipped" not in event else None
        if silent:
            began, ended = event["answered"] if began is None else began, None
        elif silent is False and began is not None:
            ended = event["answered"]
    return None if began is None or ended is None else (began, ended)


def recovery_tasks(run: Outcome) -> float | None:
    """Tasks after the outage until the cloud's share is back; infinite if it never came back.

    None if there was no outage, or if the cloud had too small a share before it. Tasks that ran on all sites
    count in no share. The first spans after the outage still contain tasks from the outage itself.
    """
    if run.outage is None:
        return None
    began, ended = run.outage
    sent = sorted(
        (one.i, one.chosen != ONBOARD)
        for one in run.answered
        if one.robot == ROBOT and one.chosen and not one.both
    )
    before = [cloud for i, cloud in sent if i < began]
    usual = _percent(before) if len(before) >= SPAN else 0.0
    if usual <= WITHIN_PERCENT:
        return None
    for n in range(SPAN, len(sent) + 1):
        after = sent[n - 1][0] + 1 - ended
        share = _percent([cloud for _, cloud in sent[n - SPAN : n]])
        if after >= 0 and abs(share - usual) <= WITHIN_PERCENT:
            return float(after)
    return float("inf")


def median_recovery(runs: Sequence[Outcome]) -> tuple[float | None, str]:
    """The median over the runs, and a note about the runs that never recovered."""
    found = [tasks for run in runs if (tasks := recovery_tasks(run)) is not None]
    never = found.count(float("inf"))
    note = f"the cloud's share never came back in {never} of {len(found)} runs" if never else ""
    median = statistics.median(found) if found else None
    return (None if median == float("inf") else median), note


def _percent(facts: Sequence[bool]) -> float:
    return 100 * sum(facts) / len(facts)


def _silenced(event: Mapping[str, Any]) -> bool | None:
    """True if an event begins an outage, False if it ends one, None if it does neither."""
    if "cut" in event or "join" in event:
        return "cut" in event
    link = event.get("link", {})
    said = [one["outage"] for one in (link, link.get("up", {}), link.get("down", {})) if "outage" in one]
    return any(said) if said else None
