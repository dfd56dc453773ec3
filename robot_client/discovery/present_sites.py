"""The runners of the sites that tasks can use now: those that stay, and those of the servers in use.

Which servers are in use is decided in `roster`; the threads that read lists are in `server_lists`.
"""

import logging
import threading
import time
from collections.abc import Callable, Collection, ItemsView, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

from offboard.common.errors import ConfigError, OffloadError
from offboard.common.variants import group_of
from offboard.robot_client.discovery.roster import Roster, Server
from offboard.robot_client.sites.absence import Absent, SiteView
from offboard.robot_client.sites.runner import ONBOARD, Runner

LEAVING_MIN_S = 5.0  # for which a server that is no longer used may still get tasks that began before
LEAVING_MAX_S = 300.0  # for which a server that no list names any more may still answer the tasks that it has

log = logging.getLogger(__name__)


class PresentSites(Mapping[str, Runner]):
    """The runner of each site now, by its name.

    `now` is replaced and never changed, so a task keeps the sites that were present when it began.
    A server that leaves gets no more tasks; its runner is closed once its tasks have ended. If a server that
    lists still name was only left for another one, its tasks have all their time.

    `staying`: the runners of the sites that no list changes.
    `roster`: chooses the servers in use. `connect`: makes the runner of one of them.
    `changing`: whether servers may come and go. If not, no task needs to be counted.
    `tended`: a thread calls `refresh` at least every few seconds. Otherwise it is called whenever the
    servers in use change, as in a simulation.
    """

    def __init__(
        self,
        staying: Sequence[Runner],
        *,
        roster: Roster | None = None,
        connect: Callable[[Server], Runner] | None = None,
        tended: bool = False,
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.now: Mapping[str, Runner] = {runner.site: runner for runner in staying}
        if ONBOARD not in self.now or len(self.now) != len(staying):
            given = [runner.site for runner in staying]
            raise ConfigError(f"sites {given}: each site once, and {ONBOARD!r} among them")
        self.staying = tuple(staying)
        self.changing = roster is not None
        self.awaited = Absent()  # why no server of a group is there yet, by group
        self.in_flight: Callable[[str], int] = lambda _: 0  # tasks on a site; the offloader says it
        self._roster = roster or Roster()
        self._connect = connect
        self._tended = tended
        self._clock_s = clock_s
        self._roster_lock = threading.Lock()  # a task may wait for it, so no connection is made under it
        self._lock = threading.Lock()
        self._connected: dict[str, tuple[Server, Runner]] = {}
        self._leaving: list[tuple[Server, Runner, float]] = []  # with the time when it left
        self._failed: set[Server] = set()
        self._closed = False
        self._on_close: list[Callable[[], None]] = []
        self.refresh()

    def follow(self, listed: Collection[Server], source: str = "") -> None:
        """This is the list of this source from now on."""
        with self._roster_lock:
            self._roster.follow(listed, source)
        self.refresh()
        for one in listed:
            self.awaited.pop(group_of(one.site), None)

    def count_task(self, finish_s: Mapping[str, float], now_s: float) -> None:
        """Count a task, and sometimes change the servers in use: see `Roster.look`.

        `finish_s`: how long it should take on each site that can take it. Called under the offloader's lock.
        """
        with self._roster_lock:
            looks = self._roster.count_task(finish_s, now_s)
            if looks:
                self._roster.look(finish_s, now_s)
        if looks and not self._tended:
            self.refresh()

    def refresh(self) -> None:
        """Connect to the servers in use, and close what has left and has no more tasks."""
        with self._lock:
            if self._closed:
                return
            wanted = self._roster.in_use
            for site, (server, runner) in list(self._connected.items()):
                if wanted.get(site) != server:
                    del self._connected[site]
                    self._leaving.append((server, runner, self._clock_s()))
                    log.info("%s: %s is no longer used", site, server.endpoint)
            self._connect_to([wanted[site] for site in wanted.keys() - self._connected.keys()])
            self.now = {one.site: one for one in self.staying} | {
                site: self._connected[site][1] for site in wanted if site in self._connected
            }
            ended = [one for one in self._leaving if self._may_close(*one)]
            self._leaving = [one for one in self._leaving if one not in ended]
        for _, runner, _ in ended:
            runner.close()

    def views(self) -> Mapping[str, SiteView]:
        """Each site as it is now, by its name."""
        found = {}
        for site, runner in self.now.items():
            look = getattr(runner, "look", SiteView)  # a runner of the user's own may have none
            found[site] = replace(look(), in_flight=self.in_flight(site))
        return MappingProxyType(found)

    def on_close(self, act: Callable[[], None]) -> None:
        """Call this when the sites are closed."""
        self._on_close.append(act)

    def close(self) -> None:
        """Close all runners. Safe to call twice."""
        for act in self._on_close:
            act()
        with self._lock:
            self._closed = True
            runners = [*self.now.values(), *(runner for _, runner, _ in self._leaving)]
        for runner in runners:
            runner.close()

    def _connect_to(self, servers: Iterable[Server]) -> None:
        """Connect to these servers; the log says once why that cannot be done."""
        failed = set()
        for server in servers:
            assert self._connect is not None, "a roster with servers needs it"
            try:
                self._connected[server.site] = server, self._taken_back(server) or self._connect(server)
                log.info("%s: %s is used from now on", server.site, server.endpoint)
            except OffloadError as error:
                failed.add(server)
                if server not in self._failed:
                    said = "%s: %s; it is not used; remedy: correct its entry, or close other files"
                    log.warning(said, server.site, error)
        self._failed = failed

    def _taken_back(self, server: Server) -> Runner | None:
        """The runner of this server if it is still there."""
        for one in self._leaving:
            if one[0] == server:
                self._leaving.remove(one)
                return one[1]
        return None

    def _may_close(self, server: Server, runner: Runner, left_s: float) -> bool:
        gone_s = self._clock_s() - left_s
        if self.in_flight(runner.site):
            return gone_s >= LEAVING_MAX_S and self._roster.listed.get(server.site) != server
        return gone_s >= LEAVING_MIN_S

    def items(self) -> ItemsView[str, Runner]:
        return self.now.items()

    def __getitem__(self, site: str) -> Runner:
        return self.now[site]

    def __iter__(self) -> Iterator[str]:
        return iter(self.now)

    def __len__(self) -> int:
        return len(self.now)
