"""A comparison that goes on where it was stopped: the runs that were played before are not played again.

What a run is, and how it is judged, is the business of `play`; what it depends on that of `digest`.
"""

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.common.errors import DataError, OffloadError
from offboard.loadgen.play.digest import digests
from offboard.loadgen.play.play import SUMMARY, Played, figures, judge, play
from offboard.loadgen.scenario.scenario import Scenario

PLAYS_MAX = 5  # of one run in a row, whatever the host takes of them
DIFFERENCES = {
    "testbed": "it was on another testbed",
    "scenario_sha256": "its scenario or settings were others",
    "software_sha256": "its software was another",
}


def play_once(scenario: Scenario, out: Path, testbed: str, stolen_max: float | None = None) -> Played:
    """The run in `out` where it is this one and came to its end, else played now; stderr says which.

    A run of which the host took more than `stolen_max` percent is played again, the last of PLAYS_MAX kept.
    """
    before = played_before(scenario, out, testbed, _say, stolen_max)
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
                _say(f"kept in {out} after {plays} plays: {error}")
                return played
            _say(f"played again in {out}: {error}")
        else:
            return played


def played_before(
    scenario: Scenario, out: Path, testbed: str, say: Callable[[str], None], stolen_max: float | None = None
) -> Played | None:
    """This run as it was left in `out`, judged anew from its files; None where it must be played."""
    if not out.exists():
        return None
    try:
        about = _read_summary(out / SUMMARY)
        now = {"testbed": testbed, **digests(scenario)}
        for name, why in DIFFERENCES.items():
            if about.get(name) != now[name]:
                raise DataError(why)
        played = replace(
            judge(scenario, out, about["exit_codes"]), stolen_percent=about.get("stolen_percent")
        )
        played.check_robots()
        _check_undisturbed(played, stolen_max)
        _check_whole(played, about["figures"])
    except OffloadError as error:
        say(f"played again in {out}: {error}")
        return None
    say(f"taken from before: {out}")
    return played


def _read_summary(path: Path) -> dict[str, Any]:
    """It is written last: a run without one was stopped."""
    try:
        about = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError("it did not come to its end") from None
    except ValueError as error:
        raise DataError(f"{path.name} cannot be read: {error}") from None
    return about if isinstance(about, dict) else {}


def _check_undisturbed(played: Played, stolen_max: float | None) -> None:
    """DataError where the host took more percent than that; where nobody knows, it took nothing."""
    stolen = played.stolen_percent
    if stolen is not None and stolen_max is not None and stolen > stolen_max:
        raise DataError(f"the host took {stolen:.0f} % of the CPU time that it asked for")


def _check_whole(played: Played, figures_before: Mapping[str, Any]) -> None:
    """DataError where the files do not say what the summary does: some of them are gone, or others."""
    now = figures(played.outcome, played.scenario)
    for name, value in figures_before.items():
        if name in now and now[name] != value:
            raise DataError(f"{name} is {now[name]} by its files, and {value} in {SUMMARY}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
