"""The registration of `examples/`, whose scans cross the link with one point for each voxel.

The task makes such a voxel grid itself. `benchmarks.packing` measures both.
"""

from typing import Any

import numpy as np

from examples.registration import (
    STEP_M,
    VOXEL_M,
    Array,
    Known,
    Match,
    inputs,
    load_map,
    register_scan,
    same,
    work,
)
from offboard import task

__all__ = ["PLAIN", "inputs", "packed", "same"]

VOXEL_STEPS = round(VOXEL_M / STEP_M)
VOXELS_MAX = 1 << 20  # on one axis
PLAIN = register_scan


def to_voxels(scan: Array, guess: Array) -> list[Array]:
    """The first point of each voxel, in the order of the scan."""
    x, y, z = (scan // VOXEL_STEPS).astype(np.int64).T
    _, first = np.unique((x * VOXELS_MAX + y) * VOXELS_MAX + z, return_index=True)
    return [scan[np.sort(first)], guess]


def from_voxels(both: list[Array]) -> tuple[Any, ...]:
    return tuple(both)


@task(
    "register_scan_voxels",
    setup=load_map,
    size=lambda scan, _: len(scan),
    work=work,
    types=(Match,),
    pack=to_voxels,
    unpack=from_voxels,
)
def packed(known: Known, scan: Array, guess: Array) -> Match:
    """The pose from which a scan was taken."""
    return register_scan(known, scan, guess)
