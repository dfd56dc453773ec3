"""How long a site is left out for a kind whose values cannot cross."""

import time

import pytest

from offboard.common.errors import CannotCross, CloudBusy, OffloadError, TaskFailed
from offboard.robot_client.sites.absence import PAUSE_MAX_S, CrossingPauses

BAD = CannotCross("result: a set")


def left_s(pauses: CrossingPauses) -> float:
    """The rest of the pause of `plan`, as its text says."""
    why = pauses.why_absent("plan")
    return 0.0 if why is None else float(why.split(" in ")[1].removesuffix(" s"))


def test_pauses_grow_to_a_minute() -> None:
    """The first two calls make no pause; then each pause is twice as long, at most PAUSE_MAX_S."""
    pauses, now_s, found = CrossingPauses(), time.perf_counter(), []
    for _ in range(10):
        pauses.note("plan", BAD, now_s)
        found.append(left_s(pauses))
    assert found == [0, 0, 1, 2, 4, 8, 16, 32, PAUSE_MAX_S, PAUSE_MAX_S]
    for _ in range(5000):
        pauses.note("plan", BAD, now_s)
    assert left_s(pauses) == PAUSE_MAX_S
    pauses.note("plan", BAD, now_s - PAUSE_MAX_S)
    assert pauses.why_absent("plan") is None


@pytest.mark.parametrize("ended", [None, TaskFailed("no"), CloudBusy("full")])
def test_a_call_that_crossed_ends_them(ended: OffloadError | None) -> None:
    """The next values that cannot cross count from one; other kinds are not concerned."""
    pauses, now_s = CrossingPauses(), time.perf_counter()
    for _ in range(3):
        pauses.note("plan", BAD, now_s)
        pauses.note("scan", ended, now_s)
    assert pauses.why_absent("scan") is None
    pauses.note("plan", ended, now_s)
    assert pauses.why_absent("plan") is None
    pauses.note("plan", BAD, now_s)
    assert pauses.why_absent("plan") is None
