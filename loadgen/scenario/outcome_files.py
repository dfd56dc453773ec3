"""Reads the outcome of a run from the files in its folder (docs/formats.md).

The robot writes these files; what their lines mean is in `outcome`.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError
from offboard.loadgen.robot_files import Late, late_executions, read_trace
from offboard.loadgen.scenario.interval_coverage import intervals_of
from offboard.loadgen.scenario.outcome import Answered, Reading, Reference, Spent, Step
from offboard.robot_client.sites.runner import ONBOARD


def read_answered(answers: Path, records: Path, robot: str) -> list[Answered]:
    """The answers of one robot, joined with its trace by task id. Without a trace record no site is known."""
    by_id = {record["id"]: record for record in read_trace(records)} if records.is_file() else {}
    late = late_executions(by_id.values())
    found = []
    for line in read_lines(answers):
        record = by_id.get(line["id"], {})
        decision, executions = record.get("decision", {}), record.get("executions", ())
        used, step = record.get("used"), step_of(line["answer"])
        quality = record["sites"][used].get("quality") if used else None
        if step is not None:
            used, quality = line["answer"]["site"], line["answer"]["quality"]
        found.append(
            Answered(
                i=line["i"],
                robot=robot,
                due_s=line["due_s"],
                ended_s=line["ended_s"],
                error=line["error"],
                answer=line["answer"],
                chosen=decision.get("site"),
                both=decision.get("both", False),
                sites=tuple(one["site"] for one in executions),
                intervals=intervals_of(record, late),
                server_s=next(
                    (one["run_s"] for one in executions if one["site"] != ONBOARD and one["ok"]), None
                ),
                overhead_s=overhead_s(record) if record else None,
                used=used,
                probed=is_probed(record) if record else False,
                quality=quality,
                spent=spent_of(record, late) if record else Spent(),
                step=step,
            )
        )
    return found


def step_of(answer: Mapping[str, Any] | None) -> Step | None:
    """The step of a stream that a line of the answers holds; None: it holds the answer of a call."""
    if answer is None or "held" not in answer:
        return None
    return Step(answer["held"], answer["age_s"], answer["seam"])


def spent_of(record: Mapping[str, Any], late: Late) -> Spent:
    """What the executions of a record took; a run that was still going on counts with its end."""
    compute_s, remote_s, moved = 0.0, 0.0, 0.0
    for one in record["executions"]:
        ended = late.get((record["id"], one["site"]), one)
        if one["site"] == ONBOARD:
            compute_s += _onboard_s(ended, record["features"].get(f"{ONBOARD}.capacity", 1.0))
        else:
            remote_s += one["seconds"]
            moved += ended["bytes_out"] + ended["bytes_in"]
    return Spent(compute_s, min(remote_s, record["waited_s"]), moved)


def _onboard_s(execution: Mapping[str, Any], capacity: float) -> float:
    """CPU seconds; those of a cancelled run are not known, and it counts with all that it may have had."""
    if not execution["started"]:
        return 0.0
    cpu_s = execution["cpu_s"]
    ran_s = execution["seconds"] - (execution["queue_s"] or 0.0)
    return float(capacity * ran_s if cpu_s is None else cpu_s)


def is_probed(record: Mapping[str, Any]) -> bool:
    """Whether the task was run on a second site from the start, to learn how that site does."""
    decision = record["decision"]
    ran = any(one["site"] == decision["second"] for one in record["executions"])
    return ran and not decision["second_after_s"]


def overhead_s(record: Mapping[str, Any]) -> float | None:
    """What Offboard itself added to the time of a task that ran on one site: wait minus execution.

    An onboard execution counts without the time to hand it to a worker and back. None if a second site ran
    too: then the wait contains what was lost on the first one, or the delay of a hedge.
    """
    executions = record["executions"]
    if len(executions) != 1 or not executions[0]["ok"]:
        return None
    (one,) = executions
    if one["site"] != ONBOARD:
        return float(record["waited_s"] - one["seconds"])
    return float(record["waited_s"] - one["queue_s"] - one["run_s"])


def read_references(path: Path) -> list[Reference]:
    """The reference runs of a run; leaves out tasks that no site answered."""
    found = []
    for line in read_lines(path):
        seconds = {site: run["seconds"] for site, run in line["sites"].items() if run["ok"]}
        given_up_s = {site: run["seconds"] for site, run in line["sites"].items() if not run["ok"]}
        if seconds:
            found.append(
                Reference(
                    i=line["i"],
                    chosen=line["chosen"],
                    both=line["both"],
                    seconds=seconds,
                    given_up_s=given_up_s,
                )
            )
    return found


def read_readings(path: Path) -> list[Reading]:
    return [Reading(**line) for line in read_lines(path)]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The lines of a JSON Lines file, without a torn last line; an absent file has none."""
    if not path.is_file():
        return []
    found = []
    for number, line in enumerate(path.read_bytes().split(b"\n")[:-1], 1):
        try:
            found.append(json.loads(line))
        except (ValueError, RecursionError) as error:
            raise DataError(f"{path}:{number}: not a JSON line: {error}") from None
    return found
