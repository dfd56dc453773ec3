"""`loadgen run`: plays a scenario, then verifies the answers, judges the checks and writes the summary.

`player` does what happens during the run; the testbed starts and ends the processes.
"""

import json
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from datetime import datetime, timezone
from functools import partial
from pathlib import Path
from typing import Any

from offboard.common import VERSION
from offboard.common.errors import OffloadError
from offboard.common.wording import duration, rounded
from offboard.loadgen.play.answer_verification import verified
from offboard.loadgen.play.machine import NOTED_PERCENT, StolenCpuTime
from offboard.loadgen.play.part_setups import setups
from offboard.loadgen.play.player import Player, started_at_first
from offboard.loadgen.play.run_digest import digests
from offboard.loadgen.play.run_files import (
    EVENTS,
    PICTURE,
    READINGS,
    SUMMARY,
    TRACE,
    RobotFiles,
    clear_folder,
)
from offboard.loadgen.play.run_table import run_table
from offboard.loadgen.play.watch import Page, watching
from offboard.loadgen.progress import progress
from offboard.loadgen.robot_files import alone_path, reference_path
from offboard.loadgen.scenario.outcome import Answered, Outcome
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.outcome_files import read_answered, read_readings, read_references
from offboard.loadgen.scenario.pass_fail_check import Verdict
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.site_shares import read_outage, share_lines, site_shares
from offboard.loadgen.table.measured_rows import write_whole
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.testbed import Setup, Testbed


def _docker(out: Path, setups: Mapping[str, Setup]) -> Testbed:
    from offboard.loadgen.testbed.docker_testbed import DockerTestbed

    return DockerTestbed(out, setups)


TESTBEDS: dict[str, Callable[[Path, Mapping[str, Setup]], Testbed]] = {
    "local": LocalTestbed,
    "docker": _docker,
}


@dataclass(frozen=True, slots=True)
class Played:
    """A run that was played to its end: its outcome, the verdict of every check, each robot's exit code.

    `stolen_percent` is the stolen share of the CPU time that the run asked for; None: unknown.
    """

    scenario: Scenario
    outcome: Outcome
    verdicts: Sequence[Verdict]
    exit_codes: Mapping[str, int]
    stolen_percent: float | None = None

    def check_robots(self) -> None:
        """OffloadError if a robot failed, unless an event ended it."""
        ended = {
            event.value for event in self.scenario.timeline() if event.action in ("kill", "stop", "restart")
        }
        for robot, code in self.exit_codes.items():
            if code != 0 and robot not in ended:
                how = f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}"
                raise OffloadError(f"{robot} {how}")

    def check_verdicts(self) -> None:
        """OffloadError if a check failed."""
        failed = [verdict for verdict in self.verdicts if not verdict.holds]
        if failed:
            raise OffloadError(f"{len(failed)} of {len(self.verdicts)} checks of {self.scenario.name} failed")


def play(
    scenario: Scenario, out: Path, testbed: str = "local", *, quiet: bool = False, page: Page = Page.NONE
) -> Played:
    """Play a scenario to its end. Its files in `out` (docs/formats.md) replace those of an older run.

    Unless `quiet`, progress lines and the output of the first robot go to stdout. `page`: the page that shows
    the run while it goes on.
    """
    say: Callable[[str], object] = (lambda _: None) if quiet else partial(print, flush=True)
    started_at, workload = datetime.now(timezone.utc), scenario.workload
    played_from = digests(scenario)  # taken now, because the parts load the software now
    with ExitStack() as opened:
        bed = opened.enter_context(TESTBEDS[testbed](out, setups(scenario, out, shown=not quiet)))
        clear_folder(out)
        if page is not Page.NONE:
            opened.enter_context(watching(out, say, page=page))
        say(f"starting {_servers_of(scenario)} (logs in {out / 'logs'})")
        with progress("compiling the planner" if workload.map else "starting", to=sys.stdout):
            bed.start(*started_at_first(scenario))
        many = "the robot" if workload.robots == 1 else f"{workload.robots} robots"
        noun = "plans" if workload.map else "steps" if workload.streams else "tasks"
        tasks = f"{workload.tasks} {noun}"
        say(f"starting {many} with a quota of {scenario.robot.cpus:g} CPU: {tasks}")
        stolen = StolenCpuTime()
        with progress("starting the robots", to=sys.stdout) as shown:
            exit_codes = Player(scenario, bed, say, shown).play()
        stolen_percent = stolen.percent()
    played = replace(judge(scenario, out, exit_codes), stolen_percent=stolen_percent)
    about = {"testbed": testbed, "started_at": started_at.isoformat(timespec="seconds"), **played_from}
    write_summary(out, played, about)
    for line in _ending(played, out):
        say(line)
    return played


