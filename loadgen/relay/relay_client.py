"""A client of the relay's control API: changes the link of a relay that runs in another process.

The API itself is in `control_api.py`.
"""

import contextlib
import http.client
import json
from typing import Any

from offboard.common.errors import ConfigError, OffloadError

ASK_S = 2.0


class RelayClient:
    """The relay whose control API is at `address` (HOST:PORT)."""

    def __init__(self, address: str) -> None:
        self._address = address

    def set_link(self, changes: dict[str, Any]) -> dict[str, Any]:
        """Change some conditions and return the whole link; ConfigError if the relay refuses the change."""
        return self._ask("PUT", "/link", json.dumps(changes))

    def link(self) -> dict[str, Any]:
        return self._ask("GET", "/link")

    def begin_recording(self) -> None:
        """Play the recording of the link from its beginning; ConfigError if it plays none."""
        self._ask("POST", "/recording")

    def reset(self) -> None:
        self._ask("POST", "/reset")

    def _ask(self, method: str, path: str, body: str | None = None) -> dict[str, Any]:
        status, text = ask(self._address, method, path, body)
        answer: dict[str, Any] = json.loads(text)
        if status != http.client.OK:
            raise ConfigError(f"link: {answer.get('detail', text)}")
        return answer


def ask(address: str, method: str, path: str, body: str | None = None) -> tuple[int, str]:
    """Send one HTTP request and return status and body; OffloadError if there is no answer within ASK_S."""
    connection = http.client.HTTPConnection(address, timeout=ASK_S)
    headers = {} if body is None else {"Content-Type": "application/json"}
    try:
        with contextlib.closing(connection):
            connection.request(method, path, body, headers)
            reply = connection.getresponse()
            return reply.status, reply.read().decode()
    except (OSError, http.client.HTTPException) as error:
        raise OffloadError(f"http://{address}{path} does not answer: {error}") from error
