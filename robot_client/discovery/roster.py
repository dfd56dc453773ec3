"""Which of the listed servers a robot uses now. Pure: no clock, socket or thread.

Lists come from `server_lists` or a simulation; `present_sites` connects to the servers in use.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from random import Random

from offboard.common.errors import ConfigError
from offboard.common.variants import group_of

KNOWN_MAX = 4  # servers of one group that a robot uses at a time
LOOK_EVERY, LOOK_S = 20, 2.0  # tasks and seconds, both at least, between two looks at the servers in use
SPARED_S = 15.0  # for which a server that has just come into use may still be connecting
TRY_EVERY = 10  # looks, of which the last one lets the robot try another server


@dataclass(frozen=True, slots=True)
class Server:
    """A server of a list. Servers with a site GROUP/NAME are equal to the others of their group.

    `key`: its public key (None: the connection is not encrypted). `token`: what a policy server wants to see.
    """

    site: str
    endpoint: str
    key: bytes | None = None
    token: str | None = field(default=None, repr=False)


class Roster:
    """Chooses the servers in use: all of a small group, and `known` of a larger one.

    Of a larger group, the robot keeps the servers that finish its tasks soonest, and rarely tries another
    one in the place of one of them. Robots of a fleet need different seeds, so that they spread out.
    """

    def __init__(self, known: int = KNOWN_MAX, seed: int | str = 0) -> None:
        if known < 2:
            raise ConfigError(f"known {known}: must be at least 2 servers of each group")
        self.in_use: Mapping[str, Server] = {}  # by site; replaced and never changed, as `listed` is
        self.listed: Mapping[str, Server] = {}
        self._known = known
        self._random = Random(seed)
        self._lists: dict[str, dict[str, Server]] = {}  # by source
        self._tasks = self._looks = 0
        self._able: set[str] = set()  # the sites that could take a task since the last look
        self._since_s: dict[str, float] = {}  # when a look first found a site in use
        self._looked_s = -math.inf

    def follow(self, listed: Iterable[Server], source: str = "") -> None:
        """This is the list of this source from now on: servers that it does not name are left."""
        self._lists[source] = {one.site: one for one in listed}
        self.listed = {site: one for servers in self._lists.values() for site, one in servers.items()}
        self._use(self.in_use)

    def count_task(self, able: Iterable[str], now_s: float) -> bool:
        """Count a task that these sites could take; returns whether the robot should now `look`."""
        self._tasks += 1
        self._able.update(able)
        return self._tasks >= LOOK_EVERY and now_s - self._looked_s >= LOOK_S

    def look(self, finish_s: Mapping[str, float], now_s: float) -> None:
        """Replace servers of larger groups: those that could take no task, and rarely one more.

        If none of a group could, it is more likely the link of the robot that fails, so they are replaced as
        rarely. `finish_s`: how long a task should take on each site that can take it, in seconds. The site
        that is left for a trial is the later one of two drawn ones: the best one always stays.
        """
        able_now = self._able | finish_s.keys()
        self._tasks, self._looked_s, self._able = 0, now_s, set()
        self._looks += 1
        self._since_s = {site: self._since_s.get(site, now_s) for site in self.in_use}
        kept = {site for site, since_s in self._since_s.items() if now_s - since_s < SPARED_S}
        for members in _groups(self.in_use).values():
            able = [site for site in members if site in able_now] or members
            kept.update(able)
            if self._looks % TRY_EVERY == 0 and len(able) >= self._known:
                kept.remove(max(self._random.sample(able, 2), key=lambda site: finish_s.get(site, math.inf)))
        self._use(kept)

    def _use(self, kept: Iterable[str]) -> None:
        """Use the listed ones of these, and in their groups others where there is room, new ones first."""
        listed = self.listed
        kept, in_use = set(kept), dict[str, Server]()
        for members in _groups(listed).values():
            stay = [site for site in members if site in kept]
            self._random.shuffle(members)
            members.sort(key=lambda site: site in self.in_use)  # one that was just left comes last
            room = [site for site in members if site not in kept][: max(0, self._known - len(stay))]
            # In a random order: the first of several equal servers gets the task.
            in_use |= {site: listed[site] for site in stay + room}
        self.in_use = in_use


def _groups(sites: Iterable[str]) -> dict[str, list[str]]:
    """The sites of each group, sorted."""
    groups: dict[str, list[str]] = {}
    for site in sorted(sites):
        groups.setdefault(group_of(site), []).append(site)
    return groups
