"""The flags that name the servers of a robot; connecting to them is done by the offloader."""

from dataclasses import dataclass
from pathlib import Path

from offboard.common.config import setting
from offboard.common.errors import ConfigError
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S, check_endpoint

SERVERS = "servers"


@dataclass(frozen=True)
class ServerSettings:
    """Which servers the robot may use, and how long it waits for them."""

    cloud: str | None = setting(
        None,
        "server to use; without any server, all tasks run onboard",
        group=SERVERS,
        metavar="tcp://HOST:PORT",
    )
    site: tuple[str, ...] = setting(
        (),
        "a further server, with a name; repeat the flag for more",
        group=SERVERS,
        rare=True,
        metavar="NAME=ENDPOINT",
    )
    keys: Path | None = setting(
        None,
        "folder with robot.key_secret (made by `robot-client keys`) and server.key (copied from the server; "
        "NAME.key for the server of --site NAME); without it, nothing is encrypted",
        group=SERVERS,
        metavar="DIR",
    )
    timeout_s: float = setting(
        TIMEOUT_S,
        "time to wait for an answer of a server before the task runs onboard, in seconds",
        group=SERVERS,
        name="timeout",
        minimum=0.001,
        maximum=3600,
    )
    connect_s: float = setting(
        10.0,
        "time to wait for the servers at start, in seconds",
        group=SERVERS,
        rare=True,
        name="connect",
        minimum=0.0,
        maximum=3600,
    )

    def check_servers(self) -> None:
        if self.cloud is not None:
            check_endpoint("--cloud", self.cloud)
        if self.keys is not None and self.cloud is None and not self.site:
            raise ConfigError(f"--keys: {self.keys} needs --cloud, the server to use")
        self.sites()

    def sites(self) -> dict[str, str]:
        """The endpoint of each --site, by its name."""
        found: dict[str, str] = {}
        for entry in self.site:
            name, equals, endpoint = entry.partition("=")
            if not (equals and name.isidentifier()):
                raise ConfigError(f"--site: {entry!r} is not NAME=tcp://HOST:PORT")
            if name in (ONBOARD, CLOUD, *found):
                raise ConfigError(f"--site: {entry!r}: the name {name!r} is already taken")
            check_endpoint(f"--site {name}", endpoint)
            found[name] = endpoint
        return found
