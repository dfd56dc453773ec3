"""The settings of `robot-client gateway`: where it listens, and who answers."""

import logging
from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import REQUIRED, check, setting
from offboard.common.errors import ConfigError
from offboard.common.logs import LEVELS
from offboard.common.security.address import on_loopback
from offboard.robot_client.gateway.policy_sites import QUALITY_ONBOARD
from offboard.robot_client.policy_servers.groot import GROOT
from offboard.robot_client.sites.endpoint import check_policy_server

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class GatewayConfig:
    """Where the gateway listens, and who answers."""

    listen: str = setting(
        "ws://127.0.0.1:8000",
        "address for clients; groot://HOST:PORT for those of GR00T",
        metavar="ws://HOST:PORT",
    )
    site: tuple[str, ...] = setting(
        REQUIRED,
        "policy server (ws://, wss:// or groot://, as --listen); repeat the flag for more",
        metavar="NAME=ws://HOST:PORT",
    )
    onboard: str | None = setting(
        None, "policy on the robot, which maps an observation to an action", metavar="MODULE:FUNCTION"
    )
    convert: tuple[str, ...] = setting(
        (),
        "for a server that wants other observations or speaks the other protocol: an object with the "
        "functions observation and action",
        metavar="NAME=MODULE:OBJECT",
    )
    quality: float = setting(
        QUALITY_ONBOARD, "quality of the onboard policy, where the servers have 1", minimum=0.0, maximum=1.0
    )
    deadline_s: float | None = setting(
        None,
        "time that each answer may take, in seconds (default: 2, for a server)",
        name="deadline",
        minimum=0.001,
        maximum=3600.0,
    )
    keys: Path | None = setting(None, "folder with NAME.token, what a server wants to see", metavar="DIR")
    insecure: bool = setting(False, "allow ws:// beyond this computer, on both sides")
    trace: Path | None = setting(None, "append one JSON line per observation to this file")
    metrics: str | None = setting(None, "serve Prometheus metrics and /live here", metavar="HOST:PORT")
    log: str = setting("info", "least severe messages that are logged", choices=LEVELS)

    def __post_init__(self) -> None:
        check(self)
        check_policy_server("--listen", self.listen, insecure=self.insecure)
        host, port = self.address
        if not self.listen.startswith(("ws://", GROOT)) or not port:
            raise ConfigError(f"--listen: {self.listen!r} is not ws://HOST:PORT or {GROOT}HOST:PORT")
        schemes = (GROOT,) if self.listen.startswith(GROOT) else ("ws://", "wss://")
        if not on_loopback(host):
            text = "--listen: %s: anybody who reaches it can ask; remedy: listen on loopback"
            log.warning(text, self.listen)
        converts = self.converts()
        if unknown := converts.keys() - self.sites().keys():
            raise ConfigError(f"--convert: {min(unknown)!r} is no --site")
        for site, endpoint in self.sites().items():
            if not endpoint.startswith(schemes) and site not in converts:
                raise ConfigError(
                    f"--site {site}: {endpoint!r} is not {' or '.join(schemes)}, as --listen is; give a "
                    f"--convert {site}=MODULE:OBJECT"
                )
            check_policy_server(f"--site {site}", endpoint, insecure=self.insecure)

    @property
    def address(self) -> tuple[str, int]:
        host, _, port = self.listen.partition("://")[2].rpartition(":")
        return host.strip("[]"), int(port) if port.isdigit() else 0

    def sites(self) -> dict[str, str]:
        return _named("--site", self.site, "NAME=ws://HOST:PORT")

    def converts(self) -> dict[str, str]:
        return _named("--convert", self.convert, "NAME=MODULE:OBJECT")


def _named(flag: str, given: tuple[str, ...], shape: str) -> dict[str, str]:
    found: dict[str, str] = {}
    for one in given:
        name, equals, value = one.partition("=")
        if not equals or not name or name in found:
            raise ConfigError(f"{flag}: {one!r} is not {shape} with a name of its own")
        found[name] = value
    return found
