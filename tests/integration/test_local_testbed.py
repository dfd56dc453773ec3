"""The local testbed with small real processes: readiness, faults, and that no process outlives it."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.testbed.cpu_quota import SignalQuota
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.loadgen.testbed.part_process import Part
from offboard.loadgen.testbed.testbed import Setup

pytestmark = pytest.mark.integration

WAIT_S = 10.0
WAN = """
import sys
from offboard.common.command_line import load, run_command
from offboard.loadgen.relay.wan import WanConfig, run_wan
settings = dict(prog="wan", description="", environ={}, prefix="WAN")
sys.exit(run_command("wan", lambda: run_wan(load(WanConfig, sys.argv[1:], **settings))))
"""
# Answers 200 on its HTTP port, and echoes everything on its other port.
CLOUD = """
import argparse, http.server, socketserver, sys, threading
flags = argparse.ArgumentParser()
for name in ("--listen", "--http", "--fail"):
    flags.add_argument(name)
flags = flags.parse_args()
if flags.fail:
    sys.exit(f"cloud-server: {flags.fail}")

class Echo(socketserver.BaseRequestHandler):
    def handle(self):
        while data := self.request.recv(4096):
            self.request.sendall(data)

class Ready(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200 if self.path == "/ready" else 404)
        self.end_headers()

def address(text):
    host, port = text.removeprefix("tcp://").split(":")
    return host, int(port)

socketserver.ThreadingTCPServer.allow_reuse_address = True
echo = socketserver.ThreadingTCPServer(address(flags.listen), Echo)
threading.Thread(target=echo.serve_forever, daemon=True).start()
http.server.ThreadingHTTPServer(address(flags.http), Ready).serve_forever()
"""
# Prints the shortest round trip to the cloud in ms, or computes forever.
ROBOT = """
import socket, sys, time
if "--busy" in sys.argv:
    while True: pass
host, port = next(arg for arg in sys.argv if arg.startswith("--cloud=")).removeprefix("--cloud=tcp://").split(":")
link = socket.create_connection((host, int(port)))
def trip():
    start = time.perf_counter()
    link.sendall(b"ping")
    assert link.recv(4) == b"ping"
    return time.perf_counter() - start
print(1e3 * min(trip() for _ in range(15)))
"""
# A testbed in its own process, with two parts and a busy robot with a quota, until it is ended.
HOST = """
import signal, sys
from pathlib import Path
import offboard.loadgen.testbed.local_testbed as processes
from offboard.loadgen.testbed.cpu_quota import SignalQuota
from offboard.loadgen.testbed.testbed import Setup
from tests_commands import COMMANDS
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores Ctrl-C
if sys.argv[2] == "stop-continue":
    processes.hold = SignalQuota
robot = {"robot": Setup({"busy": True}, cpus=0.1)}
with processes.LocalTestbed(Path(sys.argv[1]), robot, commands=COMMANDS) as bed:
    bed.start()
    bed.start("robot")
    print(bed.children["robot"].quota.kind, flush=True)
    if sys.argv[3] == "paused":
        bed.pause("robot")
        print("paused", flush=True)
    bed.wait("robot")
"""


@pytest.fixture
def commands(tmp_path: Path) -> dict[str, list[str]]:
    """The commands of the small parts; their command lines contain the folder of the test."""
    scripts = {"cloud": CLOUD, "wan": WAN, "robot": ROBOT}
    for name, code in scripts.items():
        (tmp_path / f"{name}.py").write_text(code)
    return {name: [sys.executable, str(tmp_path / f"{name}.py")] for name in scripts}


@pytest.fixture
def host(tmp_path: Path, commands: dict[str, list[str]]) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Factory: starts a testbed process with a busy robot that has a quota."""
    (tmp_path / "tests_commands.py").write_text(f"COMMANDS = {commands!r}")
    (tmp_path / "host.py").write_text(HOST)
    with contextlib.ExitStack() as stack:

        def start(kind: str, robot: str = "running") -> subprocess.Popen[str]:
            command = [sys.executable, str(tmp_path / "host.py"), str(tmp_path / "out"), kind, robot]
            process = stack.enter_context(
                subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            )
            stack.callback(process.kill)
            assert process.stdout is not None
            shown = process.stdout.readline().strip()
            assert shown == kind or (kind == "any" and shown)
            if robot == "paused":
                assert process.stdout.readline() == "paused\n"
            return process

        yield start


