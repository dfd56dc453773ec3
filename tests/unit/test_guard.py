"""What is asked of whoever reaches a process, without a socket."""

import asyncio
import logging
import threading
from pathlib import Path
from typing import Any

import pytest

from offboard.cloud_server.config import ServerConfig
from offboard.common.errors import ConfigError
from offboard.common.security import guard
from offboard.common.security.guard import Guard, on_loopback, read_private, read_token, warn_each_minute
from offboard.loadgen.relay.wan import WanConfig

TOKEN = "a-token-of-the-tests"


def ask(path: str = "/config", *, headers: dict[str, str] | None = None, **settings: Any) -> tuple[int, Any]:
    """The status, and what the app behind the guard was told of trust (None: it was not asked)."""
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
    asyncio.run(Guard(app, **settings)(scope, None, send))
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
def test_only_the_token_is_taken(authorization: str, status: int) -> None:
    """The scheme in any case, the token to its last character."""
    headers = {"Authorization": authorization}
    assert ask(token=TOKEN, headers=headers) == (status, True if status == 200 else None)


def test_open_paths_need_no_token_but_are_told() -> None:
    """What lies behind knows whether it may say everything."""
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
def test_web_pages_of_others_are_refused(headers: dict[str, str], loopback: bool, status: int) -> None:
    """By their origin everywhere; on loopback by the name that they were told for this computer, too."""
    assert ask(headers=headers, loopback=loopback)[0] == status


@pytest.mark.parametrize(
    ("text", "mode", "error"),
    [
        ("short", 0o600, "must hold one token of at least 16 characters"),
        ("two tokens are not one", 0o600, "must hold one token"),
        ("", 0o600, "must hold one token"),
        (TOKEN, 0o644, "has mode 0644, so group or others may use it: chmod 600"),
        ("x" * 70_000, 0o600, "is above 65536 bytes"),
    ],
)
def test_a_wrong_token_file_is_one_line(tmp_path: Path, text: str, mode: int, error: str) -> None:
    """It names flag and file, and never says the token."""
    path = tmp_path / "token"
    path.write_text(text)
    path.chmod(mode)
    with pytest.raises(ConfigError, match=f"^--token-file: {path} {error}") as caught:
        read_token(path)
    assert TOKEN not in str(caught.value)


def test_a_token_file_may_end_its_line(tmp_path: Path) -> None:
    """What an editor adds is not part of the token; no file is no token."""
    path = tmp_path / "token"
    path.touch(0o600)
    path.write_text(f"{TOKEN}\n")
    assert read_token(path) == TOKEN
    assert read_token(None) is None


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    """One line, as for a file that is not there."""
    path = tmp_path / "key"
    path.touch(0o600)
    path.write_bytes(b"\xff")
    for name, error in ((path, "is not text"), (tmp_path, "Is a directory"), (tmp_path / "no", "No such")):
        with pytest.raises(ConfigError, match=error):
            read_private("--keys", name)


@pytest.mark.parametrize(
    ("host", "inside"),
    [
        *[(host, True) for host in ("127.0.0.1", "127.8.8.8", "::1", "localhost")],
        *[(host, False) for host in ("*", "0.0.0.0", "::", "192.168.1.5", "eth0", "localhost.example", "")],
    ],
)
def test_what_only_this_computer_reaches(host: str, inside: bool) -> None:
    """Addresses of loopback and localhost; every other name counts as reached."""
    assert on_loopback(host) == inside


@pytest.mark.parametrize(
    ("flags", "open_ways"),
    [
        ({}, 0),
        ({"listen": "tcp://[::1]:1", "http": "localhost:1"}, 0),
        ({"listen": "tcp://*:1", "insecure": True}, 1),
        ({"listen": "tcp://*:1", "http": "0.0.0.0:1", "insecure": True}, 2),
        ({"listen": "tcp://*:1", "http": "0.0.0.0:1", "keys": Path("k"), "token_file": Path("t")}, 0),
        ({"listen": "tcp://*:1", "keys": Path("k"), "insecure": True}, 0),
    ],
)
def test_what_a_server_leaves_open(flags: dict[str, Any], open_ways: int) -> None:
    """Each way beyond loopback without its key or token; --insecure alone opens nothing."""
    config = ServerConfig(**flags)
    assert len(config.open_ways) == open_ways


def test_robots_are_in_the_folder_of_keys_unless_told() -> None:
    """--robots, else robots in that of --keys."""
    assert ServerConfig().robots_folder is None
    assert ServerConfig(keys=Path("k")).robots_folder == Path("k/robots")
    assert ServerConfig(keys=Path("k"), robots=Path("r")).robots_folder == Path("r")


def test_a_relay_beyond_loopback_wants_its_token() -> None:
    """Its control alone: what it relays is for whoever it is meant for."""
    assert WanConfig(listen="0.0.0.0:1").open_ways == ()
    with pytest.raises(ConfigError, match=r"^--http: 0\.0\.0\.0:1 is beyond loopback and without --token-f"):
        WanConfig(http="0.0.0.0:1")
    assert WanConfig(http="0.0.0.0:1", token_file=Path("t")).open_ways == ()
    assert len(WanConfig(http="0.0.0.0:1", insecure=True).open_ways) == 1


def test_insecure_is_said_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A warning at once, and after each pause."""
    thrice, said = threading.Event(), list[str]()

    class Count(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            said.append(record.getMessage())
            if len(said) == 3:
                thrice.set()

    handler = Count()
    monkeypatch.setattr(guard, "INSECURE_WARNING_S", 0.001)
    guard.log.addHandler(handler)
    try:
        warn_each_minute(["--http: x is open"])
        assert thrice.wait(5)
    finally:
        monkeypatch.undo()
        guard.log.removeHandler(handler)
    assert said[0] == "--insecure: --http: x is open: whoever reaches this process may use it"
