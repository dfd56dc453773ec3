"""The entrance: the names that users import, as in `from offboard import Offloader, task`.

The names live in the packages inside this folder; in a checkout those are links to the folders next to it.
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
    from offboard.common.task_call import check_wanted
    from offboard.common.tasks import task
    from offboard.common.together import Together
    from offboard.robot_client.execution.call_future import CallFuture
    from offboard.robot_client.learning.savings import Savings
    from offboard.robot_client.offloader import Offloader
    from offboard.robot_client.policies import Decision, Forecast, Outlook
    from offboard.robot_client.policies.expectation import Expectation
    from offboard.robot_client.predictors import Prediction, Predictor
    from offboard.robot_client.records.record import Record
    from offboard.robot_client.records.trace import Trace
    from offboard.robot_client.settings import Settings
    from offboard.robot_client.sites.runner import Execution, Runner
    from offboard.robot_client.streams.action_stream import ActionStream, Step

__all__ = [
    "ActionStream",
    "BadValue",
    "CallFuture",
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
    "Step",
    "TaskError",
    "TaskFailed",
    "Together",
    "Trace",
    "UnknownTask",
    "Unwanted",
    "__version__",
    "check_wanted",
    "task",
]

_HOMES = {
    "ActionStream": "robot_client.streams.action_stream",
    "CallFuture": "robot_client.execution.call_future",
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
    "Step": "robot_client.streams.action_stream",
    "Trace": "robot_client.records.trace",
    "Together": "common.together",
    "check_wanted": "common.task_call",
    "task": "common.tasks",
}
_ERRORS = "common.errors"  # the home of every other name

_here = Path(__file__).parent
if not (_here / "common").is_dir():  # a copy of a checkout that has lost its links
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
