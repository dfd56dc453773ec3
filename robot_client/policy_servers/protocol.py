"""What differs between the protocols of policy servers, and the observation of one task.

A protocol opens a channel, packs what is sent and reads what comes. When something is sent is decided in
`policy_server`, and each protocol has a file of its own.
"""

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from offboard.common.errors import CloudBroken, ProtocolError
from offboard.robot_client.sites.conversation import PendingRequest
from offboard.robot_client.sites.runner import Execution

OBSERVATION_BYTES_MAX = 64 * 1024 * 1024
ANSWER_BYTES_MAX = 16 * 1024 * 1024
DIMENSIONS_MAX = 32
TEXT_LENGTH_MAX = 200  # of an error of the server, in logs and records
OPEN_S = 5.0  # an attempt to connect, and then the greeting, are short, so that the next one begins soon


class Channel(Protocol):
    """An open connection. Each method raises CloudBroken once the connection has ended."""

    async def receive(self) -> bytes | str:
        """The next answer, or what greets; a text, if the server sent a text."""

    async def send(self, data: bytes) -> None: ...

    async def ping(self, answered: Callable[[], None]) -> None:
        """Send a ping; `answered` is called if its answer comes."""


class ClientProtocol(Protocol):
    """The protocol of a client, whose messages are forwarded as they are where that is possible."""

    def read_request(self, data: bytes) -> Any:
        """The observation in a request, as the onboard policy gets it."""

    def pack_answer(self, value: Any) -> bytes:
        """The message of an answer that no server of this protocol has given."""


class PolicyProtocol(Protocol):
    """One protocol, for one server.

    converts: whether a client would not understand the answers of this server as they come.
    """

    converts: bool

    def open(self) -> "AbstractAsyncContextManager[Channel]": ...

    async def greet(self, channel: Channel) -> dict[Any, Any]:
        """Wait until the server is ready; what it says about itself."""

    def pack(self, item: Any) -> bytes:
        """The message for an observation. An error that it raises says what cannot be sent."""

    def forward(self, raw: "Raw") -> bytes:
        """The message for a raw observation: the same, with our own token if the server wants one."""

    def read(self, message: bytes | str) -> Any:
        """The action in a message. CloudBroken: the server has failed. ProtocolError: malformed bytes."""

    def run_s(self, value: Any) -> float | None:
        """The computing time that the server says in its answer, in seconds; None if it does not."""


class Raw(NamedTuple):
    """A message as it crosses the link to a client. A raw observation gets a raw answer.

    client: the protocol of that client.
    """

    data: bytes
    client: ClientProtocol


@dataclass(eq=False, slots=True, kw_only=True)
class Observation(PendingRequest):
    """The observation of one task, as bytes. raw: what it was, if its answer is to be raw, too."""

    protocol: PolicyProtocol
    data: bytes
    raw: Raw | None = None

    def answered(self, message: bytes | str, now_s: float) -> Execution:
        """The execution that the answer means; the server says in it how long it computed, if it does."""
        value, failure = self._read(message)
        seconds = now_s - self.published_s
        queue_s = (self.sent_s or now_s) - self.published_s
        run_s = self.protocol.run_s(value)
        if run_s is not None and run_s > seconds - queue_s:
            run_s = None
        if self.raw is not None and failure is None and isinstance(message, bytes):
            client = self.raw.client
            value = Raw(client.pack_answer(value) if self.protocol.converts else message, client)
        return Execution(
            self.site,
            seconds,
            value,
            failure,
            queue_s=queue_s,
            run_s=run_s,
            network_s=None if run_s is None else seconds - queue_s - run_s,
            bytes_out=self.bytes_out,
            bytes_in=len(message.encode() if isinstance(message, str) else message),
        )

    def _read(self, message: bytes | str) -> tuple[Any, CloudBroken | None]:
        """The action in a message, or why there is none. Either way the server is at fault, not the task."""
        try:
            return self.protocol.read(message), None
        except CloudBroken as error:
            return None, error
        except ProtocolError as error:
            return None, CloudBroken(f"answer: {error}")


def check_finite(action: Any) -> None:
    """ProtocolError if an array of an action has a number that is not finite: a robot must not play it."""
    for part in action.values() if isinstance(action, dict) else (action,):
        if isinstance(part, np.ndarray) and part.dtype.kind == "f" and not np.isfinite(part).all():
            raise ProtocolError("an action has values that are not finite")


def shortened(text: str) -> str:
    """The last line of a text, which in a traceback is the error."""
    return (text.strip().splitlines() or [""])[-1][:TEXT_LENGTH_MAX]


def failed(text: Any) -> CloudBroken:
    """The error that the server says."""
    return CloudBroken(f"the policy server failed: {shortened(str(text))}")
