"""What the tests of keys and tokens share: commands, tokens, and looks at a server and a robot."""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import httpx

from offboard.robot_client.offloader import Offloader
from tests.curves import ROOT, Served, clean_environ
from tests.probes import echo

TOKEN = "a-token-of-the-tests"
SAFE_HEADERS = {
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "cache-control": "no-store",
}


Serve = Callable[..., Served]
Robot = Callable[..., Offloader]


def run(*command: str, **environ: str) -> "subprocess.CompletedProcess[str]":
    return subprocess.run(
        [sys.executable, "-m", f"offboard.{command[0]}", *command[1:]],
        cwd=ROOT,
        env=clean_environ() | environ,
        capture_output=True,
        text=True,
        timeout=60,
    )


def token_file(folder: Path) -> Path:
    path = folder / "token"
    path.touch(0o600)
    path.write_text(f"{TOKEN}\n")
    return path


def metric(served: Served, name: str) -> float:
    """The sum of a metric of the server over all of its labels."""
    text = httpx.get(f"{served.http}/metrics").text
    full = f"offboard_server_{name}"
    assert full.partition("{")[0] in text, f"the server has no metric {full}"
    return sum(float(line.split()[-1]) for line in text.splitlines() if line.startswith(full))


def why_not(offload: Offloader) -> str:
    """Why the cloud is unavailable; empty if it is available."""
    return offload.wait_for_sites(echo, 0.0).get("cloud", "")


def stays_onboard(offload: Offloader) -> None:
    """Check that a task is answered, and runs onboard."""
    assert offload(echo, "mine") == "mine"
    assert offload.last is not None
    assert offload.last.used == "onboard"
