"""The first calls of a new robot, and calls with a deadline, with a real server behind a real relay."""

from pathlib import Path

import pytest

from benchmarks.deadlines import NOT_STARTED, PROGRAMS, Program, play
from benchmarks.first_calls import CALLS, ROUND_TRIP_MS
from benchmarks.first_calls import play as play_first
from offboard.robot_client.sites.runner import ONBOARD

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

ROBOTS = 3
DEADLINES = 80  # calls of each program, of which about ten stall


def test_no_first_call_waits_for_a_slow_link(tmp_path: Path) -> None:
    """Each of the first six calls is answered onboard before an answer of the server could come."""
    for records in play_first(ROBOTS, tmp_path):
        print([f"{1e3 * one.waited_s:.1f} ms" for one in records])
        assert len(records) == CALLS
        for record in records:
            assert record.used == ONBOARD
            assert 1e3 * record.waited_s < ROUND_TRIP_MS
        assert [len(one.executions) > 1 for one in records] == [True] + [False] * (CALLS - 1)


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda one: one.name)
def test_onboard_is_started_before_every_deadline(program: Program, tmp_path: Path) -> None:
    """Where the server or the link stalls, onboard runs the task; most answers are still the better ones."""
    counted = play(program, DEADLINES, tmp_path)
    print(counted)
    assert NOT_STARTED not in counted.causes
    assert counted.quality > 0.85  # 0.7 onboard, 1 in the cloud
