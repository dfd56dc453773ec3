"""The figures of an outcome, such as lost tasks, P95 or time over oracle, registered in `FIGURES` by name.

Which limits they must keep is up to `pass_fail_check`.
"""

import itertools
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from offboard.loadgen.scenario.outcome import Outcome, Reading, Step
from offboard.loadgen.table.table_two_figures import quantile
from offboard.loadgen.testbed.testbed import ROBOT
from offboard.robot_client.sites.runner import ONBOARD

GROWTH_FROM = 1 / 3  # share of the run that is left out: a process needs it to reach its usual size
SHARE = "cloud_percent"  # the figure that can be asked for one site
READINGS_MIN = 6  # readings of a part that are needed to tell whether it grows


@dataclass(frozen=True, slots=True)
class Figure:
    """One figure of an outcome: its unit, its meaning, and the function that computes it (None: undefined).

    `needs` names the setting of the workload that the figure cannot do without. `real`: only real processes
    have it, because a simulation computes no answers, and has no memory and no overhead.
    """

    unit: str
    about: str
    compute: Callable[[Outcome], float | None] = field(repr=False)
    needs: str | None = None
    real: bool = False


def _lost(run: Outcome) -> float:
    return sum(run.asked.values()) - len({(one.robot, one.i) for one in run.answered})


def _count(field: str) -> Callable[[Outcome], float]:
    """How many answers have something in this field."""
    return lambda run: sum(getattr(one, field) is not None for one in run.answered)


def _mean_ms(run: Outcome) -> float | None:
    return 1e3 * sum(one.response_s for one in run.answered) / len(run.answered) if run.answered else None


def _quantile_ms(percent: int) -> Callable[[Outcome], float | None]:
    def compute(run: Outcome) -> float | None:
        times = np.array([one.response_s for one in run.answered])
        return 1e3 * float(quantile(times, percent)) if len(times) else None

    return compute


def _percent(of: Callable[[Outcome], Sequence[bool]]) -> Callable[[Outcome], float | None]:
    def compute(run: Outcome) -> float | None:
        facts = of(run)
        return 100 * sum(facts) / len(facts) if facts else None

    return compute


def _late(run: Outcome) -> list[bool]:
    assert run.deadline_s is not None
    return [one.response_s > run.deadline_s for one in run.answered]


def _in_the_cloud(run: Outcome) -> list[bool]:
    return [one.chosen != ONBOARD for one in run.answered if one.chosen and not one.both]


def site_percent(run: Outcome, site: str) -> float | None:
    return _percent(lambda run: [one.chosen == site for one in run.answered if one.chosen and not one.both])(
        run
    )


def _probed(run: Outcome) -> list[bool]:
    return [one.probed for one in run.answered if one.chosen]


def _twice(run: Outcome) -> list[bool]:
    return [len(one.sites) > 1 for one in run.answered if one.sites]


def _right_site(run: Outcome) -> list[bool]:
    known = [one for one in run.references if len(one.seconds) > 1 and not one.both]
    return [one.chosen == min(one.seconds, key=one.seconds.__getitem__) for one in known]


def _time_over_oracle(run: Outcome) -> float | None:
    oracle_s = sum(one.oracle_s for one in run.references)
    return sum(one.sent_s for one in run.references) / oracle_s if oracle_s else None


def _wait_over_oracle(run: Outcome) -> float | None:
    waited_s = {one.i: one.response_s for one in run.answered if one.robot == ROBOT}
    known = [one for one in run.references if one.i in waited_s]
    oracle_s = sum(one.oracle_s for one in known)
    return sum(waited_s[one.i] for one in known) / oracle_s if oracle_s else None


def _regret_ms(run: Outcome) -> float | None:
    regrets = [one.sent_s - one.oracle_s for one in run.references]
    return 1e3 * sum(regrets) / len(regrets) if regrets else None


def _quality(run: Outcome) -> float | None:
    known = [one.quality for one in run.answered if one.quality is not None]
    return sum(known) / len(known) if known else None


def _cost(run: Outcome) -> float | None:
    return float(run.costing.over(np.array(run.costs()))) if run.answered else None


def _steps(run: Outcome) -> list[Step]:
    """The steps from the first fresh action on."""
    steps = [one.step for one in sorted(run.answered, key=lambda one: one.i) if one.step is not None]
    return list(itertools.dropwhile(lambda step: step.held, steps))


def _held(run: Outcome) -> list[bool]:
    return [step.held for step in _steps(run)]


def _age_ms(run: Outcome) -> float | None:
    ages = [step.age_s for step in _steps(run) if step.age_s is not None and not step.held]
    return 1e3 * sum(ages) / len(ages) if ages else None


