"""Settings and nodes that do not fit end the server with one line and exit code 2."""

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common import VERSION
from tests.ray.clusters import RayNodes
from tests.ray.servers import ROOT, refusal

pytestmark = [pytest.mark.integration, pytest.mark.timeout(180)]

PACKAGES = ("offboard", "common", "cloud_server", "robot_client")
OTHER_VERSION = "0.0.1"


@pytest.mark.parametrize(
    ("resources", "said"),
    [
        (
            '{"GPU": 1}',
            '--ray-resources: no node of the Ray cluster has {"CPU": 1.0, "GPU": 1.0}; its 3 nodes have',
        ),
        ('{"CPU": 4}', '--ray-resources: no node of the Ray cluster has {"CPU": 4.0}; its 3 nodes have'),
        ("GPU", '--ray-resources: \'GPU\' is not JSON like {"CPU": 1, "GPU": 1}'),
        ('{"GPU": "one"}', '--ray-resources: \'{"GPU": "one"}\' is not JSON like'),
    ],
)
def test_a_resource_that_no_node_has_is_one_line(
    nodes: RayNodes, tmp_path: Path, resources: str, said: str
) -> None:
    """It says what was asked for, and what the nodes have."""
    code, lines = refusal(tmp_path, "--ray-address", nodes.address, "--ray-resources", resources)
    print(*lines)
    assert code == 2
    assert len(lines) == 1
    assert said in lines[0]


def test_an_address_without_a_cluster_is_one_line(nodes: RayNodes, tmp_path: Path) -> None:
    """It names the flag and the address."""
    host = nodes.address.partition(":")[0]
    code, lines = refusal(tmp_path, "--ray-address", f"{host}:1")
    print(*lines)
    assert (code, len(lines)) == (2, 1)
    assert lines[0].startswith(f"cloud-server: --ray-address: {host}:1: ")


def test_a_cluster_of_another_ray_version_is_one_line(tmp_path: Path, fresh: Callable[[], RayNodes]) -> None:
    """It names both versions of Ray."""
    cluster = fresh()
    cluster.say_version("2.0.0")
    code, lines = refusal(tmp_path, "--ray-address", cluster.address)
    print(*lines)
    assert (code, len(lines)) == (2, 1)
    assert "Ray: 2.0.0" in lines[0]


def offboard_in(folder: Path, replaced: str, by: str, file: str) -> Path:
    """A copy of Offboard with one changed file."""
    for package in PACKAGES:
        shutil.copytree(
            ROOT / package, folder / package, symlinks=True, ignore=shutil.ignore_patterns("__pycache__")
        )
    changed = (folder / file).read_text()
    assert replaced in changed
    (folder / file).write_text(changed.replace(replaced, by))
    return folder


@pytest.mark.parametrize(
    ("file", "replaced", "by", "said"),
    [
        (
            "common/__init__.py",
            f'VERSION = "{VERSION}"',
            f'VERSION = "{OTHER_VERSION}"',
            f"runs Offboard {OTHER_VERSION}, this server {VERSION}; install the same version on all nodes",
        ),
        (
            "common/planning/planner.py",
            "    check_planner(planner, weighted=costs is not None)\n",
            "",
            "has another source of the task plan_path; install the same version of it on all nodes",
        ),
        (
            "cloud_server/executors/ray_actor.py",
            "class RayActor:",
            "class Worker:",
            "the Ray nodes do not have this Offboard: ",
        ),
    ],
)
def test_a_node_with_another_offboard_is_one_line(
    tmp_path: Path, fresh: Callable[[], RayNodes], file: str, replaced: str, by: str, said: str
) -> None:
    """A real node with another version of Offboard, or with another source of a task, gets no task."""
    other, here = tmp_path / "other", tmp_path / "here"
    here.mkdir()
    cluster = fresh()
    cluster.add({"PYTHONPATH": str(offboard_in(other, replaced, by, file))})
    code, lines = refusal(here, "--ray-address", cluster.address, "--workers", "1")
    print(*lines)
    assert (code, len(lines)) == (2, 1)
    assert said in lines[0]
