"""Digests of everything that a run depends on: if both are unchanged, the run need not be played again.

`compare/runs` compares them with those in the summary of an earlier run.
"""

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

# The packages that the parts of a testbed load.
PARTS = (
    "offboard.common",
    "offboard.robot_client",
    "offboard.cloud_server",
    "offboard.loadgen.relay",
    "offboard.loadgen.rivals",
    "offboard.loadgen.robot",
)


def digests(scenario: Scenario) -> dict[str, str]:
    """Both digests, under their names in summary.json."""
    return {"scenario_sha256": of_scenario(scenario), "software_sha256": of_software(scenario)}


def of_scenario(scenario: Scenario) -> str:
    """The digest of everything that decides what is played. Files count by their content.

    The text `about` and the checks do not count.
    """
    settings = asdict(replace(scenario, about="", checks=()))
    workload = settings["workload"]
    workload["sizes"] = [Path(text) if text.endswith(".csv") else text for text in workload["sizes"]]
    return hashlib.sha256(json.dumps(settings, sort_keys=True, default=_of_file).encode()).hexdigest()


def of_software(scenario: Scenario) -> str:
    """The digest of the source that robot, server and relay load. The test bench itself does not count."""
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
    named = (scenario.workload.task, scenario.workload.inputs)
    for module in dict.fromkeys(name.partition(":")[0] for name in named if name is not None):
        with contextlib.suppress(ModuleNotFoundError):  # the parts report it when they start
            spec = find_spec(module)
            if spec is not None and spec.origin is not None:
                yield Path(spec.origin)


def _of_file(path: Any) -> str:
    """The digest of a file of the scenario; that of a map covers its cells, which are in another file."""
    assert isinstance(path, Path), path
    if path.suffix not in (".yaml", ".yml", ".map"):
        return hashlib.sha256(path.read_bytes()).hexdigest()
    grid = read_map(path)
    about = f"{grid.cells.shape} {grid.resolution} {grid.origin}"
    return hashlib.sha256(about.encode() + grid.cells.tobytes()).hexdigest()
