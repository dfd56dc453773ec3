"""What a stranger gets from the wheel, in an environment of its own outside the repository."""

import os
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = [pytest.mark.integration, pytest.mark.timeout(300)]

ROOT = Path(__file__).parents[2]

TASKS = '''
"""A user's own tasks."""
import os
from offboard import task

@task("count_primes", size=lambda limit: limit)
def count_primes(limit: int) -> int:
    return sum(all(n % k for k in range(2, int(n**0.5) + 1)) for n in range(2, limit))

@task("where_am_i", size=lambda: 0.0, duplicate=False)
def where_am_i() -> int:
    return os.getpid()
'''

PROGRAM = """
import asyncio, os, sys
from offboard import Offloader, Settings
from mytasks import count_primes, where_am_i

with Offloader.connect(sys.argv[1], settings=Settings(window=5)) as offload:
    assert offload.wait_for_sites(count_primes, 20.0) == {}
    for _ in range(100):
        answer = offload(count_primes, 1000)
        if not offload.last.decision.reason.startswith("warm-up"):
            break
    print(answer, offload.last.decision.reason)
    print(*[offload(where_am_i, where=site) == os.getpid() for site in ("onboard", "cloud")])
    print(asyncio.run(offload.run(count_primes, 100)))
"""

CHANGED = """
import logging, sys
logging.basicConfig(format="%(message)s")
from offboard import Offloader
from mytasks import count_primes
with Offloader.connect(sys.argv[1]) as offload:
    print(offload.wait_for_sites(count_primes, 3.0))
    print([offload(count_primes, 100) for _ in range(3)], offload.last.used)
"""


SCENARIOS = """
import logging
logging.disable()  # depot.yaml has an odd threshold
from offboard.common.planning.map_files import read_map
from offboard.loadgen.scenario.scenario_file import find_scenario, read_scenario, shipped

maps = {read_scenario(find_scenario(name)).workload.map for name in shipped()} - {None}
assert all(read_map(path).cells.size for path in maps)
print(len(shipped()), *sorted(path.name for path in maps))
"""


def run(*command: str | Path, cwd: Path, **env: str) -> str:
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=os.environ | env, capture_output=True, text=True, timeout=240
    )
    assert done.returncode == 0, f"{command}:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"
    return done.stdout + done.stderr


