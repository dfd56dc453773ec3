"""HOST:PORT as text, whether other computers can reach it, and a warning while a process lets anyone in."""

import ipaddress
import logging
import threading
from collections.abc import Iterable

from offboard.common.errors import ConfigError

PORT_MAX = 65_535
INSECURE_WARNING_S = 60.0  # between two warnings
LOOPBACK = "127.0.0.1, [::1], localhost"
OPEN_REMEDY = f"set it, or listen on loopback ({LOOPBACK}), or let anyone in with --insecure"

log = logging.getLogger(__name__)


def address(where: str, text: str) -> tuple[str, int]:
    """Host and port of HOST:PORT, or [HOST]:PORT for IPv6; ConfigError names the flag or the field."""
    host, _, port = text.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not (host and "/" not in host and port.isascii() and port.isdigit() and int(port) <= PORT_MAX):
        raise ConfigError(f"{where}: {text!r} is not HOST:PORT with a port from 0 to {PORT_MAX}")
    return host, int(port)


def on_loopback(host: str) -> bool:
    """True if only this computer can reach `host`. Of host names only localhost counts as loopback."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def warn_each_minute(open_ways: Iterable[str]) -> None:
    """Log what is open to anyone, now and once a minute, in a thread that lives as long as the process."""
    ways = "; ".join(open_ways)

    def warn() -> None:
        again = threading.Event()
        while True:
            text = (
                "--insecure: %s: anyone who can reach this process may use it; remedy: set the missing flags"
            )
            log.warning(text, ways)
            again.wait(INSECURE_WARNING_S)

    threading.Thread(target=warn, name="insecure", daemon=True).start()
