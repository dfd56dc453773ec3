"""The signs of `examples/`, whose frames cross the link as JPEG. `benchmarks.packing` measures them."""

from typing import Any

import cv2
import numpy as np

from examples.signs import Array, inputs, load_networks, pixels, read_signs, work
from offboard import task

__all__ = ["PLAIN", "inputs", "packed", "same"]

QUALITY = 90
PLAIN = read_signs


def to_jpeg(frame: Array) -> Array:
    _, jpeg = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return np.asarray(jpeg).reshape(-1)


def from_jpeg(jpeg: Array) -> Array:
    return np.asarray(cv2.imdecode(jpeg, cv2.IMREAD_COLOR))


def same(a: list[dict[str, Any]], b: list[dict[str, Any]]) -> bool:
    """Whether both answers hold the same texts. Their scores differ a little after a JPEG."""
    return [sign["text"] for sign in a] == [sign["text"] for sign in b]


@task("read_signs_jpeg", setup=load_networks, size=pixels, work=work, pack=to_jpeg, unpack=from_jpeg)
def packed(networks: Any, frame: Array) -> list[dict[str, Any]]:
    """The text on each sign of a frame."""
    return read_signs(networks, frame)
