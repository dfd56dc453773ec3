"""The states of the connection to one server: why the site is unavailable, and what to do next.

Pure: events and times come in as arguments. `cloud` owns the socket and does what is due.
"""

import logging
import math
from dataclasses import dataclass
from enum import Enum, auto

from offboard.common.logs import RareLog
from offboard.common.wording import duration
from offboard.robot_client.sites.runner import Lasting

HELLO_EVERY_S = 1.0  # until it is answered
CONNECT_EVERY_S = 1.0  # once libzmq has stopped trying
LOG_LINES_MAX = 10  # about one connection, before they become rare

log = logging.getLogger(__name__)


class State(Enum):
    """Where a connection stands. A handshake that succeeds leads to GREETING from every state but CLOSED.

    CONNECTING --handshake--> GREETING --hello--> UP --disconnected--> LOST
        |                        `--other version--> INCOMPATIBLE
        |--handshake failed--> HANDSHAKE_FAILED
        `--handshake failed, libzmq stops--> GIVEN_UP --connect again--> HANDSHAKE_FAILED
    """

    CONNECTING = auto()
    GREETING = auto()  # the server has not answered `hello` yet
    UP = auto()
    INCOMPATIBLE = auto()  # the server speaks another version of the wire format
    LOST = auto()  # libzmq connects again by itself
    HANDSHAKE_FAILED = auto()  # the last one; libzmq tries again by itself
    GIVEN_UP = auto()  # the last handshake failed, and libzmq has stopped trying
    CLOSED = auto()


class Action(Enum):
    """What the owner of the socket must do."""

    SAY_HELLO = auto()
    CONNECT_AGAIN = auto()


@dataclass(frozen=True, slots=True)
class HandshakeFailure:
    """`final`: libzmq stops trying to connect."""

    text: str
    final: bool


UNKNOWN_ROBOT = "the server does not know this robot's key"
NO_HANDSHAKE = "the handshake failed: the connection broke, or the keys of robot and server do not match"
# For a robot without keys:
BROKEN_HANDSHAKE = "the handshake failed: a relay does not reach the server, or no cloud-server listens there"
ONE_WITH_KEYS = "the handshake failed: of robot and server, one has keys and the other has none"

_WHY = {
    State.CONNECTING: "no answer from {endpoint} yet",
    State.GREETING: "connected to {endpoint}, but its server has not answered yet",
    State.UP: None,
    State.INCOMPATIBLE: "{detail}",
    State.LOST: "not connected to {endpoint}",
    State.HANDSHAKE_FAILED: "not connected to {endpoint}: {detail}",
    State.GIVEN_UP: "not connected to {endpoint}: {detail}",
    State.CLOSED: "closed",
}


class Connection:
    """Follows one connection. All times are readings of one clock, in seconds.

    `why_absent` says why no task can be sent, None while the site is up. At `due_s` the owner must call
    `take_due` and do what it returns. Nothing leaves the state CLOSED.
    """

    def __init__(self, site: str, endpoint: str) -> None:
        self._endpoint = endpoint
        self._log = RareLog(log, f"{site}: ", LOG_LINES_MAX)  # a server may come and go, or lie
        self._lost_s: float | None = None  # when a site that was up was lost; None: it was not, or is back
        self.state = State.CONNECTING
        self.why_absent: str | None = None
        self._move(State.CONNECTING)

    def handshake_succeeded(self, now_s: float) -> None:
        self._move(State.GREETING, due_s=now_s)

    def handshake_failed(self, failure: HandshakeFailure, now_s: float) -> None:
        if failure.text == UNKNOWN_ROBOT != self._detail and self.state is not State.CLOSED:
            text = f"{self._endpoint}: {failure.text}; asking again; remedy: copy robot.key to the server"
            self._log(logging.WARNING, text, now_s)
        if failure.final:
            self._move(State.GIVEN_UP, failure.text, due_s=now_s + CONNECT_EVERY_S)
        else:
            self._move(State.HANDSHAKE_FAILED, failure.text)

    def disconnected(self, now_s: float) -> None:
        """The connection has ended, also after a handshake that failed."""
        if self.state is State.GIVEN_UP:
            self.due_s = now_s + CONNECT_EVERY_S
        elif self.state is not State.HANDSHAKE_FAILED:
            if self.state is State.UP:
                self._log(
                    logging.WARNING, f"connection to {self._endpoint} lost; remedy: robot-client check", now_s
                )
                self._lost_s = now_s
            self._move(State.LOST)

    def hello_answered(self, now_s: float) -> bool:
        """The server has answered `hello`. Returns whether that brought the site up.

        An answer that an earlier connection left behind does not.
        """
        if self.state not in (State.GREETING, State.INCOMPATIBLE):
            return False
        if self._lost_s is None:
            self._log(logging.INFO, f"{self._endpoint} is up", now_s)
        else:  # whoever read of the loss reads of the return
            away = duration(now_s - self._lost_s)
            text = f"connected to {self._endpoint} again after {away}; remedy: none is needed"
            self._log(logging.WARNING, text, now_s)
            self._lost_s = None
        self._move(State.UP)
        return True

    def other_version(self, why: str, now_s: float) -> None:
        """A message came in another version of the wire format."""
        if self.state in (State.INCOMPATIBLE, State.GIVEN_UP, State.CLOSED):
            return
        self._log(logging.WARNING, f"{why}: tasks stay onboard; remedy: install one version", now_s)
        self._move(State.INCOMPATIBLE, why)
        self.why_absent = Lasting(why)

    def close(self) -> None:
        self._move(State.CLOSED)

    def take_due(self, now_s: float) -> Action | None:
        """What to do now. Each action is returned once, and again after its pause if it had no effect."""
        if now_s < self.due_s:
            return None
        if self.state is State.GREETING:
            self.due_s = now_s + HELLO_EVERY_S
            return Action.SAY_HELLO
        self._move(State.HANDSHAKE_FAILED, self._detail)
        return Action.CONNECT_AGAIN

    def _move(self, state: State, detail: str = "", *, due_s: float = math.inf) -> None:
        if self.state is State.CLOSED:
            return
        self.state, self._detail, self.due_s = state, detail, due_s
        why = _WHY[state]
        self.why_absent = why and why.format(endpoint=self._endpoint, detail=detail)
