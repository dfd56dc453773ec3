"""Which addresses other computers can reach, and the warning of a process that lets anyone in."""

import logging
import threading
from pathlib import Path
from typing import Any

import pytest

from offboard.cloud_server.config import ServerConfig
from offboard.common.errors import ConfigError
from offboard.common.security import address
from offboard.common.security.address import on_loopback, warn_each_minute
from offboard.loadgen.relay.wan import WanConfig


@pytest.mark.parametrize(
    ("host", "inside"),
    [
        *[(host, True) for host in ("127.0.0.1", "127.8.8.8", "::1", "localhost")],
        *[(host, False) for host in ("*", "0.0.0.0", "::", "192.168.1.5", "eth0", "localhost.example", "")],
    ],
)
def test_loopback_addresses_are_recognised(host: str, inside: bool) -> None:
    """Loopback addresses and `localhost` count; every other name may be reached from outside."""
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
def test_a_server_knows_what_it_leaves_open(flags: dict[str, Any], open_ways: int) -> None:
    """An address beyond loopback is open if its keys or token are missing; --insecure alone opens nothing."""
    config = ServerConfig(**flags)
    assert len(config.open_ways) == open_ways


def test_the_folder_of_robots_is_in_the_folder_of_keys() -> None:
    """This is the default; --robots names another folder."""
    assert ServerConfig().robots_folder is None
    assert ServerConfig(keys=Path("k")).robots_folder == Path("k/robots")
    assert ServerConfig(keys=Path("k"), robots=Path("r")).robots_folder == Path("r")


def test_the_http_side_of_a_relay_needs_a_token_beyond_loopback() -> None:
    """The relayed port needs none: the server behind it checks its robots itself."""
    assert WanConfig(listen="0.0.0.0:1").open_ways == ()
    with pytest.raises(ConfigError, match=r"^--http: 0\.0\.0\.0:1 is beyond loopback and without --token-f"):
        WanConfig(http="0.0.0.0:1")
    assert WanConfig(http="0.0.0.0:1", token_file=Path("t")).open_ways == ()
    assert len(WanConfig(http="0.0.0.0:1", insecure=True).open_ways) == 1


def test_an_insecure_process_keeps_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    """It logs one warning at once, and one after each pause."""
    thrice, said = threading.Event(), list[str]()

    def count(record: logging.LogRecord) -> bool:
        said.append(record.getMessage())
        if len(said) == 3:
            thrice.set()
            threading.Event().wait()  # the thread stays here, and does not warn during other tests
        return True

    monkeypatch.setattr(address, "INSECURE_WARNING_S", 0.001)
    address.log.addFilter(count)
    try:
        warn_each_minute(["--http: x is open"])
        assert thrice.wait(5)
    finally:
        monkeypatch.undo()
        address.log.removeFilter(count)
    assert said[0] == (
        "--insecure: --http: x is open: anyone who can reach this process may use it; "
        "remedy: set the missing flags"
    )
