"""All errors that Offboard raises, and what happens when each one is caught."""

import threading
from collections.abc import Mapping
from typing import Any


class OffloadError(Exception):
    """Base of all errors raised by Offboard.

    `record` is that of the call that raised it; None if the call did not get so far.
    """

    record: Any = None


def describe(error: BaseException) -> str:
    """`Type: text` of any exception, even if its text cannot be read."""
    try:
        return f"{type(error).__name__}: {error}"
    except BaseException as unreadable:  # a user's __str__ may raise anything
        if is_interrupt(unreadable):
            raise
        name = type.__dict__["__name__"].__get__(type(error))  # its own class may hide it
        return f"{name}: (it has no readable text)"


def of_task(kind: str, text: str) -> str:
    """The text of an error, with the name of the task in front unless the text has it."""
    return text if f"task {kind}" in text else f"task {kind}: {text}"


def is_interrupt(error: BaseException) -> bool:
    """Whether this may be the Ctrl-C of a user, which Python raises in the main thread."""
    in_main = threading.current_thread() is threading.main_thread()
    return isinstance(error, KeyboardInterrupt) and in_main


class ConfigError(OffloadError):
    """A setting, flag or input file is wrong. The process ends with exit code 2."""


class MissingExtra(ConfigError):
    """An optional library is missing. The message names the extra to install."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(
            f"{what} needs the extra '{extra}': run pip install '.[{extra}]' in a checkout of Offboard"
        )


class DataError(OffloadError):
    """A map, trace or scenario is wrong. The message names file and line; exit code 2."""


class TaskError(OffloadError):
    """The task is at fault, on every site. It is raised to the caller once and never retried."""


class UnknownTask(TaskError):
    """No task of this kind is registered."""


class TaskFailed(TaskError):
    """The function of the task raised an exception. The message has its type and text.

    `traceback` is its traceback on the site where it ran, at most 4,000 characters; empty if it is unknown.
    """

    def __init__(self, message: str, traceback: str = "") -> None:
        super().__init__(message)
        self.traceback = traceback


class BadValue(TaskError):
    """A value cannot be sent, or an input size is none. A call raises it for the size only."""


class DeadlineMissed(OffloadError):
    """A call with `deadline_s` had no answer in time. A task that has begun runs to its end and is learnt.

    `expected` is what was expected of each site when the call began: an `Expectation` by site. `record` says
    what had happened by the deadline; observers get another one with the same id when the task has ended.
    """

    def __init__(self, message: str, expected: Mapping[str, Any]) -> None:
        super().__init__(message)
        self.expected = expected


class CloudError(OffloadError):
    """A site gave no answer. The task runs onboard, and the lost time is learnt."""


class CloudTimeout(CloudError):
    """There was no answer within the budget of the task."""


class CloudBusy(CloudError):
    """The queue of the server was full, or the budget ended before the task could start."""


class Overtaken(CloudError):
    """Another site answered first, or nobody wants the answer. How long this site would take is unknown."""


class CloudBroken(CloudError):
    """The connection was lost, or the server cannot run this task."""


class CannotCross(CloudBroken):
    """The arguments or the result of this task cannot be sent, or not be read on the other side."""


class SiteClosed(CloudBroken):
    """The robot closed its connection to the site, which is not at fault: nothing is learnt of it."""


class Unwanted(OffloadError):
    """Raised inside a task, by `check_wanted`, if nobody waits for its answer any more."""


class ProtocolError(OffloadError):
    """Received bytes that are no valid message. They are logged, counted and dropped."""
