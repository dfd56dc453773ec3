"""Calls of an offloader, with the types that a type checker must see. Mypy reads this file; it never runs."""

from typing import Any

from typing_extensions import assert_type

from offboard import Expectation, Offloader, Record, Savings, TaskFailed, task


class Detector:
    """Stands for a model."""


@task("typed_count", size=lambda limit: limit)
def count(limit: int, scale: float = 1.0) -> str:
    return str(limit * scale)


@task("typed_detect", size=lambda frame: len(frame), setup=Detector)
def detect(detector: Detector, frame: bytes) -> list[int]:
    assert detector
    return list(frame)


@task("typed_render", size=lambda pixels, layers: (pixels, layers))
def render(pixels: int, layers: int) -> bytes:
    return bytes(pixels * layers)


def untyped(limit):  # type: ignore[no-untyped-def]
    return limit


async def calls(offload: Offloader) -> None:
    assert_type(offload(count, 5), str)
    assert_type(offload(count, 5, scale=2.0, where="cloud", timeout_s=1.0), str)
    assert_type(offload(detect, b"frame"), list[int])
    assert_type(offload(render, 5, 3), bytes)
    assert_type(offload(untyped, 5), Any)
    assert_type(offload.map(count, [1, (2, 3.0)]), list[str])
    assert_type(offload.map(detect, [b"frame"], where="both"), list[list[int]])
    assert_type(offload.submit(count, 5, deadline_s=1.0).result(), str)
    assert_type(offload.submit(detect, b"frame").record, Record | None)
    assert_type(offload.call(count, 5, where="cloud"), tuple[str, Record])
    assert_type(offload.call(detect, b"frame"), tuple[list[int], Record])
    assert_type(offload.map(count, [1], records=True), list[tuple[str, Record]])
    assert_type(offload.expect(count, 5, deadline_s=1.0), dict[str, Expectation])
    assert_type(offload.savings(), dict[str, Savings | None])
    assert_type(await offload.run(count, 5, where="onboard"), str)
    assert_type(await offload.run(detect, b"frame"), list[int])
    assert_type(count(5), str)
    assert_type(detect(Detector(), b"frame"), list[int])
    assert_type(TaskFailed("why").traceback, str)
