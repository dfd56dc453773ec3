"""The connections that a server remembers."""

from offboard.cloud_server.connections import KEPT, Connections

NO_FILE = 1 << 30  # no process may open as many


def test_the_memory_of_connections_is_limited() -> None:
    """Beyond the limit the oldest is forgotten, and then counts as one that has not ended."""
    known = Connections()
    for number in range(KEPT + 1):
        known.heard(b"%d" % number, NO_FILE)
    assert not known.ended(b"0")
    assert known.ended(b"1")
    assert known.ended(b"%d" % KEPT)


def test_a_connection_that_was_closed_before_its_first_message_was_read_has_ended() -> None:
    """The end is found once; a peer that was never heard has no connection that could end."""
    known = Connections()
    assert not known.ended(b"peer")
    known.heard(b"peer", NO_FILE)
    known.pings(b"peer")
    assert known.ended(b"peer")
    assert not known.ended(b"peer")
