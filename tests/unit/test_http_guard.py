"""The HTTP guard: token, foreign web pages, and security headers, without a socket."""

import asyncio
from typing import Any

import pytest

from offboard.common.security.http_guard import HttpGuard

TOKEN = "a-token-of-the-tests"


def ask(path: str = "/config", *, headers: dict[str, str] | None = None, **settings: Any) -> tuple[int, Any]:
    """The status, and `trusted` as the app behind the guard saw it; None if the app was not called."""
    seen: list[Any] = [None]
    sent: list[Any] = []

    async def app(scope: Any, _receive: Any, send: Any) -> None:
        seen[0] = scope["state"]["trusted"]
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b""})

    async def send(message: Any) -> None:
        sent.append(message)

    raw = [(name.lower().encode(), value.encode()) for name, value in (headers or {}).items()]
    scope = {"type": "http", "path": path, "headers": raw}
    asyncio.run(HttpGuard(app, **settings)(scope, None, send))
    names = {name for name, _ in sent[0]["headers"]}
    assert {b"x-content-type-options", b"content-security-policy", b"x-frame-options"} <= names
    return sent[0]["status"], seen[0]


@pytest.mark.parametrize(
    ("authorization", "status"),
    [
        (f"Bearer {TOKEN}", 200),
        (f"bearer  {TOKEN}", 200),
        (TOKEN, 401),
        (f"Basic {TOKEN}", 401),
        (f"Bearer {TOKEN} {TOKEN}", 401),
        (f"Bearer {TOKEN[:-1]}", 401),
        (f"Bearer {TOKEN.upper()}", 401),
        ("Bearer", 401),
        ("Bearer \xff", 401),
        ("", 401),
    ],
)
def test_only_the_exact_token_is_accepted(authorization: str, status: int) -> None:
    """The case of `Bearer` does not matter; every character of the token does."""
    headers = {"Authorization": authorization}
    assert ask(token=TOKEN, headers=headers) == (status, True if status == 200 else None)


def test_open_paths_need_no_token_and_are_not_trusted() -> None:
    """The app can then answer a client without a token with fewer details."""
    assert ask("/health", token=TOKEN, open_paths=("/health",)) == (200, False)
    assert ask("/health/", token=TOKEN, open_paths=("/health",)) == (401, None)
    assert ask("/health") == (200, True)


@pytest.mark.parametrize(
    ("headers", "loopback", "status"),
    [
        ({"Host": "127.0.0.1:8000", "Origin": "http://127.0.0.1:8000"}, True, 200),
        ({"Host": "localhost"}, True, 200),
        ({"Host": "[::1]:8000"}, True, 200),
        ({"Host": "[::1]"}, True, 200),
        ({"Host": "127.0.0.1:8000", "Origin": "http://evil.example"}, True, 403),
        ({"Host": "127.0.0.1:8000", "Origin": "null"}, True, 403),
        ({"Host": "evil.example:8000"}, True, 403),
        ({"Host": "evil.example:8000"}, False, 200),
        ({"Host": "planner:8000", "Origin": "http://evil.example"}, False, 403),
    ],
)
def test_requests_from_foreign_web_pages_are_refused(
    headers: dict[str, str], loopback: bool, status: int
) -> None:
    """The Origin header must match the Host header; on loopback the host must be this computer too."""
    assert ask(headers=headers, loopback=loopback)[0] == status
