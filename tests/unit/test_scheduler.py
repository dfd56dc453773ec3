"""Requests that have cost too many workers."""

from offboard.cloud_server.scheduler import CRASHED_KEPT, CRASHES_MAX, CrashCount


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
    assert len(crashes) == CRASHED_KEPT
    assert [crashes.too_many(b"robot", id) for id in (1, 2)] == [True, False]
