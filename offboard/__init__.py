"""The entrance: the names that users import, as in `from offboard import Offloader, task`.

The names live in the packages next to this file; in a checkout those are the folders next to this one.
"""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from offboard.common import VERSION as __version__  # noqa: N811
    from offboard.common.errors import (
        BadValue,
        CloudBroken,
        CloudBusy,
        CloudError,
        CloudTimeout,
        ConfigError,
        DataError,
        DeadlineMissed,
        MissingExtra,
        OffloadError,
        ProtocolError,
        TaskError,
        TaskFailed,
        UnknownTask,
        Unwanted,
    )
    from offboard.common.tasks import task
    from offboard.common.wanted import check_wanted
    from offboard.robot_client.learning.savings import Savings
    from offboard.robot_client.offloader import Offloader
    from offboard.robot_client.policies import Decision, Forecast, Outlook
    from offboard.robot_client.policies.expectation import Expectation
    from offboard.robot_client.predictors import Prediction, Predictor
    from offboard.robot_client.records.record import Record
    from offboard.robot_client.records.trace import Trace
    from offboard.robot_client.settings import Settings
    from offboard.robot_client.sites.runner import Execution, Runner

__all__ = [
    "BadValue",
    "CloudBroken",
    "CloudBusy",
    "CloudError",
    "CloudTimeout",
    "ConfigError",
    "DataError",
    "DeadlineMissed",
    "Decision",
    "Execution",
    "Expectation",
    "Forecast",
    "MissingExtra",
    "OffloadError",
    "Offloader",
    "Outlook",
    "Prediction",
    "Predictor",
    "ProtocolError",
    "Record",
    "Runner",
    "Savings",
    "Settings",
    "TaskError",
    "TaskFailed",
    "Trace",
    "UnknownTask",
    "Unwanted",
    "__version__",
    "check_wanted",
    "task",
]

_HOMES = {
    "Decision": "robot_client.policies",
    "Execution": "robot_client.sites.runner",
    "Expectation": "robot_client.policies.expectation",
    "Forecast": "robot_client.policies",
    "Offloader": "robot_client.offloader",
    "Outlook": "robot_client.policies",
    "Prediction": "robot_client.predictors",
    "Predictor": "robot_client.predictors",
    "Record": "robot_client.records.record",
    "Runner": "robot_client.sites.runner",
    "Savings": "robot_client.learning.savings",
    "Settings": "robot_client.settings",
    "Trace": "robot_client.records.trace",
    "check_wanted": "common.wanted",
    "task": "common.tasks",
}
_ERRORS = "common.errors"  # the home of every other name

_here = Path(__file__).parent
if not (_here / "common").is_dir():  # a checkout; in the wheel, the packages are inside this folder
    __path__.append(str(_here.parent))


def __getattr__(name: str) -> Any:
    """Names are loaded when they are first used (PEP 562), so that `--help` stays fast."""
    if name == "__version__":
        found = importlib.import_module("offboard.common").VERSION
    elif name in __all__:
        home = importlib.import_module(f"offboard.{_HOMES.get(name, _ERRORS)}")
        found = getattr(home, name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
