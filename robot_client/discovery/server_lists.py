"""Lists of servers that change, from a TOML file or a name of DNS, and the thread that reads them again.

What a list changes is in `present_sites`; `docs/formats.md` describes the file.
"""

import logging
import re
import socket
import threading
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any, Protocol

from offboard.common.errors import CloudBroken, ConfigError, DataError, OffloadError
from offboard.common.security.keys import read_token
from offboard.common.security.plain_files import read_plain
from offboard.common.toml_file import parse_toml, unknown
from offboard.common.variants import IN_GROUP, SITE_LENGTH_MAX
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Server
from offboard.robot_client.sites.endpoint import (
    check_dns,
    check_endpoint,
    check_policy_server,
    host_and_port,
    is_policy_server,
)

ADDRESSES_MAX = 1_000  # of a name
FILE_BYTES_MAX = 1_000_000
SERVERS_MAX, GROUPS_MAX = 1_000, 32  # of a file; a server without a group counts as a group
TEND_S = 2.0  # the longest pause until the sites connect to new servers and close what has left
SETTLE = 0.2  # of the usual pause: until a list that has just changed is read again

_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{SITE_LENGTH_MAX}}}")
_KEYS = ("endpoint", "key", "group", "token_file")

log = logging.getLogger(__name__)


class Source(Protocol):
    """A list of servers. `settling`: it has just changed, and should be read again soon."""

    name: str
    settling: bool

    def read(self) -> list[Server] | None:
        """The servers now; None if nothing is new. OffloadError if the list cannot be used."""


class SitesFile:
    """Reads the file. Every mistake in it is a ConfigError or a DataError that names the file.

    `key_of`: the public key for a site and the `key` of its entry, if it has one.
    `taken`: names that sites of this file cannot have. `insecure`: see `check_policy_server`.
    `settling`: the file has just changed and may be half-written, so it should be read again soon.
    """

    def __init__(
        self,
        path: Path,
        key_of: Callable[[str, str | None], bytes | None],
        taken: Collection[str],
        *,
        insecure: bool = False,
    ) -> None:
        self.name = f"sites {path}"
        self.settling = False
        self._path = path
        self._key_of = key_of
        self._taken = taken
        self._insecure = insecure
        self._seen: bytes | None = None
        self._used: bytes | None = None

    def read(self) -> list[Server] | None:
        """The servers of the file; None if nothing is new, or before two reads have found the same."""
        try:
            found = read_plain(self._path, FILE_BYTES_MAX + 1)
        except OSError as error:
            raise DataError(f"{self._path}: {error.strerror}") from error
        self.settling = self._seen not in (None, found)
        self._seen = found
        if self.settling or found == self._used:
            return None
        servers = self._servers(found)
        self._used = found
        return servers

    def _servers(self, found: bytes) -> list[Server]:
        if len(found) > FILE_BYTES_MAX:
            raise DataError(f"{self._path}: over {FILE_BYTES_MAX} bytes")
        tables = parse_toml(self._path, found)
        if not 0 < len(tables) <= SERVERS_MAX:
            raise DataError(f"{self._path}: {len(tables)} servers; allowed are 1 to {SERVERS_MAX}")
        servers = [self._server(name, table) for name, table in tables.items()]
        groups = {table.get("group", name) for name, table in tables.items()}
        if len(groups) > GROUPS_MAX:
            raise DataError(
                f"{self._path}: {len(groups)} groups and servers without a group; at most {GROUPS_MAX} are "
                "allowed, so give equal servers the same `group`"
            )
        return servers

    def _server(self, name: str, table: object) -> Server:
        where = f"{self._path}: [{name}]"
        if not isinstance(table, Mapping):
            raise DataError(
                f"{where}: must be a table with `endpoint`, and perhaps `key`, `group`, `token_file`"
            )
        for key in table:
            if key not in _KEYS:
                raise DataError(f"{where}: {unknown('key', key, _KEYS)}")
        group = _text(where, table, "group")
        for one in (name, group):
            if one is not None and (not _NAME.fullmatch(one) or one in self._taken):
                allowed = f"a free name of 1 to {SITE_LENGTH_MAX} letters, digits, _ and -"
                raise DataError(f"{where}: {one!r} is not {allowed}")
        endpoint = _text(where, table, "endpoint")
        if endpoint is None:
            raise DataError(f"{where}: `endpoint` is missing")
        site = name if group is None else f"{group}{IN_GROUP}{name}"
        key, token_file = _text(where, table, "key"), _text(where, table, "token_file")
        try:
            if is_policy_server(endpoint):
                return self._policy_server(site, endpoint, key=key, token_file=token_file)
            if token_file is not None:
                raise ConfigError("token_file: only policy servers (ws://, wss://, groot://) take a token")
            check_endpoint("endpoint", endpoint)
            return Server(site, endpoint, self._key_of(site, key))
        except ConfigError as error:
            raise DataError(f"{where}: {error}") from error

    def _policy_server(self, site: str, endpoint: str, *, key: str | None, token_file: str | None) -> Server:
        check_policy_server("endpoint", endpoint, insecure=self._insecure)
        if key is not None:
            raise ConfigError("key: a policy server has none; wss:// proves who it is by a certificate")
        path = None if token_file is None else self._path.parent / token_file
        return Server(site, endpoint, token=None if path is None else read_token("token_file", path))


