"""Which large arguments are certainly new, and for how long it is known which are not."""

import numpy as np

from offboard.robot_client.sites.uploads import KEPT, NEW_AFTER, Uploads

BYTES = 100_000
MESSAGE_BYTES_MAX = 2**24


def along(uploads: Uploads, n: float) -> bool:
    """Whether the n-th argument is sent along."""
    raw = np.full(BYTES // 8, n).view(np.uint8).data
    return uploads.along("plan", MESSAGE_BYTES_MAX)(raw)


def test_what_comes_again_stays_known_beside_any_number_of_new_ones() -> None:
    """A map that goes with every scan is not sent along, however many scans there were."""
    uploads = Uploads()
    for _ in range(NEW_AFTER):
        uploads.found("plan", new=True)
    assert along(uploads, 0)
    for n in range(1, 2 * KEPT):
        assert along(uploads, n)
        assert not along(uploads, 0)


def test_an_argument_that_differs_in_any_byte_of_its_numbers_is_told_apart() -> None:
    """The sample takes every byte of a number in turn: those of small whole numbers are mostly 0."""
    uploads = Uploads()
    for _ in range(NEW_AFTER):
        uploads.found("plan", new=True)
    assert all(along(uploads, n) for n in (0.0, 1.0, 2.0, 256.0, 1e-300, -0.0))
