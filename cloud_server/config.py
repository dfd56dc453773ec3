"""The settings of `cloud-server`."""

import contextlib
import json
import os
import re
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError
from offboard.common.logs import JSON, LEVELS, TEXT
from offboard.common.security.address import OPEN_REMEDY, on_loopback

MIB = 1024 * 1024
ROBOTS = "robots"  # default folder for the keys of robots, inside the folder of --keys
PORT_MAX = 65535
AUTO = "auto"  # Ray's word for the cluster that runs on this computer
RESOURCES_EXAMPLE = '{"CPU": 1, "GPU": 1}'

_address, _tasks = partial(setting, group="addresses"), partial(setting, group="tasks")
_access, _output = partial(setting, group="access"), partial(setting, group="output")
_limit = partial(setting, group="limits", rare=True)

_LISTEN = re.compile(r"tcp://(\*|\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):(\d{1,5})")
_HTTP = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9_.-]+):(\d{1,5})")


@dataclass(frozen=True, slots=True)
class ServerConfig:
    """What the server listens on, whom it lets in, which tasks it runs, and its limits."""

    listen: str = _address(
        "tcp://127.0.0.1:5555",
        "endpoint for robots; port 0 picks a free one; an address beyond loopback needs --keys",
        metavar="ENDPOINT",
    )
    http: str = _address(
        "127.0.0.1:8000",
        "address of /health, /metrics and the other pages; an address beyond loopback needs --token-file",
        metavar="HOST:PORT",
    )
    tasks: tuple[str, ...] = _tasks(
        ("offboard.common.planning.planner",),
        "modules that register tasks, separated by commas",
        metavar="MODULE,MODULE",
    )
    executor: str = _tasks(
        "threads",
        "what runs the tasks: threads share memory; processes survive a task that crashes; "
        "ray: actors on the nodes of a Ray cluster",
        choices=("threads", "processes", "ray"),
    )
    workers: int = _tasks(
        len(os.sched_getaffinity(0)), "tasks that run at the same time", minimum=1, maximum=1024, metavar="W"
    )
    ray_address: str = _tasks(
        AUTO,
        "head of the Ray cluster, of which this computer is a node; auto: the cluster that runs here",
        rare=True,
        metavar="HOST:PORT",
    )
    ray_resources: str = _tasks(
        '{"CPU": 1}',
        "what each worker needs on a node of the Ray cluster, as JSON",
        rare=True,
        metavar="JSON",
    )
    keys: Path | None = _access(
        None,
        "folder with server.key_secret, made by `cloud-server keys`; encrypts everything (CURVE)",
        metavar="DIR",
    )
    token_file: Path | None = _access(
        None, "file with the bearer token that HTTP needs, except for /health and /ready"
    )
    insecure: bool = _access(
        False, "accept anybody from beyond loopback without keys or token; logs a warning every minute"
    )
    robots: Path | None = _access(
        None,
        "folder with the public key of each robot that may connect, read again when it changes "
        "(default: robots in the folder of --keys)",
        rare=True,
        metavar="DIR",
    )
    log: str = _output("info", "least severe messages that are logged", choices=LEVELS)
    log_format: str = _output(
        TEXT, "form of the lines of the log: text, or a JSON object each", rare=True, choices=(TEXT, JSON)
    )
    worker_memory: int = _limit(
        2048,
        "memory that one worker process may use, in MiB; a task that needs more fails",
        minimum=256,
        maximum=2**20,
        metavar="MIB",
    )
    queue_max: int = _limit(
        64, "requests that may wait; further requests are answered busy", minimum=1, maximum=100_000
    )
    blob_mib: int = _limit(
        256, "memory for large arguments that are kept for later requests, in MiB", minimum=1, maximum=2**20
    )
    message_mib: int = _limit(
        64, "largest message that is received or sent, in MiB", minimum=1, maximum=2**11 - 1
    )
    robot_mib_s: int = _limit(
        64,
        "data that one robot may send, in MiB per second; each message counts for at least 64 KiB; "
        "further requests are answered busy",
        minimum=1,
        maximum=2**20,
    )
    drain_s: float = _limit(
        10.0, "time to finish accepted tasks after SIGTERM or Ctrl-C, in seconds", minimum=0, maximum=3600
    )

    def __post_init__(self) -> None:
        check(self)
        host_and_port("--listen", self.listen, _LISTEN, "tcp://HOST:PORT or tcp://*:PORT")
        host_and_port("--http", self.http, _HTTP, "HOST:PORT")
        assert self.resources is not None
        if self.ray_address != AUTO:
            host_and_port("--ray-address", self.ray_address, _HTTP, f"{AUTO} or HOST:PORT")
        if self.robots is not None and self.keys is None:
            raise ConfigError(f"--robots: {self.robots} needs --keys, the keys of the server")
        for way in () if self.insecure else self.open_ways:
            raise ConfigError(f"{way}: {OPEN_REMEDY}")
        if self.blob_mib < self.message_mib:
            raise ConfigError(
                f"--blob-mib: {self.blob_mib} is below --message-mib {self.message_mib}; "
                "a large argument would never fit"
            )
        if self.executor != "threads" and self.worker_memory < self.blob_mib + 2 * self.message_mib:
            raise ConfigError(
                f"--worker-memory: {self.worker_memory} is below --blob-mib {self.blob_mib} and twice "
                f"--message-mib {self.message_mib}, which a worker needs for arguments and results"
            )

    @property
    def open_ways(self) -> tuple[str, ...]:
        """What anybody who reaches this computer may use, with the flags that say so."""
        listen_host = host_and_port("--listen", self.listen, _LISTEN, "tcp://HOST:PORT or tcp://*:PORT")[0]
        ways = []
        if self.keys is None and not on_loopback(listen_host):
            ways.append(f"--listen: {self.listen} is beyond loopback and without --keys")
        if self.token_file is None and not self.http_on_loopback:
            ways.append(f"--http: {self.http} is beyond loopback and without --token-file")
        return tuple(ways)

    @property
    def robots_folder(self) -> Path | None:
        return self.robots or (self.keys / ROBOTS if self.keys else None)

    @property
    def resources(self) -> dict[str, float]:
        """What each worker needs on a Ray node, by Ray's names."""
        with contextlib.suppress(ValueError, RecursionError):
            found = json.loads(self.ray_resources)
            if isinstance(found, dict) and all(map(_is_amount, found.values())):
                return {name: float(amount) for name, amount in found.items()}
        raise ConfigError(f"--ray-resources: {self.ray_resources!r} is not JSON like {RESOURCES_EXAMPLE}")

    @property
    def http_on_loopback(self) -> bool:
        return on_loopback(self.http_address[0])

    @property
    def http_address(self) -> tuple[str, int]:
        return host_and_port("--http", self.http, _HTTP, "HOST:PORT")


def _is_amount(value: object) -> bool:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and 0 <= value <= sys.float_info.max  # type: ignore[operator]


def host_and_port(flag: str, text: str, pattern: re.Pattern[str], allowed: str) -> tuple[str, int]:
    """Both parts of an address; a ConfigError names the flag of a wrong one."""
    match = pattern.fullmatch(text)
    if match is None or int(match[2]) > PORT_MAX:
        raise ConfigError(f"{flag}: {text!r} is not {allowed} with a port 0 to {PORT_MAX}")
    return match[1].strip("[]"), int(match[2])