def processes(tmp_path: Path) -> list[str]:
    """Command lines of the live processes of this test; zombies have none."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            command = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            if str(tmp_path) in command and int(entry.name) != os.getpid():
                found.append(command)
    return found


def wait_until(fact: Callable[[], Any]) -> None:
    end = time.monotonic() + WAIT_S
    while not fact():
        assert time.monotonic() < end, "not within the wait"
        time.sleep(0.02)


def bed(delay_ms: float) -> dict[str, Setup]:
    """The setups of a robot behind a link with this delay."""
    return {"wan": Setup({"delay_ms": delay_ms}), "robot": Setup()}


def robot_ms(testbed: LocalTestbed) -> float:
    """The shortest round trip that a robot measures; other load on the machine can only make it longer."""
    testbed.start("robot")
    assert testbed.wait("robot", WAIT_S) == 0
    return float(testbed.children["robot"].tail())


def test_the_three_parts_work_together(tmp_path: Path, commands: Any) -> None:
    """With 10 ms each way, the round trip of the robot through the relay is 20 ms."""
    with LocalTestbed(tmp_path / "out", bed(10), commands=commands) as testbed:
        testbed.start()
        assert robot_ms(testbed) == pytest.approx(21, abs=1.5)
        assert testbed.link()["accepted"] == 1
    assert processes(tmp_path) == []
    assert {file.name for file in (tmp_path / "out" / "logs").iterdir()} == {
        "cloud.log",
        "wan.log",
        "robot.log",
    }


def test_set_link_changes_what_the_relay_does(tmp_path: Path, commands: Any) -> None:
    """A changed delay changes the next round trips; an unknown condition is refused by its name."""
    with LocalTestbed(tmp_path / "out", bed(0), commands=commands) as testbed:
        testbed.start()
        assert robot_ms(testbed) == pytest.approx(1, abs=1.5)
        assert testbed.set_link(up={"delay_ms": 20})["up"]["delay_ms"] == 20
        assert robot_ms(testbed) == pytest.approx(21, abs=1.5)
        with pytest.raises(ConfigError, match="link: delay: unknown condition"):
            testbed.set_link(delay=3)


def test_a_killed_cloud_can_be_started_again(tmp_path: Path, commands: Any) -> None:
    """After SIGKILL, the cloud starts again on the same ports, behind the same relay."""
    with LocalTestbed(tmp_path / "out", bed(0), commands=commands) as testbed:
        testbed.start()
        testbed.kill("cloud")
        assert not testbed.running("cloud")
        testbed.start("cloud")
        assert testbed.running("cloud")
        assert robot_ms(testbed) > 0


def test_a_paused_part_hangs_until_it_is_resumed(tmp_path: Path, commands: Any) -> None:
    """A robot waits for a paused relay, and ends normally after the relay is resumed."""
    with LocalTestbed(tmp_path / "out", bed(0), commands=commands) as testbed:
        testbed.start()
        testbed.pause("wan")
        testbed.start("robot")
        with pytest.raises(OffloadError, match=r"robot has not ended after 0\.5 s"):
            testbed.wait("robot", 0.5)
        testbed.resume("wan")
        assert testbed.wait("robot", WAIT_S) == 0


def test_a_quota_holds_from_the_start(tmp_path: Path, commands: Any) -> None:
    """A busy robot never gets more than its share, and gets all of it when the machine is free."""
    robot = {"robot": Setup({"busy": True}, cpus=0.25)}
    with LocalTestbed(tmp_path / "out", robot, commands=commands) as testbed:
        testbed.start("robot")
        child = testbed.children["robot"]
        start_s = time.monotonic()
        quota = child.quota
        assert quota is not None
        assert quota.cpus == 0.25
        shares, before = [], (start_s, 0.0)
        for _ in range(6):
            time.sleep(0.5)
            now = time.monotonic(), time.clock_gettime((~child.process.pid << 3) | 2)
            shares.append((now[1] - before[1]) / (now[0] - before[0]))
            before = now
        assert before[1] / (before[0] - start_s) < 0.25 * 1.15
        assert max(shares) > 0.25 * 0.85, "other load on the machine can only reduce the share"


def test_a_part_that_ends_during_start_is_an_error(tmp_path: Path, commands: Any) -> None:
    """The error comes at once, with the exit code and the end of the log."""
    cloud = {"cloud": Setup({"fail": "no such task module: planer"})}
    with LocalTestbed(tmp_path / "out", cloud, commands=commands) as testbed:
        with pytest.raises(OffloadError) as caught:
            testbed.start()
        assert not testbed.running("wan")
    log = tmp_path / "out" / "logs" / "cloud.log"
    assert str(caught.value) == (
        f"cloud ended during start with exit code 1; {log} ends with:\n"
        "cloud-server: no such task module: planer"
    )


def test_a_wrong_flag_of_a_part_is_a_config_error(tmp_path: Path, commands: Any) -> None:
    """Exit code 2 of a part becomes a ConfigError with the part's own message."""
    with (
        LocalTestbed(tmp_path / "out", bed(-1), commands=commands) as testbed,
        pytest.raises(ConfigError, match=r"^wan: --delay-ms: -1.0 is below 0, the minimum$"),
    ):
        testbed.start("wan")


