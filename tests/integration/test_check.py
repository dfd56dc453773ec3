"""`robot-client check` against good servers, and against everything that may stand in the way of one."""

import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
import zmq

from benchmarks.keyring import Keys
from offboard.common.security.keys import make_keys
from tests.curves import ROOT, Served, clean_environ

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]

STEPS = (
    "name resolves",
    "port is open",
    "server answers",
    "keys",
    "hello",
    "tasks",
    "round trip",
    "empty task",
)
TASK = """from dataclasses import dataclass
from offboard.common.tasks import task


@dataclass
class Pose:
    x: float = 0.0


def load() -> int:
    return 2


@task("twice", size=float, setup=load, types=(Pose,))
def twice(factor: int, number: int) -> int:
    return factor * number
"""

Serve = Callable[..., Served]


@pytest.fixture
def serve() -> Iterator[Serve]:
    """Factory: a server process with `tests.probes` and these flags."""
    with ExitStack() as stack:

        def start(*flags: object) -> Served:
            served = Served(*map(str, flags))
            stack.callback(served.close)
            return served

        yield start


def check(endpoint: str, *flags: object, cwd: Path = ROOT) -> tuple[int, list[str]]:
    """Run the check; return its exit code and its lines, one for each step."""
    done = subprocess.run(
        [sys.executable, "-m", "offboard.robot_client", "check", endpoint, *map(str, flags)],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=cwd,
        env=clean_environ(),
    )
    assert done.stderr == ""
    print(done.stdout)
    lines = done.stdout.splitlines()
    assert [line[6:22].strip() for line in lines] == list(STEPS)
    return done.returncode, lines


def fails(result: tuple[int, list[str]], step: str, *texts: str) -> None:
    """The check failed at `step` with these texts and a remedy; it skipped the steps after it."""
    code, lines = result
    at = STEPS.index(step)
    assert code == 1
    assert [line[:6].strip() for line in lines] == ["ok"] * at + ["FAIL"] + ["skip"] * (len(STEPS) - at - 1)
    for text in (*texts, "; remedy: "):
        assert text in lines[at]


def test_each_server_of_a_list_is_checked(serve: Serve, tmp_path: Path) -> None:
    """The lines of each server follow its name; one that fails makes the exit code 1."""
    served, path = serve(), tmp_path / "sites.toml"
    path.write_text(f'[a]\nendpoint = "{served.endpoint}"\n[b]\nendpoint = "tcp://127.0.0.1:1"\n')
    command = [sys.executable, "-m", "offboard.robot_client", "check", str(path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=ROOT, env=clean_environ())
    lines = done.stdout.splitlines()
    assert (done.returncode, done.stderr) == (1, "")
    assert lines[0] == f"a: {served.endpoint}"
    assert lines[len(STEPS) + 1] == "b: tcp://127.0.0.1:1"
    assert all(line.startswith("ok ") for line in lines[1 : len(STEPS) + 1])


@pytest.mark.parametrize("executor", ["threads", "processes"])
def test_a_good_server_passes_each_step(serve: Serve, executor: str) -> None:
    """With the tasks of its user, a server passes each step, and runs the empty task."""
    served = serve("--executor", executor)
    code, lines = check(served.endpoint, "--tasks", "tests.probes")
    assert code == 0
    assert all(line.startswith("ok ") for line in lines)
    assert "127.0.0.1 -> 127.0.0.1" in lines[0]
    assert "none; nothing is encrypted" in lines[3]
    assert "the same on both sides: " in lines[5]
    assert " ms, worst " in lines[6]
    assert "ran; it waited " in lines[7]


def test_keys_that_fit_pass(serve: Serve, tmp_path: Path) -> None:
    """With keys on both sides, the check says that the connection is encrypted."""
    keys = Keys(tmp_path)
    folder = keys.add("arm")
    served = serve("--keys", keys.server)
    code, lines = check(served.endpoint, "--keys", folder, "--tasks", "tests.probes")
    assert code == 0
    assert "encrypted (CURVE)" in lines[3]


def test_an_unknown_name_fails() -> None:
    """The line names the host."""
    fails(check("tcp://no-such-host.invalid:5555"), "name resolves", "no-such-host.invalid: ", "/etc/hosts")


def test_a_port_without_a_server_fails() -> None:
    """The remedy is to start the server."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    fails(
        check(f"tcp://127.0.0.1:{port}"),
        "port is open",
        f"nothing listens on port {port} of 127.0.0.1",
        f"--listen tcp://127.0.0.1:{port}",
    )


def test_the_http_port_of_the_server_fails(serve: Serve) -> None:
    """The remedy is to use the port of --listen."""
    endpoint = serve().http.replace("http://", "tcp://")
    fails(check(endpoint), "server answers", "an HTTP server listens", "cloud-server --listen")


def test_an_http_server_that_waits_for_a_line_fails() -> None:
    """A server that does not answer the greeting of ZMQ is asked in HTTP."""
    server = HTTPServer(("127.0.0.1", 0), BaseHTTPRequestHandler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        result = check(f"tcp://127.0.0.1:{server.server_port}", "--timeout", 1)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()
    fails(result, "server answers", "an HTTP server listens")


def test_a_silent_listener_fails() -> None:
    """A program that accepts connections and says nothing is not a cloud-server."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        result = check(f"tcp://127.0.0.1:{silent.getsockname()[1]}", "--timeout", 0.3)
    fails(result, "server answers", "a program that is not a cloud-server")


def test_another_zmq_program_does_not_answer_hello() -> None:
    """The remedy is to wait until the server is ready."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")
        result = check(f"tcp://127.0.0.1:{port}", "--timeout", 0.5)
    fails(result, "hello", "has not answered within 0.5 s", "/ready")


def test_another_version_fails() -> None:
    """A server that speaks another version of the wire format is named as such."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")

        def answer() -> None:
            robot, *_ = router.recv_multipart()
            router.send_multipart([robot, b"\x93\x02\xa5hello\x80"])  # msgpack of [2, "hello", {}]

        thread = threading.Thread(target=answer)
        thread.start()
        result = check(f"tcp://127.0.0.1:{port}")
        thread.join()
    fails(result, "hello", "version 2", "the same version of Offboard")


