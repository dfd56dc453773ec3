"""Endpoints of sites: which ones are allowed, and which of them need --insecure.

The command line checks its flags here, so nothing heavy is imported.
"""

import re

from offboard.common.errors import ConfigError
from offboard.common.security.address import LOOPBACK, PORT_MAX, on_loopback

DNS = "dns://"
_HOST = r"\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+"
_SERVER = re.compile(rf"tcp://({_HOST}):(\d{{1,5}})")
_POLICY_SERVER = re.compile(
    rf"(wss?)://({_HOST})(?::(\d{{1,5}}))?(/[^\s#]*)?|(groot)://({_HOST}):(\d{{1,5}})"
)


def is_policy_server(endpoint: str) -> bool:
    """Whether this names a policy server, and not a server of Offboard."""
    return endpoint.startswith(("ws://", "wss://", "groot://"))


def is_dns(endpoint: str) -> bool:
    """Whether this names the servers of a name of DNS."""
    return endpoint.startswith(DNS)


def check_site(where: str, endpoint: str, *, insecure: bool) -> None:
    """Raise ConfigError unless this is the endpoint of a server of either sort; `where` names its flag."""
    if is_policy_server(endpoint):
        check_policy_server(where, endpoint, insecure=insecure)
    else:
        check_endpoint(where, endpoint)


def check_endpoint(where: str, endpoint: str) -> None:
    """Raise ConfigError unless this is the endpoint of a server of ours."""
    match = _SERVER.fullmatch(endpoint)
    if match is None or not 0 < int(match[2]) <= PORT_MAX:
        raise ConfigError(f"{where}: {endpoint!r} is not tcp://HOST:PORT with a port 1 to {PORT_MAX}")


def check_dns(where: str, endpoint: str) -> None:
    """Raise ConfigError unless this is dns://HOST:PORT."""
    try:
        check_endpoint(where, endpoint.replace(DNS, "tcp://", 1))
    except ConfigError:
        raise ConfigError(
            f"{where}: {endpoint!r} is not {DNS}HOST:PORT with a port 1 to {PORT_MAX}"
        ) from None


def check_policy_server(where: str, endpoint: str, *, insecure: bool) -> None:
    """Raise ConfigError unless a robot may connect to this endpoint."""
    match = _POLICY_SERVER.fullmatch(endpoint)
    port = None if match is None else match[3] or match[7]
    if match is None or (port is not None and not 0 < int(port) <= PORT_MAX):
        raise ConfigError(
            f"{where}: {endpoint!r} is not ws://HOST:PORT or wss://HOST:PORT with a port 1 to {PORT_MAX}; "
            "a path may follow; nor groot://HOST:PORT"
        )
    if not insecure and is_readable(endpoint):
        raise ConfigError(
            f"{where}: {endpoint!r} is not encrypted; use wss://, or a server on loopback ({LOOPBACK}), "
            "or allow it with --insecure (in a program: Settings(insecure=True))"
        )


def is_readable(endpoint: str) -> bool:
    """Whether others can read what is sent: it is not encrypted, and it leaves this computer."""
    match = _POLICY_SERVER.fullmatch(endpoint)
    if match is None or match[1] == "wss":
        return False
    return not on_loopback((match[2] or match[6]).strip("[]"))


def host_and_port(endpoint: str) -> tuple[str, str]:
    """The parts of tcp://HOST:PORT or dns://HOST:PORT; an IPv6 address without its brackets."""
    host, _, port = endpoint.partition("://")[2].rpartition(":")
    return host.strip("[]"), port
