"""The default without one of its mechanisms: a class for each, named after what is left out.

Most are predictors, as in `loadgen run calm --predictor benchmarks.left_out.Tail`; the last ones are
policies, as in `--policy benchmarks.left_out.Stall`. `ablations` measures what leaving them out costs.
"""

import math

from offboard.common.tasks import first_number
from offboard.robot_client import policies
from offboard.robot_client.policies import Decision, Forecast, Hedge, Outlook
from offboard.robot_client.predictors.base import Call, Prediction, Run
from offboard.robot_client.predictors.line import (
    ODD,
    PACE,
    RATE,
    TAIL_MAX,
    Line,
)
from offboard.robot_client.predictors.parts import Parts
from offboard.robot_client.sites.runner import ONBOARD, Condition


class Switched(Line):
    """A line whose rules can be switched off; with all of them it is the same as `Line`."""

    pace = PACE
    outliers = True  # a time beyond the reach counts only up to it
    good_news = True  # one outlier below the line is a change
    bad_news = True  # two outliers above it are one
    doubling = True  # a change about doubles the time at most

    def learn(self, x: float, y: float, apart_s: float = 0.0) -> None:
        self.count += 1
        if self.count == 1:
            self._begin(x, y, apart_s)
            return
        rate = max(RATE, 1.0 / self.count)
        error = y - self.a - self.b * x
        unit = 0.5 * (max(0.0, self.a + self.b * x + apart_s) + self._usual) or 1.0
        self._usual += rate * (min(y + apart_s, ODD * self._usual) - self._usual)
        self._loosen(self.pace * self.pace, apart_s)
        variance, reach = self._reach(x, unit)
        side = math.copysign(1.0, error) if abs(error) > reach else 0.0
        again = side != 0 and side == self._side
        changed = (self.good_news and side < 0) or (self.bad_news and again)
        if changed:
            error = min(error, unit) if self.doubling else error
            self._loosen(min(1.0, (error / unit) ** 2), apart_s)
            variance, reach = self._reach(x, unit)
        self._side = side
        beyond = min(max(0.0, error - reach) / unit, TAIL_MAX)
        self._tail += rate * (beyond - self._tail)
        if not changed:
            seen = max(0.0, min(error * error, 0.5 * reach * reach) - variance) / (unit * unit)
            self._noise += rate * (min(1.0, seen) - self._noise)
        self._correct(x, max(-reach, min(reach, error)), unit)

    def _reach(self, x: float, unit: float) -> tuple[float, float]:
        variance, reach = super()._reach(x, unit)
        return variance, reach if self.outliers else math.inf


class _WithoutPace(Switched):
    pace = 0.0


class _WithoutOutliers(Switched):
    outliers = False


class _WithoutGoodNews(Switched):
    good_news = False


class _WithoutBadNews(Switched):
    bad_news = False


class _WithoutChange(Switched):
    good_news = bad_news = False


class _WithoutDoubling(Switched):
    doubling = False


class _WithoutTail(Line):
    @property
    def tail(self) -> float:
        return 0.0


class _WithoutLoadedShape(Line):
    def begin_as(self, other: Line, x: float, y: float) -> None:  # noqa: ARG002
        self.learn(x, y)


class Pace(Parts):
    """A site does not become slower or faster as a whole."""

    LINE = _WithoutPace


class Outliers(Parts):
    """A plain Kalman filter: no outlier is clipped, none is a change, and there is no tail."""

    LINE = _WithoutOutliers


class GoodNews(Parts):
    """An outlier below the line is a change only the second time."""

    LINE = _WithoutGoodNews


class BadNews(Parts):
    """Outliers above the line are never a change."""

    LINE = _WithoutBadNews


class Change(Parts):
    """No outlier is a change."""

    LINE = _WithoutChange


class Doubling(Parts):
    """A change may make a prediction as long as the time that showed it."""

    LINE = _WithoutDoubling


class Tail(Parts):
    """What outliers take beyond the reach is not predicted."""

    LINE = _WithoutTail


class LoadedShape(Parts):
    """The line of runs under load begins as any other line (`Line.begin_as`)."""

    LINE = _WithoutLoadedShape


class Load(Parts):
    """Runs while other programs take the CPU are learned with all others."""

    def _load(self, condition: Condition) -> float:  # noqa: ARG002
        return 0.0


