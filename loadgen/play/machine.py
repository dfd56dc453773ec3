"""What a measurement was made with: the machine, the commit of the code, and CPU time that a host took."""

import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

ASK_S = 30.0
NONE = "none"
ROOT = Path("/")
# Devices of graphics processors: NVIDIA, any with a kernel driver, AMD compute, Jetson, Windows with WSL.
GPU_DEVICES = ("nvidia[0-9]*", "dri/renderD*", "kfd", "nvhost-gpu", "dxg")
STAT = Path("/proc/stat")
NOTED_PERCENT = 5.0  # from this share on, it is reported with the times of a run
# Files that no measurement depends on, so that figures, and pages about them, can be committed without making
# the figures old.
NOT_CODE = (  # as patterns of git, from the root of the checkout
    "docs",
    "tests/[!r]*",  # all but tests/ros2, which is measured
    "tests/r[!o]*",
    "*.md",
    "loadgen/datasets",
    "loadgen/scenarios",  # a measurement keeps the digest of those that it needs
    "benchmarks/capacity.json",
    "benchmarks/costs",
    "benchmarks/figures",  # it runs the measurements, and writes the pages
    ".ci",
    ".gitignore",
    "Makefile",
    "mkdocs.yml",
)
_CODE = (":(top)", *(f":(top,exclude){pattern}" for pattern in NOT_CODE))


def machine() -> dict[str, Any]:
    """The machine as NAME.json of a dataset keeps it; memory in GiB."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1),
        "gpu": gpu(ROOT),
        "system": _system(),
        "kernel": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
    }


def docker_version() -> str | None:
    """The version of the Docker engine; None: unknown."""
    return output_of(("docker", "version", "--format", "{{.Server.Version}}"))


def gpu(root: Path) -> str:
    """The names of the graphics processors, or else their devices; `none` if there is no device."""
    found = sorted(str(path) for pattern in GPU_DEVICES for path in (root / "dev").glob(pattern))
    models = []
    for path in sorted((root / "proc/driver/nvidia/gpus").glob("*/information")):
        lines = path.read_text(errors="replace").splitlines()
        models += [line.partition(":")[2].strip() for line in lines if line.startswith("Model")]
    return ", ".join(models or found) or NONE


def commit_here() -> str | None:
    """The last commit that changed code in the checkout of the current folder.

    `-dirty` is added if code files were changed since then. None if git does not tell, as outside a checkout.
    """
    commit = output_of(("git", "log", "-1", "--format=%h", "--abbrev=12", "--", *_CODE))
    changed = changed_code()
    if commit is None or changed is None:
        return None
    return f"{commit}{'-dirty' if changed else ''}"


def changed_code() -> list[str] | None:
    """The code files that differ from the last commit, new ones included, from the root of the checkout.

    None if git does not tell.
    """
    lines = output_of(("git", "status", "--porcelain", "--branch", "--untracked-files=all", "--", *_CODE))
    return None if lines is None else [line.split(maxsplit=1)[1] for line in lines.splitlines()[1:]]


class StolenCpuTime:
    """Measures the share of stolen CPU time since it was created ("steal" in proc(5)); 0 on bare metal.

    Stolen time makes every task longer, whatever the policy does, so runs that lost much of it cannot be
    compared.
    """

    def __init__(self, stat: Path = STAT) -> None:
        self._stat = stat
        self._before = self._read()

    def percent(self) -> float | None:
        """The stolen share in percent of the CPU time that was asked for; None if the kernel does not say."""
        now, before = self._read(), self._before
        if now is None or before is None:
            return None
        stolen, asked = now[0] - before[0], now[1] - before[1]
        return 100 * stolen / asked if asked > 0 else 0.0

    def _read(self) -> tuple[int, int] | None:
        """Stolen ticks, and all ticks that were asked for, stolen ones included."""
        try:
            first = self._stat.read_text().split("\n", 1)[0].split()
            user, nice, system, _idle, _wait, irq, softirq, steal = map(int, first[1:9])
        except (OSError, ValueError):
            return None
        return steal, user + nice + system + irq + softirq + steal


def output_of(command: Sequence[str]) -> str | None:
    """What a command printed; None if it failed or printed nothing."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return (done.stdout.strip() or None) if done.returncode == 0 else None


def _system() -> str:
    try:
        return platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):  # not Linux, or one without this file
        return platform.system()


def _cpu_model() -> str:
    """The kernel's name of the CPU, or else the architecture."""
    try:
        lines = (ROOT / "proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    models = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(models, platform.machine())
