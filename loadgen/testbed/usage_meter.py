"""A shell that stays in a container and says what its part uses, whenever it is asked.

To execute one for each reading takes 10 ms of the container's CPU, which is 100 ms of a tenth of a CPU.
"""

import struct
from typing import Any

from offboard.loadgen.testbed import container_part as inside
from offboard.loadgen.testbed.testbed import Usage

ANSWER_S = 10.0  # for one reading
ANSWER_BYTES_MAX = 10_000
_FRAME = struct.Struct(">BxxxL")  # of Docker's attach streams: 1 is stdout, 2 stderr; bytes


class Meter:
    """`api` is the SDK's low-level client. What the engine refuses is a DockerException, or an OSError."""

    def __init__(self, api: Any, container: str) -> None:
        made = api.exec_create(container, ["sh", "-c", inside.MEASURE], stdin=True)
        self._attached = api.exec_start(made["Id"], socket=True)
        self._socket = getattr(self._attached, "_sock", self._attached)  # it can be written to
        self._socket.settimeout(ANSWER_S)

    def read(self) -> Usage:
        """OSError where it has ended, or does not answer within ANSWER_S: then it is of no more use."""
        self._socket.sendall(b"\n")
        said = b""
        while not said.endswith(b"\n"):
            stream, size = _FRAME.unpack(self._receive(_FRAME.size))
            if stream != 1 or len(said) + size > ANSWER_BYTES_MAX:
                raise OSError(f"a shell in the container said {said + self._receive(min(size, 200))!r}")
            said += self._receive(size)
        return inside.measured(said)

    def close(self) -> None:
        # Closing what it belongs to closes it; the other way round leaves that in disorder.
        getattr(self._attached, "_response", self._attached).close()

    def _receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            chunk = self._socket.recv(size - len(received))
            if not chunk:
                raise OSError("the shell that reads what it uses has ended")
            received += chunk
        return received