class Bound(Parts):
    """An answer that the robot may have read late counts as any other one."""

    def learn(self, call: Call, run: Run) -> None:
        super().learn(call, run._replace(bound=False))


class Late(Parts):
    """A run that was given up after its predicted time says nothing."""

    def learn(self, call: Call, run: Run) -> None:
        if run.ended:
            super().learn(call, run)


class Work(Parts):
    """The sites learn seconds per size, also of kinds whose results tell their work."""

    per_work = False


class _Without(Parts):
    """Parts that does not get some of what is told of a task; `_told` says what is left of it."""

    def _told(self, call: Call) -> Call:
        raise NotImplementedError

    def predict(self, call: Call) -> Prediction | None:
        return super().predict(self._told(call))

    def learn(self, call: Call, run: Run) -> None:
        super().learn(self._told(call), run)


class Payload(_Without):
    """All tasks move the same bytes."""

    def _told(self, call: Call) -> Call:
        return call._replace(moved=0.0)


class _WithoutCondition(_Without):
    def _seen(self, condition: Condition) -> Condition:
        raise NotImplementedError

    def _told(self, call: Call) -> Call:
        return call._replace(condition=self._seen(call.condition))


class Capacity(_WithoutCondition):
    """The share of a CPU that a task may use is not known."""

    def _seen(self, condition: Condition) -> Condition:
        return condition._replace(capacity=1.0)


class Queue(_WithoutCondition):
    """The tasks that wait at a server are not known."""

    def _seen(self, condition: Condition) -> Condition:
        return condition._replace(queue=0)


class RoundTrip(_WithoutCondition):
    """The round trip of the heartbeats is not known; their silence is."""

    def _seen(self, condition: Condition) -> Condition:
        return condition._replace(round_trip_s=None)


class NetworkLine(Parts):
    """One line for all that a task takes beyond its queue and the round trip: run and network together."""

    def learn(self, call: Call, run: Run) -> None:
        if run.ended:
            alone_s = max(0.0, run.seconds - (run.queue_s or 0.0)) if self.remote else run.seconds
            super().learn(call, Run(alone_s))
            return
        condition, seconds = call.condition, run.seconds
        if self.remote:
            waited_s = condition.queue * self._usual_run.value + (condition.round_trip_s or 0.0)
            seconds = max(0.0, seconds - waited_s)
        self._learn_run(first_number(call.amount), seconds, condition)


class AllParts(_Without):
    """One line on the total seconds: no network, no queue and no round trip."""

    def learn(self, call: Call, run: Run) -> None:
        super().learn(call, run._replace(run_s=None))

    def _told(self, call: Call) -> Call:
        return call._replace(moved=0.0, condition=call.condition._replace(round_trip_s=None, queue=0))


class _Default:
    """The default policy; `_told` says what it gets of a forecast."""

    pairs = True

    def __init__(self, seed: int = 0) -> None:
        self._policy = policies.make(policies.DEFAULT, seed)

    def decide(self, forecast: Forecast) -> Decision:
        return self._policy.decide(self._told(forecast))

    def _told(self, forecast: Forecast) -> Forecast:
        return forecast


class HedgeAtP95(_Default):
    """A run is late after the time that 95 % of such runs stay below, as by Dean and Barroso."""

    SHARE = 0.95

    def decide(self, forecast: Forecast) -> Decision:
        decision = super().decide(forecast)
        first, second = forecast.sites[decision.site], decision.second
        if not isinstance(second, Hedge) or first.predicted_s is None:
            return decision
        after_s = first.errors.below(first.predicted_s, self.SHARE, first.error_s or 0.0)
        return decision._replace(second=Hedge(second.site, after_s)) if after_s else decision


class Stall(_Default):
    """A late heartbeat adds nothing to the time of a server; once it is silent, it still is."""

    def _told(self, forecast: Forecast) -> Forecast:
        return forecast._replace(
            sites={
                site: one
                if site == ONBOARD or one.predicted_s is None
                else _without_wait(one, one.predicted_s)
                for site, one in forecast.sites.items()
            }
        )


def _without_wait(one: Outlook, predicted_s: float) -> Outlook:
    wait_s = one.condition.wait_s
    cost = None if one.cost is None else one.cost - wait_s
    return one._replace(predicted_s=predicted_s - wait_s, cost=cost)
