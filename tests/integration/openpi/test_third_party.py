"""A robot with a server of `policy-websocket`: 200 calls, a killed server, a late answer, a frozen server."""

import signal
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from offboard.common.errors import CloudBroken, CloudTimeout
from offboard.common.tasks import Task, kind_of
from offboard.loadgen.robot_files import read_trace
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policy_servers.policy_server import PolicyServerRunner
from offboard.robot_client.sites.runner import ONBOARD
from tests.integration.openpi.conftest import PolicyServer
from tests.integration.openpi.robot import START_S, act, observation, of_gpu, right, until, used, why_absent
from tests.programs import output_of

pytestmark = [pytest.mark.integration, pytest.mark.timeout(400)]

ROOT = Path(__file__).parents[3]
PAGE, ENDPOINT = ROOT / "docs" / "policy_servers.md", "ws://127.0.0.1:8000"
CALLS, KILL_AT, RESTART_AT, LATE_AT = 200, 80, 110, 160
TIMEOUT_S = 0.25
LARGE = 32 * 2**20  # bytes, more than the kernel keeps for a connection
PACKING_S = 2.0  # enough to pack those on a busy machine
SLACK_S = 1.0  # of a busy machine
USED_MIN = 0.7  # of the calls while the server is there; the default policy also probes


def test_200_calls_with_a_killed_server_and_a_missed_deadline(
    policy_server: Callable[[], PolicyServer], tmp_path: Path
) -> None:
    """Every call has the right answer: of the server while it is there, and otherwise of the robot itself."""
    server, trace = policy_server(), tmp_path / "trace.jsonl"
    answered: list[str | None] = []
    with Offloader.connect(sites={"gpu": server.endpoint}, trace=trace) as offload:
        assert not offload.wait_for_sites(act, START_S)
        for number in range(CALLS):
            if number == KILL_AT:
                server.kill()
            elif number == RESTART_AT:
                server.start()
                assert not offload.wait_for_sites(act, START_S)
            if number == LATE_AT:
                began_s = time.perf_counter()
                late = observation(number, delay_s=2 * SLACK_S)
                action = offload(act, late, where="gpu", timeout_s=TIMEOUT_S)
                waited_s = time.perf_counter() - began_s
                assert isinstance(of_gpu(offload).failure, CloudTimeout)
                assert action["by"] == ONBOARD
                assert TIMEOUT_S <= waited_s <= TIMEOUT_S + SLACK_S
                assert "came too late" in why_absent(offload)
                assert not offload.wait_for_sites(act, START_S)
            else:
                action = offload(act, observation(number))
            assert right(action, number)
            assert action["by"] == used(offload)
            answered.append(used(offload))
    before, during, after = answered[:KILL_AT], answered[KILL_AT:RESTART_AT], answered[RESTART_AT:]
    print(
        {name: Counter(sites) for name, sites in (("before", before), ("during", during), ("after", after))}
    )
    assert set(during) == {ONBOARD}
    assert before.count("gpu") >= USED_MIN * len(before)
    assert after.count("gpu") >= USED_MIN * len(after)
    lines = list(read_trace(trace))
    assert len(lines) == CALLS


def test_a_server_that_dies_during_a_call(policy_server: Callable[[], PolicyServer]) -> None:
    """The call notices at once, and the robot answers it."""
    server = policy_server()
    with Offloader.connect(sites={"gpu": server.endpoint}, timeout_s=START_S) as offload:
        assert not offload.wait_for_sites(act, START_S)
        killer = threading.Timer(0.3, server.kill)
        killer.start()
        began_s = time.perf_counter()
        action = offload(act, observation(delay_s=START_S), where="gpu")
        waited_s = time.perf_counter() - began_s
        killer.join()
        assert isinstance(of_gpu(offload).failure, CloudBroken)
        assert right(action, 1.0)
        assert waited_s <= 0.3 + SLACK_S, waited_s


