"""A comparison that goes on where it was stopped: the runs that were played before are not played again.

What a run is, and how it is judged, is the business of `play`; what it depends on that of `digest`.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from common.errors import DataError, OffloadError
from loadgen.digest import digests
from loadgen.play import SUMMARY, Played, figures, judge, play
from loadgen.scenario import Scenario

DIFFERENCES = {
    "testbed": "it was on another testbed",
    "scenario_sha256": "its scenario or settings were others",
    "software_sha256": "its software was another",
}


def play_once(scenario: Scenario, out: Path, testbed: str) -> Played:
    """The run in `out` where it is this one and came to its end, else played now; stderr says which."""
    before = played_before(scenario, out, testbed, _say)
    if before is not None:
        return before
    played = play(scenario, out, testbed, quiet=True)
    played.check_robots()
    return played


def played_before(scenario: Scenario, out: Path, testbed: str, say: Callable[[str], None]) -> Played | None:
    """This run as it was left in `out`, judged anew from its files; None where it must be played."""
    if not out.exists():
        return None
    try:
        about = _read_summary(out / SUMMARY)
        now = {"testbed": testbed, **digests(scenario)}
        for name, why in DIFFERENCES.items():
            if about.get(name) != now[name]:
                raise DataError(why)
        played = judge(scenario, out, about["exit_codes"])
        played.check_robots()
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


def _check_whole(played: Played, figures_before: Mapping[str, Any]) -> None:
    """DataError where the files do not say what the summary does: some of them are gone, or others."""
    now = figures(played.outcome, played.scenario)
    for name, value in figures_before.items():
        if name in now and now[name] != value:
            raise DataError(f"{name} is {now[name]} by its files, and {value} in {SUMMARY}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
