"""`cloud-server --executor ray` as a process of its own, on a cluster."""

import json
import os
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Sequence
from pathlib import Path

ROOT = Path(__file__).parents[2]
START_S = 60.0
UNTIL_S = 120.0


class RayServer:
    """A server process with these flags, which runs in `folder` and writes its log there."""

    def __init__(self, folder: Path, *flags: str) -> None:
        self._log = folder / "server.log"
        self._process = start(folder, *flags, log=self._log)
        until(lambda: " ready: " in self._log.read_text() or self._process.poll() is not None)
        lines = self._log.read_text().splitlines()
        ready = next((line for line in lines if " ready: " in line), None)
        assert ready is not None, lines
        self.endpoint, self.http = ready.split("listening on ")[1].split(", ")

    @property
    def log(self) -> str:
        return self._log.read_text()

    def get(self, path: str) -> tuple[int, str]:
        """The status and the body of a page."""
        try:
            with urllib.request.urlopen(f"{self.http}{path}", timeout=START_S) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()

    def health(self) -> dict[str, object]:
        found: dict[str, object] = json.loads(self.get("/health")[1])
        return found

    def close(self) -> int:
        self._process.terminate()
        try:
            return self._process.wait(START_S)
        finally:
            self._process.kill()


def start(folder: Path, *flags: str, log: Path) -> "subprocess.Popen[bytes]":
    command = [sys.executable, "-m", "offboard.cloud_server", "--executor", "ray", "--listen"]
    command += ["tcp://127.0.0.1:0", "--http", "127.0.0.1:0", *flags]
    with log.open("wb") as file:
        environ = os.environ | {"PYTHONPATH": str(ROOT)}
        return subprocess.Popen(command, cwd=folder, stdout=file, stderr=file, env=environ)


def refusal(folder: Path, *flags: str) -> tuple[int, Sequence[str]]:
    """The exit code of a server that does not start, and the lines that are no log."""
    log = folder / "refused.log"
    process = start(folder, *flags, log=log)
    try:
        code = process.wait(START_S)
    finally:
        process.kill()  # one that is not refused would take the CPU of the tests after it
    return code, [line for line in log.read_text().splitlines() if line.startswith("cloud-server: ")]


def until(condition: Callable[[], bool]) -> None:
    """Wait until a process has done something."""
    end_s = time.monotonic() + UNTIL_S
    while not condition():
        assert time.monotonic() < end_s, f"it did not happen within {UNTIL_S:g} s"
        time.sleep(0.02)
