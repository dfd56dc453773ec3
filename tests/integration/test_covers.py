"""`covers=` between a real robot and a real server: helpers, models, comments, and missing files."""

import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zmq

from offboard.common import VERSION
from offboard.common.wire import messages as wire
from tests.curves import ROOT, Served, clean_environ, until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(90)]

TASK = """from offboard import task


def scale(number: int) -> int:
    return 2 * number


@task("twice", size=float, covers={covers})
def twice(number: int) -> int:
    return scale(number)
"""
ROBOT = """import sys

from mytask import twice
from offboard import Offloader

with Offloader.connect(sys.argv[1]) as offload:
    print(offload.wait_for_sites(twice, 20.0))
    print(offload(twice, 3), offload.last.used)
"""
MODEL = "model.bin"
HASHED = f"or is only hashed in another way: Offboard 0.1.0 there, {VERSION} here"

Sides = Callable[..., Served]


@pytest.fixture
def sides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Sides]:
    """Factory: a server and the folder of a robot, each with its text of the task and its model."""
    with ExitStack() as stack:

        def start(
            covers: str, *, here: tuple[str, str] = ("", ""), models: tuple[str, str] = ("", "")
        ) -> Served:
            text = TASK.format(covers=covers)
            for side, changed, model in (
                ("here", text.replace(*here), models[0]),
                ("there", text, models[1]),
            ):
                (tmp_path / side).mkdir()
                (tmp_path / side / "mytask.py").write_text(changed)
                (tmp_path / side / "robot.py").write_text(ROBOT)
                if model:
                    (tmp_path / side / MODEL).write_text(model)
            with monkeypatch.context() as patch:
                patch.setenv("PYTHONPATH", str(tmp_path / "there"))
                served = Served("--tasks", "mytask")
            stack.callback(served.close)
            return served

        yield start


def ran(folder: Path, *command: str) -> subprocess.CompletedProcess[str]:
    environ = clean_environ() | {"PYTHONPATH": f"{folder}:{ROOT}"}
    done = subprocess.run(
        [sys.executable, *command],
        capture_output=True, text=True, timeout=60, cwd=folder, env=environ, check=False,
    )  # fmt: skip
    print(done.stdout, done.stderr)
    return done


def check(served: Served, folder: Path) -> tuple[int, str]:
    """The exit code and the line of the tasks."""
    done = ran(folder, "-m", "offboard.robot_client", "check", served.endpoint, "--tasks", "mytask")
    assert done.stderr == ""
    return done.returncode, next(line for line in done.stdout.splitlines() if line[6:].startswith("tasks "))


def test_check_names_a_helper_that_is_not_covered(sides: Sides, tmp_path: Path) -> None:
    """The changed helper is not compared, and the line says so instead of "the same" alone."""
    served = sides("()", here=("2 * number", "4 * number"))
    code, line = check(served, tmp_path / "here")
    assert code == 0
    assert "the same on both sides: twice; not compared: mytask.scale (called, but in no covers=)" in line


def test_a_changed_helper_fails_if_it_is_covered(sides: Sides, tmp_path: Path) -> None:
    """The task then stays onboard."""
    served = sides("(scale,)", here=("2 * number", "4 * number"))
    code, line = check(served, tmp_path / "here")
    assert code == 1
    assert "twice differs: its source, with the code that it covers, is " in line
    said, answer = ran(tmp_path / "here", "robot.py", served.endpoint).stdout.splitlines()
    assert said == "cloud: the source of task twice or the code that it covers differs on the server"
    assert answer == "12 onboard"


def test_a_comment_takes_no_cloud_away(sides: Sides, tmp_path: Path) -> None:
    """Neither does other formatting."""
    served = sides(
        "(scale,)", here=("    return scale(number)", "    # more\n    return scale(\n        number)")
    )
    code, line = check(served, tmp_path / "here")
    assert (code, "scale" in line) == (0, False)
    assert ran(tmp_path / "here", "robot.py", served.endpoint).stdout.startswith("all sites can take")


@pytest.mark.parametrize(
    ("models", "said"),
    [
        (("weights", "weights"), "all sites can take this task"),
        (("old", "weights"), "cloud: model.bin, which twice covers, differs on the server"),
    ],
)
def test_a_model_is_compared(sides: Sides, tmp_path: Path, models: tuple[str, str], said: str) -> None:
    """Each side reads its own, next to its module."""
    served = sides(f"({MODEL!r},)", models=models)
    assert ran(tmp_path / "here", "robot.py", served.endpoint).stdout.splitlines()[0] == said
    code, line = check(served, tmp_path / "here")
    same = models[0] == models[1]
    assert code == (0 if same else 1)
    assert ("the same on both sides: twice" in line) == same


def test_a_missing_file_is_one_line(sides: Sides, tmp_path: Path) -> None:
    """A robot's first call, `robot-client check` and the start of a server name the file."""
    served = sides(f"({MODEL!r},)", models=("", "weights"))
    folder = tmp_path / "here"
    said = f"task twice: covers= names {folder / MODEL}: No such file or directory"
    robot = ran(folder, "robot.py", served.endpoint)
    assert robot.stderr.splitlines()[-1].endswith(f"ConfigError: {said}")
    checked = ran(folder, "-m", "offboard.robot_client", "check", served.endpoint, "--tasks", "mytask")
    server = ran(folder, "-m", "offboard.cloud_server", "--tasks", "mytask", "--listen", "tcp://127.0.0.1:0")
    for done in (checked, server):
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.count("\n") == 1
        assert said in done.stderr


def test_a_robot_names_the_older_version_of_a_server(tmp_path: Path) -> None:
    """An Offboard 0.1.0 hashed the same text in another way; wire version 1 still carries its `hello`."""
    for name, text in (("mytask.py", TASK.format(covers="()")), ("robot.py", ROBOT)):
        (tmp_path / name).write_text(text)
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")

        def answer() -> None:
            robot, *_ = router.recv_multipart()
            router.send_multipart([robot, *wire.pack(wire.Hello({"twice": "a" * 64}, "0.1.0", 2**20))])

        thread = threading.Thread(target=answer)
        thread.start()
        done = ran(tmp_path, "robot.py", f"tcp://127.0.0.1:{port}")
        thread.join()
    why = f"cloud: the source of task twice differs on the server, {HASHED}"
    assert done.stdout.splitlines() == [why, "6 onboard"]
    assert done.stderr.count(HASHED) == 1


def test_a_server_names_the_older_version_of_a_robot(sides: Sides) -> None:
    """It answers the `hello` as before, and logs once why the tasks of such robots stay onboard."""
    served = sides("()")
    hello = wire.pack(wire.Hello({"twice": "a" * 64}, "0.1.0", 2**20))
    with zmq.Context() as context, context.socket(zmq.DEALER) as robot:
        robot.linger = 0
        robot.connect(served.endpoint)
        for _ in range(2):
            robot.send_multipart(hello)
            answer = wire.unpack([bytes(frame) for frame in robot.recv_multipart()])
            assert isinstance(answer, wire.Hello)
            assert len(answer.tasks["twice"]) == 64
    said = f"a robot keeps twice onboard: the source differs, {HASHED}"
    until(lambda: served.logged(said))
    assert served.logged("a robot keeps ") == 1
