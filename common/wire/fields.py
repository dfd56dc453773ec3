"""Checks the fields of a message header, which may come from anyone."""

import math
from typing import Any

from offboard.common.errors import ProtocolError
from offboard.common.tasks import KINDS_MAX, NAME_LENGTH_MAX
from offboard.common.wire.values import BLOBS_MAX

TEXT_LENGTH_MAX = 128  # of a software version or a source hash
WORDS_MAX = 16
SECONDS_MAX = 1e6
DIGEST_BYTES = 32
IDLE = {"load": 0.0, "capacity": 1.0}  # values of an idle server; they are not sent


class Fields:
    """The fields of one message. Each method returns a checked value, or raises a ProtocolError."""

    def __init__(self, message: str, values: dict[Any, Any]) -> None:
        self.message = message
        self.values = values

    def whole(self, name: str, low: int, high: int) -> int:
        value = self.values.get(name)
        if type(value) is not int or not low <= value <= high:
            raise self.wrong(name, f"a whole number {low} to {high}")
        return value

    def seconds(self, name: str) -> float:
        value: Any = self.values.get(name)
        if type(value) not in (int, float) or not (math.isfinite(value) and 0 <= value <= SECONDS_MAX):
            raise self.wrong(name, f"a number 0 to {SECONDS_MAX:g}")
        return float(value)

    def share(self, name: str) -> float:
        value: Any = self.values.get(name, IDLE[name])
        if type(value) not in (int, float) or not 0 <= value <= 1 or (name == "capacity" and not value):
            raise self.wrong(name, f"a share {'above ' if name == 'capacity' else ''}0 to 1")
        return float(value)

    def text(self, name: str, length_max: int) -> str:
        value = self.values.get(name)
        if not isinstance(value, str) or len(value) > length_max:
            raise self.wrong(name, f"a text of at most {length_max} characters")
        return value

    def flag(self, name: str) -> bool:
        value = self.values.get(name)
        if type(value) is not bool:
            raise self.wrong(name, "true or false")
        return value

    def digests(self, name: str) -> tuple[bytes, ...]:
        value = self.values.get(name)
        if not isinstance(value, list) or len(value) > BLOBS_MAX:
            raise self.wrong(name, f"a list of at most {BLOBS_MAX} digests")
        if not value:
            return ()
        if not all(isinstance(item, bytes) and len(item) == DIGEST_BYTES for item in value):
            raise self.wrong(name, f"a list of digests of {DIGEST_BYTES} bytes")
        return tuple(value)

    def words(self, name: str) -> tuple[str, ...]:
        value = self.values.get(name, [])
        if not isinstance(value, list) or len(value) > WORDS_MAX:
            raise self.wrong(name, f"a list of at most {WORDS_MAX} texts")
        if not all(isinstance(item, str) and len(item) <= TEXT_LENGTH_MAX for item in value):
            raise self.wrong(name, f"a list of texts of at most {TEXT_LENGTH_MAX} characters")
        return tuple(value)

    def tasks(self, name: str) -> dict[str, str]:
        value = self.values.get(name)
        if not isinstance(value, dict) or len(value) > KINDS_MAX:
            raise self.wrong(name, f"a map of at most {KINDS_MAX} tasks")
        for key, text in value.items():
            if not (isinstance(key, str) and 0 < len(key) <= NAME_LENGTH_MAX):
                raise self.wrong(name, f"a map of names of 1 to {NAME_LENGTH_MAX} characters")
            if not (isinstance(text, str) and len(text) <= TEXT_LENGTH_MAX):
                raise self.wrong(name, f"a map to texts of at most {TEXT_LENGTH_MAX} characters")
        return value

    def wrong(self, name: str, allowed: str) -> ProtocolError:
        return ProtocolError(f"{self.message}.{name} is {self.values.get(name)!r:.80}; it must be {allowed}")
