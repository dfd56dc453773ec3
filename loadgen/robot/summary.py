"""What a run says about its tasks: one line for each as it goes, and the summary at its end.

The records that are summed up come from the offloader.
"""

import statistics
from array import array
from collections.abc import Sequence

from offboard.common.wording import duration
from offboard.robot_client.policies.reason import show_size
from offboard.robot_client.records.record import Record
from offboard.robot_client.sites.runner import ONBOARD

PROGRESS_EVERY = 10  # tasks
LATE_S = 0.01  # a task that starts later than this counts as late


class Summary:
    """Sums up a run. It keeps two floats per task, in arrays, because runs may be long.

    `found` is what a good answer brings, such as a path (None: nothing to say). `due` is true if the tasks
    had instants at which they should start.
    """

    def __init__(self, *, found: str | None, due: bool) -> None:
        self._found = found
        self._due = due
        self._got = 0
        self._failed = 0
        self._late = array("d")  # seconds after the due instant
        # Seconds onboard and on the fastest other site.
        self._both: list[tuple[float | None, float | None]] = []
        self._waited: dict[str, array[float]] = {}  # seconds by the chosen site
        self._fallbacks = 0
        self._seconds = 0  # tasks that also ran on a second site

    def add(self, record: Record, *, got: bool, late_s: float = 0.0) -> None:
        self._got += got
        self._late.append(late_s)
        if record.decision.both:
            good = {one.site: one.seconds for one in record.executions if one.ok}
            onboard = good.pop(ONBOARD, None)
            self._both.append((onboard, min(good.values(), default=None)))
        else:
            self._waited.setdefault(record.decision.site, array("d")).append(record.waited_s)
            ran = [one.site for one in record.executions]
            second = record.decision.second
            twice = second is not None and second.site in ran
            self._seconds += twice
            self._fallbacks += len(ran) > 1 and not twice

    def add_failure(self, *, late_s: float = 0.0) -> None:
        self._failed += 1
        self._late.append(late_s)

    def lines(self) -> list[str]:
        chosen = sum(map(len, self._waited.values()))
        found = f"; {self._found} for {self._got}" if self._found else ""
        failed = f"; {self._failed} failed" if self._failed else ""
        lines = [f"{len(self._both) + chosen} tasks answered{found}{failed}"]
        if self._both:
            lines.append(f"run on both sites: {len(self._both)}; {_both_times(self._both)}")
        if chosen:
            lines.append(f"run on the chosen site: {chosen} ({self._shares(chosen)}); {self._times()}")
        if self._due and self._late:
            lines.append(self._lateness())
        return lines

    def _shares(self, chosen: int) -> str:
        return ", ".join(f"{site} {len(self._waited[site]) / chosen:.0%}" for site in sorted(self._waited))

    def _times(self) -> str:
        waited = [seconds for times in self._waited.values() for seconds in times]
        mean = duration(statistics.fmean(waited))
        twice = f"; {self._seconds} also ran on the second site" if self._seconds else ""
        return f"mean {mean}, P95 {duration(_p95(waited))}; {self._fallbacks} fell back {ONBOARD}{twice}"

    def _lateness(self) -> str:
        late = sum(late_s > LATE_S for late_s in self._late)
        return (
            f"started over {duration(LATE_S)} after they were due: {late} of {len(self._late)} tasks; "
            f"P95 of the delay: {duration(_p95(self._late))}"
        )


def describe(record: Record) -> str:
    """One decision in one line."""
    took = ", ".join(
        f"{one.site} {duration(one.seconds)}" if one.ok else f"{one.site} {one.error}"
        for one in record.executions
    )
    return f"size {show_size(record.size, '.2f')} -> {took} ({record.decision.reason})"


def _p95(values: Sequence[float]) -> float:
    return sorted(values)[min(len(values) - 1, int(0.95 * len(values)))]


def _both_times(times: list[tuple[float | None, float | None]]) -> str:
    pairs = [(onboard, other) for onboard, other in times if onboard is not None and other is not None]
    if not pairs:
        return "no answer from another site"
    onboard_mean, other_mean = (duration(statistics.fmean(column)) for column in zip(*pairs, strict=True))
    share = sum(onboard > other for onboard, other in pairs) / len(pairs)
    return f"cloud mean {other_mean}, onboard mean {onboard_mean}; the cloud was faster in {share:.0%}"
