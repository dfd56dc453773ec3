"""Drop-in clients for policy servers: those of openpi and GR00T, with more servers and an onboard policy.

    from offboard.policy_client import WebsocketClientPolicy    # in place of openpi_client's

They differ from the originals in that each answer has a time limit, a server that is gone is no longer waited
for, and `onboard=` answers when no server does.
"""

import logging
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from types import TracebackType
from typing import Any, TypeVar

import numpy as np

from offboard.common.errors import CloudBroken, ConfigError
from offboard.robot_client.gateway.policy_sites import Onboard, PolicySites
from offboard.robot_client.policy_servers.groot import GROOT, GrootCall
from offboard.robot_client.settings import Settings
from offboard.robot_client.streams.action_stream import ActionStream

__all__ = ["PolicyClient", "WebsocketClientPolicy"]

SERVER = "server"  # the site of the server that the original would use
CONNECT_S = 1.0  # for which a client with an onboard policy waits for a server
FIRST_S = 60.0  # for which a client without one waits for it, and a stream for its first chunk
SAID_S = 5.0  # between two lines that say so

log = logging.getLogger(__name__)
Own = TypeVar("Own", bound="_Client")


class _Client:
    """What both clients share; see `WebsocketClientPolicy`."""

    def __init__(
        self,
        endpoint: str,
        token: str | None,
        *,
        groot: bool = False,
        onboard: Onboard | None,
        sites: Mapping[str, str] | None,
        deadline_s: float | None,
        settings: Settings | None,
    ) -> None:
        own = settings or Settings()
        if token is not None:
            own = replace(own, tokens={**own.tokens, SERVER: token})
        self._sites = PolicySites(
            {SERVER: endpoint, **(sites or {})},
            groot=groot,
            onboard=onboard,
            deadline_s=deadline_s,
            settings=own,
        )
        until_s = time.monotonic() + (FIRST_S if onboard is None else CONNECT_S)
        while not self._sites.wait(min(SAID_S, max(0.0, until_s - time.monotonic()))):
            log.warning("no policy server at %s yet; remedy: robot-client check %s", endpoint, endpoint)
            if time.monotonic() >= until_s:
                break
        if onboard is None and not self._sites.wait(0.0):
            self._sites.close()
            raise CloudBroken(f"{endpoint}: no policy server after {FIRST_S:g} s")

    def close(self) -> None:
        """End the connections. Safe to call twice."""
        self._sites.close()

    def __enter__(self: Own) -> Own:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class WebsocketClientPolicy(_Client):
    """The client of openpi (`openpi_client.websocket_client_policy`), with several servers and onboard.

    host, port, api_key: as there. onboard: maps an observation to an action, and answers if no server does.
    sites: further servers with the same policy (ws://HOST:PORT), by name.
    deadline_s: of each `infer`: onboard is started in time, or without it CloudBroken is raised.
    settings: of the offloader; beyond this computer, ws:// needs `Settings(insecure=True)`.
    stream: `infer` returns the action of this step at once, from a queue that is kept filled. It needs the
    options `hz` and `horizon`, and takes the others of `Offloader.stream` (docs/streams.md).
    """

    def __init__(
        self,
        host: str = "0.0.0.0",
        port: int | None = None,
        api_key: str | None = None,
        *,
        onboard: Onboard | None = None,
        sites: Mapping[str, str] | None = None,
        deadline_s: float | None = None,
        settings: Settings | None = None,
        stream: bool = False,
        **of_stream: Any,
    ) -> None:
        if stream != {"hz", "horizon"}.issubset(of_stream) or (of_stream and not stream):
            raise ConfigError("stream=True needs hz= and horizon=, and other options belong to a stream")
        endpoint = host if "://" in host else f"ws://{host}"
        endpoint = endpoint.replace("://0.0.0.0", "://127.0.0.1")
        super().__init__(
            endpoint if port is None else f"{endpoint}:{port}",
            api_key,
            onboard=onboard,
            sites=sites,
            deadline_s=deadline_s,
            settings=settings,
        )
        self._stream: ActionStream | None = None
        if stream:
            self._stream = self._sites.offload.stream(self._sites.task, **of_stream)

    def get_server_metadata(self) -> dict[Any, Any]:
        """The metadata of the first server that is there; empty while none is."""
        return self._sites.metadata()

    def infer(self, obs: dict[Any, Any]) -> dict[Any, Any]:
        """The action for this observation; with `stream`, that of this step, as `actions` (1, dimensions).

        CloudBroken: no server has answered, and there is no onboard policy. TaskFailed: onboard failed.
        """
        if self._stream is None:
            found: dict[Any, Any] = self._sites.call(obs)
            return found
        until_s = time.monotonic() + FIRST_S
        self._stream.see(obs)
        while (step := self._stream.next()).action is None:  # before the first chunk
            if time.monotonic() > until_s:
                raise CloudBroken(f"no chunk after {FIRST_S:g} s")
            time.sleep(0.01)
        return {
            "actions": np.asarray(step.action)[np.newaxis],
            "offboard": {"age_s": step.age_s, "site": step.site, "held": step.held},
        }

    def reset(self) -> None:
        """Begin an episode. Nothing is sent, as in the original; a stream plays nothing of the old one."""
        if self._stream is not None:
            self._stream.reset()

    def close(self) -> None:
        if self._stream is not None:
            self._stream.close()
        super().close()


class PolicyClient(_Client):
    """The client of GR00T (`gr00t.policy.server_client`), with several servers and an onboard policy.

    host, port, timeout_ms, api_token: as there, but `timeout_ms` is kept. `strict` is ignored.
    onboard: maps an observation to an action, or to the pair of action and info.
    The others: as in `WebsocketClientPolicy`.
    """

    def __init__(
        self,
        host: str = "localhost",
        port: int = 5555,
        timeout_ms: int = 15000,
        api_token: str | None = None,
        *,
        onboard: Callable[[Any], Any] | None = None,
        sites: Mapping[str, str] | None = None,
        deadline_s: float | None = None,
        settings: Settings | None = None,
        **ignored: Any,
    ) -> None:
        if not {"strict"}.issuperset(ignored):
            raise ConfigError(f"PolicyClient has no option {', '.join(ignored)}")
        super().__init__(
            f"{GROOT}{host}:{port}",
            api_token,
            groot=True,
            onboard=onboard,
            sites=sites,
            deadline_s=timeout_ms / 1000 if deadline_s is None else deadline_s,
            settings=settings,
        )

    def ping(self) -> bool:
        """Whether a server is there."""
        return self._sites.wait(0.0)

    def get_action(
        self, observation: dict[str, Any], options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Action and info for this observation. The errors are those of `WebsocketClientPolicy.infer`."""
        call = GrootCall("get_action", {"observation": observation, "options": options})
        answer = self._sites.call(call)
        return answer if isinstance(answer, tuple) else (answer, {})

    def reset(self, options: dict[str, Any] | None = None) -> dict[str, Any]:
        """Begin an episode on each server that is there."""
        return dict(self._sites.ask_all(GrootCall("reset", {"options": options}), "reset"))

    def get_modality_config(self) -> dict[str, Any]:
        """The config of a server, as plain values."""
        what = "get_modality_config"
        return dict(self._sites.ask_all(GrootCall(what), what))
