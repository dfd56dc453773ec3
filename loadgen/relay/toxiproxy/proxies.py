"""Toxiproxy's proxies: each is a relay with its own port and its own toxics.

The relay is in `toxics.py`, the HTTP API in `toxiproxy_api.py`.
"""

import asyncio
import random
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from offboard.common.errors import ConfigError
from offboard.common.security.address import address
from offboard.loadgen.relay.tcp.relay import BACKLOG, RelaySettings, bind, name_of
from offboard.loadgen.relay.toxiproxy.toxics import Refused, Toxic, ToxicRelay, link_of

PROXIES_MAX = 64
TOXICS_MAX = 32  # of one proxy
LISTEN = "127.0.0.1:0"  # default address of a proxy


@dataclass(frozen=True, slots=True)
class ProxySettings:
    """A proxy, as a request describes it."""

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
    """All proxies by name. Changes run one at a time, because opening a listener is asynchronous."""

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
        """Create these proxies; keep an existing one with the same addresses, and replace one with others."""
        async with self._changing:
            if len({asked.name for asked in wanted}) < len(wanted):
                raise Refused("bad request body: two proxies have the same name")
            return [await self._create_or_keep(asked) for asked in wanted]

    async def update(self, name: str, changes: Mapping[str, Any]) -> "Proxy":
        """Change listen, upstream or enabled; a new address ends the connections."""
        async with self._changing:
            proxy = self.get(name)
            await proxy.change(replace(proxy.settings, **changes))
            return proxy

    async def remove(self, name: str) -> None:
        async with self._changing:
            self.get(name).close()
            del self._proxies[name]

    async def reset(self) -> None:
        """Enable every proxy and remove all toxics."""
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
            raise Refused(f"too many proxies: at most {PROXIES_MAX} are allowed")
        proxy = Proxy(asked, self._settings)
        await proxy.change(asked)
        self._proxies[asked.name] = proxy
        return proxy


class Proxy:
    """A relay with a name. Once it listens, `settings` hold its real port."""

    def __init__(self, asked: ProxySettings, settings: RelaySettings) -> None:
        seed = random.Random(f"{settings.seed}/{asked.name}").getrandbits(64)
        self._relay = ToxicRelay(address("upstream", asked.upstream), replace(settings, seed=seed))
        self._server: asyncio.Server | None = None
        self._asked_listen = asked.listen
        self.settings = replace(asked, enabled=False)

    def shown(self) -> dict[str, Any]:
        """The proxy as the API shows it."""
        return asdict(self.settings) | {"toxics": [toxic.shown() for toxic in self._relay.toxics]}

    @property
    def toxics(self) -> tuple[Toxic, ...]:
        return self._relay.toxics

    def leads_as(self, asked: ProxySettings) -> bool:
        """Whether the proxy already has these addresses, with its requested or its real port."""
        listens = asked.listen in (self.settings.listen, self._asked_listen)
        return listens and asked.upstream == self.settings.upstream

    async def change(self, wanted: ProxySettings) -> None:
        """Apply these settings. If the proxy cannot listen, it stays disabled."""
        if not (wanted.enabled and self.leads_as(wanted)):
            self.close()
        if not self.leads_as(wanted):
            self._relay.target = address("upstream", wanted.upstream)
            self._asked_listen = wanted.listen
            self.settings = replace(wanted, enabled=False)
        if wanted.enabled and self._server is None:
            await self._open()

    def close(self) -> None:
        """Stop listening, and end the connections."""
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
            raise Refused(f"too many toxics: a proxy may have at most {TOXICS_MAX}")
        self.put((*self.toxics, toxic))

    def update(self, toxic: Toxic) -> None:
        """Replace the toxic that has the same name."""
        self.put(toxic if toxic.name == other.name else other for other in self.toxics)

    def remove(self, name: str) -> None:
        gone = self.toxic(name)
        self.put(other for other in self.toxics if other is not gone)

    def put(self, toxics: Iterable[Toxic]) -> None:
        """Replace all toxics, unless their sum exceeds the limits of a link."""
        toxics = tuple(toxics)
        try:
            link_of(toxics)
        except ConfigError as error:
            raise Refused(f"bad request body: the toxics of a stream together: {error}") from None
        self._relay.set_toxics(toxics)

    async def _open(self) -> None:
        try:
            listening = await asyncio.to_thread(bind, "listen", self.settings.listen)  # may wait for DNS
        except ConfigError as error:
            raise Refused(str(error), 500) from None
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._relay.accept, sock=listening, backlog=BACKLOG)
        self._relay.taking = True
        self.settings = replace(self.settings, listen=name_of(listening), enabled=True)
