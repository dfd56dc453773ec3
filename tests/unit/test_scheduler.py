"""Requests that have cost too many workers, and the log of failed tasks."""

import pytest

from offboard.cloud_server.executors.executor import Outcome
from offboard.cloud_server.failures import CRASHED_KEPT, CRASHES_MAX, FAILURES_KEPT, CrashCount, FailureLog


def test_a_request_is_refused_after_its_last_crash() -> None:
    """Robot and id together name a request; the same id of another robot is another request."""
    crashes = CrashCount()
    for _ in range(CRASHES_MAX):
        assert not crashes.too_many(b"robot", 7)
        crashes.note(b"robot", 7)
    assert crashes.too_many(b"robot", 7)
    assert not crashes.too_many(b"robot", 8)
    assert not crashes.too_many(b"other", 7)


def test_the_memory_of_crashes_is_limited() -> None:
    """The request with the oldest crash is forgotten first."""
    crashes = CrashCount()
    for _ in range(CRASHES_MAX):
        for id in (1, 2):
            crashes.note(b"robot", id)
    for id in range(3, 3 + CRASHED_KEPT - 2):
        crashes.note(b"robot", id)
    crashes.note(b"robot", 1)
    crashes.note(b"robot", 0)
    assert len(crashes._counts) == CRASHED_KEPT
    assert [crashes.too_many(b"robot", id) for id in (1, 2)] == [True, False]


def test_a_failure_is_logged_once_for_each_kind_and_type(caplog: pytest.LogCaptureFixture) -> None:
    """The warning has the traceback. Failures without one are not logged, and the memory is limited."""
    failures = FailureLog()
    for kind, error in [("plan", "ValueError: 1"), ("plan", "ValueError: 2"), ("plan", "OSError: 3")]:
        failures.note(kind, Outcome("failed", error, traceback=f"Traceback\n{error}\n"))
    failures.note("see", Outcome("failed", "the worker died"))
    text = "task plan failed; its next failures with {0} are not logged; remedy: correct the task\n"
    text += "Traceback\n{0}: {1}"
    assert [record.getMessage() for record in caplog.records] == [
        text.format("ValueError", 1),
        text.format("OSError", 3),
    ]
    for number in range(2 * FAILURES_KEPT):
        failures.note("plan", Outcome("failed", f"Error{number}: made up", traceback="Traceback"))
    assert len(caplog.records) == FAILURES_KEPT
