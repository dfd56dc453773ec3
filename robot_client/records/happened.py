"""What became of a task after its decision, in words.

The decision has its own reason.
"""

from typing import TYPE_CHECKING

from offboard.common.errors import Overtaken
from offboard.common.wording import duration
from offboard.robot_client.policies.decision import Hedge, Probe
from offboard.robot_client.policies.hedge import NONE_LEFT
from offboard.robot_client.sites.runner import ONBOARD, Execution

if TYPE_CHECKING:
    from offboard.robot_client.records.record import Record


def happened(record: "Record") -> str:
    """Which sites started when and why, how each run ended, and whose answer was used."""
    runs = record.executions
    said = [_failed(one) for one in runs if not one.ok and not _left(one)]
    said += [_started(record, number) for number in range(1, len(runs))]
    if record.refused is not None:
        said.append(f"{record.refused} was due too, but no second run was left")
    elif NONE_LEFT in record.decision.reason and _is_late(record):
        said.append(f"{record.decision.site} was late, but no second run was left")
    left = " and ".join([one.site for one in runs if _left(one)])
    waited = duration(record.waited_s)
    if record.cancelled:
        said.append(f"cancelled after {waited}, with {left or 'no site'} under way")
    elif record.used is not None:
        rivals = any(one.ok or _left(one) for one in runs if one.site != record.used)
        said.append(f"{record.used} answered{' first' if rivals else ''} after {waited}")
    else:
        said.append(f"{left} had not answered after {waited}" if left else "no site answered")
    if record.missed_deadline:
        said.append(f"the deadline of {duration(record.deadline_s or 0.0)} was missed")
    return "; ".join(said)


def _started(record: "Record", number: int) -> str:
    """Why a run beyond the first began."""
    one, decision, before = record.executions[number], record.decision, record.executions[:number]
    second, latest = decision.second, decision.latest
    when = f"{one.site} started after {duration(one.after_s)}" if one.after_s else f"{one.site} started too"
    failed = [run.site for run in before if not run.ok and run.after_s + run.seconds <= one.after_s]
    if one.site == ONBOARD and len(failed) == number:
        return f"{when} instead"
    if decision.both:
        return f"{one.site} started too, to measure it"
    if isinstance(second, Probe) and second.site == one.site:
        return f"{one.site} started too, as a probe"
    if isinstance(second, Hedge) and second.site == one.site:
        return f"{when} because {decision.site} was late"
    if latest is not None and latest.site == one.site:
        return f"{when} because the deadline came near"
    return f"{when} because it was idle"


def _is_late(record: "Record") -> bool:
    """Whether the chosen site took longer than its interval."""
    outlook = record.sites.get(record.decision.site)
    return outlook is not None and outlook.high_s is not None and record.waited_s > outlook.high_s


def _failed(one: Execution) -> str:
    return f"{one.site} failed after {duration(one.seconds)} ({one.error})"


def _left(one: Execution) -> bool:
    """Whether nobody waited for the end of this run."""
    return isinstance(one.failure, Overtaken)