def _servers_of(scenario: Scenario) -> str:
    count = len(scenario.servers)
    return "the cloud server and the relay" if count == 1 else f"{count} servers, each with its relay"


def _ending(played: Played, out: Path) -> Iterator[str]:
    """What a run says at its end: figures, verdicts and the files that it wrote."""
    yield f"\n{run_table(played.scenario.name, played.outcome)}"
    if links := played.scenario.recorded_text():
        yield links
    if len(played.scenario.servers) > 1:
        yield from share_lines(site_shares(played.outcome, played.scenario.sites()))
    yield from _findings(played.outcome)
    yield from map(str, played.verdicts)
    stolen_percent = played.stolen_percent
    if stolen_percent is not None and stolen_percent >= NOTED_PERCENT:
        yield f"warning: the host of this virtual machine took {stolen_percent:.0f} % of its CPU time (steal)"
    for path in (out / TRACE, alone_path(out / TRACE), out / SUMMARY, out / PICTURE):
        if path.exists():
            yield f"written: {path}"


def judge(scenario: Scenario, out: Path, exit_codes: Mapping[str, int]) -> Played:
    """Read the outcome of the run in `out`, verify its answers and judge its checks."""
    workload, asked = scenario.workload, {}
    answered: list[Answered] = []
    stopped = {event.value for event in scenario.timeline() if event.action == "stop"}
    for files in RobotFiles.of(scenario, out):
        answers = read_answered(files.answers, files.trace, files.robot)
        answered += verified(answers, workload, files.seed)
        # A stopped robot asked for no further tasks. The missing answers of a killed robot count as lost.
        last = max((one.i for one in answers), default=-1)
        asked[files.robot] = last + 1 if files.robot in stopped else workload.tasks
    outcome = Outcome(
        asked=asked,
        answered=answered,
        references=read_references(reference_path(out / TRACE)),
        readings=read_readings(out / READINGS),
        deadline_s=workload.deadline_s,
        outage=read_outage(out / EVENTS),
        costing=scenario.costing,
    )
    verdicts = [check.judge(outcome) for check in scenario.checks]
    return Played(scenario, outcome, verdicts, exit_codes)


def write_summary(out: Path, played: Played, about: Mapping[str, Any]) -> None:
    """Write summary.json, the last file of a run. `about` holds what no other file of the run says."""
    scenario = played.scenario
    summary = {
        "name": scenario.name,
        "seed": scenario.seed,
        "policy": scenario.robot.policy,
        "predictor": scenario.robot.predictor,
        "window": scenario.robot.window,
        "decided_by": asdict(scenario.decided_by),
        "tasks": scenario.workload.tasks * scenario.workload.robots,
        "recordings": scenario.recorded(),
        "software": VERSION,
        **about,
        "exit_codes": dict(played.exit_codes),
        "stolen_percent": played.stolen_percent,
        "figures": figures(played.outcome, scenario),
        "site_shares": site_shares(played.outcome, scenario.sites()),
        "checks": [verdict.as_dict() for verdict in played.verdicts],
    }
    write_whole(out / SUMMARY, json.dumps(summary, indent=2, ensure_ascii=False) + "\n")


def figures(outcome: Outcome, scenario: Scenario) -> dict[str, float | None]:
    """All figures that this workload allows, over the whole run."""
    known = scenario.workload.known()
    return {
        name: figure.compute(outcome)
        for name, figure in FIGURES.items()
        if figure.needs is None or known[figure.needs]
    }


def _findings(outcome: Outcome) -> Iterator[str]:
    """What people should know about a run even without a check."""
    overhead_ms, percent = (FIGURES[name].compute(outcome) for name in ("overhead_ms", "overhead_percent"))
    if overhead_ms is not None and percent is not None:
        share = f"{rounded(percent, 2)} % of the mean time of a task"
        yield f"overhead of Offboard itself: {duration(overhead_ms / 1e3)} per task (median), {share}"
    yield from _by_quality(outcome)
    for field, said in (("wrong", "wrong"), ("unverified", "not verified")):
        found = [one for one in outcome.answered if getattr(one, field) is not None]
        if found:
            first = f"the first is that of task {found[0].i} from {found[0].used}"
            yield f"warning: answers that are {said}: {len(found)}; {first}: {getattr(found[0], field)}"


def _by_quality(outcome: Outcome) -> Iterator[str]:
    """Quality and time of a task with variants, for each site that answered."""
    for site in sorted({one.used for one in outcome.answered if one.used and one.quality is not None}):
        part = replace(outcome, answered=[one for one in outcome.answered if one.used == site])
        quality, mean_ms = FIGURES["quality"].compute(part), FIGURES["mean_ms"].compute(part)
        mean = duration((mean_ms or 0.0) / 1e3)
        yield f"{site}: {len(part.answered)} answers of quality {quality:g} after {mean} (mean)"
