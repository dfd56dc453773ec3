"""The rate limit of the server: how much one robot may send per second."""

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


def test_small_messages_are_limited_by_number() -> None:
    """Messages beyond the rate (64 KiB each) are refused; then the robot is cut off for a while."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = verdicts(quota, b"a", 1_000, 0.0)
    refused, excess = int(BUSY_A_S), int(EXCESS_S * 100)
    assert refused == excess
    end = 100 + excess
    assert found[:end] == [Verdict.TAKE] * 100 + [Verdict.REFUSE] * refused
    assert found[end:] == [Verdict.CUT_OFF] + [Verdict.DROP] * (1_000 - end - 1)
    assert verdicts(quota, b"a", 1, CUT_OFF_S - 0.01) == [Verdict.DROP]
    assert verdicts(quota, b"a", 1, CUT_OFF_S) == [Verdict.TAKE]


def test_a_robot_at_twice_the_rate_is_not_cut_off() -> None:
    """A robot that sends nearly twice as much as allowed loses messages, but not its connection."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = [quota.judge(b"a", 10, n / 192) for n in range(100_000)]
    assert Verdict.CUT_OFF not in found
    assert found.count(Verdict.REFUSE) > 40_000


def test_the_rate_is_kept_over_time() -> None:
    """In ten seconds, a robot that never stops sending gets its burst and ten seconds of its rate."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    found = [quota.judge(b"a", 10, n / 128) for n in range(1_281)]
    assert found.count(Verdict.TAKE) == 1_100


def test_a_message_of_the_largest_size_is_accepted_at_any_rate() -> None:
    """Even at a low rate the largest message is accepted, and again after the time that it costs."""
    quota = RateLimit(1_000.0, 10**6)
    assert verdicts(quota, b"a", 1, 0.0, 10**6) == [Verdict.TAKE]
    assert verdicts(quota, b"a", 1, 999.0, 10**6) == [Verdict.REFUSE]
    assert verdicts(quota, b"a", 1, 1_000.0, 10**6) == [Verdict.TAKE]


def test_a_refused_message_does_not_use_up_the_rate() -> None:
    """A robot that keeps sending too much is still served at its rate."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 250, 0.0)
    assert verdicts(quota, b"a", 50, 0.5) == [Verdict.TAKE] * 50


def test_every_robot_has_its_own_limit() -> None:
    """A robot at its limit does not affect others; beyond ROBOTS_MAX robots the quietest are forgotten."""
    quota = RateLimit(RATE, MESSAGE_BYTES)
    verdicts(quota, b"a", 10_000, 0.0)
    assert verdicts(quota, b"b", 1, 0.0) == [Verdict.TAKE]
    for n in range(ROBOTS_MAX):
        quota.judge(n.to_bytes(4, "big"), 10, 0.0)
    assert verdicts(quota, b"a", 1, 0.0) == [Verdict.TAKE], (
        "the robot was forgotten, so its limit starts again"
    )
