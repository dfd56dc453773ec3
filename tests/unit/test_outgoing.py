"""What one run sends of its arguments: packed by the kind once, or compressed where that was chosen."""

import importlib
import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from offboard.cloud_server.executors.executor import Call, run_task
from offboard.common.errors import BadValue
from offboard.common.task_states import TaskStates
from offboard.common.tasks import Task, kind_of, task
from offboard.common.wire import messages as wire
from offboard.robot_client.sites.outgoing import BlobUploads, Outgoing, Parcel, new_task

WHOLE = np.zeros(100_000, np.uint8)
NOISE = np.frombuffer(np.random.default_rng(1).bytes(100_000), np.uint8)
packed: list[Any] = []


def to_half(array: Any) -> Any:
    packed.append(array)
    return array.astype(np.float16)


@task("outgoing_half", size=len, pack=to_half, unpack=lambda half: half.astype(float))
def half_sum(array: Any) -> float:
    return float(array.sum())


@task("outgoing_bad", size=len, pack=lambda array: array.missing, unpack=list)
def bad_sum(array: Any) -> float:
    return float(array.sum())


@task("outgoing_plain", size=lambda *arrays: len(arrays))
def plain_sum(*arrays: Any) -> list[float]:
    return [float(array.sum()) for array in arrays]


def outgoing(one: Task, *, compresses: bool = True) -> Outgoing:
    """What a task of this kind sends if its arguments were new so far."""
    uploads = BlobUploads()
    for _ in range(2):
        uploads.found(one.kind.name, new=True)
    return Outgoing(one, uploads.inline_rule(one.kind.name, 2**26), compresses=compresses)


def body_of(one: Task, using: Outgoing) -> wire.Body:
    return wire.encode(using.values(one, lambda _: False), (), blobs=True, along=using)


def test_a_task_is_packed_once_for_all_sites() -> None:
    """The second site gets the same value, and packing takes no time for it."""
    packed.clear()
    one = new_task(kind_of(half_sum), (np.ones(1000),))
    assert packed == []
    first, second = outgoing(one), outgoing(one)
    values = [using.values(one, lambda _: False) for using in (first, second)]
    assert values[0][0] is values[1][0]
    assert len(packed) == 1
    ((argument, how, raw_bytes, count, seconds),) = first.packed
    assert (argument, how, raw_bytes, count) == (None, "pack", 8000, 2000)
    assert seconds > 0.0
    assert second.packed[0].seconds == 0.0


def test_two_threads_pack_a_task_once() -> None:
    """The second thread waits for the first one."""
    packed.clear()
    parcel, args, got = Parcel(), (np.ones(100_000),), []
    threads = [
        threading.Thread(target=lambda: got.append(parcel.packed(kind_of(half_sum), args)[0]))
        for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(packed) == 1
    assert all(one is got[0] for one in got)


def test_a_pack_that_raises_is_named() -> None:
    """The error says which task, and what was raised."""
    one = new_task(kind_of(bad_sum), (np.ones(3),))
    with pytest.raises(BadValue, match="pack of task outgoing_bad: AttributeError: "):
        outgoing(one).values(one, lambda _: False)


def test_only_the_chosen_arguments_are_compressed() -> None:
    """The frames of the others are the bytes of their arrays; all of them come back."""
    one = Task(kind_of(plain_sum), (WHOLE, WHOLE + 1), 0.0, compress=(1,))
    using = outgoing(one)
    body = body_of(one, using)
    assert [memoryview(frame).nbytes == WHOLE.nbytes for frame in body.frames[1:]] == [True, False]
    ((argument, how, raw_bytes, count, seconds),) = using.packed
    assert (argument, how, raw_bytes, count) == (1, "zstd", WHOLE.nbytes, len(body.frames[2]))
    assert seconds > 0.0
    for got, sent in zip(wire.decode(body.frames, (), {}), one.args, strict=True):
        np.testing.assert_array_equal(got, sent)


@pytest.mark.parametrize("args", [(NOISE,), (WHOLE[:1000],)], ids=["noise", "small"])
def test_what_does_not_shrink_is_sent_as_it_is(args: tuple[Any, ...]) -> None:
    """Noise is tried in vain, which is noted; a small array is not tried."""
    one = Task(kind_of(plain_sum), args, 0.0, compress=(0,))
    using = outgoing(one)
    body = body_of(one, using)
    assert bytes(body.frames[1]) == args[0].tobytes()
    assert [(each.raw_bytes, each.bytes) for each in using.packed] == [(100_000, 100_000)] * (
        args[0] is NOISE
    )
    assert wire.decode(body.frames, (), {})[0].tobytes() == args[0].tobytes()


def test_nothing_is_compressed_for_a_server_that_cannot_read_it() -> None:
    """Such as one of an older version, or of a robot whose user has switched it off."""
    one = Task(kind_of(plain_sum), (WHOLE,), 0.0, compress=(0,))
    using = outgoing(one, compresses=False)
    assert bytes(body_of(one, using).frames[1]) == WHOLE.tobytes()
    assert using.packed == ()


def test_the_bytes_of_a_blob_are_compressed_when_they_are_sent() -> None:
    """Its digest is that of the array itself, and its argument is known."""
    one = Task(kind_of(plain_sum), (WHOLE,), 0.0, compress=(0,))
    using = Outgoing(one, BlobUploads().inline_rule("outgoing_plain", 2**26), compresses=True)
    body, as_before = body_of(one, using), wire.encode([WHOLE], (), blobs=True)
    assert using.packed == ()
    assert body.blobs.keys() == as_before.blobs.keys()
    ((digest, raw),) = body.blobs.items()
    assert memoryview(using.smaller(body.arguments[digest], raw)).nbytes < 1000
    assert len(using.packed) == 1


def test_the_example_of_the_docs_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The robot sends a quarter of the bytes, and the server computes with the type that the task wants."""
    page = (Path(__file__).parents[2] / "docs" / "own_task.md").read_text(encoding="utf-8")
    (module,) = re.findall(r"```python\n# halves\.py\n(.*?)```", page, re.DOTALL)
    (tmp_path / "halves.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    centre = importlib.import_module("halves").centre
    one = new_task(kind_of(centre), (np.full((1000, 3), 0.5),))
    body = body_of(one, outgoing(one))
    assert sum(memoryview(frame).nbytes for frame in body.frames) < 0.3 * one.args[0].nbytes
    outcome = run_task(Call("centre", body.frames), TaskStates(1))
    assert (outcome.status, outcome.error) == ("ok", "")
    assert wire.decode(outcome.frames, (), {}) == [0.5, 0.5, 0.5]
