"""The first pages: offloading a function, and two servers with keys, as docs/ shows them."""

import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.curves import ROOT, Served
from tests.integration.keys.servers import run
from tests.programs import output_of

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

BLOCK = re.compile(r"```python\n# (\w+\.py)\n(.*?)```", re.DOTALL)
CALLS = 20  # of each program


def blocks(page: str) -> dict[str, str]:
    return dict(BLOCK.findall((ROOT / "docs" / page).read_text(encoding="utf-8")))


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the module of the tasks, which servers also find."""
    (tmp_path / "mytasks.py").write_text(blocks("offload.md")["mytasks.py"])
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{ROOT}")
    return tmp_path


@pytest.fixture
def serve() -> Iterator[Callable[..., Served]]:
    """Factory: a server of the tasks with these flags."""
    with ExitStack() as stack:

        def start(*flags: str) -> Served:
            served = Served("--tasks", "mytasks", *flags)
            stack.callback(served.close)
            return served

        yield start


def test_a_function_is_offloaded_as_the_page_says(folder: Path, serve: Callable[..., Served]) -> None:
    """Both sites can take the task, every call is answered, and the server answers some."""
    served = serve()
    program = blocks("offload.md")["robot.py"].replace("tcp://127.0.0.1:5555", served.endpoint)
    (folder / "robot.py").write_text(program)
    first, *calls = output_of(folder / "robot.py").splitlines()
    assert first == "all sites can take this task"
    assert len(calls) == CALLS
    assert {line.split()[2] for line in calls} <= {"onboard", "cloud"}
    assert [int(line.split()[0]) for line in calls] == [*range(10_000, 60_000, 2_500)]


def test_a_robot_uses_two_servers_with_keys_as_the_page_says(
    folder: Path, serve: Callable[..., Served]
) -> None:
    """Each server has its own key pair; with the key of the other one, a server is never used."""
    assert run("robot_client", "keys", "--out", str(folder / "keys")).returncode == 0
    program = blocks("server.md")["patrol.py"]
    for name in ("edge", "datacentre"):
        keys = folder / name
        assert run("cloud_server", "keys", "--out", str(keys)).returncode == 0
        shutil.copy(keys / "server.key", folder / "keys" / f"{name}.key")
        shutil.copy(folder / "keys" / "robot.key", keys / "robots" / "arm-1.key")
        program = program.replace(f"tcp://{name}:5555", serve("--keys", str(keys)).endpoint)
    (folder / "patrol.py").write_text(program)
    first, *calls = output_of(folder / "patrol.py").splitlines()
    assert first == "all sites can take this task"
    assert len(calls) == CALLS
    assert {line.split()[1] for line in calls} <= {"onboard", "edge", "datacentre"}
    shutil.copy(folder / "keys" / "edge.key", folder / "keys" / "datacentre.key")
    program = program.replace("10.0)", "2.0)")
    (folder / "patrol.py").write_text(program)
    first, *calls = output_of(folder / "patrol.py").splitlines()
    assert "datacentre" in first
    assert {line.split()[1] for line in calls} <= {"onboard", "edge"}
