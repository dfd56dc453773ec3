"""The runs of a comparison: each policy plays each scenario, unless that run was already played to its end.

`run_digest` says what a run depends on; `play_scenario` plays and judges it.
"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError, OffloadError
from offboard.loadgen.compare.compare_settings import PLAYS_MAX, RunsConfig
from offboard.loadgen.play.play_scenario import Played, figures, judge, play
from offboard.loadgen.play.run_digest import digests
from offboard.loadgen.play.run_files import SUMMARY
from offboard.loadgen.progress import Progress
from offboard.loadgen.scenario.outcome import Outcome
from offboard.loadgen.scenario.scenario import Scenario
from offboard.loadgen.scenario.scenario_file import check_calls, find_scenario, read_scenario

DIFFERENCES = {
    "testbed": "it was played on another testbed",
    "scenario_sha256": "its scenario or settings were different",
    "software_sha256": "its software was different",
}


def read_scenarios(names: Sequence[str], **changes: Any) -> list[Scenario]:
    """The scenarios with these names, as `Scenario.changed` changes them."""
    found = []
    for path in map(find_scenario, names):
        scenario = read_scenario(path).changed(**changes)
        check_calls(scenario, path)
        found.append(scenario)
    return found


def play_runs(
    units: Sequence[Scenario],
    config: RunsConfig,
    shown: Progress,
    *,
    first_turn: int = 0,
    stolen_max: float | None = None,
) -> dict[str, list[Played]]:
    """The real runs of each unit, by policy.

    The runs of a unit follow each other directly, and each policy comes first equally often, so that changes
    of the machine affect all policies in the same way.
    """
    strategies = config.strategies()
    played: dict[str, list[Played]] = {policy: [] for policy in config.policies}
    for turn, unit in enumerate(units, first_turn):
        for policy in rotated(config.policies, turn):
            _say(f"{unit.name}, seed {unit.seed}, policy {policy}")
            out = config.out / unit.name / f"{unit.seed}-{policy}"
            scenario = unit.changed(**strategies[policy])
            played[policy].append(play_once(scenario, out, config.testbed, stolen_max))
            shown.step()
    return played


def outcomes(played: Mapping[str, Sequence[Played]]) -> dict[str, list[Outcome]]:
    return {policy: [one.outcome for one in runs] for policy, runs in played.items()}


def rotated(names: Sequence[str], turns: int) -> Sequence[str]:
    """The names in the same order, beginning with another one each turn."""
    start = turns % len(names)
    return [*names[start:], *names[:start]]


def play_once(scenario: Scenario, out: Path, testbed: str, stolen_max: float | None = None) -> Played:
    """The finished run in `out` if it is the same run, else a new one; stderr says which.

    A run is played again if the host took more than `stolen_max` percent of its CPU time. After PLAYS_MAX
    plays the last one is kept.
    """
    before = played_before(scenario, out, testbed, say=_say, stolen_max=stolen_max)
    if before is not None:
        return before
    plays = 0
    while True:
        played = play(scenario, out, testbed, quiet=True)
        played.check_robots()
        plays += 1
        try:
            _check_undisturbed(played, stolen_max)
        except DataError as error:
            if plays == PLAYS_MAX:
                _say(f"kept the run in {out} after {plays} plays: {error}")
                return played
            _say(f"playing the run in {out} again: {error}")
        else:
            return played


def played_before(
    scenario: Scenario,
    out: Path,
    testbed: str,
    *,
    say: Callable[[str], None],
    stolen_max: float | None = None,
) -> Played | None:
    """The finished run in `out`, judged again from its files; None if it must be played."""
    if not out.exists():
        return None
    try:
        about = _read_summary(out / SUMMARY)
        now = {"testbed": testbed, **digests(scenario)}
        for name, why in DIFFERENCES.items():
            if about.get(name) != now[name]:
                raise DataError(why)
        judged = judge(scenario, out, about["exit_codes"])
        played = replace(judged, stolen_percent=about.get("stolen_percent"))
        played.check_robots()
        _check_undisturbed(played, stolen_max)
        _check_complete(played, about["figures"])
    except OffloadError as error:
        say(f"playing the run in {out} again: {error}")
        return None
    say(f"using the finished run in {out}")
    return played


def _read_summary(path: Path) -> dict[str, Any]:
    """The summary of a run. It is written last, so that a run without one was stopped before its end."""
    try:
        about = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError("it was not played to its end") from None
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path.name} cannot be read: {error}") from None
    return about if isinstance(about, dict) else {}


def _check_undisturbed(played: Played, stolen_max: float | None) -> None:
    """DataError if the host took more than `stolen_max` percent of the CPU time.

    An unknown share is allowed.
    """
    stolen = played.stolen_percent
    if stolen is not None and stolen_max is not None and stolen > stolen_max:
        raise DataError(f"the host took {stolen:.0f} % of the CPU time that the run asked for")


def _check_complete(played: Played, figures_before: Mapping[str, Any]) -> None:
    """DataError if the figures from the files differ from the summary: then files are missing or changed."""
    now = figures(played.outcome, played.scenario)
    for name, value in figures_before.items():
        if name in now and now[name] != value:
            raise DataError(f"{name} is {now[name]} in its files, but {value} in {SUMMARY}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