def build(kind: str, source: Path, out: Path) -> Path:
    """The one file that a build of this kind (`wheel` or `sdist`) puts into `out`."""
    run(sys.executable, "-m", "build", f"--{kind}", "--no-isolation", "--outdir", out, source, cwd=out)
    return next(out.iterdir())


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build("wheel", ROOT, tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bin folder of an environment with the wheel and what the cloud needs."""
    home = tmp_path_factory.mktemp("stranger")
    run(sys.executable, "-m", "venv", home / "venv", cwd=home)
    python = home / "venv/bin/python"
    requirements = ROOT / "requirements/cloud.txt"
    run(python, "-m", "pip", "install", "-q", "--require-hashes", "-r", requirements, cwd=home)
    run(python, "-m", "pip", "install", "-q", "--no-deps", wheel, cwd=home)
    return python.parent


@pytest.fixture
def server(installed: Path, tmp_path: Path) -> Iterator[str]:
    """A server started from the wheel, with the user's own tasks; its endpoint."""
    (tmp_path / "mytasks.py").write_text(TASKS)
    command = [installed / "cloud-server", "--listen", "tcp://127.0.0.1:0", "--http", "127.0.0.1:0"]
    process = subprocess.Popen(
        [*map(str, command), "--tasks", "mytasks"], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    for line in process.stderr:
        if "listening on " in line:
            yield line.partition("listening on ")[2].partition(",")[0].strip()
            break
    process.terminate()
    assert process.wait(20) == 0
    process.stderr.close()


def test_offboard_is_the_only_top_level_package(wheel: Path) -> None:
    """The wheel holds `offboard/` alone: code, types, scenarios and their maps, but no tests."""
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.partition("/")[0] for name in names if ".dist-info" not in name} == {"offboard"}
    assert not [name for name in names if name.endswith((".map", ".png")) or "tests/" in name]
    packages = ("common", "robot_client", "cloud_server", "loadgen")
    assert all(f"offboard/{package}/__init__.py" in names for package in packages)
    assert "offboard/py.typed" in names
    assert "offboard/loadgen/scenarios/outage.toml" in names


def test_a_wheel_from_the_sdist_is_identical(wheel: Path, tmp_path: Path) -> None:
    """Who builds from the source distribution gets the same files, byte by byte."""
    folders = {name: tmp_path / name for name in ("sdist", "source", "wheel")}
    for folder in folders.values():
        folder.mkdir()
    with tarfile.open(build("sdist", ROOT, folders["sdist"])) as archive:
        archive.extractall(folders["source"], filter="data")
    rebuilt = build("wheel", next(folders["source"].iterdir()), folders["wheel"])
    assert rebuilt.read_bytes() == wheel.read_bytes()


def test_every_shipped_scenario_finds_its_map(installed: Path, tmp_path: Path) -> None:
    """Each scenario is read outside the repository, and the maps of those that plan can be read."""
    (tmp_path / "scenarios.py").write_text(SCENARIOS)
    assert run(installed / "python", "scenarios.py", cwd=tmp_path).split() == [
        str(len(list((ROOT / "loadgen/scenarios").glob("*.toml")))),
        "depot.yaml",
        "willow-full-0.05.yaml",
    ]


@pytest.mark.parametrize("command", ["offboard", "robot-client", "cloud-server", "loadgen"])
def test_the_console_scripts_start(installed: Path, tmp_path: Path, command: str) -> None:
    """--help of every console script answers outside the repository."""
    assert "usage:" in run(installed / command, "--help", cwd=tmp_path)


def test_a_ten_line_program_offloads_its_own_task(installed: Path, server: str, tmp_path: Path) -> None:
    """A user's module on both sides: warm-up, decision, pinned calls, a single-run task, asyncio."""
    (tmp_path / "program.py").write_text(PROGRAM)
    first, second, third = run(installed / "python", "program.py", server, cwd=tmp_path).splitlines()
    assert first.startswith("168 ")
    assert re.search(r" m?s .*against .* m?s", first), first
    assert second == "True False"
    assert third == "25"


def test_another_package_named_common_does_no_harm(installed: Path, server: str, tmp_path: Path) -> None:
    """A distribution `common` and a folder `common` of the user leave the program alone."""
    command = "import sysconfig; print(sysconfig.get_path('purelib'))"
    site_packages = Path(run(installed / "python", "-c", command, cwd=tmp_path).strip())
    others = [site_packages / "common", tmp_path / "common", tmp_path / "robot_client"]
    (tmp_path / "program.py").write_text(PROGRAM)
    try:
        for folder in others:
            folder.mkdir()
            (folder / "__init__.py").write_text("raise ImportError('not the package that you want')\n")
        assert run(installed / "python", "program.py", server, cwd=tmp_path).startswith("168 ")
    finally:
        shutil.rmtree(others[0])


def test_a_task_whose_source_differs_stays_onboard(installed: Path, server: str, tmp_path: Path) -> None:
    """`hello` compares source: the changed task runs onboard, and the log says so once."""
    other = tmp_path / "robot"
    other.mkdir()
    (other / "mytasks.py").write_text(TASKS.replace("range(2, limit)", "range(2, limit + 1)"))
    (other / "program.py").write_text(CHANGED)
    output = run(installed / "python", "program.py", server, cwd=other)
    assert "cloud: the source of task count_primes differs on the server" in output
    assert "[25, 25, 25] onboard" in output
    assert output.count("this task stays onboard") == 1
