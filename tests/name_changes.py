"""A name whose addresses change, for `run_alone`: two servers on loopback, and names from a file of ours.

`python -m tests.name_changes` prints the sites of the robot: at the start, with both addresses, and after the
first one has gone, with the site that then answers.
"""

import json
import subprocess
import tempfile
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path

from offboard.robot_client.offloader import Offloader
from offboard.robot_client.settings import Settings
from tests.cables import server
from tests.curves import until
from tests.probes import echo

PORT, NAME, START_S = 5555, "planners.test", 60.0
ADDRESSES = ("127.0.0.1", "127.0.0.2")


def main() -> None:
    with ExitStack() as stack:
        hosts = Path(stack.enter_context(tempfile.NamedTemporaryFile()).name)
        answer(hosts, ADDRESSES[:1])
        subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
        subprocess.run(["mount", "--bind", str(hosts), "/etc/hosts"], check=True)
        for address in ADDRESSES:
            stack.enter_context(server(f"tcp://{address}:{PORT}"))
        settings = Settings(reread_s=0.1, insecure=True)
        sites = {"planners": f"dns://{NAME}:{PORT}"}
        offload = stack.enter_context(Offloader.connect(sites=sites, settings=settings))
        assert offload.wait_for_sites(echo, START_S) == {}
        seen = [sorted(offload.expect(echo, 1))]
        answer(hosts, ADDRESSES)
        until(lambda: len(offload.expect(echo, 1)) == 3)
        assert offload.wait_for_sites(echo, START_S) == {}
        seen.append(sorted(offload.expect(echo, 1)))
        answer(hosts, ADDRESSES[1:])
        until(lambda: len(offload.expect(echo, 1)) == 2)
        seen.append(sorted(offload.expect(echo, 1)))
        assert offload(echo, 7, where="planners") == 7
        assert offload.last is not None
        print(json.dumps({"seen": seen, "used": offload.last.used}))


def answer(hosts: Path, addresses: Collection[str]) -> None:
    """Let the resolver answer with these addresses. The file is written in place, because it is mounted."""
    lines = ["127.0.0.1 localhost", *(f"{one} {NAME}" for one in addresses)]
    hosts.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
