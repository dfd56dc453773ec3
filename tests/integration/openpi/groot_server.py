"""A server that speaks the protocol of GR00T: `groot_server.py PORT npy|maps [TOKEN]`.

It was written from the description of the protocol (gr00t/policy/server_client.py), as the package of GR00T
needs CUDA. Its policy doubles the state. `bad` in an observation asks for an answer that is none.
"""

import io
import sys
import time
from typing import Any

import msgpack
import numpy as np
import zmq


def npy(array: "np.ndarray[Any, Any]", *, pickled: bool = False) -> dict[str, Any]:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=pickled)
    return {"__ndarray_class__": True, "as_npy": file.getvalue()}


def as_map(array: "np.ndarray[Any, Any]") -> dict[bytes, Any]:
    return {
        b"nd": True,
        b"type": array.dtype.str,
        b"kind": b"",
        b"shape": array.shape,
        b"data": array.tobytes(),
    }


def array_of(tree: Any, dialect: str) -> "np.ndarray[Any, Any]":
    if dialect == "npy":
        found: np.ndarray[Any, Any] = np.load(io.BytesIO(tree["as_npy"]), allow_pickle=False)
        return found
    return np.frombuffer(tree[b"data"], tree[b"type"]).reshape(tree[b"shape"])


HEADER = b"\x93NUMPY\x02\x00\xff\xff\xff\x3f" + b" " * 2000
BAD = {
    "object": lambda: npy(np.array([{"a": 1}], object), pickled=True),
    "header": lambda: {"__ndarray_class__": True, "as_npy": HEADER},
    "length": lambda: {"__ndarray_class__": True, "as_npy": npy(np.zeros(100))["as_npy"][:-8]},
    "shape": lambda: {
        "__ndarray_class__": True,
        "as_npy": npy(np.zeros(8))["as_npy"].replace(b"(8,), ", b"(9**9,)"),
    },
    "dtype": lambda: as_map(np.array([1 + 2j])),
    "map object": lambda: {b"nd": True, b"type": "|O", b"kind": b"O", b"shape": (1,), b"data": b"x"},
    "nan": lambda: npy(np.array([0.0, np.nan])),
    "items": lambda: [{}] * 999_000,
    "large": lambda: npy(np.zeros(100_000_000, np.uint8)),
}


def act(request: dict[str, Any], dialect: str) -> Any:
    observation = request["data"]["observation"]
    time.sleep(observation.get("delay_s", 0.0))
    if observation.get("fail"):
        raise ValueError("there is no gripper")
    if (bad := observation.get("bad")) is not None:
        return [{"action": BAD[bad]()}, {}]
    action = array_of(observation["state"], dialect).astype(np.float32) * 2
    return [
        {"action": (npy if dialect == "npy" else as_map)(action)},
        {"options": request["data"]["options"]},
    ]


def main(port: str, dialect: str, token: str | None = None) -> None:
    socket = zmq.Context().socket(zmq.REP)
    socket.bind(f"tcp://127.0.0.1:{port}")
    resets = 0
    while True:
        request = msgpack.unpackb(socket.recv())
        answer: Any
        try:
            if token is not None and request.get("api_token") != token:
                answer = {"error": "Unauthorized: Invalid API token"}
            elif request["endpoint"] == "ping":
                answer = {"status": "ok", "message": "Server is running"}
            elif request["endpoint"] == "reset":
                resets += 1
                answer = {"resets": resets}
            elif request["endpoint"] == "get_modality_config":
                answer = {"state": {"delta_indices": [0]}}
            else:
                answer = act(request, dialect)
        except Exception as error:  # noqa: BLE001 - as the reference does
            answer = {"error": str(error)}
        socket.send(msgpack.packb(answer))


if __name__ == "__main__":
    main(*sys.argv[1:])
