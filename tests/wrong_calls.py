"""Ten wrong calls of an offloader, each in a line. Mypy reads this file and must find them; it never runs."""

from offboard import Offloader
from tests.typed_calls import count, detect


async def calls(offload: Offloader) -> None:
    offload(count)
    offload(count, "5")
    offload(count, 5, size=2.0)
    offload(detect, 1, b"frame")  # the setup gives the first argument
    offload(detect)
    offload.call(count, 5, 2.0, 3)
    offload.call(detect, "frame")
    offload.submit(count, scale=2.0)
    offload.submit(count, 5, timeout=1.0)
    await offload.run(count, None)
