"""The walls of the house: who may import whom."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ROOMS = {
    "common": set(),
    "robot_client": {"common"},
    "cloud_server": {"common"},
    "loadgen": {"common", "robot_client"},
}
# Heavy or optional libraries, and the files that may import them.
OWNERS = {
    "zmq": {
        "common/wire/channel.py",
        "common/security/keys.py",
        "robot_client/sites/cloud.py",
        "cloud_server/reply_queue.py",
        "cloud_server/authorisation.py",
        "cloud_server/server.py",
        "cloud_server/unsent_replies.py",
    },
    "fastapi": {
        "cloud_server/http_api.py",
        "loadgen/relay/http_control.py",
        "loadgen/relay/toxiproxy/toxiproxy_api.py",
    },
    "uvicorn": {
        "common/security/bounded_http.py",
        "cloud_server/http_api.py",
        "loadgen/relay/http_control.py",
    },
    "docker": {"loadgen/testbed/containers.py"},
    "numba": {"common/planning/compiled.py"},
    "PIL": {"common/planning/maps.py"},
    "yaml": {"common/planning/maps.py"},
    "matplotlib": {"loadgen/report/charts.py"},
    "sklearn": {"robot_client/predictors/learned/random_forest.py"},
    "statsmodels": {"robot_client/predictors/learned/arima.py"},
    "threadpoolctl": {"robot_client/predictors/learned/arima.py"},
    "torch": {"robot_client/predictors/learned/lstm.py"},
    "river": {"robot_client/predictors/learned/river_model.py"},
}


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            assert node.level == 0, f"{path}: relative import"
            names.add(node.module.partition(".")[0])
    return names


@pytest.mark.parametrize("room", ROOMS)
def test_imports_point_one_way(room: str) -> None:
    """A package imports itself and the packages below it, and no other of ours."""
    for path in (ROOT / room).rglob("*.py"):
        ours = imported(path) & ROOMS.keys()
        assert ours <= ROOMS[room] | {room}, f"{path} imports {sorted(ours)}"


@pytest.mark.parametrize("library", OWNERS)
def test_heavy_libraries_have_one_owner_a_room(library: str) -> None:
    """A heavy or optional library is imported by the files that own it, and those do import it."""
    users = {
        str(path.relative_to(ROOT))
        for room in ROOMS
        for path in (ROOT / room).rglob("*.py")
        if library in imported(path)
    }
    assert users == OWNERS[library]


def test_the_robot_library_needs_no_extra() -> None:
    """robot_client imports where fastapi, docker, numba, Pillow, yaml and what learns are absent."""
    block = (
        "import sys\n"
        "for name in ('fastapi', 'uvicorn', 'docker', 'numba', 'PIL', 'yaml', 'httpx', 'rich',\n"
        "             'sklearn', 'statsmodels', 'river', 'torch', 'scipy', 'pandas'):\n"
        "    sys.modules[name] = None\n"
        "import offboard, offboard.robot_client.sites.cloud, offboard.robot_client.records.metrics\n"
        "print(offboard.Offloader.__name__)\n"
    )
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.stdout == "Offloader\n", done.stderr


@pytest.mark.parametrize("command", ["robot_client", "cloud_server", "loadgen"])
def test_help_loads_no_heavy_library(command: str) -> None:
    """--help answers with exit code 0 without importing numpy, zmq, numba, fastapi or what learns."""
    heavy = ("numpy", "zmq", "numba", "fastapi", "sklearn", "statsmodels", "river", "torch", "scipy")
    probe = (
        "import runpy, sys\n"
        f"sys.argv = [{command!r}, '--help']\n"
        "try:\n"
        f"    runpy.run_module('offboard.{command}', run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    assert end.code in (0, None), end.code\n"
        f"print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.stderr == "[]\n", done.stderr
    assert "--" in done.stdout
