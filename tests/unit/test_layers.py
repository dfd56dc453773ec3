"""Who may import whom: between packages, between folders, and never in a circle."""

import ast
import functools
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES: dict[str, set[str]] = {
    "common": set(),
    "robot_client": {"common"},
    "cloud_server": {"common"},
    "loadgen": {"common", "robot_client", "offboard"},  # of offboard only offboard/ros2 and offboard/testing
    "offboard": {"common", "robot_client"},
}
# This command is an application of the library, and is imported only when it is chosen.
COMMANDS_ELSEWHERE = {"robot_client/__main__.py": {"offboard"}}
# Folders by what they may import from their own package. `__main__`, which
# builds everything, may import all.
FOLDERS: dict[str, set[str]] = {
    "common/wire": {"common"},
    "common/planning": {"common"},
    "common/security": {"common"},
    "common/source": {"common", "common/security"},
    "common/live": {"common", "common/security"},
    "robot_client/sites": set(),
    "robot_client/cloud": {"robot_client/sites"},
    "robot_client/policy_servers": {"robot_client/cloud", "robot_client/sites"},
    "robot_client/discovery": {"robot_client/sites"},
    "robot_client/predictors": {"robot_client/sites"},
    "robot_client/policies": {"robot_client/predictors", "robot_client/sites"},
    "robot_client/learning": {"robot_client/policies", "robot_client/predictors", "robot_client/sites"},
    "robot_client/records": {"robot_client/learning", "robot_client/policies", "robot_client/sites"},
    "robot_client/execution": {
        "robot_client/policies",
        "robot_client/predictors",
        "robot_client/records",
        "robot_client/sites",
    },
    "robot_client/streams": {"robot_client/execution", "robot_client/records", "robot_client/sites"},
    "robot_client": {  # the offloader
        "robot_client/cloud",
        "robot_client/discovery",
        "robot_client/execution",
        "robot_client/learning",
        "robot_client/policy_servers",
        "robot_client/policies",
        "robot_client/predictors",
        "robot_client/records",
        "robot_client/sites",
        "robot_client/streams",
    },
    "robot_client/gateway": {
        "robot_client",
        "robot_client/policy_servers",
        "robot_client/records",
        "robot_client/sites",
    },
    "robot_client/check": {"robot_client/cloud", "robot_client/policy_servers", "robot_client/sites"},
    "cloud_server/executors": set(),
    "loadgen/robot": {"loadgen", "loadgen/rivals"},
    "loadgen/relay/link": set(),
    "loadgen/relay/tcp": {"loadgen/relay/link"},
    "loadgen/relay/toxiproxy": {"loadgen/relay/link", "loadgen/relay/tcp"},
    "loadgen/relay": {"loadgen/relay/link", "loadgen/relay/tcp", "loadgen/relay/toxiproxy"},
    "loadgen/testbed": {"loadgen", "loadgen/relay", "loadgen/relay/link"},
    "loadgen/rivals": set(),
    "loadgen/table": {"loadgen", "loadgen/rivals"},
    "loadgen/claims": {"loadgen", "loadgen/replay", "loadgen/rivals", "loadgen/table"},
    "loadgen/replay": {"loadgen", "loadgen/rivals", "loadgen/simulation/model", "loadgen/table"},
    "loadgen/export": {"loadgen", "loadgen/play", "loadgen/replay", "loadgen/robot", "loadgen/table"},
    "loadgen/scenario": {
        "loadgen",
        "loadgen/relay/link",
        "loadgen/rivals",
        "loadgen/robot",
        "loadgen/table",
        "loadgen/testbed",
    },
    "loadgen/play": {
        "loadgen",
        "loadgen/replay",
        "loadgen/robot",
        "loadgen/scenario",
        "loadgen/table",
        "loadgen/testbed",
    },
    "loadgen/simulation/model": {
        "loadgen/relay/link",
        "loadgen/robot",
        "loadgen/scenario",
        "loadgen/testbed",
    },
    "loadgen/simulation": {
        "loadgen",
        "loadgen/play",
        "loadgen/relay/link",
        "loadgen/rivals",
        "loadgen/robot",
        "loadgen/scenario",
        "loadgen/simulation/model",
        "loadgen/testbed",
    },
    "loadgen/compare": {
        "loadgen",
        "loadgen/play",
        "loadgen/relay/link",
        "loadgen/rivals",
        "loadgen/robot",
        "loadgen/scenario",
        "loadgen/simulation",
        "loadgen/table",
    },
    "loadgen/fleet": {
        "loadgen",
        "loadgen/play",
        "loadgen/replay",
        "loadgen/report",
        "loadgen/scenario",
        "loadgen/simulation",
        "loadgen/simulation/model",
        "loadgen/table",
    },
    "loadgen/report": {"loadgen", "loadgen/play", "loadgen/replay", "loadgen/rivals", "loadgen/table"},
    "offboard/ros2": set(),
    "offboard/testing": set(),
}
# Heavy or optional libraries, and the files that may import them.
OWNERS = {
    "zmq": {
        "common/wire/channel.py",
        "common/security/keys.py",
        "robot_client/cloud/cloud_socket.py",
        "robot_client/policy_servers/groot_socket.py",
        "robot_client/gateway/groot_gateway.py",
        "cloud_server/authorisation.py",
        "cloud_server/robot_socket.py",
        "cloud_server/server.py",
    },
    "backports": {"common/wire/compression.py"},
    "fastapi": {
        "cloud_server/http_api.py",
        "loadgen/relay/control_api.py",
        "loadgen/relay/toxiproxy/toxiproxy_api.py",
    },
    "uvicorn": {
        "common/security/bounded_http.py",
        "cloud_server/http_api.py",
        "loadgen/relay/control_api.py",
    },
    "docker": {"loadgen/testbed/docker_engine.py"},
    "websockets": {
        "robot_client/policy_servers/web_socket.py",
        "robot_client/gateway/web_socket_gateway.py",
    },
    "numba": {"common/planning/compiled.py"},
    "PIL": {"common/planning/map_files.py", "loadgen/map_picture.py"},
    "yaml": {"common/planning/map_files.py"},
    "matplotlib": {"loadgen/report/chart_parts.py"},
    "sklearn": {"loadgen/rivals/k_means.py", "loadgen/rivals/random_forest.py"},
    "statsmodels": {"loadgen/rivals/arima.py"},
    "threadpoolctl": {"loadgen/rivals/arima.py", "loadgen/rivals/k_means.py"},
    "torch": {"loadgen/rivals/lstm.py"},
    "rich": {"loadgen/progress.py"},
    "ray": {"cloud_server/executors/ray_cluster.py"},
    "rclpy": {"offboard/ros2/node.py"},
    "cyclonedds": {"offboard/ros2/bridge.py"},
    "mcap": {"loadgen/export/mcap_file.py"},
    "rosbags": {"loadgen/export/mcap_file.py"},
}


