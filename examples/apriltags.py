"""Finds AprilTags in the JPEG frames of a camera. One core needs about 40 ms for a million pixels.

pupil_apriltags releases the interpreter lock while it detects, so a server can use threads. A raw 4K frame
would take 1.3 s at 50 Mbit/s, several times as long as the detection; its JPEG takes a tenth of that.
"""

import io
import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np

from examples import missing, run
from offboard import Offloader, task

try:
    from PIL import Image
    from pupil_apriltags import Detector
except ImportError as error:
    raise missing(__name__, "apriltags") from error

Array = np.ndarray[Any, Any]

FAMILY = "tag36h11"
SHAPES = ((480, 640), (720, 1280), (1080, 1920), (1536, 2048), (2160, 3840))  # rows, columns
QUALITIES = (60, 75, 85, 95)  # of the JPEG: the payload changes by a factor of six, the work hardly at all
TAGS = (2, 24)  # the fewest and the most tags of a frame
CELL_PIXELS = (4, 9)
CENTER_TOLERANCE_PIXELS = 0.1


def make_detector() -> Detector:
    """A detector with one thread. It is not safe to share, so each worker has its own."""
    detector = Detector(families=FAMILY, nthreads=1, quad_decimate=1.0)
    # `Detector.__del__` frees each family in this dict before the detector, which still uses it: a crash.
    # The detector itself is freed all the same; 36 kB of the family stay.
    detector.tag_families.clear()
    return detector


def pixels(frame: Array) -> int:
    """The pixels of a JPEG. Its header has them, so nothing is decoded."""
    width, height = Image.open(io.BytesIO(frame.data)).size
    return width * height


@task("detect_tags", setup=make_detector, size=pixels)
def detect_tags(detector: Detector, frame: Array) -> list[dict[str, Any]]:
    """The number and the center of each tag in a JPEG, in order of their numbers."""
    grey = np.asarray(Image.open(io.BytesIO(frame.data)).convert("L"))
    found = [{"id": tag.tag_id, "center": tag.center.tolist()} for tag in detector.detect(grey)]
    return sorted(found, key=lambda tag: (tag["id"], tag["center"]))


def inputs(seed: int, shapes: tuple[tuple[int, int], ...] = SHAPES) -> Iterator[tuple[Array]]:
    """Frames without end. Resolution, quality and number of tags are drawn independently of each other."""
    rng = np.random.default_rng(seed)
    pictures = tag_pictures()
    while True:
        shape = shapes[rng.integers(len(shapes))]
        quality = QUALITIES[rng.integers(len(QUALITIES))]
        scene = draw_scene(shape, pictures, rng)
        jpeg = io.BytesIO()
        Image.fromarray(scene).save(jpeg, "JPEG", quality=quality)
        # As an array, because new arrays travel inside the request; large `bytes` cost one more round trip.
        yield (np.frombuffer(jpeg.getvalue(), np.uint8),)


def same(a: list[dict[str, Any]], b: list[dict[str, Any]]) -> bool:
    """Whether both answers hold the same tags. Two versions of a JPEG decoder may differ by a grey level."""
    if [tag["id"] for tag in a] != [tag["id"] for tag in b]:
        return False
    return all(
        np.allclose(x["center"], y["center"], rtol=0, atol=CENTER_TOLERANCE_PIXELS)
        for x, y in zip(a, b, strict=True)
    )


def tag_pictures() -> list[Array]:
    """One picture of 10 x 10 cells for each tag of the family, drawn from the codes in the library."""
    detector = Detector(families=FAMILY)
    family = detector.tag_families[FAMILY].contents
    pictures = []
    for code in family.codes[: family.ncodes]:
        picture = np.full((family.total_width, family.total_width), 255, np.uint8)
        picture[1:-1, 1:-1] = 0
        for bit in range(family.nbits):
            if code >> (family.nbits - 1 - bit) & 1:
                picture[family.bit_y[bit] + 1, family.bit_x[bit] + 1] = 255
        pictures.append(picture)
    detector.tag_families.clear()
    return pictures


def draw_scene(shape: tuple[int, int], pictures: list[Array], rng: np.random.Generator) -> Array:
    """Tags on a smooth background, with the noise of a camera."""
    rows, columns = shape
    coarse = rng.integers(60, 190, (rows // 40, columns // 40), dtype=np.uint8)
    scene = np.array(Image.fromarray(coarse).resize((columns, rows), Image.Resampling.BICUBIC))
    for _ in range(rng.integers(TAGS[0], TAGS[1], endpoint=True)):
        cell = rng.integers(*CELL_PIXELS)
        tag = np.kron(pictures[rng.integers(len(pictures))], np.ones((cell, cell), np.uint8))
        y, x = rng.integers(rows - len(tag)), rng.integers(columns - len(tag))
        scene[y : y + len(tag), x : x + len(tag)] = tag
    noise = rng.normal(0, 2, shape).astype(np.float32)
    return np.clip(scene + noise, 0, 255).astype(np.uint8)


def main(endpoint: str) -> None:
    """Call the task 30 times: `python -m examples.apriltags tcp://HOST:PORT`."""
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(detect_tags, 30.0)
        for (frame,) in itertools.islice(inputs(seed=1), 30):
            tags, record = offload.call(detect_tags, frame)
            print(
                f"{pixels(frame) / 1e6:.1f} Mpixel, {frame.nbytes / 1e3:.0f} kB: {len(tags)} tags from "
                f"{record.used} after {record.waited_s * 1e3:.0f} ms ({record.decision.reason})"
            )


if __name__ == "__main__":
    run(main)
