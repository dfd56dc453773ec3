"""The servers that a name of DNS has: one for each address, as a headless Service of Kubernetes answers.

The command line checks its flags here, so nothing heavy is imported.
"""

import socket

from offboard.common.errors import CloudBroken, ConfigError
from offboard.common.variants import IN_GROUP
from offboard.robot_client.discovery.roster import Server
from offboard.robot_client.sites.runner import check_endpoint

SCHEME = "dns://"
ADDRESSES_MAX = 1_000


def is_dns(endpoint: str) -> bool:
    """Whether this names the servers of a name of DNS."""
    return endpoint.startswith(SCHEME)


def check_dns(where: str, endpoint: str) -> None:
    """Raise ConfigError unless this is dns://HOST:PORT; `where` names its flag."""
    try:
        check_endpoint(where, endpoint.replace(SCHEME, "tcp://", 1))
    except ConfigError:
        raise ConfigError(f"{where}: {endpoint!r} is not {SCHEME}HOST:PORT with a port 1 to 65535") from None


class DnsName:
    """The servers at dns://HOST:PORT are equal, and have one `key`.

    If the name has IPv4 addresses, those are used, and otherwise the IPv6 ones: a server may have both.
    """

    settling = False

    def __init__(self, group: str, endpoint: str, key: bytes | None) -> None:
        check_dns(group, endpoint)
        self.name = f"{group}={endpoint}"
        self._group = group
        host, _, self._port = endpoint.removeprefix(SCHEME).rpartition(":")
        self._host = host.strip("[]")
        self._key = key

    def read(self) -> list[Server]:
        """The servers now; CloudBroken if the name has no address."""
        try:
            found = socket.getaddrinfo(self._host, self._port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise CloudBroken(f"{self._host}: {getattr(error, 'strerror', None) or error}") from error
        addresses = {family: set[str]() for family in (socket.AF_INET, socket.AF_INET6)}
        for family, _, _, _, address in found:
            if family in addresses and "%" not in str(address[0]):
                addresses[family].add(str(address[0]))
        used = sorted(addresses[socket.AF_INET] or addresses[socket.AF_INET6])[:ADDRESSES_MAX]
        if not used:
            raise CloudBroken(f"{self._host}: no address that can be used; those of one link cannot")
        return [Server(f"{self._group}{IN_GROUP}{one}", self._endpoint(one), self._key) for one in used]

    def _endpoint(self, address: str) -> str:
        return f"tcp://[{address}]:{self._port}" if ":" in address else f"tcp://{address}:{self._port}"
