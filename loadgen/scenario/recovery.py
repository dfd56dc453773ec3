"""How many tasks it takes, after an outage of the link, until the cloud has its share of them again."""

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from offboard.loadgen.scenario.outcome import Outcome, read_lines
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import CLOUD

SPAN = 10  # tasks that a share is taken over
WITHIN_PERCENT = 10.0  # of the share before


def read_outage(path: Path) -> tuple[int, int] | None:
    """Tasks that the first robot had answered when the link fell silent first, and when it was back for good.

    None where it never was, or stayed, silent; `path` holds the events of the run.
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
    """Tasks after the outage until the share is back; infinite where it never was.

    None where there was no outage, or before it no share that could be missed. Tasks that ran on all sites
    have none; the last ones of the outage count while they are in the span.
    """
    if run.outage is None:
        return None
    began, ended = run.outage
    sent = sorted(
        (one.i, one.chosen == CLOUD)
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
    """The median over the runs, and what is to be said of those that never recovered."""
    found = [tasks for run in runs if (tasks := recovery_tasks(run)) is not None]
    never = found.count(float("inf"))
    note = f"the cloud's share never came back in {never} of {len(found)} runs" if never else ""
    median = statistics.median(found) if found else None
    return (None if median == float("inf") else median), note


def _percent(facts: Sequence[bool]) -> float:
    return 100 * sum(facts) / len(facts)


def _silenced(event: Mapping[str, Any]) -> bool | None:
    """Whether an event begins an outage or ends one; None: neither."""
    if "cut" in event or "join" in event:
        return "cut" in event
    link = event.get("link", {})
    said = [one["outage"] for one in (link, link.get("up", {}), link.get("down", {})) if "outage" in one]
    return any(said) if said else None
