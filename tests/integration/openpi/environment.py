"""Builds an environment with `openpi-client` and `policy-websocket` from PyPI, which need numpy < 2."""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
FOLDER = ROOT / ".cache" / "openpi"
LOCK = ROOT / "requirements" / "openpi.txt"
PYTHON_MIN = (3, 11)  # that of the lock
PYTHON_MAX = (3, 12)  # numpy < 2 has no wheels for later versions
BUILD_S = 300.0


class CannotBuildError(Exception):
    """The environment cannot be made on this machine; the message says why."""


def python() -> Path:
    """The Python of the environment, which is built unless it is there."""
    ready, wanted = FOLDER / ".ready", hashlib.sha256(LOCK.read_bytes()).hexdigest()
    path = FOLDER / "bin" / "python"
    if not (ready.exists() and ready.read_text() == wanted):
        shutil.rmtree(FOLDER, ignore_errors=True)
        _run(_suitable(), "-m", "venv", FOLDER)
        _run(path, "-m", "pip", "install", "--quiet", "--require-hashes", "-r", LOCK)
        ready.write_text(wanted)
    return path


def _suitable() -> str:
    if PYTHON_MIN <= sys.version_info[:2] <= PYTHON_MAX:
        return sys.executable
    found = shutil.which("python3.12") or shutil.which("python3.11")
    if found is None:
        raise CannotBuildError("openpi-client needs Python 3.11 or 3.12, and neither is on the PATH")
    return found


def _run(*command: str | Path) -> None:
    done = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, check=False, timeout=BUILD_S
    )
    if done.returncode:
        raise CannotBuildError(f"{' '.join(map(str, command))}: {done.stderr[-500:]}")
