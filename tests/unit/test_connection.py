"""The states of a connection: what each event does in each of them, without a socket."""

import logging
import math
from collections.abc import Callable

import pytest

from offboard.common.logs import PAUSE_S
from offboard.robot_client.cloud.connection import (
    CONNECT_EVERY_S,
    HELLO_EVERY_S,
    LOG_LINES_MAX,
    NO_HANDSHAKE,
    UNKNOWN_ROBOT,
    Action,
    Connection,
    HandshakeFailure,
    State,
)

ENDPOINT = "tcp://server:5555"
NOW_S = 100.0
VERSIONS = "peer speaks wire version 2, this is version 1"
BROKEN = HandshakeFailure(NO_HANDSHAKE, final=False)
UNKNOWN = HandshakeFailure(UNKNOWN_ROBOT, final=True)

Event = Callable[[Connection], object]
HANDSHAKE: Event = lambda one: one.handshake_succeeded(NOW_S)  # noqa: E731 - one line for each event
HANDSHAKE_BROKEN: Event = lambda one: one.handshake_failed(BROKEN, NOW_S)  # noqa: E731
REFUSAL: Event = lambda one: one.handshake_failed(UNKNOWN, NOW_S)  # noqa: E731
DISCONNECT: Event = lambda one: one.disconnected(NOW_S)  # noqa: E731
HELLO: Event = lambda one: one.hello_answered(NOW_S)  # noqa: E731
OTHER_VERSION: Event = lambda one: one.other_version(VERSIONS, NOW_S)  # noqa: E731
CLOSE: Event = lambda one: one.close()  # noqa: E731
EVENTS = [HANDSHAKE, HANDSHAKE_BROKEN, REFUSAL, DISCONNECT, HELLO, OTHER_VERSION, CLOSE]

WAYS: dict[State, list[Event]] = {
    State.CONNECTING: [],
    State.GREETING: [HANDSHAKE],
    State.UP: [HANDSHAKE, HELLO],
    State.INCOMPATIBLE: [HANDSHAKE, OTHER_VERSION],
    State.LOST: [HANDSHAKE, HELLO, DISCONNECT],
    State.HANDSHAKE_FAILED: [HANDSHAKE_BROKEN],
    State.GIVEN_UP: [REFUSAL],
    State.CLOSED: [CLOSE],
}

GREETING, UP, INCOMPATIBLE, LOST = State.GREETING, State.UP, State.INCOMPATIBLE, State.LOST
FAILED, GIVEN_UP, CLOSED = State.HANDSHAKE_FAILED, State.GIVEN_UP, State.CLOSED
# For each state, where the events lead in the order of EVENTS.
NEXT: dict[State, list[State]] = {
    State.CONNECTING: [GREETING, FAILED, GIVEN_UP, LOST, State.CONNECTING, INCOMPATIBLE, CLOSED],
    GREETING: [GREETING, FAILED, GIVEN_UP, LOST, UP, INCOMPATIBLE, CLOSED],
    UP: [GREETING, FAILED, GIVEN_UP, LOST, UP, INCOMPATIBLE, CLOSED],
    INCOMPATIBLE: [GREETING, FAILED, GIVEN_UP, LOST, UP, INCOMPATIBLE, CLOSED],
    LOST: [GREETING, FAILED, GIVEN_UP, LOST, LOST, INCOMPATIBLE, CLOSED],
    FAILED: [GREETING, FAILED, GIVEN_UP, FAILED, FAILED, INCOMPATIBLE, CLOSED],
    GIVEN_UP: [GREETING, FAILED, GIVEN_UP, GIVEN_UP, GIVEN_UP, GIVEN_UP, CLOSED],
    CLOSED: [CLOSED] * len(EVENTS),
}


def led_to(state: State) -> Connection:
    connection = Connection("cloud", ENDPOINT)
    for event in WAYS[state]:
        event(connection)
    assert connection.state is state
    return connection


@pytest.mark.parametrize("state", list(State))
def test_every_event_leads_to_one_state(state: State) -> None:
    """Each event in each state leads where the table says."""
    found = []
    for event in EVENTS:
        connection = led_to(state)
        event(connection)
        found.append(connection.state)
    assert found == NEXT[state]


@pytest.mark.parametrize(
    ("state", "why"),
    [
        (State.CONNECTING, f"no answer from {ENDPOINT} yet"),
        (GREETING, f"connected to {ENDPOINT}, but its server has not answered yet"),
        (UP, None),
        (INCOMPATIBLE, VERSIONS),
        (LOST, f"not connected to {ENDPOINT}"),
        (FAILED, f"not connected to {ENDPOINT}: {NO_HANDSHAKE}"),
        (GIVEN_UP, f"not connected to {ENDPOINT}: {UNKNOWN_ROBOT}"),
        (CLOSED, "closed"),
    ],
)
def test_every_state_says_why_the_site_is_absent(state: State, why: str | None) -> None:
    """The text names the endpoint and the reason; an available site has none."""
    assert led_to(state).why_absent == why