def test_an_error_of_the_policy_is_the_fault_of_the_server(policy_server: Callable[[], PolicyServer]) -> None:
    """The robot answers; the execution names the error, and the next call is answered by the server again."""
    server = policy_server()
    with Offloader.connect(sites={"gpu": server.endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        assert offload(act, observation(fail=True), where="gpu")["by"] == ONBOARD
        assert of_gpu(offload).error == (
            "CloudBroken: the policy server failed: ValueError: there is no gripper"
        )
        time.sleep(0.05)  # the server closes the connection after an error
        assert not offload.wait_for_sites(act, START_S)
        assert offload(act, observation(3.0), where="gpu")["by"] == "gpu"


def test_the_server_says_how_long_it_computed(policy_server: Callable[[], PolicyServer]) -> None:
    """The parts of the time add up, so that network and computing are learned apart."""
    server = policy_server()
    with Offloader.connect(sites={"gpu": server.endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        offload(act, observation(delay_s=0.2), where="gpu")
        one = of_gpu(offload)
        assert one.run_s is not None
        assert one.queue_s is not None
        assert one.network_s is not None
        assert 0.2 <= one.run_s <= 0.2 + SLACK_S
        assert one.queue_s + one.run_s + one.network_s == pytest.approx(one.seconds)
        assert one.bytes_out > 32 * 32 * 3
        assert one.bytes_in > 0


def test_a_frozen_server_is_silent_and_a_busy_one_is_not(policy_server: Callable[[], PolicyServer]) -> None:
    """This server computes in the thread that answers pings, so no ping is sent while it computes."""
    server = policy_server()
    with closing(PolicyServerRunner(server.endpoint, site="gpu", heartbeat_s=0.05)) as runner:
        kind = kind_of(act)
        until(lambda: runner.unavailable(kind) is None and runner.condition().round_trip_s is not None)
        busy = runner.submit(Task(kind, (observation(delay_s=1.0),), 2), START_S)
        while not busy.done():
            assert not runner.condition().silent
            time.sleep(0.01)
        assert busy.result().ok
        server.signal(signal.SIGSTOP)
        until(lambda: runner.condition().silent)
        assert runner.unavailable(kind) is None
        server.signal(signal.SIGCONT)
        until(lambda: not runner.condition().silent)


def test_a_frozen_server_that_does_not_take_an_observation(
    policy_server: Callable[[], PolicyServer], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its task ends in time. After OWED_MAX_S more the robot connects again."""
    monkeypatch.setattr("offboard.robot_client.sites.conversation.OWED_MAX_S", TIMEOUT_S)
    server, kind = policy_server(), kind_of(act)
    with closing(PolicyServerRunner(server.endpoint, site="gpu")) as runner:
        until(lambda: runner.unavailable(kind) is None)
        server.signal(signal.SIGSTOP)
        large = observation(more=np.zeros(LARGE, np.uint8))
        late = runner.submit(Task(kind, (large,), 2), PACKING_S).result(START_S)
        assert isinstance(late.failure, CloudTimeout)
        until(lambda: "it has not answered" in str(runner.unavailable(kind)))
        server.signal(signal.SIGCONT)
        until(lambda: runner.unavailable(kind) is None)


def test_the_example_of_the_page_runs(policy_server: Callable[[], PolicyServer], tmp_path: Path) -> None:
    """The program of docs/policy_servers.md answers every observation, most of them with the server."""
    program = PAGE.read_text().split("```python\n")[1].split("```")[0]
    assert ENDPOINT in program
    (tmp_path / "robot.py").write_text(program.replace(ENDPOINT, policy_server().endpoint))
    first, *steps = output_of(tmp_path / "robot.py").splitlines()
    assert first == "all sites can take this task"
    assert [line.split()[0] for line in steps] == [str(step) for step in range(20)]
    assert [line.split()[1] for line in steps].count("gpu") > len(steps) / 2, steps


def test_a_policy_server_is_a_site_of_a_stream(policy_server: Callable[[], PolicyServer]) -> None:
    """Its chunks are played in time: each action is for its step, and no step is empty after the first."""
    hz, horizon = 50.0, 25
    with Offloader.connect(sites={"gpu": policy_server().endpoint}) as offload:
        assert not offload.wait_for_sites(act, START_S)
        with offload.stream(act, hz=hz, horizon=horizon, blend=0) as actions:
            held = []
            for step in range(100):
                half = (step + np.arange(horizon, dtype=np.float64)) / 2  # the policies double it
                actions.see({"state": half.reshape(-1, 1)})
                found = actions.next()
                held.append(found.held)
                if not found.held:
                    assert found.action is not None
                    assert float(found.action[0]) == step
                time.sleep(1 / hz)
    print(actions.counts)
    assert sum(held[50:]) <= 5
    assert actions.counts.played["gpu"] > 0
