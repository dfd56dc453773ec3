"""Tells whether other computers can reach an address, and warns while a process lets anyone in.

Which flags are needed beyond loopback is decided by the settings of each process.
"""

import ipaddress
import logging
import threading
from collections.abc import Iterable

INSECURE_WARNING_S = 60.0  # between two warnings
LOOPBACK = "127.0.0.1, [::1], localhost"
OPEN_REMEDY = f"set it, or listen on loopback ({LOOPBACK}), or let anyone in with --insecure"

log = logging.getLogger(__name__)


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
