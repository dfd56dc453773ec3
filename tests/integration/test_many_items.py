"""Messages of 15 MB that hold 15 million empty lists: server, robot and policy server's robot refuse them."""

import contextlib
import threading
from collections.abc import Iterator

import pytest
import zmq

from benchmarks import attacks
from benchmarks.attack_messages import request
from benchmarks.attack_target import Target, dealer
from offboard.common.errors import CannotCross, CloudBroken
from offboard.common.wire import messages as wire
from offboard.common.wire.item_count import ITEMS_MAX
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.sites.runner import ONBOARD
from tests.curves import WAIT_S, Served
from tests.integration.openpi.bad_servers import says, serving
from tests.integration.openpi.robot import START_S, act, observation, of_gpu
from tests.probes import echo

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

MIB = 1 << 20
LISTS = 15_000_000
MANY = b"\xdd" + LISTS.to_bytes(4, "big") + b"\x90" * LISTS
MEMORY_MAX = 150 * MIB  # the message, in the few copies that are made of it; its lists would take 1,200 MiB
SAID = f"has more than {ITEMS_MAX} items"


def test_a_server_refuses_them_without_making_them() -> None:
    """The request fails, the server takes no memory for the lists, and it answers the next request."""
    served = Served("--robot-mib-s", "1024", "--executor", "threads")
    try:
        at_first = attacks.memory(served.process.pid, "VmHWM")
        with dealer(Target(served.endpoint, 0, None)) as client:
            for body, status in ((b"\x91" + MANY, "failed"), (b"\x91\x07", "ok")):
                client.send_multipart(request([body], "echo"))
                assert client.poll(int(WAIT_S * 1000))
                reply = wire.unpack(client.recv_multipart())
                assert isinstance(reply, wire.Reply)
                assert reply.status == status
                assert (SAID in reply.error) == (status == "failed")
        assert attacks.memory(served.process.pid, "VmHWM") - at_first < MEMORY_MAX
    finally:
        served.close()


@contextlib.contextmanager
def server_that_answers(result: bytes) -> Iterator[str]:
    """The endpoint of a server with the tasks of each robot, whose every result is this."""
    with zmq.Context() as context, context.socket(zmq.ROUTER) as router:
        router.linger = 0
        port = router.bind_to_random_port("tcp://127.0.0.1")
        ended = threading.Event()

        def serve() -> None:
            while not ended.is_set():
                if not router.poll(50):
                    continue
                robot, *frames = router.recv_multipart()
                match wire.unpack(frames):
                    case wire.Hello(tasks):
                        answer: wire.Message = wire.Hello(tasks, "0", 2**28)
                    case wire.Request(id=number):
                        answer = wire.Reply(number, "ok", body=[result])
                    case wire.Ping(number):
                        answer = wire.Pong(number)
                    case _:
                        continue
                router.send_multipart([robot, *wire.pack(answer)])

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield f"tcp://127.0.0.1:{port}"
        finally:
            ended.set()
            thread.join()


def test_a_robot_answers_onboard() -> None:
    """The record says what was wrong with the result."""
    with server_that_answers(MANY) as endpoint, Offloader.connect(endpoint, policy="cloud") as offload:
        assert not offload.wait_for_sites(echo, WAIT_S)
        assert offload(echo, "x", timeout_s=WAIT_S) == "x"
        assert offload.last is not None
        assert offload.last.used == ONBOARD
        failure = offload.last.executions[0].failure
        assert isinstance(failure, CannotCross)
        assert str(failure).startswith(f"result: the value {SAID}")


def test_a_robot_of_a_policy_server_answers_onboard() -> None:
    """The record says what was wrong with the answer; an observation with as many items is not sent."""
    with serving(says(MANY)) as endpoint, Offloader.connect(sites={"gpu": endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        assert offload(act, observation(), where="gpu", timeout_s=START_S)["by"] == ONBOARD
        assert type(of_gpu(offload).failure) is CloudBroken
        assert str(of_gpu(offload).failure).startswith(f"answer: the value {SAID}")
        many = observation(more=[0] * ITEMS_MAX)
        assert offload(act, many, where="gpu", timeout_s=START_S)["by"] == ONBOARD
        assert isinstance(of_gpu(offload).failure, CannotCross)
        assert str(of_gpu(offload).failure).startswith(f"observation: it {SAID}")
