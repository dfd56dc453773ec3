"""The settings of `loadgen replay`, and those that the summary of a run has for it."""

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from offboard.common.config import check, setting
from offboard.common.errors import ConfigError, DataError
from offboard.loadgen import rivals
from offboard.loadgen.policy_name import split_objective
from offboard.loadgen.robot_files import SUMMARY
from offboard.loadgen.table.table_settings import MeasuredTimesConfig
from offboard.robot_client import policies
from offboard.robot_client.predictors.window import WINDOW, WINDOW_MAX
from offboard.robot_client.settings import ObjectiveOptions


@dataclass(frozen=True)
class ReplayConfig(MeasuredTimesConfig):
    """Which policies to replay, and with which predictor."""

    policies: tuple[str, ...] = setting(
        (*policies.names(), policies.DEFAULT),
        f"policies to replay: {policies.HELP}; POLICY+OBJECTIVE, such as default+p95, decides by another"
        " objective than the run",
        metavar="NAME,NAME,..",
    )
    predictor: str | None = setting(
        None,
        "predictor for all policies (default: that of the run, if its summary.json names one, or else the "
        f"one that each policy brings): {rivals.PREDICTOR_HELP}",
        metavar="NAME",
    )
    window: int | None = setting(
        None,
        "window length N; the first N rows are warm-up and are not scored (default: that of the run, if its "
        f"summary.json is next to the trace, or else {WINDOW})",
        minimum=2,
        maximum=WINDOW_MAX,
    )
    decided_by: ObjectiveOptions = ObjectiveOptions()

    def __post_init__(self) -> None:
        check(self)
        for policy in self.policies:
            split_objective(policy, "--policies")
        if self.predictor is not None:
            rivals.predictor(self.predictor, "--predictor")

    @property
    def length(self) -> int:
        return WINDOW if self.window is None else self.window

    def as_in_the_run(self, path: Path) -> "ReplayConfig":
        """With the objective of the run of this trace, and with its window and predictor if none are given.

        ConfigError if a policy has an objective that needs what the run does not say.
        """
        run = settings_of_run(path)
        for policy in self.policies:
            _, objective = split_objective(policy, "--policies")
            try:
                run.decided_by.make(objective)
            except ConfigError as error:
                raise ConfigError(f"--policies: {policy!r}: {error} in the summary of the run") from None
        return replace(
            self,
            window=self.window or run.window,
            predictor=self.predictor or run.predictor,
            decided_by=run.decided_by,
        )


class SettingsOfRun(NamedTuple):
    """How a robot decided. None: unknown; of the predictor also: the one that the policy brings."""

    window: int | None = None
    predictor: str | None = None
    decided_by: ObjectiveOptions = ObjectiveOptions()


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
    try:
        options = ObjectiveOptions(**decided_by)
        options.make()
    except (ConfigError, TypeError) as error:
        raise DataError(f"{path}: decided_by: {error}") from error
    return SettingsOfRun(window, predictor, options)


def _is_length(window: Any) -> bool:
    return type(window) is int and 2 <= window <= WINDOW_MAX
