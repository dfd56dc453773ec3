"""Decides where a task runs, runs it, learns, and writes down what happened."""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from common.tasks import task
    from robot_client.offloader import Offloader
    from robot_client.policies import Decision, Forecast, Outlook
    from robot_client.predictors import Prediction, Predictor
    from robot_client.runner import Execution, Runner
    from robot_client.trace import Record, Trace

__all__ = [
    "Decision",
    "Execution",
    "Forecast",
    "Offloader",
    "Outlook",
    "Prediction",
    "Predictor",
    "Record",
    "Runner",
    "Trace",
    "task",
]

_HOMES = {
    "Decision": "robot_client.policies",
    "Execution": "robot_client.runner",
    "Forecast": "robot_client.policies",
    "Offloader": "robot_client.offloader",
    "Outlook": "robot_client.policies",
    "Prediction": "robot_client.predictors",
    "Predictor": "robot_client.predictors",
    "Record": "robot_client.trace",
    "Runner": "robot_client.runner",
    "Trace": "robot_client.trace",
    "task": "common.tasks",
}


def __getattr__(name: str) -> Any:
    """Loads a name when it is first asked for (PEP 562): `--help` of the commands needs none of them."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(_HOMES[name]), name)
    return found
