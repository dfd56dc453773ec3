"""A robot on a test bench: a real `Offloader` with scripted sites, in virtual time."""

from collections.abc import Callable, Iterable, Mapping

from offboard.robot_client import policies
from offboard.robot_client.offloader import Offloader
from offboard.robot_client.policies.observe import Observe
from offboard.robot_client.records.record import Record
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.heartbeat import EVERY_S, Heartbeat
from offboard.robot_client.sites.runner import CLOUD, TIMEOUT_S
from offboard.testing.scripted_onboard import ScriptedOnboard
from offboard.testing.scripted_site import ScriptedSite
from offboard.testing.shared_clock import SharedClock
from offboard.testing.task_script import Seconds


class Bench:
    """A robot for tests: a program gets its `offload`, and the test says what its sites do, in virtual time.

    `onboard_s`, `cloud_s`: seconds that each task takes there, or a function of the task's arguments that
    returns them. `sites`: the same for further servers, by name.
    `policy`, `timeout_s`, `observers`, `observe`, `settings`: as for `Offloader.connect`. A wrong one is a
    ConfigError.

    offload: a real `Offloader`, as `Offloader.connect` makes it.
    onboard: the `ScriptedOnboard`. sites: each server, a `ScriptedSite`, by its name.
    clock: the virtual time in seconds, which starts at 0. It passes while a call waits, and by
        `clock.pass_by(5.0)`; `clock.at(3.0, bench.cloud.dead)` plans what happens.
    records: the `Record` of each task so far.

    Use it as a context manager, or call `close`.
    """

    def __init__(
        self,
        *,
        onboard_s: Seconds = 0.2,
        cloud_s: Seconds = 0.05,
        sites: Mapping[str, Seconds] | None = None,
        policy: str = policies.DEFAULT,
        timeout_s: float = TIMEOUT_S,
        observers: Iterable[Callable[[Record], None]] = (),
        observe: bool = False,
        settings: Settings | None = None,
    ) -> None:
        rare = settings or Settings()
        chosen, memories = rare.make_policy(policy), rare.make_memories(policy)
        heartbeat_s = EVERY_S if rare.beats(policy) else 0.0
        self.clock = SharedClock()
        self.onboard = ScriptedOnboard(self.clock, onboard_s)
        self.sites = {
            site: ScriptedSite(self.clock, seconds, site=site, heartbeat=Heartbeat(heartbeat_s, rare.seed))
            for site, seconds in {CLOUD: cloud_s, **(sites or {})}.items()
        }
        self.records: list[Record] = []
        self.offload = Offloader(
            [*self.sites.values(), self.onboard],
            policy=Observe(chosen) if observe else chosen,
            memories=memories,
            allowance=rare.allowance(),
            timeout_s=timeout_s,
            observers=[self.records.append, *observers],
            clock=self.clock,
        )

    @property
    def cloud(self) -> ScriptedSite:
        """The server `cloud`."""
        return self.sites[CLOUD]

    def close(self) -> None:
        """Close the offloader, and so its sites. Safe to call twice."""
        self.offload.close()

    def __enter__(self) -> "Bench":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