@pytest.mark.parametrize("state", [state for state in State if state not in (GREETING, GIVEN_UP)])
def test_nothing_is_due_in_most_states(state: State) -> None:
    """libzmq connects by itself, so that only two states have something to do."""
    connection = led_to(state)
    assert connection.due_s == math.inf
    assert connection.take_due(NOW_S + 1e9) is None


def test_hello_is_said_at_once_and_again_until_it_is_answered() -> None:
    """The first hello is due with the handshake, the next one HELLO_EVERY_S later, none after the answer."""
    connection = led_to(GREETING)
    assert connection.due_s == NOW_S
    assert connection.take_due(NOW_S) is Action.SAY_HELLO
    assert connection.take_due(NOW_S + 0.99 * HELLO_EVERY_S) is None
    assert connection.take_due(NOW_S + HELLO_EVERY_S) is Action.SAY_HELLO
    assert connection.hello_answered(NOW_S)
    assert connection.take_due(NOW_S + 10 * HELLO_EVERY_S) is None


def test_a_refused_robot_connects_again_after_a_pause() -> None:
    """The pause starts when the connection ends. The reason stays until a handshake succeeds."""
    connection = led_to(GIVEN_UP)
    assert connection.due_s == NOW_S + CONNECT_EVERY_S
    connection.disconnected(NOW_S + 0.5)
    assert connection.take_due(NOW_S + CONNECT_EVERY_S) is None
    assert connection.take_due(NOW_S + 0.5 + CONNECT_EVERY_S) is Action.CONNECT_AGAIN
    assert connection.state is FAILED
    assert connection.take_due(NOW_S + 100.0) is None
    connection.disconnected(NOW_S + 101.0)
    assert connection.why_absent == f"not connected to {ENDPOINT}: {UNKNOWN_ROBOT}"
    connection.handshake_succeeded(NOW_S + 102.0)
    connection.disconnected(NOW_S + 103.0)
    assert connection.why_absent == f"not connected to {ENDPOINT}"


def test_only_the_first_answer_to_hello_brings_the_site_up() -> None:
    """A second answer changes nothing, and neither does one that a lost connection left behind."""
    connection = led_to(GREETING)
    assert connection.hello_answered(NOW_S)
    assert not connection.hello_answered(NOW_S)
    connection.disconnected(NOW_S)
    assert not connection.hello_answered(NOW_S)
    connection.handshake_succeeded(NOW_S)
    assert connection.hello_answered(NOW_S)


def test_the_log_says_each_change_once(caplog: pytest.LogCaptureFixture) -> None:
    """Up, lost, refused and incompatible are one line each, however often the event repeats."""
    connection = Connection("cloud", ENDPOINT)
    with caplog.at_level(logging.INFO):
        for event in (HANDSHAKE, HELLO, HELLO, DISCONNECT, DISCONNECT, REFUSAL, DISCONNECT):
            event(connection)
        connection.take_due(NOW_S + CONNECT_EVERY_S)
        for event in (REFUSAL, HANDSHAKE_BROKEN, HANDSHAKE, OTHER_VERSION, OTHER_VERSION, CLOSE, REFUSAL):
            event(connection)
    assert [record.getMessage() for record in caplog.records] == [
        f"cloud: {ENDPOINT} is up",
        f"cloud: connection to {ENDPOINT} lost; remedy: robot-client check",
        f"cloud: {ENDPOINT}: {UNKNOWN_ROBOT}; asking again; remedy: copy robot.key to the server",
        f"cloud: {VERSIONS}: tasks stay onboard; remedy: install one version",
    ]


def test_a_lost_server_that_is_back_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    """Whoever read of the loss reads of the return too, with the time in between, and of no second one."""
    connection = led_to(LOST)
    caplog.clear()
    with caplog.at_level(logging.WARNING):
        connection.handshake_failed(BROKEN, NOW_S + 1.0)
        connection.handshake_succeeded(NOW_S + 89.9)
        connection.hello_answered(NOW_S + 90.0)
        connection.handshake_succeeded(NOW_S + 91.0)
        connection.hello_answered(NOW_S + 91.0)
    assert [record.getMessage() for record in caplog.records] == [
        f"cloud: connected to {ENDPOINT} again after 90 s; remedy: none is needed"
    ]


def test_a_server_that_comes_and_goes_does_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """The first lines are logged, and then one in PAUSE_S, which says that others are not."""
    connection = Connection("cloud", ENDPOINT)
    pauses = 3
    with caplog.at_level(logging.INFO):
        for number in range(1001):
            connection.handshake_succeeded(NOW_S)
            connection.other_version(VERSIONS, NOW_S + number / 1000 * (pauses + 0.5) * PAUSE_S)
    lines = [record.getMessage() for record in caplog.records]
    left_out = [line for line in lines if line.endswith("(others within 10 s are not logged)")]
    assert len(lines) == LOG_LINES_MAX + pauses
    assert left_out == lines[LOG_LINES_MAX - 1 :]
