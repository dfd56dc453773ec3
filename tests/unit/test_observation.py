"""What the answer of a policy server means for the execution."""

from typing import Any

import numpy as np
import pytest

from offboard.common.errors import CloudBroken, CloudTimeout
from offboard.common.tasks import Task, kind_of, task
from offboard.robot_client.policy_servers.openpi import OpenPi, pack
from offboard.robot_client.policy_servers.protocol import TEXT_LENGTH_MAX, Observation, shortened

pytest.importorskip("websockets", reason="needs the extra 'openpi': pip install '.[openpi]'")


@task("openpi_observed", policy_server=True, size=len)
def observed(observation: dict[str, Any]) -> dict[str, Any]:
    return observation


def published() -> Observation:
    return Observation(
        site="gpu",
        task=Task(kind_of(observed), ({},), 0),
        protocol=OpenPi("ws://127.0.0.1:8000"),
        data=b"12345",
        published_s=10.0,
        deadline_s=20.0,
    )


def sent() -> Observation:
    """It was published at 10 s, and sent at 11 s."""
    one = published()
    one.sent_s, one.bytes_out = 11.0, 5
    return one


@pytest.mark.parametrize(
    ("timing", "run_s"),
    [
        ({"infer_ms": 1500.0}, 1.5),
        ({"infer_ms": 0}, 0.0),
        ({"infer_ms": np.float64(1500.0)}, 1.5),
        ({"infer_ms": 5000.0}, None),  # longer than the whole time
        ({"infer_ms": -1.0}, None),
        ({"infer_ms": float("nan")}, None),
        ({"infer_ms": True}, None),
        ({"infer_ms": "1"}, None),
        ({}, None),
        ([1], None),
    ],
)
def test_the_time_that_the_server_says(timing: Any, run_s: float | None) -> None:
    """It counts if it can be true; the action is returned as it came."""
    action = {"actions": 1, "server_timing": timing}
    one = sent().answered(pack(action), 13.0)
    assert one.ok
    assert one.value["actions"] == 1
    assert (one.seconds, one.queue_s, one.run_s) == (3.0, 1.0, run_s)
    assert one.network_s == (None if run_s is None else pytest.approx(2.0 - run_s))
    assert (one.bytes_out, one.bytes_in) == (5, len(pack(action)))


def test_an_answer_need_not_be_a_dictionary() -> None:
    """Some servers answer with an array."""
    assert sent().answered(pack([1.0, 2.0]), 13.0).value == [1.0, 2.0]


@pytest.mark.parametrize(
    ("message", "failure", "text"),
    [
        (
            "Traceback ...\n  line\nKeyError: 'image'\n",
            CloudBroken,
            "the policy server failed: KeyError: 'image'",
        ),
        ("", CloudBroken, "the policy server failed: "),
        (pack({"type": "error", "message": "busy"}), CloudBroken, "the policy server failed: busy"),
        (b"\xc1", CloudBroken, "answer: not msgpack"),
    ],
)
def test_an_answer_without_an_action(message: bytes | str, failure: type[Exception], text: str) -> None:
    """The server is at fault, so onboard can answer."""
    one = sent().answered(message, 13.0)
    assert type(one.failure) is failure
    assert str(one.failure).startswith(text)
    assert one.value is None


def test_a_type_that_is_not_an_error_is_part_of_the_action() -> None:
    """Only a map whose type is `error` is one."""
    assert sent().answered(pack({"type": "grasp"}), 13.0).value == {"type": "grasp"}


def test_what_is_given_up_before_it_is_sent_never_ran() -> None:
    """It moved no bytes."""
    execution = published().given_up(CloudTimeout("late"), 12.0, censored=True)
    assert (execution.started, execution.bytes_out, execution.seconds) == (False, 0, 2.0)
    execution = sent().given_up(CloudTimeout("late"), 12.0, censored=True)
    assert (execution.started, execution.bytes_out) == (True, 5)


def test_a_long_text_is_shortened() -> None:
    """Logs and records hold its last line, and not all of that."""
    assert shortened("a\nb" + "c" * 500) == "b" + "c" * (TEXT_LENGTH_MAX - 1)
