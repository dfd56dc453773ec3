"""The time to predict, decide, learn and record a task, with runners that answer at once."""

import itertools
import random
from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from benchmarks.measure import Requirement, Table, each_of
from offboard.common.tasks import Kind, Task, kind_of, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.memories import Memories
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies import Policy, Probe
from offboard.robot_client.predictors.base import Call, Run
from offboard.robot_client.predictors.plain import model_of
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, UNMEASURED, Condition, Execution, Sending

CALLS = 2_000
RUN = "a run that ends at once"
WINDOW = 50
RANDOM = random.Random(1)
SIZES = [RANDOM.uniform(1, 5) for _ in range(CALLS)]
MEASURED = Condition(round_trip_s=0.03)
NOISE = [RANDOM.lognormvariate(0.0, 0.1) for _ in range(CALLS)]
SENT = Sending(1000)
SECONDS = {ONBOARD: 0.02, CLOUD: 0.04}  # of a task of size 1


@task("counted", size=lambda size: size)
def counted(size: float) -> float:
    return size


class InstantRunner:
    """A runner that answers at once, and reports times that are linear in the size, with noise."""

    def __init__(self, site: str) -> None:
        self.site = site
        self._noise = itertools.cycle(NOISE)

    def unavailable(self, kind: Kind) -> str | None:  # noqa: ARG002
        return None

    def submit(self, task: Task, budget_s: float) -> "Future[Execution]":  # noqa: ARG002
        future: Future[Execution] = Future()
        future.set_result(Execution(self.site, SECONDS[self.site] * task.size * next(self._noise), task.size))
        return future

    def to_send(self, task: Task) -> Sending:  # noqa: ARG002
        return SENT

    def cancel(self, task: Task) -> None:
        pass

    def hurry(self) -> None:
        pass

    def condition(self) -> Condition:
        return MEASURED if self.site == CLOUD else UNMEASURED

    def close(self) -> None:
        pass


class Remembering:
    """A policy that remembers its last forecast."""

    def __init__(self, inner: Policy) -> None:
        self.inner = inner

    def decide(self, forecast: policies.Forecast) -> policies.Decision:
        self.forecast = forecast
        return self.inner.decide(forecast)


def tables() -> list[Table]:
    return [_decisions(), _predictors()]


def _offloader(policy: str, window: int) -> tuple[Offloader, Remembering]:
    """An offloader that has learned both sites well, and its policy."""
    name = policies.predictor_of(policy)
    kept = Remembering(policies.make(policy))
    offload = Offloader(
        [InstantRunner(ONBOARD), InstantRunner(CLOUD)],
        policy=kept,
        memories=Memories(lambda: predictors.make(name, window), shared_work=name == predictors.PARTS),
    )
    for size in SIZES:
        offload(counted, size, where="both")
    for size in SIZES:
        offload(counted, size)
    return offload, kept


def _decisions() -> Table:
    cases: dict[str, Callable[[int], object]] = {"an empty call": _empty_calls, RUN: _runs}
    for policy in ("paper", policies.DEFAULT):
        for window in (10, WINDOW, 1_000):
            offload, kept = _offloader(policy, window)
            cases[f"{policy}, N = {window}"] = lambda count, offload=offload: _ask(offload, count)
            if window == WINDOW:
                cases[f"{policy}: predict, decide and learn"] = _thinks(offload)
                cases[f"{policy}: decide only"] = lambda count, kept=kept: _decide(kept, count)
    seconds = each_of(cases, CALLS)
    empty, run = seconds["an empty call"], seconds[RUN]
    rows = [[name, f"{each * 1e6:.2f}", f"{each / empty:.0f}"] for name, each in seconds.items()]
    requirements = []
    for policy, limit in (("paper", 25.0), (policies.DEFAULT, 80.0)):
        few, usual, many = (seconds[f"{policy}, N = {window}"] for window in (10, WINDOW, 1_000))
        thought = seconds[f"{policy}: predict, decide and learn"]
        requirements += [
            Requirement(f"{policy}: predict, decide and learn", thought * 1e6, limit, "us"),
            Requirement(f"{policy}: a task without its run", (usual - run) * 1e6, limit, "us"),
            Requirement(f"{policy}: N = 1,000, relative difference to N = 10", abs(many / few - 1), 0.2),
        ]
    return Table("Time of a decision", ("step", "us", "relative to an empty call"), rows, requirements)


