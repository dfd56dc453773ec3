"""What both testbeds with real processes share: links, the output of parts, waiting for them, and signals.

`local_testbed` and `docker_testbed` start, change and end the parts.
"""

import codecs
import contextlib
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

from offboard.common.command_line import USAGE_EXIT
from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.relay.relay_client import RelayClient
from offboard.loadgen.testbed.testbed import CLOUD, ROBOT, WAN, Setup, kind_of, relay_of, servers_among

POLL_S = 0.05
TERMINATE_S = 15.0  # a cloud with a tenth of a CPU takes 5 s to end
KILL_S = 5.0
TAIL_LINES = 15
TAIL_BYTES = 1 << 16
END_S = 5.0  # longest wait for the last output of a part that has ended
INTERRUPTS = (signal.SIGINT, signal.SIGTERM)

Own = TypeVar("Own", bound="RealTestbed")


class RealTestbed:
    """A testbed whose parts are real processes, and whose links are real relays.

    Ctrl-C and SIGTERM raise an exception in the `with` block, which ends the parts.
    Use it from the main thread only, because only there signals can be delayed.
    """

    def __init__(self, out: Path, setups: Mapping[str, Setup] | None, ready_s: float) -> None:
        self.out = out
        self.ready_s = ready_s
        self._setups = {CLOUD: Setup(), WAN: Setup()} | dict(setups or {})
        self._relays: dict[str, RelayClient] = {}  # by the name of the server
        self._terminate_before: Any = None

    def __enter__(self: Own) -> Own:
        self._terminate_before = signal.signal(signal.SIGTERM, leave)
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        finally:
            signal.signal(signal.SIGTERM, self._terminate_before)

    def close(self) -> None:
        """End all parts. It takes a bounded time; Ctrl-C does not interrupt it."""
        raise NotImplementedError

    def start(self, *parts: str) -> None:
        for name in parts or [part for part in self._setups if kind_of(part) != ROBOT]:
            self._start(name)

    def _start(self, name: str) -> None:
        """Start the part, or start it again if it has ended, and wait until it is ready."""
        raise NotImplementedError

    def set_link(self, server: str | None = None, **changes: Any) -> dict[str, Any]:
        first, *_ = [relay.set_link(changes) for relay in self._links(server)]
        return first

    def begin_recording(self, server: str) -> None:
        self._links(server)[0].begin_recording()

    def link(self, server: str = CLOUD) -> dict[str, Any]:
        return self._links(server)[0].link()

    def reset(self, server: str | None = None) -> None:
        for relay in self._links(server):
            relay.reset()

    def _links(self, server: str | None) -> list[RelayClient]:
        """The relay of a server, or all relays."""
        servers = servers_among(self._setups) if server is None else (server,)
        for one in servers:
            assert one in self._relays, f"{relay_of(one)} was not started"
        return [self._relays[one] for one in servers]

    def _log(self, name: str) -> Path:
        return self.out / "logs" / f"{name}.log"


class Output(threading.Thread):
    """Copies `chunks` until they end: to the file `log`, or to our stdout if `log` is None.

    `again` appends to an existing log instead of replacing it.
    """

    def __init__(self, name: str, chunks: Iterator[bytes], log: Path | None, *, again: bool = False) -> None:
        super().__init__(name=f"output of {name}", daemon=True)
        self.log = log
        self._chunks = chunks
        self._last = b""
        if log is not None:
            log.parent.mkdir(parents=True, exist_ok=True)
            log.open("ab" if again else "wb").close()

    def run(self) -> None:
        text = codecs.getincrementaldecoder("utf-8")("replace")
        for chunk in self._chunks:
            self._last = (self._last + chunk)[-TAIL_BYTES:]
            with contextlib.suppress(OSError, ValueError):  # after a full disk or a closed stdout, read on
                if self.log is None:
                    sys.stdout.write(text.decode(chunk))
                    sys.stdout.flush()
                else:
                    with self.log.open("ab") as file:
                        file.write(chunk)

    def finish(self) -> None:
        """Wait for the last output of a part that has ended, at most END_S."""
        self.join(END_S)

    def tail(self) -> str:
        return last_lines(self._last)


def last_lines(output: bytes) -> str:
    return "\n".join(output.decode(errors="replace").splitlines()[-TAIL_LINES:]) or "(it logged nothing)"


def poll_until_ready(
    name: str,
    ready: Callable[[], bool],
    exit_code: Callable[[], int | None],
    *,
    tail: Callable[[], str],
    log: object,
    timeout_s: float,
) -> None:
    """Wait until the part `name` is ready, which it is not while `ready` raises OffloadError.

    If it ends before, or takes too long, the error contains the end of its log.
    """
    end_s = time.monotonic() + timeout_s
    while (code := exit_code()) is None:
        with contextlib.suppress(OffloadError):
            if ready():
                return
        if time.monotonic() > end_s:
            raise OffloadError(f"{name} was not ready within {timeout_s:g} s; its log ends with:\n{tail()}")
        time.sleep(POLL_S)
    if code == USAGE_EXIT:
        raise ConfigError(tail())
    raise OffloadError(f"{name} ended during start with exit code {code}; {log} ends with:\n{tail()}")


def leave(number: int, _frame: FrameType | None) -> NoReturn:
    """Handler for SIGTERM: raises SystemExit, so that `with` blocks end what they started."""
    raise SystemExit(128 + number)


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the end of the block. Children would inherit it if they were blocked."""
    kept: list[int] = []
    before = {number: signal.signal(number, lambda n, _: kept.append(n)) for number in INTERRUPTS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for interrupt in set(kept):
            signal.raise_signal(interrupt)
