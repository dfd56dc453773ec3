"""What one robot may send in a second."""

from cloud_server.quota import BUSY_A_S, MESSAGE_BYTES, ROBOTS_MAX, Quota, Verdict

RATE = 100 * MESSAGE_BYTES


def verdicts(quota: Quota, robot: bytes, count: int, now_s: float, size: int = 10) -> list[Verdict]:
    return [quota.judge(robot, size, now_s) for _ in range(count)]


def test_small_messages_are_bounded_by_number() -> None:
    """As many as the rate bears at 64 KiB each, then refusals, then what is not even read."""
    found = verdicts(Quota(RATE, MESSAGE_BYTES), b"a", 1_000, 0.0)
    refused = int(BUSY_A_S)
    assert found == [Verdict.TAKE] * 100 + [Verdict.REFUSE] * refused + [Verdict.DROP] * (900 - refused)


def test_the_rate_is_what_it_says() -> None:
    """In ten seconds a robot that never stops has ten seconds' worth taken, and its burst."""
    quota = Quota(RATE, MESSAGE_BYTES)
    found = [quota.judge(b"a", 10, n / 1_024) for n in range(10_241)]
    assert found.count(Verdict.TAKE) == 1_100


def test_a_message_of_the_largest_size_is_taken_at_any_rate() -> None:
    """However low the rate, one of them may be sent at first, and again once it is paid for."""
    quota = Quota(1_000.0, 10**6)
    assert verdicts(quota, b"a", 1, 0.0, 10**6) == [Verdict.TAKE]
    assert verdicts(quota, b"a", 1, 999.0, 10**6) == [Verdict.REFUSE]
    assert verdicts(quota, b"a", 1, 1_000.0, 10**6) == [Verdict.TAKE]


def test_what_is_refused_costs_nothing() -> None:
    """A robot that asks on and on is served at its rate, not shut out."""
    quota = Quota(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 100_000, 0.0)
    assert verdicts(quota, b"a", 50, 0.5) == [Verdict.TAKE] * 50


def test_robots_do_not_share_a_quota() -> None:
    """One that has spent all leaves another as it was; the silent ones are forgotten beyond a number."""
    quota = Quota(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 10_000, 0.0)
    assert verdicts(quota, b"b", 1, 0.0) == [Verdict.TAKE]
    for n in range(ROBOTS_MAX):
        quota.judge(n.to_bytes(4, "big"), 10, 0.0)
    assert len(quota._robots) == ROBOTS_MAX
    assert b"a" not in quota._robots
