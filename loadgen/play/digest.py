"""What a run depends on as two digests: where they are equal it need not be played again."""

import contextlib
import hashlib
import json
from collections.abc import Iterator
from dataclasses import asdict, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from offboard.common.planning.map_files import read_map
from offboard.loadgen.scenario.scenario import Scenario

PARTS = (
    "offboard.common",
    "offboard.robot_client",
    "offboard.cloud_server",
    "offboard.loadgen.relay",
)  # what the parts of a testbed run


def digests(scenario: Scenario) -> dict[str, str]:
    """Both, under the names that they have in summary.json."""
    return {"scenario_sha256": of_scenario(scenario), "software_sha256": of_software(scenario)}


def of_scenario(scenario: Scenario) -> str:
    """Of all that decides what is played, files by their content; what is said and checked of it is not."""
    settings = asdict(replace(scenario, about="", checks=()))
    workload = settings["workload"]
    workload["sizes"] = [Path(text) if text.endswith(".csv") else text for text in workload["sizes"]]
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=_of_file).encode()).hexdigest()


def of_software(scenario: Scenario) -> str:
    """Of the source of all that robot, server and relay load; the bench itself may change meanwhile."""
    digest = hashlib.sha256()
    for path in _sources(scenario):
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _sources(scenario: Scenario) -> Iterator[Path]:
    for name in PARTS:
        spec = find_spec(name)
        assert spec is not None, f"{name} is installed with us"
        for folder in spec.submodule_search_locations or ():
            yield from sorted(Path(folder).rglob("*.py"))
    if scenario.workload.task is not None:
        with contextlib.suppress(ModuleNotFoundError):  # the parts will say so
            spec = find_spec(scenario.workload.task.partition(":")[0])
            if spec is not None and spec.origin is not None:
                yield Path(spec.origin)


def _of_file(path: Any) -> str:
    """Of a file that a scenario names; of a map the cells, which are in a file beside it."""
    assert isinstance(path, Path), path
    if path.suffix not in (".yaml", ".yml", ".map"):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    grid = read_map(path)
    about = f"{grid.cells.shape} {grid.resolution} {grid.origin}"
    return hashlib.sha256(about.encode() + grid.cells.tobytes()).hexdigest()
