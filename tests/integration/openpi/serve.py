"""A server of `policy-websocket`: `serve.py PORT`, with the Python of the environment that has it.

Its policy waits `delay_s` of the observation, and raises if the observation asks for it.
"""

import sys
import time
from typing import Any

import numpy as np
from policy_websocket import BasePolicy, WebsocketPolicyServer


class Doubling(BasePolicy):
    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        time.sleep(obs.get("delay_s", 0.0))
        if obs.get("fail"):
            raise ValueError("there is no gripper")
        return {"actions": np.asarray(obs["state"], np.float32) * 2, "by": "gpu"}


if __name__ == "__main__":
    WebsocketPolicyServer(Doubling(), host="127.0.0.1", port=int(sys.argv[1])).serve_forever()
