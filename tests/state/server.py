"""The server of the state machine: one process on one port that is killed, paused, restarted or replaced."""

import os
import signal
import socket
import sys
from pathlib import Path

from offboard.loadgen.testbed.part_process import Child, Part, end, launch, wait_ready
from tests.state import served

READY_S = 60.0
SAME, OTHER = "the same tasks", "other tasks"
DOWN, RUNNING, PAUSED = "down", "running", "paused"


class Server:
    """`cloud-server` at `endpoint`, with the tasks of `served` or with tasks of other source.

    Use it from the main thread only: the kernel kills the process when the thread that started it ends.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        with socket.create_server(("127.0.0.1", 0)) as one, socket.create_server(("127.0.0.1", 0)) as two:
            self._listen, self._http = (f"127.0.0.1:{taken.getsockname()[1]}" for taken in (one, two))
        self.endpoint = f"tcp://{self._listen}"
        self.state, self.source, self._started = DOWN, SAME, False
        self._child: Child | None = None
        text = Path(served.__file__).read_text()
        (folder / "other_served.py").write_text(text.replace("    return ", "    return 'wrong', "))

    def __enter__(self) -> "Server":
        self.heal()
        return self

    def __exit__(self, *_: object) -> None:
        if self._child is not None:
            end(self._child)

    def start(self, source: str, executor: str, *, wait: bool = False) -> None:
        """Start the process; it is ready a while later."""
        modules = {SAME: "tests.state.served", OTHER: "other_served"}
        command = [sys.executable, "-m", "offboard.cloud_server", "--tasks", modules[source]]
        command += ["--listen", self.endpoint, "--http", self._http, "--workers", "2"]
        path = os.environ.get("PYTHONPATH", "")
        os.environ["PYTHONPATH"] = f"{self._folder}{os.pathsep}{path}"
        try:
            part = Part("server", (*command, "--executor", executor), http=self._http)
            self._child = launch(part, self._folder / "server.log", again=self._child is not None)
            self._child.wait_launched()
        finally:
            os.environ["PYTHONPATH"] = path
        self.state, self.source = RUNNING, source
        if wait:
            wait_ready(self._child, READY_S)

    def kill(self) -> None:
        self._known().kill()
        self.state = DOWN

    def stop(self) -> None:
        """Ask it to end, as an operator does, and wait."""
        end(self._known())
        self.state = DOWN

    def pause(self) -> None:
        self._known().send(signal.SIGSTOP)
        self.state = PAUSED

    def resume(self) -> None:
        self._known().send(signal.SIGCONT)
        self.state = RUNNING

    def heal(self) -> None:
        """Let the server with the same tasks run, and wait until it is ready."""
        if self.state == PAUSED:
            self.resume()
        if self.state == RUNNING and self.source != SAME:
            self.kill()
        if self.state == DOWN:
            self.start(SAME, "threads")
        wait_ready(self._known(), READY_S)

    def ended(self) -> str | None:
        """How the process ended, if it was not told to."""
        if self.state == DOWN or self._known().process.poll() is None:
            return None
        return f"the server ended with {self._known().process.returncode}: {self._known().tail()}"

    def _known(self) -> Child:
        assert self._child is not None
        return self._child
