"""The bridge finds ROS on its computer, whatever ROS allows."""

from collections.abc import Callable
from pathlib import Path

import pytest

from offboard.common.planning.maps import GridMap
from tests.ros2.conftest import DDS, NETWORK, RANGE, RELEASES, Process
from tests.ros2.goals import PLANS, place

pytestmark = [pytest.mark.ros2, pytest.mark.timeout(120)]


@pytest.fixture(params=["SUBNET", "LOCALHOST"])
def reach(request: pytest.FixtureRequest) -> str:
    if request.param == "SUBNET" and NETWORK != "SUBNET":
        pytest.skip(f"{RANGE} is {NETWORK}: this test would be heard outside this computer")
    return str(request.param)


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.usefixtures("reach")
def test_the_bridge_finds_ros_with_and_without_multicast(
    release: str, node: Callable[..., Process], peer: Callable[..., Process], depot: GridMap, tmp_path: Path
) -> None:
    """Whether ROS may look beyond its computer or not, the bridge on that computer answers its goals."""
    node(DDS, **PLANS)
    place(peer(release), depot, tmp_path)
