"""Tasks for the tests of executors, and how to run them."""

from dataclasses import replace
from pathlib import Path
from typing import Any

from offboard.cloud_server.executors.executor import Call, Executor, Outcome
from offboard.common.wire.messages import StoredBlob, decode, encode

WAIT_S = 8
ON_THIS_COMPUTER = ("processes", "threads")  # executors; `make ray` tests the other one
ROOT = Path(__file__).parents[1]
MODULE = '''
import asyncio, dataclasses, os, pathlib, threading, time
from offboard import Together
from offboard.common.tasks import task
from offboard.common.task_call import check_wanted

warmed = []

@task("exec_sum", size=lambda array: array.size, warm=lambda: warmed.append(1))
def exec_sum(array):
    return float(array.sum())

@task("exec_where", size=lambda array: 0)
def exec_where(array):
    """Process, times warmed, identity of the array."""
    return [os.getpid(), len(warmed), id(array)]

@task("exec_raise", size=lambda text: 0)
def exec_raise(text):
    raise ValueError(text)

@task("exec_exit", size=lambda: 0)
def exec_exit():
    raise SystemExit(3)

@task("exec_cancel", size=lambda: 0)
def exec_cancel():
    raise asyncio.CancelledError("late")

class Mute(Exception):
    def __str__(self):
        raise RuntimeError

@task("exec_mute", size=lambda: 0)
def exec_mute():
    raise Mute

@task("exec_object", size=lambda: 0)
def exec_object():
    return object()

@task("exec_deep", size=lambda: 0)
def exec_deep():
    return {"a": [1, object()]}

@dataclasses.dataclass
class Pose:
    x: float

@task("exec_pose", size=lambda pose: 0, types=(Pose,))
def exec_pose(pose):
    return pose.x

def to_one(a, b):
    return {"a": a, "b": b}

def to_both(one):
    return one["a"], one["b"]

@task("exec_packed", size=lambda a, b: 0, pack=to_one, unpack=to_both)
def exec_packed(a, b):
    return [a, b]

def raise_value_error(value):
    raise ValueError(f"no picture: {value}")

@task("exec_bad_unpack", size=lambda value: 0, pack=str, unpack=raise_value_error)
def exec_bad_unpack(value):
    return value

@task("exec_few_unpacked", size=lambda a, b: 0, pack=lambda a, b: a, unpack=str)
def exec_few_unpacked(a, b):
    return [a, b]

@task("exec_echo", size=lambda value: 0)
def exec_echo(value):
    return value

@task("exec_wait_for_file", size=lambda path: 0)
def exec_wait_for_file(path):
    with open(path) as pipe:  # a named pipe: opening waits for the writer
        return pipe.read()

def sums(arrays):
    if any(array.size == 0 for array in arrays):
        raise ValueError("empty")
    return [[float(array.sum()), len(arrays)] for array in arrays]

@task("exec_joint", size=lambda array: 0, together=Together(sums, key=lambda array: array.ndim))
def exec_joint(array):
    return sums([array])[0]

@task("exec_burn", size=lambda seconds: seconds)
def exec_burn(seconds):
    """Compute until this thread has used this many CPU seconds; returns the exact number."""
    start = time.thread_time()
    while (used := time.thread_time() - start) < seconds:
        pass
    return used

@task("exec_look", size=lambda path: 0)
def exec_look(path):
    pathlib.Path(path).write_text("begun")  # a named pipe: waits for the reader
    while True:
        check_wanted()
        time.sleep(0.001)
'''


def call(kind: str, *args: Any, **options: Any) -> Call:
    """A call with encoded arguments."""
    body = encode(args, blobs=True)
    blobs = {digest: StoredBlob(data) for digest, data in body.blobs.items()}
    return Call(kind, body.frames, blobs, **options)


def run_joint(executor: Executor, kind: str, *items: Any) -> list[Outcome]:
    """The outcomes of calls that run together, one for each of these arguments."""
    first, *more = [call(kind, item) for item in items]
    outcome = executor.submit(replace(first, more=tuple(more)), lambda _: None).result(WAIT_S)
    return [outcome, *outcome.more]


def run(executor: Executor, kind: str, *args: Any) -> Outcome:
    return executor.submit(call(kind, *args), lambda _: None).result(WAIT_S)


def value(outcome: Outcome) -> Any:
    assert outcome.status == "ok", outcome.error
    return decode(outcome.frames, [], {})
