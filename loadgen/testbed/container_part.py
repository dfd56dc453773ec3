"""A part inside its container: image, command, networks, files, quota, hogs, and how its usage is measured.

`docker_testbed` makes the containers.
"""

import os
import signal
import struct
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.command_line import BROKEN_PIPE_EXIT, INTERRUPTED_EXIT
from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.testbed.cpu_quota import cgroup_us
from offboard.loadgen.testbed.testbed import (
    CLOUD,
    ROBOT,
    WAN,
    Setup,
    Usage,
    endpoint_flags,
    kind_of,
    relay_of,
    servers_among,
)

NEAR, FAR = "near", "far"
EXAMPLES = "examples"  # the folder of the applications, and the Compose service of their image
# The image of each Compose service; docker-compose.yml gives them these names.
IMAGES: Mapping[str, str] = {
    CLOUD: "offboard-cloud",
    WAN: "offboard-bench",
    ROBOT: "offboard-robot",
    EXAMPLES: "offboard-examples",
}
RESULTS, INPUTS, COMPILED = Path("/out"), Path("/in"), Path("/var/cache/offboard")
END_S = 10.0  # longest wait for the end of a hog
ANSWER_S = 10.0  # longest wait for one reading
ANSWER_BYTES_MAX = 10_000
_FRAME = struct.Struct(">BxxxL")  # header of Docker's attach stream: 1 for stdout or 2 for stderr, bytes
# A shell script. For each line that it reads, it prints the memory pages and the open handles of session 1,
# which are those of the part and its workers: process 1 is Docker's init, and every `docker exec` has a
# session of its own. The script starts no process, because that would use up the CPU quota of the part.
MEASURE = """
while read -r _; do
  pages=0 handles=0
  for process in /proc/[0-9]*; do
    read -r line < $process/stat || continue
    set -- ${line##*) }
    [ "$4" = 1 ] && [ $process != /proc/1 ] && read -r _ resident _ < $process/statm || continue
    set -- $process/fd/*
    pages=$((pages + resident)) handles=$((handles + $#))
  done 2>/dev/null
  echo $pages $handles
done
"""


@dataclass(frozen=True, slots=True)
class Kind:
    """What all parts of one kind share.

    `program` and `command` come before the flags of the part. `http` is the port of their HTTP API, `ready`
    the path that says it is up.
    """

    program: str
    command: tuple[str, ...]
    networks: tuple[str, ...]
    http: int | None = None
    ready: str = ""


# No keys are used: the networks exist for one run only and have no way out, and a run measures the link and
# not the encryption, as on the local testbed. The HTTP APIs are published on 127.0.0.1 only.
KINDS: Mapping[str, Kind] = {
    CLOUD: Kind(
        "cloud-server",
        ("--listen", "tcp://*:5555", "--http", "0.0.0.0:8000", "--insecure"),
        (FAR,),
        http=8000,
        ready="/ready",
    ),
    WAN: Kind(
        "loadgen",
        ("wan", "--listen", "0.0.0.0:5555", "--http", "0.0.0.0:8001", "--insecure"),
        (NEAR, FAR),
        http=8001,
        ready="/health",
    ),
    ROBOT: Kind("loadgen", (), (NEAR,)),
}


def addresses(part: str, setups: Mapping[str, Setup]) -> dict[str, str]:
    """The flags with which a part finds the others of these parts."""
    servers = servers_among(setups)
    if kind_of(part) == WAN:
        return {"to": f"{next(one for one in servers if relay_of(one) == part)}:5555"}
    if kind_of(part) == CLOUD:
        return {}
    return endpoint_flags(setups, {server: f"tcp://{relay_of(server)}:5555" for server in servers})


def service_of(part: str, setup: Setup) -> str:
    """The Compose service whose image the part runs in.

    Robot and cloud share one image if the task is in `examples/`, because both need its library.
    """
    module = str(setup.flags.get("task") or setup.flags.get("tasks"))  # flags of a robot, and of the cloud
    return EXAMPLES if module.startswith(f"{EXAMPLES}.") else kind_of(part)


