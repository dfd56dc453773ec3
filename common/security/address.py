"""HOST:PORT as text."""

from offboard.common.errors import ConfigError

PORT_MAX = 65_535


def address(where: str, text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, or [HOST]:PORT for IPv6; ConfigError names the flag or the field."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (host and "/" not in host and port.isascii() and port.isdigit() and int(port) <= PORT_MAX):
        raise ConfigError(f"{where}: {text!r} is not HOST:PORT with a port from 0 to {PORT_MAX}")
    return host, int(port)
