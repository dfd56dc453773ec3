"""With which window and predictor the robot of a trace learnt, by the summary of the run."""

import json
from pathlib import Path
from typing import Any, NamedTuple

from offboard.common.errors import DataError
from offboard.loadgen import rivals
from offboard.loadgen.robot_files import SUMMARY
from offboard.robot_client.predictors.window import WINDOW_MAX


class SettingsOfRun(NamedTuple):
    """None: unknown; of the predictor also: the one that the policy brings."""

    window: int | None = None
    predictor: str | None = None


def settings_of_run(trace: Path) -> SettingsOfRun:
    """What the summary next to a trace says; nothing is known of a dataset or of a trace without summary."""
    path = trace.with_name(SUMMARY)
    if trace.suffix != ".jsonl" or not path.is_file():
        return SettingsOfRun()
    try:
        fields = json.loads(path.read_text(encoding="utf-8"))
        window, predictor = fields.get("window"), fields.get("predictor")
    except (OSError, ValueError, AttributeError) as error:
        raise DataError(f"{path}: no summary of a run: {error}") from error
    if window is not None and not _is_length(window):
        raise DataError(f"{path}: window: {window!r} is not a whole number from 2 to {WINDOW_MAX}")
    if predictor is not None:
        rivals.predictor(str(predictor), f"{path}: predictor")
    return SettingsOfRun(window, predictor)


def _is_length(window: Any) -> bool:
    return type(window) is int and 2 <= window <= WINDOW_MAX
