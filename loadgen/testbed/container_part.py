"""A part inside its container: image, command, networks, files and processes, as pure functions and data.

`docker_testbed` makes the containers.
"""

import os
import signal
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.command_line import BROKEN_PIPE_EXIT, INTERRUPTED_EXIT
from offboard.common.errors import ConfigError
from offboard.loadgen.testbed.cpu_quota import CGROUP_PERIOD_S, CGROUP_QUOTA_S_MIN, check_cpus
from offboard.loadgen.testbed.testbed import (
    CLOUD,
    ROBOT,
    WAN,
    Setup,
    Usage,
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
    ways = {server: f"tcp://{relay_of(server)}:5555" for server in servers}
    first = ways.pop(CLOUD)
    further = ",".join(f"{setups[server].site or server}={endpoint}" for server, endpoint in ways.items())
    return {"cloud": first, **({"site": further} if further else {})}


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
    """Docker's options for a CPU quota, with a period of 10 ms, or longer if the kernel needs it."""
    check_cpus(cpus)
    period_us = round(1e6 * max(CGROUP_PERIOD_S, CGROUP_QUOTA_S_MIN / cpus))
    return {"cpu_period": period_us, "cpu_quota": round(cpus * period_us)}


def measured(output: bytes) -> Usage:
    """The usage in one line of output of MEASURE."""
    pages, handles = map(int, output.split())
    return Usage(memory_bytes=pages * os.sysconf("SC_PAGE_SIZE"), handles=handles)


def as_popen(code: int) -> int:
    """The exit code as `Popen` reports it: 128 + signal becomes -signal.

    Our commands themselves exit with 130 and 141, so these two stay.
    """
    own = (INTERRUPTED_EXIT, BROKEN_PIPE_EXIT)
    return 128 - code if code not in own and code - 128 in set(signal.Signals) else code
