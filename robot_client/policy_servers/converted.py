"""A policy server that wants other observations than the client sends, and answers otherwise."""

from contextlib import AbstractAsyncContextManager
from typing import Any, Protocol

from offboard.common.errors import CloudBroken, ConfigError, describe
from offboard.robot_client.policy_servers.groot import observation_of
from offboard.robot_client.policy_servers.protocol import Channel, PolicyProtocol, Raw


class Convert(Protocol):
    """What the user gives for one server, whose protocol may be another one, too."""

    def observation(self, observation: Any) -> Any:
        """The observation for that server."""

    def action(self, answer: Any) -> Any:
        """The action for the client, from what that server has answered."""


def check_convert(where: str, convert: object) -> None:
    """ConfigError unless this object has the two functions."""
    for name in ("observation", "action"):
        if not callable(getattr(convert, name, None)):
            raise ConfigError(f"{where}: {convert!r:.80} has no function {name!r}")


class Converted:
    """The protocol of such a server. ConfigError unless `convert` has the two functions."""

    converts = True

    def __init__(self, server: PolicyProtocol, convert: Convert) -> None:
        check_convert("convert", convert)
        self._server, self._convert = server, convert
        self._run_s: float | None = None  # of the last answer: its action need not say it

    def open(self) -> "AbstractAsyncContextManager[Channel]":
        return self._server.open()

    async def greet(self, channel: Channel) -> dict[Any, Any]:
        return await self._server.greet(channel)

    def pack(self, item: Any) -> bytes:
        return self._server.pack(self._convert.observation(observation_of(item)))

    def forward(self, raw: Raw) -> bytes:
        return self.pack(raw.client.read_request(raw.data))

    def read(self, message: bytes | str) -> Any:
        found = self._server.read(message)
        self._run_s = self._server.run_s(found)
        try:
            return self._convert.action(found)
        except Exception as error:
            raise CloudBroken(f"its answer cannot be converted: {describe(error)}") from error

    def run_s(self, value: Any) -> float | None:  # noqa: ARG002 - the server said it before
        return self._run_s
