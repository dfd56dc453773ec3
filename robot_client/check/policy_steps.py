"""The steps of `robot-client check` for a policy server: port, connection, greeting, one observation.

Those for a server of Offboard are in `steps`.
"""

import asyncio
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from offboard.common.errors import CloudBroken, ConfigError, ProtocolError
from offboard.common.wording import duration
from offboard.robot_client.check import network
from offboard.robot_client.check.network import StepFailed
from offboard.robot_client.check.steps import FAIL, OK, SKIP, Line
from offboard.robot_client.policy_servers.asyncio_timeout import timeout
from offboard.robot_client.policy_servers.policy_server import protocol_of

PORTS = {"ws": 80, "wss": 443}
TLS_REMEDY = "check the certificate of the server; SSL_CERT_FILE names the file of an authority of your own"
KEYS_SHOWN = 8  # of metadata and answers


class PolicyCheck:
    """One check of the policy server at `endpoint`. `observation`: what it is asked, from a file of NumPy."""

    def __init__(
        self, endpoint: str, *, token: str | None, observation: Path | None, timeout_s: float
    ) -> None:
        self._endpoint, self._token, self._timeout_s = endpoint, token, timeout_s
        self._protocol = protocol_of(endpoint, token)
        self._observation = None if observation is None else read_observation(observation)
        parts = urlsplit(endpoint)
        self._host, self._port = parts.hostname or "", parts.port or PORTS.get(parts.scheme, 0)
        self._ips: list[str] = []

    def run(self) -> Iterator[Line]:
        """The line of each step, as soon as the step is over. After a failed step, all others are skipped."""
        steps: dict[str, Callable[[], str]] = {
            "name resolves": self._resolve,
            "port is open": self._connect,
            "server answers": self._greet,
            "observation": self._ask,
        }
        failed = False
        for name, step in steps.items():
            if failed or (step == self._ask and self._observation is None):
                yield Line(SKIP, name, "" if failed else "give one by --observation FILE.npz")
                continue
            try:
                yield Line(OK, name, step())
            except StepFailed as error:
                failed = True
                yield Line(FAIL, name, str(error))

    def _resolve(self) -> str:
        try:
            self._ips = network.resolve(self._host, self._port)
        except OSError as error:
            raise StepFailed(
                f"{self._host}: {network.reason(error)}", "correct the name, or add it to DNS or /etc/hosts"
            ) from error
        return f"{self._host} -> {' and '.join(self._ips)}"

    def _connect(self) -> str:
        try:
            ip = network.connect(self._ips, self._port, self._timeout_s)
        except OSError as error:
            remedy = "start the policy server, correct the port, or let the firewall pass it"
            raise StepFailed(f"port {self._port}: {network.reason(error)}", remedy) from error
        return f"port {self._port} of {ip}"

    def _greet(self) -> str:
        metadata = asyncio.run(self._talk(None))
        sent = "its token was taken" if self._token else "it wants no token"
        secure = "TLS" if self._endpoint.startswith("wss") else "plain"
        return f"{secure}; {sent}; metadata: {shown(metadata)}"

    def _ask(self) -> str:
        began_s = time.perf_counter()
        answer = asyncio.run(self._talk(self._observation))
        return f"{shown(answer)} after {duration(time.perf_counter() - began_s)}, connecting included"

    async def _talk(self, observation: Any) -> Any:
        """The metadata, or the answer to this observation."""
        try:
            async with timeout(self._timeout_s), self._protocol.open() as channel:
                metadata = await self._protocol.greet(channel)
                if observation is None:
                    return metadata
                await channel.send(self._protocol.pack(observation))
                return self._protocol.read(await channel.receive())
        except TimeoutError as error:
            raise StepFailed(f"no answer within {self._timeout_s:g} s", "pass a longer --timeout") from error
        except ProtocolError as error:
            raise StepFailed(
                str(error), "this is no policy server of that protocol; correct the port"
            ) from error
        except CloudBroken as error:
            raise StepFailed(str(error), self._remedy(str(error))) from error

    def _remedy(self, said: str) -> str:
        if "certificate" in said.lower() or "ssl" in said.lower():
            return TLS_REMEDY
        if any(word in said for word in ("401", "403", "Unauthorized")):
            return "put its token into the keys folder as NAME.token with mode 600, and pass --keys"
        return "see the log of that server"


def read_observation(path: Path) -> dict[str, Any]:
    """The arrays and texts of a .npz file, by name; a name with `/` makes no tables."""
    try:
        with np.load(path, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)[:100]
        raise ConfigError(f"--observation: {path}: {why}; it must be a file of np.savez") from error
    return {name: value.item() if value.ndim == 0 else value for name, value in found.items()}


def shown(value: Any) -> str:
    """A value in a few words."""
    if isinstance(value, dict):
        names = [f"{name} {shown(one)}" for name, one in list(value.items())[:KEYS_SHOWN]]
        return f"{{{', '.join(names)}}}" if names else "empty"
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, tuple):
        return " and ".join(map(shown, value))
    return repr(value)[:40]
