"""A network that swallows packets without a word, and names with IPv6 addresses, in namespaces of our own."""

import pytest

from offboard.robot_client.cloud.cloud_runner import CLOSE_WAIT_S
from tests.cables import TIMEOUT_S
from tests.namespaces import run_alone

pytestmark = [pytest.mark.integration, pytest.mark.timeout(150)]

BACK_S = 4.0  # an attempt to connect, the pause after it, and a busy machine
SLACK_S = 0.5


@pytest.mark.parametrize(("outage_s", "robot"), [(8.0, "first"), (24.0, "later")])
def test_the_server_is_used_soon_after_a_silent_outage(outage_s: float, robot: str) -> None:
    """The robot connects again within four seconds, and no task waits longer than its timeout.

    The kernel alone repeats its attempt after 1, 3, 7, and 15 s: seven seconds after the end of both outages.
    A lost connection is noticed after 15 s.
    """
    found = run_alone("tests.cables", str(outage_s), robot, timeout_s=140)
    print(f"{robot}: used {found['back_s']:.2f} s after {outage_s:g} s of silence")
    assert found["back_s"] <= BACK_S
    assert found["worst_s"] <= TIMEOUT_S + SLACK_S


def test_every_kind_of_name_reaches_its_server() -> None:
    """A name may have an IPv4 address, an IPv6 address, or both, of which only one answers.

    `robot-client check` finds the server too.
    """
    found = run_alone("tests.names", "kinds", timeout_s=140)
    print(found)
    slow = {endpoint: took_s for endpoint, (took_s, _) in found.items() if took_s > BACK_S}
    assert slow == {}
    assert [code for _, code in found.values()] == [0] * len(found)


@pytest.mark.parametrize(
    ("endpoint", "said"),
    [
        ("tcp://unknown:5555", "no answer from tcp://unknown:5555 yet"),
        ("dns://unknown:5555", "the addresses of dns://unknown:5555 are not known yet"),
    ],
)
def test_nothing_waits_for_a_silent_dns_server(endpoint: str, said: str) -> None:
    """`connect` and `close` return while the name is still looked up, as on a robot that boots without Wi-Fi.

    `wait_for_sites` says why the site is absent, and in the end nothing is left of the connection.
    """
    connect_s, close_s, absent, left = run_alone("tests.names", "silent", endpoint, timeout_s=60)
    assert connect_s <= SLACK_S
    assert close_s <= CLOSE_WAIT_S + SLACK_S
    assert absent == {"cloud": said}
    assert left == [0, 0]
