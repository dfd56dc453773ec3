"""Proxies as Toxiproxy has them: each a relay on a listening port of its own, under the toxics it was given.

The relay is `toxic_relay.py`, toxics are `toxics.py`; the HTTP side is `toxiproxy.py`.
"""

import asyncio
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.loadgen.relay.tcp.endpoint import BACKLOG, address, bind, name_of
from offboard.loadgen.relay.toxiproxy.toxic_relay import ToxicRelay
from offboard.loadgen.relay.toxiproxy.toxics import Refused, Toxic, link_of

PROXIES_MAX = 64
TOXICS_MAX = 32  # of one proxy
LISTEN = "127.0.0.1:0"  # where a proxy listens that is not told where


@dataclass(frozen=True, slots=True)
class RelaySettings:
    """What the relays of all proxies share; see `Relay`."""

    seed: int
    connections_max: int
    buffer_bytes: int


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """A proxy as it is asked for."""

    name: str
    listen: str
    upstream: str
    enabled: bool

    def __post_init__(self) -> None:
        for field_name in ("name", "upstream"):
            if not getattr(self, field_name):
                raise Refused(f"missing required field: {field_name}")
        for field_name in ("listen", "upstream"):
            try:
                address(field_name, getattr(self, field_name))
            except ConfigError as error:
                raise Refused(f"bad request body: {error}") from None


class Proxies:
    """All proxies by name. One change at a time: opening a listener takes turns of the loop."""

    def __init__(self, settings: RelaySettings) -> None:
        self._settings = settings
        self._proxies: dict[str, Proxy] = {}  # at most PROXIES_MAX
        self._changing = asyncio.Lock()

    def shown(self) -> dict[str, Any]:
        return {name: proxy.shown() for name, proxy in self._proxies.items()}

    def get(self, name: str) -> "Proxy":
        if name not in self._proxies:
            raise Refused("proxy not found", 404)
        return self._proxies[name]

    async def create(self, asked: ProxySettings) -> "Proxy":
        async with self._changing:
            if asked.name in self._proxies:
                raise Refused("proxy already exists", 409)
            return await self._create(asked)

    async def populate(self, wanted: Sequence[ProxySettings]) -> list["Proxy"]:
        """Each of these proxies exists: one that listens and leads elsewhere is replaced, others are kept."""
        async with self._changing:
            if len({asked.name for asked in wanted}) < len(wanted):
                raise Refused("bad request body: two proxies of one name")
            return [await self._create_or_keep(asked) for asked in wanted]

    async def update(self, name: str, changes: Mapping[str, Any]) -> "Proxy":
        """Change some of listen, upstream and enabled; another address drops the connections."""
        async with self._changing:
            proxy = self.get(name)
            await proxy.change(replace(proxy.settings, **changes))
            return proxy

    async def remove(self, name: str) -> None:
        async with self._changing:
            self.get(name).close()
            del self._proxies[name]

    async def reset(self) -> None:
        """Every proxy is enabled, none has toxics."""
        async with self._changing:
            for proxy in self._proxies.values():
                await proxy.change(replace(proxy.settings, enabled=True))
                proxy.put(())

    def close(self) -> None:
        for proxy in self._proxies.values():
            proxy.close()

    async def _create_or_keep(self, asked: ProxySettings) -> "Proxy":
        there = self._proxies.get(asked.name)
        if there is not None:
            if there.leads_as(asked):
                return there
            there.close()
            del self._proxies[asked.name]
        return await self._create(asked)

    async def _create(self, asked: ProxySettings) -> "Proxy":
        if len(self._proxies) >= PROXIES_MAX:
            raise Refused(f"too many proxies: {PROXIES_MAX} is the most")
        proxy = Proxy(asked, self._settings)
        await proxy.change(asked)
        self._proxies[asked.name] = proxy
        return proxy


class Proxy:
    """One relay under a name. `settings` hold the real port once it has listened."""

    def __init__(self, asked: ProxySettings, settings: RelaySettings) -> None:
        seed = random.Random(f"{settings.seed}/{asked.name}").getrandbits(64)
        self._relay = ToxicRelay(address("upstream", asked.upstream), **(asdict(settings) | {"seed": seed}))
        self._server: asyncio.Server | None = None
        self._asked_listen = asked.listen
        self.settings = replace(asked, enabled=False)

    def shown(self) -> dict[str, Any]:
        """As the API shows it."""
        return asdict(self.settings) | {"toxics": [toxic.shown() for toxic in self._relay.toxics]}

    @property
    def toxics(self) -> tuple[Toxic, ...]:
        return self._relay.toxics

    def leads_as(self, asked: ProxySettings) -> bool:
        """It listens there, as asked the first time or as it is shown, and leads to the same upstream."""
        listens = asked.listen in (self.settings.listen, self._asked_listen)
        return listens and asked.upstream == self.settings.upstream

    async def change(self, wanted: ProxySettings) -> None:
        """Make it so. Where it cannot listen it is left disabled."""
        if not (wanted.enabled and self.leads_as(wanted)):
            self.close()
        if not self.leads_as(wanted):
            self._relay.target = address("upstream", wanted.upstream)
            self._asked_listen = wanted.listen
            self.settings = replace(wanted, enabled=False)
        if wanted.enabled and self._server is None:
            await self._open()

    def close(self) -> None:
        """Listen no longer, and end the connections."""
        if self._server is not None:
            self._server.close()
            self._server = None
            self._relay.close()
        self.settings = replace(self.settings, enabled=False)

    def toxic(self, name: str) -> Toxic:
        for toxic in self.toxics:
            if toxic.name == name:
                return toxic
        raise Refused("toxic not found", 404)

    def add(self, toxic: Toxic) -> None:
        if any(toxic.name == other.name for other in self.toxics):
            raise Refused("toxic already exists", 409)
        if len(self.toxics) >= TOXICS_MAX:
            raise Refused(f"too many toxics: {TOXICS_MAX} is the most of one proxy")
        self.put((*self.toxics, toxic))

    def update(self, toxic: Toxic) -> None:
        """Put it in the place of the one of its name."""
        self.put(toxic if toxic.name == other.name else other for other in self.toxics)

    def remove(self, name: str) -> None:
        gone = self.toxic(name)
        self.put(other for other in self.toxics if other is not gone)

    def put(self, toxics: Iterable[Toxic]) -> None:
        """These toxics and no others, unless they are more than a link can do."""
        toxics = tuple(toxics)
        try:
            link_of(toxics)
        except ConfigError as error:
            raise Refused(f"bad request body: all toxics of a stream together: {error}") from None
        self._relay.set_toxics(toxics)

    async def _open(self) -> None:
        try:
            listening = await asyncio.to_thread(bind, "listen", self.settings.listen)  # may look up a name
        except ConfigError as error:
            raise Refused(str(error), 500) from None
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._relay.accept, sock=listening, backlog=BACKLOG)
        self._relay.taking = True
        self.settings = replace(self.settings, listen=name_of(listening), enabled=True)
