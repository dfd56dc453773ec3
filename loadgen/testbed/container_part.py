"""What a part is inside of its container: image, command, networks, files and processes.

Pure: who makes the containers is `containers`.
"""

import os
import signal
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from offboard.common.command_line import BROKEN_PIPE_EXIT, INTERRUPTED_EXIT
from offboard.common.errors import ConfigError
from offboard.loadgen.testbed.cpu_quota import CGROUP_PERIOD_S, CGROUP_QUOTA_S_MIN, check_cpus
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Usage

NEAR, FAR = "near", "far"
RESULTS, INPUTS, COMPILED = Path("/out"), Path("/in"), Path("/var/cache/offboard")
# For each line, pages in memory and open handles of session 1, which is the part and its workers: what is
# executed in the container beside them has sessions of its own, and process 1 is Docker's init. It starts no
# process, as that would cost the part's CPU quota.
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
    """What all parts of a kind have alike; `http` is the port of their HTTP side, and `ready` its path."""

    image: str
    command: tuple[str, ...]
    networks: tuple[str, ...]
    http: int | None = None
    ready: str = ""


# Without keys: the networks are made for one run, have no way out, and end with it; a run measures the
# link and not the encryption, as on the local testbed. The HTTP sides are published on 127.0.0.1 alone.
KINDS: Mapping[str, Kind] = {
    CLOUD: Kind(
        "offboard-cloud",
        ("--listen", "tcp://*:5555", "--http", "0.0.0.0:8000", "--insecure"),
        (FAR,),
        http=8000,
        ready="/ready",
    ),
    WAN: Kind(
        "offboard-bench",
        ("wan", "--listen", "0.0.0.0:5555", "--to", "cloud:5555", "--http", "0.0.0.0:8001", "--insecure"),
        (NEAR, FAR),
        http=8001,
        ready="/health",
    ),
    ROBOT: Kind("offboard-robot", ("--cloud", "tcp://wan:5555"), (NEAR,)),
}


def kind_of(part: str) -> Kind:
    return KINDS[part.partition("-")[0]]


def as_seen(part: str, flags: Mapping[str, Any], out: Path) -> tuple[dict[str, Any], dict[Path, Path]]:
    """The flags as the part shall see them, and where it finds which folder of ours."""
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
    """How Docker holds a container to so many CPUs over 10 ms, or longer where the kernel takes no less."""
    check_cpus(cpus)
    period_us = round(1e6 * max(CGROUP_PERIOD_S, CGROUP_QUOTA_S_MIN / cpus))
    return {"cpu_period": period_us, "cpu_quota": round(cpus * period_us)}


def hog(number: int) -> Sequence[str]:
    """A command that keeps a CPU busy until `end_hog` of this number is executed."""
    return ("sh", "-c", ': > "$0"; while [ -e "$0" ]; do :; done', f"/tmp/hog-{number}")


def end_hog(number: int) -> Sequence[str]:
    return ("rm", "-f", f"/tmp/hog-{number}")


def measured(said: bytes) -> Usage:
    """What MEASURE printed."""
    pages, handles = map(int, said.split())
    return Usage(memory_bytes=pages * os.sysconf("SC_PAGE_SIZE"), handles=handles)


def as_popen(code: int) -> int:
    """Minus the signal of 128 + signal, but for the two codes that our commands end with by themselves."""
    own = (INTERRUPTED_EXIT, BROKEN_PIPE_EXIT)
    return 128 - code if code not in own and code - 128 in set(signal.Signals) else code
