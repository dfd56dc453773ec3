"""Finds AprilTags with one variant for each site: in a small picture onboard, at full size on a server.

A quarter of the width and height takes about a tenth of the time, but small tags are missed: that is the lost
quality. The program says which share of the tags each site found, and after which time.
"""

import io
import itertools
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import numpy as np

from examples import missing, run
from offboard import MissingExtra, Offloader, task

try:
    from examples import apriltags
    from examples.apriltags import Array, Detector, Image
except MissingExtra as error:
    raise missing(__name__, "apriltags") from error

SHAPES = ((720, 1280), (1080, 1920))  # rows, columns
SHRUNK = 4  # the picture onboard is that many times smaller in width and height
SMALL_QUALITY = 0.7  # share of the tags that are found; tests/unit/test_variant_example.py measures it
CALLS = 60

same = apriltags.same


def tags_in_a_small_picture(detector: Detector, frame: Array) -> list[dict[str, Any]]:
    """The tags in a JPEG that is decoded SHRUNK times smaller, with their centers in the whole frame."""
    picture = Image.open(io.BytesIO(frame.data))
    picture.draft("L", (picture.width // SHRUNK, picture.height // SHRUNK))
    grey = np.asarray(picture.convert("L"))
    found = [{"id": tag.tag_id, "center": (SHRUNK * tag.center).tolist()} for tag in detector.detect(grey)]
    return sorted(found, key=lambda tag: (tag["id"], tag["center"]))


@task(
    "find_tags",
    setup=apriltags.make_detector,
    size=apriltags.pixels,
    variants={"onboard": tags_in_a_small_picture},
    quality={"onboard": SMALL_QUALITY, "cloud": 1.0},
)
def find_tags(detector: Detector, frame: Array) -> list[dict[str, Any]]:
    """The number and the center of each tag in a JPEG. Servers run this function."""
    return apriltags.detect_tags(detector, frame)


def inputs(seed: int, shapes: tuple[tuple[int, int], ...] = SHAPES) -> Iterator[tuple[Array]]:
    """Frames without end."""
    return apriltags.inputs(seed, shapes)


def main(endpoint: str) -> None:
    """Call the task CALLS times: `python -m examples.variants tcp://HOST:PORT`."""
    detector, calls = apriltags.make_detector(), defaultdict[str, list[tuple[int, int, float]]](list)
    with Offloader.connect(endpoint) as offload:
        offload.wait_for_sites(find_tags, 30.0)
        for (frame,) in itertools.islice(inputs(seed=1), CALLS):
            tags, record = offload.call(find_tags, frame)
            found = len(tags)
            every = len(find_tags(detector, frame))
            calls[record.used].append((found, every, record.waited_s))
            print(
                f"{found} of {every} tags from {record.used} after {record.waited_s * 1e3:.0f} ms "
                f"({record.decision.reason})"
            )
    for site, those in calls.items():
        found, every, waited_s = (sum(column) for column in zip(*those, strict=True))
        print(
            f"{site}: {len(those)} calls, {found / every:.0%} of the tags, "
            f"{waited_s / len(those) * 1e3:.0f} ms in the mean"
        )


if __name__ == "__main__":
    run(main)
