"""`openpi-client`, with the Python of the environment that has it.

`client.py pack` prints each observation as openpi-client packs it, as JSON of base64 by name. `client.py talk
HOST PORT` sends each of them to a server.
"""

import base64
import json
import sys
from pathlib import Path

from openpi_client import msgpack_numpy
from openpi_client.websocket_client_policy import WebsocketClientPolicy

sys.path.insert(0, str(Path(__file__).parent))
from observations import observations


def pack() -> None:
    packed = {name: msgpack_numpy.Packer().pack(one) for name, one in observations().items()}
    print(json.dumps({name: base64.b64encode(data).decode() for name, data in packed.items()}))


def talk(host: str, port: str) -> None:
    policy = WebsocketClientPolicy(host, int(port))
    for one in observations().values():
        policy.infer(one)


if __name__ == "__main__":
    {"pack": pack, "talk": talk}[sys.argv[1]](*sys.argv[2:])
