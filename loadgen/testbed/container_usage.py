"""Memory and open handles of a container's part, read through a shell that stays in the container.

A `docker exec` for each reading would use 10 ms of the container's CPU time, which takes 100 ms at a quota of
0.1 CPU.
"""

import struct
from typing import Any

from offboard.loadgen.testbed.container_part import MEASURE, measured
from offboard.loadgen.testbed.testbed import Usage

ANSWER_S = 10.0  # longest wait for one reading
ANSWER_BYTES_MAX = 10_000
_FRAME = struct.Struct(">BxxxL")  # header of Docker's attach stream: 1 for stdout or 2 for stderr, bytes


class UsageMeter:
    """Reads the usage of one running container; use a new one after each start of the container.

    `api` is the low-level client of the Docker SDK. Docker's refusals are raised as DockerException or
    OSError.
    """

    def __init__(self, api: Any, container: str) -> None:
        made = api.exec_create(container, ["sh", "-c", MEASURE], stdin=True)
        self._attached = api.exec_start(made["Id"], socket=True)
        # On Unix sockets the SDK returns a read-only wrapper; the socket in it can be written to.
        self._socket = getattr(self._attached, "_sock", self._attached)
        self._socket.settimeout(ANSWER_S)

    def read(self) -> Usage:
        """The usage now; OSError if the shell has ended or does not answer in time.

        After that, the meter cannot be used again.
        """
        self._socket.sendall(b"\n")
        output = b""
        while not output.endswith(b"\n"):
            stream, size = _FRAME.unpack(self._receive(_FRAME.size))
            if stream != 1 or len(output) + size > ANSWER_BYTES_MAX:
                raise OSError(
                    f"the shell in the container printed {output + self._receive(min(size, 200))!r}"
                )
            output += self._receive(size)
        return measured(output)

    def close(self) -> None:
        # Close the response, which closes the socket; closing the socket first breaks the response.
        getattr(self._attached, "_response", self._attached).close()

    def _receive(self, size: int) -> bytes:
        received = b""
        while len(received) < size:
            chunk = self._socket.recv(size - len(received))
            if not chunk:
                raise OSError("the shell in the container has ended")
            received += chunk
        return received
