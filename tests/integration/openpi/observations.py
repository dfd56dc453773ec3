"""Observations with every sort of value that `openpi-client` can send. Any version of NumPy will do."""

from typing import Any

import numpy as np


def observations() -> dict[str, Any]:
    """Observations by what is special about them; the same in every process."""
    random = np.random.default_rng(7)
    grid = np.arange(24, dtype=np.int16).reshape(4, 6)
    return {
        "droid": {
            "observation/exterior_image_1_left": random.integers(0, 255, (224, 224, 3), np.uint8),
            "observation/joint_position": random.normal(size=7),
            "observation/gripper_position": np.float32([0.5]),
            "prompt": "open the drawer",
        },
        "numbers": {"float32": np.float32(1.5), "float64": np.float64(2.5), "int64": np.int64(-3)},
        "more numbers": {"bool": np.bool_(True), "uint8": np.uint8(200), "float16": np.float16(0.1)},
        "plain": {"none": None, "yes": True, "whole": 2**40, "float": 0.1, "bytes": b"\x00\xff", "text": "ü"},
        "nested": {"list": [1, [2, {"deep": np.zeros(3)}]], "tuple": (1, 2), "empty": {}, "7": []},
        "whole keys": {1: "one", 2: np.ones(2, np.int32)},
        "views": {"strided": grid[::2, 1::2], "fortran": np.asfortranarray(grid), "flat": grid.T},
        "shapes": {
            "none": np.zeros((0, 3)),
            "zero-dimensional": np.array(4.0),
            "big endian": grid.astype(">i4"),
        },
        "texts": {
            "array": np.array(["asdf", "q"]),
            "scalar": np.str_("word"),
            "bytes": np.array([b"ab", b"c"]),
        },
        "not numbers": np.array([np.nan, np.inf, -np.inf]),
    }
