"""The drive record: the settings and the map of a robot on a map, with which it can be driven again.

It is written before the first task, so it costs no task anything. `export/recording` drives again.
"""

import base64
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from offboard.common import VERSION as SOFTWARE
from offboard.common.errors import ConfigError, DataError
from offboard.common.planning.maps import CELLS_MAX, GridMap
from offboard.common.security.plain_files import replace_file
from offboard.loadgen.robot_files import drive_path, read_fields
from offboard.robot_client.records.lines import VERSION


@dataclass(frozen=True, slots=True, eq=False)
class DriveRecord:
    """What must be known to drive a robot again.

    settings: values by the names of the flags of `loadgen drive`.
    prior: the map as the robot plans on it.
    software: the version of Offboard that drove.
    """

    answers: Path
    settings: Mapping[str, Any]
    prior: GridMap
    software: str = SOFTWARE

    def write(self, trace: Path) -> None:
        """Write the record next to the trace."""
        path = drive_path(trace)
        record = {
            "v": VERSION,
            "software": self.software,
            "answers": os.path.relpath(self.answers, path.parent),
            "settings": dict(self.settings),
            "map": _map_fields(self.prior),
        }
        try:
            replace_file(path, json.dumps(record).encode() + b"\n")
        except OSError as error:
            raise ConfigError(f"drive record {path}: {error.strerror}") from error

    @classmethod
    def read(cls, trace: Path) -> "DriveRecord":
        """The record next to the trace; a DataError if it cannot be read."""
        path = drive_path(trace)
        record = next(read_fields(path, ("software", "answers", "settings", "map")), None)
        if record is None:
            raise DataError(f"{path}: there is no whole line in it")
        try:
            return cls(
                answers=path.parent / record["answers"],
                settings=dict(record["settings"]),
                prior=_map(record["map"]),
                software=str(record["software"]),
            )
        except (LookupError, TypeError, ValueError, zlib.error) as error:
            raise DataError(f"{path}: no drive record: {error!r}") from error


def _map_fields(grid: GridMap) -> dict[str, Any]:
    """The cells are int8, row by row, compressed by zlib, in Base64."""
    packed = zlib.compress(grid.cells.tobytes())
    return {
        "resolution": grid.resolution,
        "origin": grid.origin,
        "shape": grid.cells.shape,
        "cells": base64.b64encode(packed).decode(),
    }


def _map(fields: Mapping[str, Any]) -> GridMap:
    raw = zlib.decompressobj().decompress(base64.b64decode(fields["cells"]), CELLS_MAX)
    cells = np.frombuffer(raw, np.int8).reshape(fields["shape"])
    return GridMap(cells, fields["resolution"], tuple(fields["origin"]))
