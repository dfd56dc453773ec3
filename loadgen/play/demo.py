"""`loadgen demo`: one outage on a real map, with the default policy and then with the published rule."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.wording import duration, rounded
from offboard.loadgen.play.play_scenario import Played, play
from offboard.loadgen.play.run_files import PICTURE
from offboard.loadgen.play.watch import Page
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

PUBLISHED = "paper"  # the policy, and the folder of its run
PROGRAM = "loadgen"


def play_demo(out: Path) -> int:
    """Play the shipped demo scenario with both policies, and end in three sentences about them."""
    scenario = read_scenario(find_scenario("demo"))
    ours = play(scenario, out, page=Page.SERVED)
    ours.check_robots()
    print("\nThe same again, by the published rule:", flush=True)
    theirs = play(scenario.changed(policy=PUBLISHED), out / PUBLISHED)
    theirs.check_robots()
    print("\n".join(["", *ending(scenario, ours, theirs, out)]))
    return 0


def ending(scenario: Scenario, ours: Played, theirs: Played, out: Path) -> list[str]:
    """What was compared, what came out, and where to look next, for somebody who is new to the project."""
    silent, back = (event.at_task for event in scenario.events)
    far_ms = 2 * scenario.link["delay_ms"]
    picture = f", and {out / PICTURE} is a picture of the last plan" if (out / PICTURE).exists() else ""
    return [
        f"Compared: the same {scenario.workload.tasks} plans, once with Offboard and once with the published"
        " rule from which this project started, in real processes on this machine: a robot with"
        f" {scenario.robot.cpus:g} CPU, its server {far_ms:g} ms away, and a link that was silent"
        f" from plan {silent} to plan {back}.",
        f"Result: a plan took {_mean(ours)} in the mean with Offboard and {_mean(theirs)} with the published"
        f" rule, and the slowest one {_slowest(ours)} and {_slowest(theirs)}; Offboard sent"
        f" {_cloud(ours, 0, silent)} of the plans to the server before the silence and {_cloud(ours, back)}"
        f" after it, and the published rule, which learns about a site only by choosing it,"
        f" {_cloud(theirs, 0, silent)} and {_cloud(theirs, back)}.",
        f"Next: `{_program()} watch {out}` shows each plan and why it ran where it did{picture}; this was one"
        " run, and docs/results.md has more of them with intervals, next to always onboard and always cloud,"
        " and the cases where another policy is faster.",
    ]


def _mean(played: Played) -> str:
    return duration(_value("mean_ms", played) / 1e3)


def _slowest(played: Played) -> str:
    return duration(max(one.response_s for one in played.outcome.answered))


def _program() -> str:
    """`loadgen` as it was called, so that it can be called again."""
    called = sys.argv[0]
    return called if Path(called).name == PROGRAM else PROGRAM


def _cloud(played: Played, first: int | None, last: int | None = None) -> str:
    """The share of these tasks that went to the server, without those that ran on both to be measured."""
    part = replace(played, outcome=played.outcome.between(first or 0, last))
    return f"{rounded(_value('cloud_percent', part), 2)} %"


def _value(figure: str, played: Played) -> Any:
    return FIGURES[figure].compute(played.outcome)
