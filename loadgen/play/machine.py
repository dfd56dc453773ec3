"""What this machine is: processor, memory, graphics processor and system."""

import os
import platform
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from offboard.loadgen.testbed.container_part import IMAGES

ASK_S = 30.0
NONE = "none"
ROOT = Path("/")
# Devices of graphics processors: NVIDIA, any with a kernel driver, AMD compute, Jetson, Windows with WSL.
GPU_DEVICES = ("nvidia[0-9]*", "dri/renderD*", "kfd", "nvhost-gpu", "dxg")
SYSTEM = "import platform as p; print(p.freedesktop_os_release()['PRETTY_NAME'], p.python_version(), sep='|')"


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


def system_in(service: str) -> dict[str, str | None]:
    """System and Python inside the image of a Compose service; None: unknown."""
    run = ("docker", "run", "--rm", "--network", "none", "--entrypoint", "python3")
    system, _, python = (output_of((*run, IMAGES[service], "-c", SYSTEM)) or "").partition("|")
    return {"system": system or None, "python": python or None}


def gpu(root: Path) -> str:
    """The names of the graphics processors, or else their devices; `none` if there is no device."""
    found = sorted(str(path) for pattern in GPU_DEVICES for path in (root / "dev").glob(pattern))
    models = []
    for path in sorted((root / "proc/driver/nvidia/gpus").glob("*/information")):
        lines = path.read_text(errors="replace").splitlines()
        models += [line.partition(":")[2].strip() for line in lines if line.startswith("Model")]
    return ", ".join(models or found) or NONE


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