def _empty_calls(count: int) -> None:
    def empty() -> None:
        pass

    for _ in range(count):
        empty()


def _runs(count: int) -> None:
    site, work = InstantRunner(ONBOARD), Task(kind_of(counted), (2.0,), 2.0)
    for _ in range(count):
        site.submit(work, 2.0).exception()


def _ask(offload: Offloader, count: int) -> None:
    for size in SIZES[:count]:
        offload(counted, size)


def _thinks(offload: Offloader) -> Callable[[int], None]:
    """From a task to its decision, and from its time to the next task, without futures and records."""
    kind = kind_of(counted)
    tasks = [Task(kind, (size,), size) for size in SIZES]
    ran = {
        site: [
            Execution(site, seconds * size * noise, size) for size, noise in zip(SIZES, NOISE, strict=True)
        ]
        for site, seconds in SECONDS.items()
    }

    def think(count: int) -> None:
        for n, one in enumerate(tasks[:count]):
            asked = offload._begin(one, None, 2.0)
            decision = asked.decision
            probed = [decision.second.site] if isinstance(decision.second, Probe) else []
            offload._runs.learn(asked, [ran[site][n] for site in (decision.site, *probed)])

    return think


def _decide(kept: Remembering, count: int) -> None:
    forecast = kept.forecast
    for _ in range(count):
        kept.inner.decide(forecast)


def _predictors() -> Table:
    from sklearn.linear_model import LinearRegression

    least = model_of(predictors.make(predictors.LEAST_SQUARES, WINDOW), remote=False)
    parts = model_of(predictors.make(predictors.PARTS, WINDOW), remote=False)
    sizes, seconds = np.array(SIZES[:WINDOW]), np.array(SIZES[:WINDOW]) * 0.04
    for size in SIZES[:WINDOW]:
        for one in (least, parts):
            one.learn(Call(size), Run(0.04 * size))

    def ours(one: predictors.Model) -> Callable[[int], None]:
        def run(count: int) -> None:
            for size in SIZES[:count]:
                one.learn(Call(size), Run(0.04 * size))
                one.predict(Call(size))

        return run

    def polyfit(count: int) -> None:
        for n, size in enumerate(SIZES[:count]):
            sizes[n % WINDOW], seconds[n % WINDOW] = size, 0.04 * size
            slope, intercept = np.polyfit(sizes, seconds, 1)
            slope * size + intercept

    def sklearn(count: int) -> None:
        for n, size in enumerate(SIZES[:count]):
            sizes[n % WINDOW], seconds[n % WINDOW] = size, 0.04 * size
            LinearRegression().fit(sizes[:, np.newaxis], seconds).predict([[size]])

    found = each_of({"least squares": ours(least), "parts": ours(parts)}, CALLS)
    found |= each_of({"numpy.polyfit": polyfit, "scikit-learn": sklearn}, CALLS // 10)
    base = found["least squares"]
    rows = [[name, f"{each * 1e6:.2f}", f"{each / base:.1f}"] for name, each in found.items()]
    requirements = [
        Requirement(f"{name}, relative to least squares", found[name] / base, limit, at_least=True)
        for name, limit in (("numpy.polyfit", 8.0), ("scikit-learn", 50.0))
    ]
    columns = ("predictor", "us", "relative to least squares")
    return Table(f"Learn and predict for one site, N = {WINDOW}", columns, rows, requirements)
