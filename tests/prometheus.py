"""Questions to a running Prometheus."""

import json
import time
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

WAIT_S, POLL_S = 60.0, 0.2


@dataclass(frozen=True)
class Prometheus:
    """A running Prometheus at `address` (HOST:PORT)."""

    address: str

    def ask(self, path: str, **query: str) -> Any:
        url = f"http://{self.address}/api/v1/{path}?{urllib.parse.urlencode(query)}"
        with urllib.request.urlopen(url, timeout=5) as answer:
            return json.load(answer)["data"]

    def answers(self, expression: str) -> bool:
        """Whether it is up and an expression has a value."""
        try:
            return self.values(expression) != []
        except OSError:
            return False

    def values(self, expression: str) -> list[float]:
        """The present values of an expression, one for each series."""
        return [float(one["value"][1]) for one in self.ask("query", query=expression)["result"]]

    def firing(self) -> dict[str, dict[str, str]]:
        """The labels of each alert that fires, by its name."""
        alerts = [one for one in self.ask("alerts")["alerts"] if one["state"] == "firing"]
        return {one["labels"]["alertname"]: one["labels"] for one in alerts}


def until(fact: Callable[[], Any], what: str) -> float:
    """Wait until `fact` is true; return how long that took, in seconds."""
    start_s = time.monotonic()
    while not fact():
        assert time.monotonic() < start_s + WAIT_S, f"not within {WAIT_S:g} s: {what}"
        time.sleep(POLL_S)
    return time.monotonic() - start_s
