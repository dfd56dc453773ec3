"""What a robot sends to a policy server is, byte for byte, what `openpi-client` sends."""

import base64
import json
import subprocess
from contextlib import closing
from pathlib import Path

import pytest
from websockets.sync.server import ServerConnection

from offboard.common.tasks import Task, kind_of
from offboard.robot_client.policy_servers.openpi import pack
from offboard.robot_client.policy_servers.policy_server import PolicyServerRunner
from tests.integration.openpi.bad_servers import serving, stays
from tests.integration.openpi.observations import observations
from tests.integration.openpi.robot import START_S, act, observation, until

pytestmark = [pytest.mark.integration, pytest.mark.timeout(400)]

CLIENT = Path(__file__).with_name("client.py")
RUN_S = 60.0


def client(python: Path, *arguments: str) -> str:
    done = subprocess.run(
        [str(python), str(CLIENT), *arguments], capture_output=True, text=True, timeout=RUN_S, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_observations_are_packed_as_openpi_client_packs_them(third_party: Path) -> None:
    """For every sort of value, with another version of NumPy on the other side."""
    theirs = json.loads(client(third_party, "pack"))
    ours = {name: base64.b64encode(pack(one)).decode() for name, one in observations().items()}
    assert ours == theirs


def test_a_connection_carries_the_same_messages(third_party: Path) -> None:
    """A server receives the same messages from a robot as from openpi-client, and nothing else."""
    heard: list[list[bytes | str]] = []

    def talk(connection: ServerConnection) -> None:
        heard.append(messages := [])
        for message in connection:
            messages.append(message)
            connection.send(pack({"actions": 1}))

    with serving(talk) as endpoint:
        host, _, port = endpoint.removeprefix("ws://").partition(":")
        client(third_party, "talk", host, port)
        with closing(PolicyServerRunner(endpoint, site="gpu", heartbeat_s=0.01)) as runner:
            kind = kind_of(act)
            until(lambda: runner.unavailable(kind) is None)
            for one in observations().values():
                assert runner.submit(Task(kind, (one,), 1), START_S).result(START_S).ok
    theirs, ours = heard
    assert ours == theirs
    assert len(ours) == len(observations())


def test_an_observation_that_cannot_be_packed_is_not_sent() -> None:
    """The robot answers it, and the execution says which value it was."""
    with (
        serving(stays) as endpoint,
        closing(PolicyServerRunner(endpoint, site="gpu")) as runner,
    ):
        task = Task(kind_of(act), (observation(bad=1j),), 1)
        one = runner.submit(task, START_S).result(START_S)
        assert one.error == ("CannotCross: observation: a value of type builtins.complex cannot be sent")
        assert not one.started
