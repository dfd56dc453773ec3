"""The servers of a TOML file, which may be rewritten at any time; `docs/formats.md` describes it.

When it is read again is up to `following`.
"""

import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, DataError
from offboard.common.security.plain_files import read_plain
from offboard.common.toml_file import parse_toml, unknown
from offboard.common.variants import IN_GROUP, SITE_LENGTH_MAX
from offboard.robot_client.discovery.roster import Server
from offboard.robot_client.sites.runner import check_endpoint

FILE_BYTES_MAX = 1_000_000
SERVERS_MAX, GROUPS_MAX = 1_000, 32  # of a file; a server without a group counts as a group

_NAME = re.compile(rf"[A-Za-z0-9_-]{{1,{SITE_LENGTH_MAX}}}")
_KEYS = ("endpoint", "key", "group")


class SitesFile:
    """Reads the file. Every mistake in it is a ConfigError or a DataError that names the file.

    `key_of`: the public key for a site and the `key` of its entry, if it has one.
    `taken`: names that sites of this file cannot have.
    `settling`: the file has just changed and may be half-written, so it should be read again soon.
    """

    def __init__(
        self, path: Path, key_of: Callable[[str, str | None], bytes | None], taken: Collection[str]
    ) -> None:
        self.name = f"sites {path}"
        self.settling = False
        self._path = path
        self._key_of = key_of
        self._taken = taken
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
            raise DataError(f"{where}: must be a table with `endpoint`, and perhaps `key` and `group`")
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
        try:
            check_endpoint("endpoint", endpoint)
            return Server(site, endpoint, self._key_of(site, _text(where, table, "key")))
        except ConfigError as error:
            raise DataError(f"{where}: {error}") from error


def _text(where: str, table: Mapping[str, Any], key: str) -> str | None:
    found = table.get(key)
    if found is not None and not isinstance(found, str):
        raise DataError(f"{where}: {key} {found!r:.80} must be a string")
    return found
