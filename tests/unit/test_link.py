"""The conditions of a link: what is allowed, and how they are changed."""

import math
from typing import Any

import pytest

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link, LinkConditions


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"delay_ms": -1}, "delay_ms: -1 is not a number from 0 to 60000"),
        ({"delay_ms": math.nan}, "delay_ms: nan is not a number from 0 to 60000"),
        ({"jitter_ms": "5"}, "jitter_ms: '5' is not a number from 0 to 60000"),
        ({"bandwidth_mbps": math.inf}, "bandwidth_mbps: inf is not a number from 0 to 100000"),
        ({"bandwidth_mbps": True}, "bandwidth_mbps: True is not a number from 0 to 100000"),
        (
            {"distribution": "gamma"},
            "distribution: 'gamma' is not one of constant, uniform, normal, pareto, lognormal, samples",
        ),
        ({"outage": 1}, "outage: 1 is neither true nor false"),
        ({"hang": 0}, "hang: 0 is neither true nor false"),
        ({"correlation": 1.5}, "correlation: 1.5 is not a number from 0 to 1"),
        ({"loss": 2}, "loss: 2 is not a number from 0 to 1"),
        ({"loss_burst": 0.5}, "loss_burst: 0.5 is not a number from 1 to 10000"),
        ({"stall_ms": -1}, "stall_ms: -1 is not a number from 0 to 60000"),
        ({"reset_after_ms": None}, "reset_after_ms: None is not a number from 0 to 8.64e+07"),
        ({"truncate_bytes": 1.5}, "truncate_bytes: 1.5 is not a whole number"),
        ({"slow_close_ms": "1"}, "slow_close_ms: '1' is not a number from 0 to 60000"),
        ({"samples": "file"}, "samples: 'file' is not a list of delays in ms"),
        ({"samples": [1, -2]}, "samples: -2 is not a number from 0 to 60000"),
        ({"distribution": "samples"}, "samples: the list is empty, but distribution 'samples' needs delays"),
    ],
)
def test_a_bad_condition_is_named(values: dict[str, Any], message: str) -> None:
    """A wrong condition is refused; the error names the field, the value, and what is allowed."""
    with pytest.raises(ConfigError) as caught:
        LinkConditions(**values)
    assert str(caught.value) == message


def test_a_link_changes_in_both_directions_or_one() -> None:
    """A plain name changes both directions, and `up` or `down` one of them; the narrower change wins."""
    link = Link().changed({"delay_ms": 5, "down": {"delay_ms": 7, "outage": True}})
    assert link == Link(up=LinkConditions(delay_ms=5), down=LinkConditions(delay_ms=7, outage=True))


def test_an_unknown_condition_is_named() -> None:
    """An unknown name is refused, and the error lists the known names."""
    with pytest.raises(ConfigError, match="delay: unknown condition; known: delay_ms, jitter_ms"):
        Link().changed({"delay": 5})
