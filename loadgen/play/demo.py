"""`loadgen demo`: one outage on a real map, with the default policy and then with the published rule."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.wording import rounded
from offboard.loadgen.play.play_scenario import Played, play
from offboard.loadgen.play.run_files import PICTURE
from offboard.loadgen.play.watch import Page
from offboard.loadgen.scenario.outcome_figures import FIGURES
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario

PUBLISHED = "paper"  # the policy, and the folder of its run


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
    picture = f"; {out / PICTURE} is a picture of the last plan" if (out / PICTURE).exists() else ""
    return [
        f"Compared: the same {scenario.workload.tasks} plans, in real processes on this machine, with"
        " Offboard and with the published rule from which this project started; the link to the server was"
        f" silent from plan {silent} to plan {back}.",
        f"Result: from question to path, a plan took {_ms('mean_ms', ours)} in the mean with Offboard and"
        f" {_ms('mean_ms', theirs)} with the published rule, and one in a hundred took longer than"
        f" {_ms('p99_ms', ours)} and {_ms('p99_ms', theirs)}; Offboard sent {_cloud(ours, 0, silent)} of the"
        f" plans to the server before the silence and {_cloud(ours, back)} after it, the published rule"
        f" {_cloud(theirs, 0, silent)} and {_cloud(theirs, back)}; it learns only from the site that it"
        " chooses.",
        f"Next: `loadgen watch {out}` shows each plan and why it ran where it did{picture}; docs/results.md"
        " has recorded links, more runs with intervals, and the cases where another policy is faster.",
    ]


def _ms(figure: str, played: Played) -> str:
    return f"{rounded(_value(figure, played))} ms"


def _cloud(played: Played, first: int | None, last: int | None = None) -> str:
    """The share of these tasks that went to the server, without those that ran on both to be measured."""
    part = replace(played, outcome=played.outcome.between(first or 0, last))
    return f"{rounded(_value('cloud_percent', part), 2)} %"


def _value(figure: str, played: Played) -> Any:
    return FIGURES[figure].compute(played.outcome)
