"""Decides where a task runs, runs it, learns, and writes down what happened."""

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
