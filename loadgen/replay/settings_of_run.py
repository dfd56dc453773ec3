"""With which window, predictor and objective the robot of a trace decided, by the summary of the run."""

import json
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

from offboard.common.errors import ConfigError, DataError
from offboard.loadgen import rivals
from offboard.loadgen.robot_files import SUMMARY
from offboard.robot_client.policies import objectives
from offboard.robot_client.policies.objectives import MEAN, Energy, Objective
from offboard.robot_client.predictors.window import WINDOW_MAX

ENERGY = tuple(field.name for field in fields(Energy))


class DecidedBy(NamedTuple):
    """The objective of a run, with what it needs, and what a joule was estimated from."""

    objective: str = MEAN
    deadline_s: float | None = None
    s_per_joule: float | None = None
    s_per_megabyte: float | None = None
    energy: Energy = Energy()

    def make(self, name: str | None = None) -> Objective:
        """The objective with this name, or that of the run; ConfigError if its setting is unknown."""
        return objectives.make(
            name or self.objective,
            deadline_s=self.deadline_s,
            s_per_joule=self.s_per_joule,
            s_per_megabyte=self.s_per_megabyte,
        )


class SettingsOfRun(NamedTuple):
    """None: unknown; of the predictor also: the one that the policy brings."""

    window: int | None = None
    predictor: str | None = None
    decided_by: DecidedBy = DecidedBy()


def settings_of_run(trace: Path) -> SettingsOfRun:
    """What the summary next to a trace says; nothing is known of a dataset or of a trace without summary."""
    path = trace.with_name(SUMMARY)
    if trace.suffix != ".jsonl" or not path.is_file():
        return SettingsOfRun()
    try:
        summary = json.loads(path.read_text(encoding="utf-8"))
        window, predictor = summary.get("window"), summary.get("predictor")
        decided_by = dict(summary.get("decided_by", {}))
    except (OSError, ValueError, RecursionError, AttributeError, TypeError) as error:
        raise DataError(f"{path}: no summary of a run: {error}") from error
    if window is not None and not _is_length(window):
        raise DataError(f"{path}: window: {window!r} is not a whole number from 2 to {WINDOW_MAX}")
    if predictor is not None:
        rivals.predictor(str(predictor), f"{path}: predictor")
    return SettingsOfRun(window, predictor, _decided_by(path, decided_by))


def _decided_by(path: Path, named: dict[str, Any]) -> DecidedBy:
    try:
        energy = Energy(**{name: named.pop(name) for name in ENERGY if name in named})
        found = DecidedBy(**named, energy=energy)
        found.make()
    except (ConfigError, TypeError) as error:
        raise DataError(f"{path}: decided_by: {error}") from error
    return found


def _is_length(window: Any) -> bool:
    return type(window) is int and 2 <= window <= WINDOW_MAX
