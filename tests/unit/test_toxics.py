"""Toxiproxy's toxics: the link that they make, the errors, and the connections that get them."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.link.link import Link, LinkConditions
from offboard.loadgen.relay.tcp.relay import Refusal, RelaySettings
from offboard.loadgen.relay.toxiproxy.toxics import (
    ATTRIBUTES,
    Refused,
    Toxic,
    ToxicRelay,
    attributes,
    closes_after_s,
    link_of,
)


def toxic(type: str, stream: str = "downstream", toxicity: float = 1.0, **given: Any) -> Toxic:
    return Toxic(f"{type}_{stream}", type, stream, toxicity, attributes(type, given))


NOTHING = LinkConditions(distribution="uniform")


@pytest.mark.parametrize(
    ("toxics", "conditions"),
    [
        ([], {}),
        ([toxic("latency", latency=30, jitter=4)], {"delay_ms": 30, "jitter_ms": 4}),
        (
            [toxic("latency", latency=30, jitter=4), toxic("latency", latency=12, jitter=1)],
            {"delay_ms": 42, "jitter_ms": 5},
        ),
        ([toxic("bandwidth", rate=125)], {"bandwidth_mbps": 1}),
        ([toxic("bandwidth", rate=rate) for rate in (250, 0, 125)], {"bandwidth_mbps": 1}),
        ([toxic("bandwidth", rate=0)], {}),
        ([toxic("slow_close", delay=30), toxic("slow_close", delay=20)], {"slow_close_ms": 50}),
        ([toxic("timeout")], {"hang": True}),
        ([toxic("timeout", timeout=500)], {"hang": True}),
        ([toxic("reset_peer", timeout=70)], {"hang": True, "reset_after_ms": 70}),
        ([toxic("reset_peer")], {"hang": True, "reset_after_ms": 1}),
        ([toxic("reset_peer", timeout=ms) for ms in (90, 0)], {"hang": True, "reset_after_ms": 1}),
        ([toxic("limit_data", bytes=size) for size in (9, 5, 7)], {"truncate_bytes": 5}),
        (
            [toxic("limit_data", bytes=9), toxic("latency", latency=3), toxic("bandwidth", rate=1)],
            {"truncate_bytes": 9, "delay_ms": 3, "bandwidth_mbps": 0.008},
        ),
    ],
)
def test_toxics_of_a_stream_make_one_link(toxics: list[Toxic], conditions: dict[str, Any]) -> None:
    """Delays add up; the lowest bandwidth and the first end count; the other direction is unchanged."""
    expected = LinkConditions(distribution="uniform", **conditions)
    assert link_of(toxics) == Link(up=NOTHING, down=expected)
    up = [Toxic(one.name, one.type, "upstream", 1.0, one.attributes) for one in toxics]
    assert link_of(up) == Link(up=expected, down=NOTHING)


def test_toxics_that_exceed_a_limit_together_are_refused() -> None:
    """Toxics that are allowed one by one are refused if their sum exceeds a limit of the link."""
    with pytest.raises(ConfigError, match=r"delay_ms: 60001.0 is not a number from 0 to 60000"):
        link_of([toxic("latency", latency=60_000), toxic("latency", latency=1)])


def test_the_first_timeout_closes() -> None:
    """The shortest timeout ends the connection; a timeout of 0 and other types never do."""
    assert closes_after_s([]) is None
    assert closes_after_s([toxic("timeout"), toxic("reset_peer", timeout=5)]) is None
    assert closes_after_s([toxic("timeout", timeout=ms) for ms in (0, 300, 200)]) == 0.2


@pytest.mark.parametrize(
    ("type", "given", "message"),
    [
        ("latency", {"latency": -1}, "latency: -1 is not a whole number from 0 to 60000"),
        ("latency", {"latency": 60_001}, "latency: 60001 is not a whole number from 0 to 60000"),
        ("latency", {"jitter": 1.5}, "jitter: 1.5 is not a whole number from 0 to 60000"),
        ("bandwidth", {"rate": True}, "rate: True is not a whole number from 0 to 12500000"),
        ("timeout", {"timeout": "9"}, "timeout: '9' is not a whole number from 0 to 86400000"),
        ("limit_data", {}, "bytes: 0 is not a whole number from 1 to"),
    ],
)
def test_a_bad_attribute_is_refused(type: str, given: dict[str, Any], message: str) -> None:
    """The error names attribute, value and what is allowed, with the HTTP status of Toxiproxy."""
    with pytest.raises(Refused) as refused:
        attributes(type, given)
    assert str(refused.value).startswith(f"bad request body: {message}")
    assert refused.value.status == 400


def test_attributes_that_are_left_out_keep_their_value() -> None:
    """An attribute that is left out or null keeps its value, at first 0; unknown attributes are ignored."""
    first = attributes("latency", {"latency": 9, "speed": 3})
    assert first == {"latency": 9, "jitter": 0}
    assert attributes("latency", {"jitter": 2, "latency": None}, first) == {"latency": 9, "jitter": 2}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"type": "slicer"}, "invalid toxic type: 'slicer' is not one of latency, bandwidth, slow_close, "),
        ({"stream": "down"}, "stream was invalid, can be either upstream or downstream"),
        ({"toxicity": 1.1}, "bad request body: toxicity: 1.1 is not a number from 0 to 1"),
        ({"toxicity": float("nan")}, "bad request body: toxicity: nan is not a number from 0 to 1"),
    ],
)
def test_a_bad_toxic_is_refused(wrong: dict[str, Any], message: str) -> None:
    """The type, the stream and the toxicity of a toxic are checked."""
    good = {"name": "t", "type": "latency", "stream": "upstream", "toxicity": 1.0, "attributes": {}}
    Toxic(**good)
    with pytest.raises(Refused) as refused:
        Toxic(**good | wrong)
    assert str(refused.value).startswith(message)


@given(seed=st.integers(0, 2**64), type=st.sampled_from(list(ATTRIBUTES)), toxicity=st.floats(0, 1))
def test_which_connections_get_a_toxic(seed: int, type: str, toxicity: float) -> None:
    """Toxicity 1 is all connections, 0 is none; the same seed gives the same ones; more toxicity adds."""
    given = {"bytes": 1}
    some, all_, none = (toxic(type, toxicity=share, **given) for share in (toxicity, 1.0, 0.0))
    for connection in range(20):
        assert all_.strikes(seed, connection)
        assert not none.strikes(seed, connection)
        struck = some.strikes(seed, connection)
        assert struck == toxic(type, toxicity=toxicity, **given).strikes(seed, connection)
        assert struck <= toxic(type, toxicity=(1 + toxicity) / 2, **given).strikes(seed, connection)


def test_toxicity_is_the_share_of_connections() -> None:
    """At a toxicity of 0.3, 30 % of 4,000 connections get the toxic (within four standard errors).

    The streams draw independently.
    """
    down, up = toxic("latency", toxicity=0.3), toxic("latency", "upstream", toxicity=0.3)
    struck = [(down.strikes(1, number), up.strikes(1, number)) for number in range(4000)]
    assert sum(hit for hit, _ in struck) / 4000 == pytest.approx(0.3, abs=0.029)
    assert sum(hit and other for hit, other in struck) / 4000 == pytest.approx(0.09, abs=0.018)


def test_a_connection_after_the_close_is_refused() -> None:
    """A connection that the kernel accepted just before the proxy was disabled is closed."""
    relay = ToxicRelay(("127.0.0.1", 1), RelaySettings(seed=0, connections_max=1, buffer_bytes=1 << 20))
    assert isinstance(relay.accept(), Refusal)
    assert not relay.connections
