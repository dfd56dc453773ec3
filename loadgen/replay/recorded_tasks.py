"""The tasks of a trace, with all that a replay needs to know of them.

docs/formats.md explains the fields. `dataset_file` reads the tasks of a dataset, `recorded_site` runs them.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from offboard.common import errors
from offboard.common.errors import CloudBroken, CloudError, ConfigError, DataError, OffloadError, TaskError
from offboard.common.tasks import Size
from offboard.loadgen.robot_files import read_trace
from offboard.loadgen.table.measured_rows import ALLOWED, VALUE_MAX
from offboard.robot_client.policies import Decision, Hedge, Probe
from offboard.robot_client.sites.runner import (
    CLOUD,
    NOTHING,
    ONBOARD,
    TIMEOUT_S,
    UNMEASURED,
    Condition,
    Execution,
    Packed,
    Sending,
    checked_timeout,
)

PARTS = ("queue_s", "run_s", "network_s", "cpu_s")  # of the seconds of an execution


@dataclass(frozen=True, slots=True)
class RecordedTask:
    """One task.

    `runs`: its runs by site, with the work as their value. A run that was stopped has the failure Overtaken.
    `conditions`, `sendings`: by site, what was measured and what a run would send, when it was decided.
    `sites`: those that could take it. `decision`: of the run; None in a dataset.
    `i`: its place in the order in which tasks began. `process`: one for each start of the robot.
    `started_s`: on the clock of the robot; None: unknown. `waited_s`: until it was answered.
    `measured`: both times were known when the task was answered, so it is a row of `measured_rows`.
    """

    size: Size
    runs: Mapping[str, Execution]
    conditions: Mapping[str, Condition] = field(default_factory=dict)
    sendings: Mapping[str, Sending] = field(default_factory=dict)
    sites: tuple[str, ...] = (ONBOARD, CLOUD)
    decision: Decision | None = None
    i: int = 0
    started_s: float | None = None
    waited_s: float = 0.0
    timeout_s: float = TIMEOUT_S
    deadline_s: float | None = None
    process: str = ""
    measured: bool = True

    @property
    def answered_s(self) -> float:
        return (self.started_s or 0.0) + self.waited_s

    @property
    def work(self) -> float | None:
        """What the results told; None: nothing."""
        return next((run.value for run in self.runs.values() if run.value is not None), None)


def read_tasks(path: Path, kind: str | None) -> list[RecordedTask]:
    """The tasks of a trace in the order of their answers; `kind` selects one kind."""
    found: list[RecordedTask] = []
    places: dict[str, int] = {}  # of each task by its id
    for line, fields in enumerate(read_trace(path), 1):
        try:
            if kind is None or fields["kind"] == kind:
                places[fields["id"]] = len(found)
                found.append(_task(fields))
            for one in fields.get("late", ()):  # of this task too, if its run was stopped at once
                if one["id"] in places:
                    _end_late(found, places[one["id"]], one)
        except (TypeError, KeyError, ValueError, AttributeError, ConfigError) as error:
            raise DataError(f"{path}:{line}: cannot be replayed: {error!r}") from error
    return found


def _task(fields: Mapping[str, Any]) -> RecordedTask:
    size, features, sites = fields["size"], fields["features"], fields["sites"]
    work = None if fields.get("work") is None else _number(fields["work"])
    runs = {one["site"]: _execution(one, work) for one in fields["executions"]}
    return RecordedTask(
        size=tuple(map(_number, size)) if isinstance(size, list) else _number(size),
        runs=runs,
        conditions={site: _condition(site, features) for site in sites},
        sendings={site: _sending(outlook) for site, outlook in sites.items()},
        sites=tuple(dict.fromkeys((*sites, ONBOARD))),  # onboard always exists
        decision=_decision(fields["decision"], {*sites, ONBOARD}),
        i=int(fields["i"]),
        started_s=_number(fields["started_s"]) if "started_s" in fields else None,
        waited_s=_number(fields["waited_s"]),
        timeout_s=checked_timeout(fields.get("timeout_s", TIMEOUT_S)),
        deadline_s=None if fields.get("deadline_s") is None else checked_timeout(fields["deadline_s"]),
        process=str(fields["id"]).rpartition("-")[0],
        measured=all(site in runs and runs[site].ok for site in (ONBOARD, CLOUD)),
    )


def _end_late(tasks: list[RecordedTask], place: int, fields: Mapping[str, Any]) -> None:
    """Put the end of a run that another site overtook in the place of what its own line said of it."""
    task = tasks[place]
    late = _execution(fields, task.work)
    tasks[place] = replace(task, runs={**task.runs, late.site: late})


def _condition(site: str, features: Mapping[str, Any]) -> Condition:
    """What was measured of a site. The wait for the robot's own runs is left out: a replay has its own."""
    found = {
        name: _number(features[key]) for name in Condition._fields if (key := f"{site}.{name}") in features
    }
    if site == ONBOARD:
        found.pop("wait_s", None)
    if found.get("capacity") == 0:
        raise ValueError(f"{site}.capacity is 0")
    return Condition(**found) if found else UNMEASURED  # type: ignore[arg-type] # `silent` is 0 or 1


def _sending(outlook: Mapping[str, Any]) -> Sending:
    """What a run would send. What a kind packs itself is taken as already packed."""
    sending, packing = outlook.get("sending"), outlook.get("packing")
    if packing is not None and not packing["compress"]:
        return Sending(int(packing["bytes"]))
    if sending is None:
        return NOTHING
    return Sending(sending["bytes"], tuple((number, size) for number, size in sending["large"]))


def _decision(fields: Mapping[str, Any], sites: Collection[str]) -> Decision:
    for site in (fields["site"], fields["second"]):
        if site is not None and site not in sites:
            raise ValueError(f"decision: {site!r} is not one of its sites")
    second: Probe | Hedge | None = None
    if fields["second"] is not None:
        after_s = _number(fields["second_after_s"])
        second = Hedge(fields["second"], after_s) if after_s > 0 else Probe(fields["second"])
    latest_s = fields.get("latest_s")
    return Decision(
        fields["site"],
        "as in the run",
        fields["policy"],
        both=fields["both"],
        second=second,
        spared=tuple(fields.get("spared", ())),
        waits=fields.get("waits", fields["both"]),
        latest=None if latest_s is None else Hedge(ONBOARD, _number(latest_s)),
    )


def _execution(fields: Mapping[str, Any], work: float | None) -> Execution:
    ok = fields["ok"] and not fields["censored"]
    known = [name for name in PARTS if fields.get(name) is not None]
    part_s: dict[str, Any] = {name: _number(fields[name]) for name in known}
    return Execution(
        fields["site"],
        _number(fields["seconds"]),
        work if ok else None,
        None if ok else _failure(fields.get("error")),
        censored=fields["censored"],
        **part_s,
        bytes_out=int(_number(fields.get("bytes_out", 0))),
        bytes_in=int(_number(fields.get("bytes_in", 0))),
        started=fields.get("started", True),
        packed=tuple(Packed(**one) for one in fields.get("packed", ())),
        held_up=fields.get("held_up", False),
    )


def _number(value: Any) -> float:
    number = float(value)
    if not 0 <= number <= VALUE_MAX:
        raise ValueError(f"{number} is not {ALLOWED}")
    return number


def _failure(text: str | None) -> OffloadError:
    """The failure that the trace names: its type decides what is learnt from it."""
    name, _, why = (text or "").partition(": ")
    known = getattr(errors, name, None)
    if isinstance(known, type) and issubclass(known, (TaskError, CloudError)):
        return known(why)
    return CloudBroken(text or "no reason in the trace")
