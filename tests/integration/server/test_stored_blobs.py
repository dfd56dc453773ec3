"""Large arguments that the server keeps."""

from pathlib import Path

import numpy as np
import pytest

from offboard.common.wire.compression import compress
from offboard.common.wire.messages import Blob
from tests.executor_tasks import ON_THIS_COMPUTER
from tests.integration.server.peers import Join, Serve, until

pytestmark = pytest.mark.integration


@pytest.mark.parametrize("executor", ON_THIS_COMPUTER)
def test_a_blob_is_asked_for_once(serve: Serve, join: Join, executor: str) -> None:
    """The server asks for a missing blob, then answers, and keeps the blob for the next robot."""
    running = serve(executor)
    peer, other = join(running.server.endpoint), join(running.server.endpoint)
    array = np.arange(50_000.0)
    blobs = peer.request(1, "served_sum", array)
    reply = peer.reply()
    assert (reply.status, reply.missing) == ("need_blob", tuple(blobs))
    peer.send(Blob(next(iter(blobs.values()))))
    assert peer.value(2, "served_sum", array) == array.sum()
    assert other.value(1, "served_sum", array) == array.sum()
    assert running.counted("blob_bytes") == array.nbytes


def test_stored_blobs_are_bounded(serve: Serve, join: Join) -> None:
    """Beyond the limit the least recently used blob is deleted, and the server asks for it again."""
    running = serve(blob_bytes_max=1_000_000)
    peer = join(running.server.endpoint)
    arrays = [np.full(50_000, n, float) for n in range(4)]
    for n, array in enumerate(arrays):
        for data in peer.request(n, "served_sum", array).values():
            assert peer.reply().status == "need_blob"
            peer.send(Blob(data))
        assert peer.value(10 + n, "served_sum", array) == array.sum()
    assert running.counted("blob_bytes") == 2 * arrays[0].nbytes
    assert peer.value(20, "served_sum", arrays[3]) == arrays[3].sum()
    peer.request(21, "served_sum", arrays[0])
    assert peer.reply().status == "need_blob"


def test_a_compressed_blob_is_kept_whole(serve: Serve, join: Join) -> None:
    """Its digest is that of the decompressed bytes, and these count as kept."""
    running = serve()
    peer, array = join(running.server.endpoint), np.arange(50_000.0)
    peer.send(Blob(compress(array.data.cast("B")), array.nbytes))
    assert peer.value(1, "served_sum", array) == array.sum()
    assert running.counted("blob_bytes") == array.nbytes


@pytest.mark.parametrize("size", [1, 399_999, 400_001, 2**20 + 1, 2**31 - 1])
def test_a_compressed_blob_of_another_size_is_dropped(serve: Serve, join: Join, size: int) -> None:
    """It may neither be more nor less than announced, nor more than a message may have."""
    running = serve()
    peer, array = join(running.server.endpoint), np.arange(50_000.0)
    peer.send(Blob(compress(array.data.cast("B")), size))
    peer.request(1, "served_sum", array)
    assert peer.reply().status == "need_blob"
    assert running.counted("dropped_messages_total", reason="malformed") == 1
    assert running.counted("blob_bytes") == 0


def test_a_compressed_blob_counts_with_all_its_bytes(serve: Serve, join: Join) -> None:
    """Otherwise a robot could make the server hash far more than it may send."""
    running = serve(robot_bytes_per_s=2**20)
    peer = join(running.server.endpoint)
    for n in range(3):
        array = np.full(100_000, float(n))
        peer.send(Blob(compress(array.data.cast("B")), array.nbytes))
    until(lambda: running.counted("dropped_messages_total", reason="quota") == 2)
    assert running.counted("blob_bytes") == 800_000


def test_a_flood_of_compressed_blobs_is_cut_off(serve: Serve, join: Join) -> None:
    """Few bytes that stand for far more than a robot may send end its connection, as so many bytes would."""
    most, size = 2**23, 2**23 - 2**19
    running = serve(robot_bytes_per_s=2**20, message_bytes_max=most, blob_bytes_max=most)
    peer, packed = join(running.server.endpoint), compress(bytes(size))
    for _ in range(4):
        peer.send(Blob(packed, size))
    until(lambda: running.counted("cut_off_connections_total") == 1)
    assert running.counted("blob_bytes") == size
    assert running.counted("dropped_messages_total", reason="quota") == 3


def test_a_waiting_request_keeps_its_blobs(serve: Serve, join: Join, pipe: Path) -> None:
    """A blob that leaves the store while a request waits for its turn is still there when it runs."""
    peer = join(serve(blob_bytes_max=500_000).server.endpoint)
    arrays = [np.full(50_000, n, float) for n in range(2)]
    peer.send(Blob(arrays[0].tobytes()))
    peer.request(1, "served_pipe", str(pipe))
    peer.request(2, "served_sum", arrays[0])
    peer.send(Blob(arrays[1].tobytes()))
    peer.request(3, "served_sum", arrays[0])
    assert (peer.reply().status, pipe.write_text("go")) == ("need_blob", 2)
    replies = {reply.id: reply for reply in (peer.reply(), peer.reply())}
    assert replies[1].status == replies[2].status == "ok"