def test_a_part_that_is_never_ready_is_an_error(tmp_path: Path, commands: Any) -> None:
    """A part that runs but does not become ready in time is an error."""
    with LocalTestbed(tmp_path / "out", ready_s=1.0) as testbed:
        http = "127.0.0.1:1"
        with pytest.raises(OffloadError, match="robot was not ready within 1 s; its log ends with"):
            testbed.start_part(Part("robot", (*commands["robot"], "--busy"), http=http))
    assert processes(tmp_path) == []


def test_a_missing_command_is_an_error(tmp_path: Path) -> None:
    """If the program of a part is missing, the error names it."""
    with (
        LocalTestbed(tmp_path / "out") as testbed,
        pytest.raises(OffloadError, match="cannot run no-such-program"),
    ):
        testbed.start_part(Part("cloud", ("no-such-program",), http="127.0.0.1:1"))


def test_a_part_that_ignores_sigterm_is_killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A part and its worker that ignore SIGTERM are gone after the testbed is closed."""
    monkeypatch.setattr("offboard.loadgen.testbed.part_process.TERMINATE_S", 0.2)
    code = (
        "import os, signal, time; signal.signal(15, signal.SIG_IGN); os.fork(); print('up'); time.sleep(99)"
    )
    with LocalTestbed(tmp_path / "out") as testbed:
        child = testbed.start_part(Part("cloud", (sys.executable, "-u", "-c", code, str(tmp_path))))
        wait_until(lambda: child.tail() == "up\nup")
        assert len(processes(tmp_path)) == 2
    wait_until(lambda: processes(tmp_path) == [])


@pytest.mark.parametrize("robot", ["running", "paused"])
@pytest.mark.parametrize("kind", ["any", SignalQuota.kind])
def test_a_killed_testbed_leaves_no_process(tmp_path: Path, host: Any, kind: str, robot: str) -> None:
    """After kill -9 of the testbed, its parts are gone too, even a stopped one."""
    process = host(kind, robot)
    assert len(processes(tmp_path)) == 4
    process.kill()
    process.wait(WAIT_S)
    wait_until(lambda: processes(tmp_path) == [])


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("kind", ["any", SignalQuota.kind])
def test_an_interrupted_testbed_leaves_no_process(tmp_path: Path, host: Any, kind: str, stop: int) -> None:
    """After Ctrl-C or SIGTERM, even twice, no process is left once the testbed has ended."""
    process = host(kind)
    process.send_signal(stop)
    time.sleep(0.05)
    process.send_signal(stop)
    process.wait(WAIT_S)
    assert processes(tmp_path) == []