def _text(where: str, table: Mapping[str, Any], key: str) -> str | None:
    found = table.get(key)
    if found is not None and not isinstance(found, str):
        raise DataError(f"{where}: {key} {found!r:.80} must be a string")
    return found


class DnsName:
    """The servers at dns://HOST:PORT are equal, and have one `key`.

    If the name has IPv4 addresses, those are used, and otherwise the IPv6 ones: a server may have both.
    """

    settling = False

    def __init__(self, group: str, endpoint: str, key: bytes | None) -> None:
        check_dns(group, endpoint)
        self.name = f"{group}={endpoint}"
        self._group = group
        self._host, self._port = host_and_port(endpoint)
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


class Following:
    """Reads `source` every `every_s` seconds; a list that cannot be used leaves the last one as it is."""

    def __init__(self, source: Source, sites: PresentSites, every_s: float) -> None:
        self._source = source
        self._sites = sites
        self._every_s = self._left_s = every_s  # `_left_s`: until the list is read again
        self._stop = threading.Event()
        self._warned = self._failed = ""
        self._thread = threading.Thread(target=self._run, name=source.name, daemon=True)
        sites.on_close(self._stop.set)

    def start(self) -> None:
        """Read the list in a thread from now on: a name server may keep it waiting."""
        self._left_s = 0.0
        self._thread.start()

    def read(self) -> None:
        """Read the list once. A problem is logged once, until the list can be used again."""
        try:
            listed = self._source.read()
        except OffloadError as error:
            if str(error) != self._warned:
                self._warned = str(error)
                said = "%s: %s; the last servers stay in use; remedy: correct it, it is read again"
                log.warning(said, self._source.name, error)
            return
        if not self._source.settling:
            self._warned = ""
        if listed is not None:
            self._sites.follow(listed, self._source.name)

    def tend(self, passed_s: float) -> None:
        """This time has passed: read the list if that is due, and let the sites connect and close."""
        self._left_s -= passed_s
        due = self._left_s <= 0
        try:
            if due:
                self.read()
            self._sites.refresh()
        except Exception as error:  # this thread must go on
            if repr(error) != self._failed:
                self._failed = repr(error)
                log.exception("%s: it is read again; remedy: report this traceback", self._source.name)
        if due:
            self._left_s = self._every_s * (SETTLE if self._source.settling else 1.0)

    def _run(self) -> None:
        while not self._stop.wait(pause_s := min(self._left_s, TEND_S)):
            self.tend(pause_s)
