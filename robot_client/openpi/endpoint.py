"""Endpoints of policy servers: which ones are allowed, and which of them need --insecure.

The command line checks its flags here, so nothing heavy is imported. Connecting is left to `web_socket`.
"""

import re

from offboard.common.errors import ConfigError
from offboard.common.security.exposure import LOOPBACK, on_loopback
from offboard.robot_client.sites.runner import PORT_MAX, check_endpoint

_SCHEMES = ("ws://", "wss://")
_ENDPOINT = re.compile(r"(wss?)://(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+)(?::(\d{1,5}))?(/[^\s#]*)?")


def is_policy_server(endpoint: str) -> bool:
    """Whether this names a policy server, and not a server of Offboard."""
    return endpoint.startswith(_SCHEMES)


def check_site(where: str, endpoint: str, *, insecure: bool) -> None:
    """Raise ConfigError unless this is the endpoint of a server of either sort; `where` names its flag."""
    if is_policy_server(endpoint):
        check_policy_server(where, endpoint, insecure=insecure)
    else:
        check_endpoint(where, endpoint)


def check_policy_server(where: str, endpoint: str, *, insecure: bool) -> None:
    """Raise ConfigError unless a robot may connect to this endpoint."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or (match[3] is not None and not 0 < int(match[3]) <= PORT_MAX):
        raise ConfigError(
            f"{where}: {endpoint!r} is not ws://HOST:PORT or wss://HOST:PORT with a port 1 to {PORT_MAX}; "
            "a path may follow"
        )
    if not insecure and is_readable(endpoint):
        raise ConfigError(
            f"{where}: {endpoint!r} is not encrypted; use wss://, or a server on loopback ({LOOPBACK}), "
            "or allow it with --insecure (in a program: Settings(insecure=True))"
        )


def is_readable(endpoint: str) -> bool:
    """Whether others can read what is sent: it is not encrypted, and it leaves this computer."""
    match = _ENDPOINT.fullmatch(endpoint)
    return match is not None and match[1] == "ws" and not on_loopback(match[2].strip("[]"))
