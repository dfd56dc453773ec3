"""The socket that listens at HOST:PORT."""

import socket

from offboard.common.errors import ConfigError
from offboard.common.security.address import address

BACKLOG = 128  # connections that the kernel holds before they are accepted


def bind(flag: str, text: str) -> socket.socket:
    """A socket that listens at HOST:PORT; ConfigError names the flag and the reason."""
    host, port = address(flag, text)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()  # IPv4 too
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG, dualstack_ipv6=both)
    except OSError as error:
        reason = (error.strerror or str(error)).partition(" (")[0]
        raise ConfigError(f"{flag}: cannot listen on {text}: {reason}") from error


def name_of(listening: socket.socket) -> str:
    """The HOST:PORT where a socket listens, with its real port."""
    host, port = listening.getsockname()[:2]
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