def test_a_server_with_other_tasks_fails(serve: Serve) -> None:
    """The line names the missing task and the tasks of the server; the remedy names the module."""
    result = check(serve().endpoint, "--tasks", "offboard.loadgen.scenario.hash_tasks")
    fails(result, "tasks", "the server has no task hash_", "it has ", "echo", "hash_tasks")


def test_without_tasks_the_planner_is_compared(serve: Serve) -> None:
    """A server without plan_path still passes the check; the line says how to compare other tasks."""
    code, lines = check(serve().endpoint)
    assert code == 0
    assert "not compared; the server has " in lines[STEPS.index("tasks")]
    assert "--tasks" in lines[STEPS.index("tasks")]


@pytest.mark.parametrize(
    ("here", "there"),
    [("factor * number", "number * factor"), ("return 2", "return 3"), ("x: float", "y: float")],
    ids=["function", "setup", "dataclass"],
)
def test_another_source_fails(
    serve: Serve, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, here: str, there: str
) -> None:
    """The line has the source hashes of both sides; the remedy is the same version on both sides."""
    for side, text in (("here", TASK), ("there", TASK.replace(here, there))):
        (tmp_path / side).mkdir()
        (tmp_path / side / "mytask.py").write_text(text)
    with monkeypatch.context() as patch:
        patch.setenv("PYTHONPATH", str(tmp_path / "there"))
        served = serve("--tasks", "mytask")
    result = check(served.endpoint, "--tasks", "mytask", cwd=tmp_path / "here")
    fails(result, "tasks", "twice differs: its source is ", "the same version of mytask on both sides")


def test_a_server_that_wants_keys_fails_without(serve: Serve, tmp_path: Path) -> None:
    """The remedy lists all steps to get keys."""
    served = serve("--keys", Keys(tmp_path).server)
    fails(check(served.endpoint), "keys", "this robot has none", "robot-client keys --out keys")


def test_a_server_without_keys_fails_with_keys(serve: Serve, tmp_path: Path) -> None:
    """A robot with keys never talks to a server without keys."""
    folder = Keys(tmp_path).add("arm")
    fails(check(serve().endpoint, "--keys", folder), "keys", "the server has no keys", "leave out --keys")


def test_a_robot_that_the_server_does_not_know_fails(serve: Serve, tmp_path: Path) -> None:
    """The remedy is to copy the public key of the robot."""
    keys = Keys(tmp_path)
    folder = keys.make("arm")
    served = serve("--keys", keys.server)
    result = check(served.endpoint, "--keys", folder)
    fails(result, "keys", "does not know the key of this robot", "robots folder of the server")


def test_the_key_of_another_server_fails(serve: Serve, tmp_path: Path) -> None:
    """The remedy is to copy the public key of this server."""
    keys = Keys(tmp_path)
    folder = keys.add("arm")
    make_keys(tmp_path / "other", "server")
    (folder / "server.key").write_bytes((tmp_path / "other" / "server.key").read_bytes())
    served = serve("--keys", keys.server)
    fails(
        check(served.endpoint, "--keys", folder), "keys", "is not the key of this server", "copy server.key"
    )


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        ([], "the following arguments are required: ENDPOINT"),
        (["cloud:5555"], "ENDPOINT: 'cloud:5555' is not tcp://HOST:PORT"),
        (["tcp://h:1", "--keys", "none"], "none/robot.key_secret"),
        (["tcp://h:1", "--tasks", "json"], "--tasks: json registers no task"),
        (["tcp://h:1", "--tasks", "no.such"], "'no.such' cannot be imported"),
        (["tcp://h:1", "--policy", "paper"], "unrecognized arguments: --policy paper"),
    ],
)
def test_wrong_usage_is_one_line_and_exit_code_2(argv: list[str], said: str, tmp_path: Path) -> None:
    """A mistake is named before anything is connected."""
    done = subprocess.run(
        [sys.executable, "-m", "offboard.robot_client", "check", *argv],
        capture_output=True,
        text=True,
        timeout=60,
        cwd=tmp_path,
        env=clean_environ(),
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert said in done.stderr
    assert len(done.stderr.splitlines()) == 1