def as_seen(part: str, flags: Mapping[str, Any], out: Path) -> tuple[dict[str, Any], dict[Path, Path]]:
    """The flags with paths inside the container, and the mounts: our folder -> folder in the container."""
    seen: dict[str, Any] = {}
    folders: dict[Path, Path] = {}
    out = out.resolve()
    for name, value in flags.items():
        if isinstance(value, Path):
            folder = value.parent.resolve()
            path = folder / value.name
            if path.is_relative_to(out):
                folder = out
            if not folder.is_dir():
                raise ConfigError(f"{part}: --{name.replace('_', '-')}: {value}: its folder does not exist")
            place = RESULTS if folder == out else INPUTS / str(len(folders))
            value = folders.setdefault(folder, place) / path.relative_to(folder)
        seen[name] = value
    return seen, folders


def quota(cpus: float) -> dict[str, int]:
    quota_us, period_us = cgroup_us(cpus)
    return {"cpu_period": period_us, "cpu_quota": quota_us}


def as_popen(code: int) -> int:
    """The exit code as `Popen` reports it: 128 + signal becomes -signal.

    Our commands themselves exit with 130 and 141, so these two stay.
    """
    own = (INTERRUPTED_EXIT, BROKEN_PIPE_EXIT)
    return 128 - code if code not in own and code - 128 in set(signal.Signals) else code


class ContainerHogs:
    """The hogs of one part since its last start; when the part ends, they end too.

    `api` is the low-level client of the Docker SDK, `container` the running container of the part.
    """

    def __init__(self, part: str, api: Any, container: Any) -> None:
        self._part = part
        self._api = api
        self._container = container
        self._ids: list[str] = []  # of the `docker exec` of each hog

    def set(self, count: int) -> None:
        while len(self._ids) > count:
            self._end_last()
        while len(self._ids) < count:
            made = self._api.exec_create(self._container.id, _begin(len(self._ids) + 1))
            self._api.exec_start(made["Id"], detach=True)
            self._ids.append(made["Id"])

    def _end_last(self) -> None:
        number, end_s = len(self._ids), time.monotonic() + END_S
        while self._api.exec_inspect(self._ids[-1])["Running"]:
            if time.monotonic() > end_s:
                raise OffloadError(f"{self._part}: hog {number} has not ended after {END_S:g} s")
            self._container.exec_run(_end(number))  # repeated: the hog may only just have begun
        self._ids.pop()


def _begin(number: int) -> Sequence[str]:
    """A command that keeps a CPU busy until the command `_end` with the same number is executed."""
    return ("sh", "-c", ': > "$0"; while [ -e "$0" ]; do :; done', f"/tmp/hog-{number}")


def _end(number: int) -> Sequence[str]:
    return ("rm", "-f", f"/tmp/hog-{number}")


class UsageMeter:
    """Reads the usage of one running container; use a new one after each start of the container.

    Its shell stays in the container: a `docker exec` for each reading would use 10 ms of the container's CPU
    time, which takes 100 ms at a quota of 0.1 CPU.

    `api` is the low-level client of the Docker SDK. Docker's refusals are raised as DockerException or
    OSError.
    """

    def __init__(self, api: Any, container: str) -> None:
        made = api.exec_create(container, ["sh", "-c", MEASURE], stdin=True)
        self._attached = api.exec_start(made["Id"], socket=True)
        # On Unix sockets the SDK returns a read-only wrapper; the socket in it can be written to.
        self._socket = getattr(self._attached, "_sock", self._attached)
        self._socket.settimeout(ANSWER_S)

    def read(self) -> Usage:
        """The usage now; OSError if the shell gives none in time, and then the meter cannot be used again."""
        self._socket.sendall(b"\n")
        output = b""
        while not output.endswith(b"\n"):
            stream, size = _FRAME.unpack(self._receive(_FRAME.size))
            if stream != 1 or len(output) + size > ANSWER_BYTES_MAX:
                raise OSError(
                    f"the shell in the container printed {output + self._receive(min(size, 200))!r}"
                )
            output += self._receive(size)
        return measured(output)

    def close(self) -> None:
        # Close the response, which closes the socket; closing the socket first breaks the response.
        getattr(self._attached, "_response", self._attached).close()

    def _receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            chunk = self._socket.recv(size - len(received))
            if not chunk:
                raise OSError("the shell in the container has ended")
            received += chunk
        return received


def measured(output: bytes) -> Usage:
    """The usage in one line of output of MEASURE."""
    pages, handles = map(int, output.split())
    return Usage(memory_bytes=pages * os.sysconf("SC_PAGE_SIZE"), handles=handles)
