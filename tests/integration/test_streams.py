"""Streams of actions with a real server: each action says its step, so a wrong or stale one is seen."""

import logging
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard import Offloader, OffloadError, TaskFailed
from offboard.loadgen.testbed.local_testbed import LocalTestbed
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.runner import CLOUD, ONBOARD
from offboard.robot_client.streams.action_stream import ActionStream
from tests.chunk_tasks import HORIZON, act
from tests.control_loop import HZ, Loop, fresh
from tests.integration.test_own_task import server

pytestmark = [pytest.mark.integration, pytest.mark.timeout(120)]

PAGE = (Path(__file__).parents[2] / "docs" / "streams.md").read_text(encoding="utf-8")
PROGRAM = """
import os, threading, time
from offboard import Offloader
from tests.chunk_tasks import act

def tell(call):
    try:
        print(call(), flush=True)
    except Exception as error:
        print(error, flush=True)

offload = Offloader.connect()
actions = offload.stream(act, hz=50.0, horizon=25)
actions.see({"step": 0})
time.sleep(0.5)
actions.next()
"""
POLICY = {"tasks": "tests.probes,tests.chunk_tasks"}


def start(
    bed: LocalTestbed, connect: Callable[..., Offloader], **options: Any
) -> tuple[Offloader, ActionStream]:
    offload = connect(bed, settings=Settings(s_per_quality=1.0))
    assert offload.wait_for_sites(act, 10.0) == {}
    return offload, offload.stream(act, hz=HZ, horizon=HORIZON, blend=0, **options)


def test_actions_come_in_time_and_from_the_better_site(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """After the first chunk no step is empty, most actions are the server's, and the calls keep the limit."""
    _, stream = start(testbed(POLICY), connect, calls_per_s=5.0)
    with stream as actions:
        loop = Loop(actions)
        loop.play(5.0, until=fresh(CLOUD))
        played = loop.play(3.0)
        print(actions.counts, actions.late_s())
        empty = sum(step.held for step in played)
        assert empty <= 0.05 * len(played)
        assert sum(step.site == CLOUD for step in played) > 0.8 * len(played)
        assert {step.quality for step in played if not step.held} <= {0.5, 1.0}
        assert actions.counts.asked[CLOUD] <= 5.0 * (3.0 + 5.0) + 1
        ages = [step.age_s for step in played if step.age_s is not None]
        assert max(ages) <= HORIZON / HZ


@pytest.mark.parametrize("bad", ["nan", "none", "other"])
def test_bad_chunks_are_refused(
    testbed: Callable[..., LocalTestbed],
    connect: Callable[..., Offloader],
    caplog: pytest.LogCaptureFixture,
    bad: str,
) -> None:
    """Not finite, no steps, or other dimensions than before: the actions of onboard are played instead."""
    _, stream = start(testbed(POLICY), connect)
    with stream as actions, caplog.at_level(logging.WARNING):
        loop = Loop(actions)
        loop.play(5.0, until=fresh(CLOUD))
        loop.observation = {"cloud": bad}
        loop.play(5.0, until=fresh(ONBOARD))
        loop.play(1.0)
        assert actions.counts.refused[CLOUD] > 0
        assert any("no chunk of cloud: actions of the answer" in line for line in caplog.messages)


def test_the_error_of_the_onboard_policy_is_raised_when_nothing_else_is_left(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """While a server answers, nobody hears of it; without one, `next` raises it."""
    bed = testbed(POLICY)
    _, stream = start(bed, connect)
    with stream as actions:
        loop = Loop(actions, onboard="fails")
        loop.play(5.0, until=fresh(CLOUD))
        loop.play(1.0)
        bed.kill("cloud")
        with pytest.raises(TaskFailed, match="the onboard policy is broken"):
            loop.play(10.0)


def test_an_episode_plays_nothing_of_the_old_one(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """After `reset` no action is there before the first chunk of the new observations."""
    _, stream = start(testbed(POLICY), connect)
    with stream as actions:
        loop = Loop(actions)
        loop.play(5.0, until=fresh(CLOUD))
        actions.reset()
        step = actions.next()
        assert (step.action, step.held) == (None, True)
        loop.steps.append(step)
        loop.play(5.0, until=fresh(CLOUD))


def test_the_policy_gets_what_is_played_meanwhile(
    testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]
) -> None:
    """`ask` makes the argument of the observation, the expected delay in steps and the next actions."""
    asked: list[tuple[int, int, np.ndarray]] = []

    def ask(observation: dict[str, Any], delay: int, upcoming: np.ndarray) -> dict[str, Any]:
        asked.append((observation["step"], delay, upcoming))
        return observation

    _, stream = start(testbed(POLICY), connect, ask=ask)
    with stream as actions:
        Loop(actions).play(2.0)
    step, delay, upcoming = next(one for one in reversed(asked) if len(one[2]) == one[1] > 0)
    assert delay < HORIZON
    assert list(upcoming[:, 0] - upcoming[0, 0]) == list(range(delay))
    assert abs(upcoming[0, 0] - step) <= 2


def test_a_stream_ends(testbed: Callable[..., LocalTestbed], connect: Callable[..., Offloader]) -> None:
    """A closed stream says so, and so does the stream of a closed offloader."""
    bed = testbed(POLICY)
    offload, stream = start(bed, connect)
    with stream as actions:
        Loop(actions).play(5.0, until=fresh(CLOUD))
    with pytest.raises(OffloadError, match="the stream is closed"):
        actions.next()
    other = offload.stream(act, hz=HZ, horizon=HORIZON)
    offload.close()
    with pytest.raises(OffloadError, match="the offloader is closed"):
        other.next()
    other.close()


def test_the_programs_of_the_page_run(tmp_path: Path) -> None:
    """The robot of docs/streams.md plays actions of the policy that both of its programs share."""
    blocks = dict(re.findall(r"```python\n# (\w+\.py)\n(.*?)```", PAGE, re.DOTALL))
    (tmp_path / "mypolicy.py").write_text(blocks["mypolicy.py"])
    with server(tmp_path, "mypolicy") as (endpoint, _):
        (tmp_path / "arm.py").write_text(blocks["arm.py"].replace("tcp://127.0.0.1:5555", endpoint))
        done = subprocess.run(
            [sys.executable, "-W", "error", "arm.py"],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            timeout=60,
        )
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    ready, played = done.stdout.splitlines()
    assert ready == "all sites can take this task"
    assert re.match(r"(cloud|onboard) \(7,\) Counts\(steps=150, empty=\d+,", played)


@pytest.mark.parametrize(
    ("then", "said"),
    [
        (
            "if os.fork() == 0:\n    tell(actions.next)\n    actions.close()\n    os._exit(0)\nos.wait()",
            "forked",
        ),
        ("del actions\ntime.sleep(1.0)", "a stream was dropped without close()"),
    ],
)
def test_a_forked_or_dropped_stream_ends(then: str, said: str) -> None:
    """In a forked process `next` raises an error, and the thread of a dropped stream ends."""
    program = PROGRAM + then + "\ntell(lambda: [one.name for one in threading.enumerate()])\n"
    done = subprocess.run(
        [sys.executable, "-W", "always", "-c", program], capture_output=True, text=True, timeout=60
    )
    print(done.stdout, done.stderr)
    assert done.returncode == 0
    assert said in done.stdout + done.stderr
    if "dropped" in said:
        assert "'stream'" not in done.stdout
