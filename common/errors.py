"""Every error the project raises by name; who catches each one is said beside it."""


class OffloadError(Exception):
    """Base of all errors raised by Offboard."""


def describe(error: BaseException) -> str:
    """`Type: text` of any exception, also of one that cannot say its own text."""
    try:
        return f"{type(error).__name__}: {error}"
    except Exception:  # noqa: BLE001 - a user's __str__ may raise anything
        return f"{type(error).__name__}: (it has no readable text)"


class ConfigError(OffloadError):
    """A setting, flag or input file is wrong; the process ends with exit code 2."""


class MissingExtra(ConfigError):
    """An optional library is absent; the message names the extra to install."""

    def __init__(self, what: str, extra: str) -> None:
        super().__init__(f"{what} needs the extra '{extra}': pip install 'offboard[{extra}]'")


class DataError(OffloadError):
    """A map, trace or scenario is wrong; names file and line; exit code 2."""


class TaskError(OffloadError):
    """The task's own fault: the same on every site, raised to the caller once, never retried."""


class UnknownTask(TaskError):
    """No task of this kind is registered."""


class TaskFailed(TaskError):
    """The task's function raised; the message carries the type and text of what it raised."""


class BadValue(TaskError):
    """An argument or result cannot cross the wire."""


class CloudError(OffloadError):
    """A site gave no answer; the task runs onboard and the lost time is learnt."""


class CloudTimeout(CloudError):
    """No answer within the task's budget."""


class CloudBusy(CloudError):
    """The server's queue was full, or the budget was over before the task could start."""


class Overtaken(CloudError):
    """Another site answered first; how long this one would have taken is not known."""


class CloudBroken(CloudError):
    """The connection was lost, or the server cannot run this task."""


class Unwanted(OffloadError):
    """Raised within a task whose answer was given up meanwhile."""


class ProtocolError(OffloadError):
    """Bytes that are not ours; logged, counted, dropped."""
