"""The calls of `calls` through openpi's client and the policy server of `policy-websocket`.

It runs with the Python of an environment that has both, because they need an old NumPy.
"""

import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy
from policy_websocket import BasePolicy, WebsocketPolicyServer

from benchmarks.caller import Call, answer_orders

READY_S, POLL_S = 30.0, 0.05


class Length(BasePolicy):
    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        return {"length": obs["image"].nbytes if "image" in obs else 0}


def connect(port: int) -> Call:
    policy = WebsocketClientPolicy("127.0.0.1", port)

    def call(array: "np.ndarray[Any, Any] | None") -> int:
        return int(policy.infer({} if array is None else {"image": array})["length"])

    return call


def main() -> None:
    """`openpi_peer serve PORT` is the server, `openpi_peer` a caller that starts it."""
    if sys.argv[1:]:
        WebsocketPolicyServer(Length(), host="127.0.0.1", port=int(sys.argv[2])).serve_forever()
        return
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = int(taken.getsockname()[1])
    server = subprocess.Popen([sys.executable, "-m", __spec__.name, "serve", str(port)])
    try:
        _wait_for(port)
        answer_orders(lambda: connect(port))
    finally:
        server.terminate()


def _wait_for(port: int) -> None:
    until_s = time.monotonic() + READY_S
    while True:
        try:
            socket.create_connection(("127.0.0.1", port)).close()
        except OSError:
            if time.monotonic() > until_s:
                raise
            time.sleep(POLL_S)
        else:
            return


if __name__ == "__main__":
    main()
