"""The worked example of docs/how_it_decides.md is what the default computes."""

from pathlib import Path

from offboard.common.errors import CloudTimeout
from offboard.common.tasks import kind_of, task
from offboard.robot_client import policies, predictors
from offboard.robot_client.learning.kind import KindMemory
from offboard.robot_client.policies import Forecast
from offboard.robot_client.sites.runner import CLOUD, NOTHING, ONBOARD, Condition, Execution, Sending

PAGE = Path(__file__).resolve().parents[2] / "docs" / "how_it_decides.md"
TRIP_S = 0.04
BYTES = 1000


@task("worked_example", size=float)
def worked_example(size: float) -> float:
    return size


class Robot:
    """It has run twenty tasks of the sizes 1 to 5 on each site; every other one took 20 % longer."""

    def __init__(self) -> None:
        self.near = Condition(round_trip_s=TRIP_S)
        self._memory = KindMemory(
            kind_of(worked_example),
            lambda: predictors.make(predictors.PARTS, 50),
            shared_work=False,
            measured=True,
            s_per_quality=1.0,
        )
        for n in range(20):
            size, slow = 1.0 + n % 5, 1.2 if n % 2 else 1.0
            forecast = self.forecast(size, self.near)
            onboard_s, run_s = slow * (0.06 + 0.03 * size), slow * (0.01 + 0.004 * size)
            for one in (
                Execution(ONBOARD, onboard_s, queue_s=0.0, run_s=onboard_s),
                Execution(CLOUD, TRIP_S + run_s, queue_s=0.0, run_s=run_s, bytes_out=BYTES),
            ):
                expected = forecast.sites[one.site]
                self._memory.site(one.site).learn(size, one, expected, silent=False, size=size)

    def forecast(self, size: float, condition: Condition) -> Forecast:
        conditions = {CLOUD: (condition, Sending(BYTES)), ONBOARD: (Condition(), NOTHING)}
        return Forecast(
            size,
            {
                site: self._memory.site(site).outlook(size, seen, in_flight=0, sending=sending)
                for site, (seen, sending) in conditions.items()
            },
            duplicates=3.0,
        )

    def lose(self, size: float, condition: Condition) -> None:
        """A run on the silent server times out."""
        lost = Execution(CLOUD, 2.0, failure=CloudTimeout("no answer"), censored=True)
        expected = self.forecast(size, condition).sites[CLOUD]
        self._memory.site(CLOUD).learn(size, lost, expected, silent=True, size=size)

    def reason(self, size: float, condition: Condition) -> str:
        return policies.make("default").decide(self.forecast(size, condition)).reason


def test_the_page_shows_what_the_default_decides() -> None:
    """Each reason in the example is the one that the code gives, in this order."""
    robot = Robot()
    late, silent = robot.near._replace(wait_s=0.12), robot.near._replace(wait_s=0.3, silent=True)
    reasons = [robot.reason(3.0, one) for one in (robot.near, late, silent)]
    robot.lose(3.0, silent)
    assert robot.reason(3.0, robot.near) == reasons[0], "after the outage"
    page = PAGE.read_text()
    found = [page.find(f"\n{reason}\n") for reason in reasons]
    assert all(one > 0 for one in found), "\n".join(reasons)
    assert found == sorted(found)
