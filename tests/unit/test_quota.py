"""What one robot may send in a second."""

from offboard.cloud_server.rate_limit import (
    BUSY_A_S,
    CUT_OFF_S,
    EXCESS_S,
    MESSAGE_BYTES,
    ROBOTS_MAX,
    RateLimit,
    Verdict,
)

RATE = 100 * MESSAGE_BYTES


def verdicts(quota: RateLimit, robot: bytes, count: int, now_s: float, size: int = 10) -> list[Verdict]:
    return [quota.judge(robot, size, now_s) for _ in range(count)]


def test_small_messages_are_bounded_by_number() -> None:
    """As many as the rate bears at 64 KiB each, then refusals, then what is not even read, then the end."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = verdicts(quota, b"a", 1_000, 0.0)
    refused, excess = int(BUSY_A_S), int(EXCESS_S * 100)
    assert refused == excess
    end = 100 + excess
    assert found[:end] == [Verdict.TAKE] * 100 + [Verdict.REFUSE] * refused
    assert found[end:] == [Verdict.CUT_OFF] + [Verdict.DROP] * (1_000 - end - 1)
    assert verdicts(quota, b"a", 1, CUT_OFF_S - 0.01) == [Verdict.DROP]
    assert verdicts(quota, b"a", 1, CUT_OFF_S) == [Verdict.TAKE]


def test_twice_the_rate_is_dropped_but_not_cut_off() -> None:
    """A robot that is a little too eager loses messages, not its connection."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = [quota.judge(b"a", 10, n / 192) for n in range(100_000)]
    assert Verdict.CUT_OFF not in found
    assert found.count(Verdict.REFUSE) > 40_000


def test_the_rate_is_what_it_says() -> None:
    """In ten seconds a robot that never stops has ten seconds' worth taken, and its burst."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = [quota.judge(b"a", 10, n / 128) for n in range(1_281)]
    assert found.count(Verdict.TAKE) == 1_100


def test_a_message_of_the_largest_size_is_taken_at_any_rate() -> None:
    """However low the rate, one of them may be sent at first, and again once it is paid for."""
    quota = RateLimit(1_000.0, 10**6)
    assert verdicts(quota, b"a", 1, 0.0, 10**6) == [Verdict.TAKE]
    assert verdicts(quota, b"a", 1, 999.0, 10**6) == [Verdict.REFUSE]
    assert verdicts(quota, b"a", 1, 1_000.0, 10**6) == [Verdict.TAKE]


def test_what_is_refused_costs_nothing() -> None:
    """A robot that asks on and on is served at its rate, not shut out."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 250, 0.0)
    assert verdicts(quota, b"a", 50, 0.5) == [Verdict.TAKE] * 50


def test_robots_do_not_share_a_quota() -> None:
    """One that has spent all leaves another as it was; the silent ones are forgotten beyond a number."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 10_000, 0.0)
    assert verdicts(quota, b"b", 1, 0.0) == [Verdict.TAKE]
    for n in range(ROBOTS_MAX):
        quota.judge(n.to_bytes(4, "big"), 10, 0.0)
    assert len(quota) == ROBOTS_MAX
    assert b"a" not in quota
