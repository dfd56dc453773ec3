"""The outcome of one step of a check, and how it is printed."""

from dataclasses import dataclass

OK, FAIL, SKIP = "ok", "FAIL", "skip"


@dataclass(frozen=True, slots=True)
class Line:
    """The outcome of one step: its status is OK, FAIL or SKIP."""

    status: str
    step: str
    text: str = ""

    def __str__(self) -> str:
        return f"{self.status:<5} {self.step:<16}  {self.text}".rstrip()


class StepFailed(Exception):
    """A step found something wrong; `remedy` says what the user can do about it."""

    def __init__(self, wrong: str, remedy: str) -> None:
        super().__init__(f"{wrong}; remedy: {remedy}")
