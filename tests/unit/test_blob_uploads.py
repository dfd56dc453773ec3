"""Which large arguments are certainly new, and how long the others are remembered."""

import numpy as np

from offboard.robot_client.sites.outgoing import KEPT, NEW_AFTER, BlobUploads

BYTES = 100_000
MESSAGE_BYTES_MAX = 2**24


def often_new() -> BlobUploads:
    """Uploads of a kind whose last arguments were new."""
    uploads = BlobUploads()
    for _ in range(NEW_AFTER):
        uploads.found("plan", new=True)
    return uploads


def goes_inside(uploads: BlobUploads, n: float) -> bool:
    """Whether the n-th argument goes inside the request."""
    raw = np.full(BYTES // 8, n).view(np.uint8).data
    return uploads.inline_rule("plan", MESSAGE_BYTES_MAX)(raw)


def test_an_argument_that_comes_again_is_remembered_among_many_new_ones() -> None:
    """A map that is sent with every scan goes by digest, no matter how many scans came before."""
    uploads = often_new()
    assert goes_inside(uploads, 0)
    for n in range(1, 2 * KEPT):
        assert goes_inside(uploads, n)
        assert not goes_inside(uploads, 0)


def test_arguments_that_differ_in_one_byte_of_each_number_are_distinguished() -> None:
    """The sample takes every byte position of a number in turn, as most bytes of small numbers are 0."""
    uploads = often_new()
    assert all(goes_inside(uploads, n) for n in (0.0, 1.0, 2.0, 256.0, 1e-300, -0.0))
