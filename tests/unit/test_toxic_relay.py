"""The relay with toxics, as far as it needs no sockets."""

from offboard.loadgen.relay.tcp.relay import Refusal
from offboard.loadgen.relay.toxiproxy.toxic_relay import ToxicRelay


def test_a_connection_after_the_close_is_refused() -> None:
    """A connection that the kernel accepted just before the proxy was disabled is closed."""
    relay = ToxicRelay(("127.0.0.1", 1), seed=0, connections_max=1, buffer_bytes=1 << 20)
    assert isinstance(relay.accept(), Refusal)
    assert not relay.connections
