"""Reads signs in camera frames with two neural networks: one finds the text, one reads it.

All frames have the same size, so the input size says nothing: the time depends on how much text there is.
onnxruntime releases the interpreter lock while a network runs. The lock is held for a few milliseconds at a
time between the networks, so a server can use threads.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from examples import missing, run
from offboard import Offloader, task

try:
    import cv2
    from rapidocr import RapidOCR
except ImportError as error:
    raise missing(__name__, "signs") from error

Array = np.ndarray[Any, Any]

SHAPE = (608, 1080)  # rows, columns: 2 MB
SIGNS_MAX = 16
SCORE_TOLERANCE = 0.02
PLACES = ("EXIT", "LAB", "STOP", "LIFT", "DOCK 7", "ROOM 12", "HALL B", "NO ENTRY", "LOADING BAY", "GATE 21")
ENGINE = {
    "EngineConfig.onnxruntime.intra_op_num_threads": 1,
    "EngineConfig.onnxruntime.inter_op_num_threads": 1,
    "Global.log_level": "error",
}


def load_networks() -> RapidOCR:
    """Both networks, with one thread each. The wheel of rapidocr contains them."""
    cv2.setNumThreads(1)
    networks = RapidOCR(params=ENGINE)
    networks(next(inputs(seed=0))[0])  # they are loaded by the first call
    return networks


def pixels(frame: Array) -> int:
    return int(frame.shape[0] * frame.shape[1])


def work(signs: list[dict[str, Any]]) -> float:
    """Finding text takes about as long as reading 20 signs; then each sign is read by itself."""
    return 20 + len(signs)


@task("read_signs", setup=load_networks, size=pixels, work=work)
def read_signs(networks: RapidOCR, frame: Array) -> list[dict[str, Any]]:
    """The text on each sign, its score and its corners, from top to bottom."""
    found = networks(frame)
    if found.txts is None:
        return []
    return [
        {"text": text, "score": float(score), "corners": np.asarray(corners, np.float32)}
        for text, score, corners in zip(found.txts, found.scores, found.boxes, strict=True)
    ]


def inputs(seed: int, shape: tuple[int, int] = SHAPE) -> Iterator[tuple[Array]]:
    """Frames without end, each with 0 to SIGNS_MAX signs."""
    rng = np.random.default_rng(seed)
    while True:
        yield (draw_frame(shape, int(rng.integers(SIGNS_MAX, endpoint=True)), rng),)


def same(a: list[dict[str, Any]], b: list[dict[str, Any]]) -> bool:
    """Whether both answers hold the same texts, with about the same scores."""
    if [sign["text"] for sign in a] != [sign["text"] for sign in b]:
        return False
    return all(abs(x["score"] - y["score"]) <= SCORE_TOLERANCE for x, y in zip(a, b, strict=True))


def draw_frame(shape: tuple[int, int], signs: int, rng: np.random.Generator) -> Array:
    """A noisy wall with `signs` signs, each in its own cell of a grid."""
    rows, columns = shape
    frame = np.full((rows, columns, 3), 190, np.uint8)
    across, down = 4, -(-SIGNS_MAX // 4)
    for cell in rng.permutation(across * down)[:signs]:
        x = (cell % across) * columns // across + int(rng.integers(5, 20))
        y = (cell // across + 1) * rows // down - int(rng.integers(30, 70))
        text = PLACES[rng.integers(len(PLACES))]
        cv2.putText(frame, text, (int(x), int(y)), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (20, 20, 20), 2)
    noise = rng.integers(-6, 7, frame.shape, dtype=np.int16)
    return np.clip(frame + noise, 0, 255).astype(np.uint8)


def main(endpoint: str) -> None:
    """Call the task 30 times: `python -m examples.signs tcp://HOST:PORT`."""
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(read_signs, 60.0)
        for (frame,) in itertools.islice(inputs(seed=1), 30):
            signs, record = offload.call(read_signs, frame)
            print(
                f"{len(signs)} signs from {record.used} after {record.waited_s * 1e3:.0f} ms "
                f"({record.decision.reason})"
            )


if __name__ == "__main__":
    run(main)