def _seam(run: Outcome) -> float | None:
    seams = [step.seam for step in _steps(run) if step.seam is not None]
    return sum(seams) / len(seams) if seams else None


def _overhead_ms(run: Outcome) -> float | None:
    known = [one.overhead_s for one in run.answered if one.overhead_s is not None]
    return 1e3 * statistics.median(known) if known else None


def _overhead_percent(run: Outcome) -> float | None:
    known = [one for one in run.answered if one.overhead_s is not None]
    overhead_ms, mean_ms = _overhead_ms(run), _mean_ms(replace(run, answered=known))
    return 100 * overhead_ms / mean_ms if overhead_ms is not None and mean_ms else None


def _growth(of: Callable[[Reading], float]) -> Callable[[Outcome], float | None]:
    """Growth in percent of the part that grew most, from the first to the last third of its readings.

    Compares the medians of the two thirds, so that a single high reading is no growth.
    """

    def compute(run: Outcome) -> float | None:
        end_s = max((one.at_s for one in run.readings), default=0.0)
        grown = []
        for part in {one.part for one in run.readings}:
            mine = [of(one) for one in run.readings if one.part == part and one.at_s >= GROWTH_FROM * end_s]
            third = len(mine) // 3
            if len(mine) >= READINGS_MIN:
                first, last = statistics.median(mine[:third]), statistics.median(mine[-third:])
                grown.append(100 * (last / first - 1))
        return max(grown, default=None)

    return compute


FIGURES: dict[str, Figure] = {
    "lost": Figure("tasks", "tasks that were never answered", _lost),
    "wrong": Figure("tasks", "tasks with a wrong answer", _count("wrong"), "jump", real=True),
    "unverified": Figure(
        "tasks",
        "answers with unexpected bytes that are too large to be compared",
        _count("unverified"),
        "jump",
        real=True,
    ),
    "failed": Figure("tasks", "tasks that ended with an error", _count("error")),
    "mean_ms": Figure("ms", "mean time from when a task is due to its answer", _mean_ms),
    "p95_ms": Figure("ms", "95 % of the tasks are answered within this time", _quantile_ms(95)),
    "p99_ms": Figure("ms", "99 % of the tasks are answered within this time", _quantile_ms(99)),
    "late_percent": Figure("%", "tasks answered after their deadline", _percent(_late), "deadline_ms"),
    "quality": Figure("of 1", "mean quality of the variants that answered", _quality),
    "cost": Figure(
        "per task",
        "what the objective of the robot minimises: the mean time, the P95 of the time, the share of late"
        " tasks, or the mean time plus the value of joules and megabytes, in seconds",
        _cost,
    ),
    SHARE: Figure(
        "%", "share of the servers in the tasks that were sent to one site", _percent(_in_the_cloud)
    ),
    "probe_percent": Figure("%", "tasks that were probes of a second site", _percent(_probed)),
    "twice_percent": Figure("%", "tasks that ran on two sites", _percent(_twice)),
    "accuracy_percent": Figure(
        "%",
        "share of the reference tasks that were sent to the faster site",
        _percent(_right_site),
        "reference",
    ),
    "time_over_oracle": Figure(
        "",
        "time of the reference tasks on the chosen site, divided by their time on the faster site",
        _time_over_oracle,
        "reference",
    ),
    "wait_over_oracle": Figure(
        "",
        "time that the robot waited for the reference tasks, with hedges, divided by their time on the"
        " faster site",
        _wait_over_oracle,
        "reference",
    ),
    "regret_ms": Figure("ms", "mean time that the faster site would have saved", _regret_ms, "reference"),
    "empty_percent": Figure("%", "steps of a stream without a fresh action", _percent(_held), "stream"),
    "age_ms": Figure("ms", "mean time since the observation of a fresh action", _age_ms, "stream"),
    "seam": Figure(
        "",
        "mean over chunks of the largest change of one dimension from the last action to their first one",
        _seam,
        "stream",
    ),
    "overhead_ms": Figure(
        "ms", "median time that Offboard itself added to a task that ran on one site", _overhead_ms, real=True
    ),
    "overhead_percent": Figure(
        "%", "overhead_ms as a share of the mean time of these tasks", _overhead_percent, real=True
    ),
    "memory_growth_percent": Figure(
        "%", "memory growth of the part that grew most", _growth(lambda one: one.memory_bytes), real=True
    ),
    "handles_growth_percent": Figure(
        "%",
        "growth in open files and sockets of the part that grew most",
        _growth(lambda one: one.handles),
        real=True,
    ),
}