def modules() -> dict[str, Path]:
    """Every module of ours by its full name."""
    found = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
            found[name if package == "offboard" else f"offboard.{name}"] = path
    return found


MODULES = modules()


@functools.cache
def imports(path: Path) -> tuple[tuple[str, str], ...]:
    """(module, name) of each import, those inside functions included, those for types alone left out."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, str]]:
    tree = ast.parse(path.read_text())
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if id(node) in for_types:
            continue
        if isinstance(node, ast.Import):
            yield from ((alias.name, "") for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            yield from ((node.module or "", alias.name) for alias in node.names)


def imported(path: Path) -> set[str]:
    """The top-level packages that a file imports."""
    return {module.partition(".")[0] for module, _ in imports(path)}


def ours(path: Path) -> set[str]:
    """The modules of ours that a file imports."""
    found = set()
    for module, name in imports(path):
        found |= {one for one in (f"{module}.{name}", module) if one in MODULES} - {"offboard"}
    return {one for one in found if not any(other.startswith(f"{one}.") for other in found)}


def folder(path: Path) -> str:
    return path.parent.relative_to(ROOT).as_posix()


@pytest.mark.parametrize("package", PACKAGES)
def test_imports_between_packages_point_one_way(package: str) -> None:
    """A package imports itself and the packages below it, and no other of ours."""
    for path in (ROOT / package).rglob("*.py"):
        used = {folder(MODULES[name]).partition("/")[0] for name in ours(path)}
        used -= COMMANDS_ELSEWHERE.get(str(path.relative_to(ROOT)), set())
        assert used <= PACKAGES[package] | {package}, f"{path} imports {sorted(used)}"


@pytest.mark.parametrize("place", FOLDERS)
def test_imports_between_folders_point_one_way(place: str) -> None:
    """A folder imports itself and the folders that are listed for it, and no other of its package."""
    for path in (ROOT / place).glob("*.py"):
        if path.name == "__main__.py":
            continue
        used = {folder(MODULES[name]) for name in ours(path)} - {place}
        inside = {one for one in used if one.partition("/")[0] == place.partition("/")[0]}
        assert inside <= FOLDERS[place], f"{path} imports {sorted(inside - FOLDERS[place])}"


def test_nothing_unpickles() -> None:
    """No module of ours imports a library that runs what it reads, and NumPy is never allowed to."""
    for path in MODULES.values():
        assert not imported(path) & {"pickle", "marshal", "shelve", "dill", "cloudpickle"}, path
        assert "allow_pickle=True" not in path.read_text(), path


def test_every_folder_is_listed() -> None:
    """A new folder says what it may import; `common`, `cloud_server` and `loadgen` themselves are leaves."""
    folders = {folder(path) for path in MODULES.values()} - {"offboard", "common", "cloud_server", "loadgen"}
    assert folders == FOLDERS.keys()


def test_no_module_imports_itself_in_a_circle() -> None:
    """Following imports, those inside functions too, never leads back to where it began."""
    left = {name: ours(path) - {name} for name, path in MODULES.items()}
    while leaves := [name for name, used in left.items() if not used & left.keys()]:
        for name in leaves:
            del left[name]
    assert not left, f"in a circle, or importing one: {sorted(left)}"


@pytest.mark.parametrize("library", OWNERS)
def test_heavy_libraries_have_one_owner_a_room(library: str) -> None:
    """A heavy or optional library is imported by the files that own it, and those do import it."""
    users = {
        str(path.relative_to(ROOT))
        for room in PACKAGES
        for path in (ROOT / room).rglob("*.py")
        if library in imported(path)
    }
    assert users == OWNERS[library]


def test_the_robot_library_needs_no_extra() -> None:
    """robot_client imports where fastapi, docker, numba, Pillow, yaml and what learns are absent."""
    block = (
        "import sys\n"
        "for name in ('fastapi', 'uvicorn', 'docker', 'numba', 'PIL', 'yaml', 'httpx', 'rich',\n"
        "             'sklearn', 'statsmodels', 'torch', 'scipy', 'pandas', 'websockets'):\n"
        "    sys.modules[name] = None\n"
        "import offboard, offboard.robot_client.cloud.cloud_runner, offboard.robot_client.records.metrics\n"
        "print(offboard.Offloader.__name__)\n"
    )
    done = subprocess.run([sys.executable, "-c", block], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.stdout == "Offloader\n", done.stderr


def test_import_offboard_loads_little() -> None:
    """`import offboard` loads no other library and none of the packages; `Offloader` loads neither zmq,
    numba nor fastapi."""
    say = "print(*sorted({one.partition('.')[0] for one in sys.modules} - known - sys.stdlib_module_names))\n"
    code = (
        f"import sys\nknown = set(sys.modules)\nimport offboard\n{say}from offboard import Offloader\n{say}"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=30)
    first, second = done.stdout.splitlines()
    assert first == "offboard"
    assert set(second.split()).isdisjoint({"zmq", "numba", "fastapi", "uvicorn"}), second


@pytest.mark.parametrize(
    "command",
    [
        "robot_client",
        "loadgen drive",
        "loadgen call",
        "robot_client check",
        "robot_client ros2",
        "cloud_server",
        "loadgen",
    ],
)
def test_help_loads_no_heavy_library(command: str) -> None:
    """--help answers with exit code 0 without importing numpy, zmq, numba, fastapi or what learns."""
    heavy = (
        "numpy",
        "zmq",
        "numba",
        "fastapi",
        "sklearn",
        "statsmodels",
        "torch",
        "scipy",
        "websockets",
        "cyclonedds",
        "rclpy",
        "ray",
    )
    package, *words = command.split()
    probe = (
        "import runpy, sys\n"
        f"sys.argv = {[package, *words, '--help']!r}\n"
        "try:\n"
        f"    runpy.run_module('offboard.{package}', run_name='__main__')\n"
        "except SystemExit as end:\n"
        "    assert end.code in (0, None), end.code\n"
        f"print([name for name in {heavy!r} if name in sys.modules], file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, cwd=ROOT, timeout=30)
    assert done.stderr == "[]\n", done.stderr
    assert "--" in done.stdout
