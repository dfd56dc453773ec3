"""Plays a scenario on a testbed: starts the parts, makes the events happen, keeps what was seen, judges.

Which machines these are is the testbed's business, what the tasks are the robot's.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from offboard.common import VERSION
from offboard.common.errors import OffloadError
from offboard.loadgen.play.answer_check import verified
from offboard.loadgen.play.digest import digests
from offboard.loadgen.play.player import EVENTS, READINGS, TRACE, Files, Player, make_room, setups
from offboard.loadgen.play.stolen_time import NOTED_PERCENT, Stolen
from offboard.loadgen.scenario.check import Verdict
from offboard.loadgen.scenario.outcome import (
    FIGURES,
    Answered,
    Outcome,
    read_answered,
    read_readings,
    read_references,
)
from offboard.loadgen.scenario.recovery import read_outage
from offboard.loadgen.scenario.scenario import Scenario, find_scenario, read_scenario
from offboard.loadgen.table.rows import write_whole
from offboard.loadgen.table.table_two import TableConfig, table_text
from offboard.loadgen.testbed.processes import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup, Testbed
from offboard.robot_client.records.trace import alone_path, reference_path

SUMMARY = "summary.json"
TABLE = "table.md"
DEMO_WINDOWS = ("5", "10", "20", "30", "40", "50")


def _local(out: Path, setups: Mapping[str, Setup]) -> Testbed:
    return LocalTestbed(out, setups)


def _docker(out: Path, setups: Mapping[str, Setup]) -> Testbed:
    from offboard.loadgen.testbed.containers import DockerTestbed

    return DockerTestbed(out, setups)


TESTBEDS: dict[str, Callable[[Path, Mapping[str, Setup]], Testbed]] = {"local": _local, "docker": _docker}


@dataclass(frozen=True, slots=True)
class Played:
    """A run that came to its end: its outcome, the verdict of every check, each robot's exit code.

    `stolen_percent`: of the CPU time that the run asked for, what the host took (None: not known).
    """

    scenario: Scenario
    outcome: Outcome
    verdicts: Sequence[Verdict]
    exit_codes: Mapping[str, int]
    stolen_percent: float | None = None

    def check_robots(self) -> None:
        """OffloadError where a robot ended badly of itself."""
        ended = {
            event.value for event in self.scenario.timeline() if event.action in ("kill", "stop", "restart")
        }
        for robot, code in self.exit_codes.items():
            if code != 0 and robot not in ended:
                how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
                raise OffloadError(f"{robot} {how}")

    def check_verdicts(self) -> None:
        """OffloadError where a check did not hold."""
        failed = [verdict for verdict in self.verdicts if not verdict.holds]
        if failed:
            raise OffloadError(f"{len(failed)} of {len(self.verdicts)} checks of {self.scenario.name} failed")


def play(scenario: Scenario, out: Path, testbed: str = "local", *, quiet: bool = False) -> Played:
    """Play to the end. What an earlier run left in `out` is replaced; docs/formats.md names the files.

    Unless `quiet`, the first robot's output, and what is done, go to stdout.
    """
    say = _unsaid if quiet else _say
    started_at, workload = datetime.now(UTC), scenario.workload
    played_from = digests(scenario)  # of what the parts load now
    with TESTBEDS[testbed](out, setups(scenario, out, shown=not quiet)) as bed:
        make_room(out)
        say(f"starting the cloud server and the relay (logs in {out / 'logs'})")
        bed.start()
        many = "the robot" if workload.robots == 1 else f"{workload.robots} robots"
        tasks = f"{workload.tasks} {'plans' if workload.map else 'tasks'}"
        say(f"starting {many}, held to {scenario.robot.cpus:g} CPU: {tasks}")
        stolen = Stolen()
        exit_codes = Player(scenario, bed, say).play()
        stolen_percent = stolen.percent()
    played = replace(judge(scenario, out, exit_codes), stolen_percent=stolen_percent)
    about = {"testbed": testbed, "started_at": started_at.isoformat(timespec="seconds"), **played_from}
    write_summary(out, played, about)
    for verdict in played.verdicts:
        say(str(verdict))
    if stolen_percent is not None and stolen_percent >= NOTED_PERCENT:
        say(f"the host of this machine took {stolen_percent:.0f} % of the CPU time that the run asked for")
    for path in (out / TRACE, alone_path(out / TRACE), out / SUMMARY):
        if path.exists():
            say(f"written: {path}")
    return played


def play_demo(out: Path) -> int:
    """The shipped demo scenario, then Table II of the plans that were measured on both sites."""
    play(read_scenario(find_scenario("demo")), out).check_robots()
    text = table_text(out / TRACE, TableConfig(windows=DEMO_WINDOWS, feedback="both"))
    (out / TABLE).write_text(text)
    print(f"\n{text}\nwritten: {out / TABLE}; charts: loadgen report {out}")
    return 0


def judge(scenario: Scenario, out: Path, exit_codes: Mapping[str, int]) -> Played:
    """The outcome of the run in `out`, its answers verified, and what the checks say."""
    workload, asked = scenario.workload, {}
    answered: list[Answered] = []
    stopped = {event.value for event in scenario.timeline() if event.action == "stop"}
    for files in Files.of(scenario, out):
        answers = read_answered(files.answers, files.trace, files.robot)
        answered += verified(answers, workload, files.seed)
        # One that was stopped asked for no more than it got; one that was killed still owes the others.
        last = max((one.i for one in answers), default=-1)
        asked[files.robot] = last + 1 if files.robot in stopped else workload.tasks
    outcome = Outcome(
        asked=asked,
        answered=answered,
        references=read_references(reference_path(out / TRACE)),
        readings=read_readings(out / READINGS),
        deadline_s=None if workload.deadline_ms is None else workload.deadline_ms / 1e3,
        outage=read_outage(out / EVENTS),
    )
    verdicts = [check.judge(outcome) for check in scenario.checks]
    return Played(scenario, outcome, verdicts, exit_codes)


def write_summary(out: Path, played: Played, about: Mapping[str, Any]) -> None:
    """The last file of a run; `about` is what its other files do not tell."""
    scenario = played.scenario
    summary = {
        "name": scenario.name,
        "seed": scenario.seed,
        "policy": scenario.robot.policy,
        "predictor": scenario.robot.predictor,
        "tasks": scenario.workload.tasks * scenario.workload.robots,
        "software": VERSION,
        **about,
        "exit_codes": dict(played.exit_codes),
        "stolen_percent": played.stolen_percent,
        "figures": figures(played.outcome, scenario),
        "checks": [verdict.as_dict() for verdict in played.verdicts],
    }
    write_whole(out / SUMMARY, json.dumps(summary, indent=2, ensure_ascii=False) + "\n")


def figures(outcome: Outcome, scenario: Scenario) -> dict[str, float | None]:
    """All figures of the whole run that its workload has."""
    known = scenario.workload.known()
    return {
        name: figure.compute(outcome)
        for name, figure in FIGURES.items()
        if figure.needs is None or known[figure.needs]
    }


def _say(text: str) -> None:
    print(text, flush=True)


def _unsaid(_text: str) -> None:
    pass
