"""The Docker testbed: runs the parts as containers of the checkout's images, and removes them with itself.

    robots --(near)--> relays --(far)--> servers       relays, servers --(control)--> 127.0.0.1 of the host

`docker_engine` makes containers and networks; `container_part` says what a part is inside its container.
"""

import contextlib
import ipaddress
import signal
import time
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self

from offboard.common.errors import ConfigError, OffloadError
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.relay_client import RelayClient, ask
from offboard.loadgen.testbed import container_part as inside
from offboard.loadgen.testbed.container_hogs import ContainerHogs
from offboard.loadgen.testbed.container_part import FAR, KINDS, NEAR
from offboard.loadgen.testbed.container_usage import UsageMeter
from offboard.loadgen.testbed.docker_engine import (
    Container,
    Engine,
    Refusal,
    docker_errors,
    new_run,
    output_of,
    reason,
)
from offboard.loadgen.testbed.docker_images import build_images, check_compose
from offboard.loadgen.testbed.part_output import Output
from offboard.loadgen.testbed.part_process import (
    KILL_S,
    POLL_S,
    TERMINATE_S,
    USAGE_EXIT,
    leave,
    uninterrupted,
)
from offboard.loadgen.testbed.testbed import (
    CLOUD,
    PART,
    ROBOT,
    WAN,
    Setup,
    Usage,
    kind_of,
    relay_of,
    servers_among,
)

CONTROL = "control"
# The compiled planner, shared by all containers and all runs of this checkout.
CACHE = Path(".cache/containers")
READY_S = 120.0  # the first compilation of the planner takes most of it
PAUSE_TRIES = 10


class DockerTestbed:
    """Robots --> relay --> server, each in its own container; `run` labels everything that the testbed makes.

    Robots can reach only the relays, and only the relays can reach a server; these networks have no way out.
    We control relays and servers over a third network. A part keeps its addresses, and its container
    when it is started again, so that after a cut the same connections go on.

    All containers run as our own user, so that we own the files under `out`, and share one cache of the
    compiled planner. Ctrl-C and SIGTERM raise an exception in the `with` block. The next testbed removes what
    a killed one left behind. Use it from the main thread only, because only there signals can be delayed.
    """

    def __init__(
        self, out: Path, setups: Mapping[str, Setup] | None = None, *, ready_s: float = READY_S
    ) -> None:
        self.out = out
        self.ready_s = ready_s
        self.run = new_run()
        self._setups = {CLOUD: Setup(), WAN: Setup()} | dict(setups or {})
        self._connected: Engine | None = None
        self._networks: dict[str, Any] = {}
        self._containers: dict[str, Any] = {}
        self._outputs: dict[str, Output] = {}
        self._hogs: dict[str, ContainerHogs] = {}
        self._meters: dict[str, UsageMeter] = {}
        self._relays: dict[str, RelayClient] = {}  # by the name of the relay, once it was started
        self._terminate_before: Any = None

    def __enter__(self) -> Self:
        self._terminate_before = signal.signal(signal.SIGTERM, leave)
        try:
            check_compose()
            self._connected = Engine(self.run)
            build_images(sorted({inside.service_of(name, setup) for name, setup in self._setups.items()}))
            with docker_errors(), uninterrupted():
                self.out.mkdir(parents=True, exist_ok=True)
                CACHE.mkdir(parents=True, exist_ok=True)
                self._engine.remove_left_behind()
                for name in (NEAR, FAR):
                    self._networks[name] = self._engine.create_closed_network(name)
                self._networks[CONTROL] = self._engine.create_open_network(CONTROL)
        except BaseException:  # also after Ctrl-C, remove what was made so far
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        finally:
            signal.signal(signal.SIGTERM, self._terminate_before)

    def start(self, *parts: str) -> None:
        for name in parts or [part for part in self._setups if kind_of(part) != ROBOT]:
            self._start(name)

    def container(self, part: str) -> Any:
        """The container of a part that was started, as the Docker SDK represents it."""
        return self._containers[part]

    def running(self, part: str) -> bool:
        return part in self._outputs and self.exit_code(part) is None

    @docker_errors()
    def exit_code(self, part: str) -> int | None:
        container = self._containers[part]
        container.reload()
        state = container.attrs["State"]
        return None if state["Running"] else inside.as_popen(state["ExitCode"])

    @docker_errors()
    def kill(self, part: str) -> None:
        container = self._containers[part]
        try:
            container.kill(signal.SIGKILL)
        except Refusal:  # the part has ended already, or is paused and this engine kills no paused container
            container.reload()
            if container.status == "paused":
                container.unpause()
                container.kill(signal.SIGKILL)
            elif container.attrs["State"]["Running"]:
                raise
        container.wait(timeout=KILL_S)
        self._outputs[part].finish()

    @docker_errors()
    def stop(self, part: str) -> None:
        container = self._containers[part]
        container.reload()
        if container.status == "paused":
            container.unpause()
        container.stop(timeout=round(TERMINATE_S))
        self._outputs[part].finish()

    @docker_errors()
    def pause(self, part: str) -> None:
        for left in reversed(range(PAUSE_TRIES)):
            try:
                self._containers[part].pause()
                return
            except Refusal as error:  # a part that its quota stops at this instant may not freeze in time
                if not left or "freeze" not in reason(error):
                    raise

    @docker_errors()
    def resume(self, part: str) -> None:
        self._containers[part].unpause()

    @docker_errors()
    def set_cpus(self, part: str, cpus: float) -> None:
        self._containers[part].update(**inside.quota(cpus))

    @docker_errors()
    def held(self, part: str) -> str | None:
        container = self._containers[part]
        container.reload()
        quota_us, period_us = (container.attrs["HostConfig"][name] for name in ("CpuQuota", "CpuPeriod"))
        return f"{quota_us / period_us:g} CPU over {period_us / 1e3:g} ms by Docker" if quota_us else None

    @docker_errors()
    def set_hogs(self, part: str, count: int) -> None:
        self._hogs[part].set(count)

    def set_link(self, server: str | None = None, **changes: Any) -> dict[str, Any]:
        first, *_ = [self._link(one).set_link(changes) for one in self._servers(server)]
        return first

    def begin_recording(self, server: str) -> None:
        self._link(server).begin_recording()

    def link(self, server: str = CLOUD) -> dict[str, Any]:
        return self._link(server).link()

    def reset(self, server: str | None = None) -> None:
        for one in self._servers(server):
            self._link(one).reset()

    @docker_errors()
    def cut(self, part: str) -> None:
        for network in KINDS[kind_of(part)].networks:
            self._networks[network].disconnect(self._containers[part])

    @docker_errors()
    def join(self, part: str) -> None:
        for network in KINDS[kind_of(part)].networks:
            self._networks[network].connect(self._containers[part], **self._endpoint(network, part))

    @docker_errors()
    def usage(self, part: str) -> Usage:
        meter = self._meters.pop(part, None) or UsageMeter(self._engine.api, self._containers[part].id)
        try:
            used = meter.read()
        except OSError as error:
            meter.close()
            raise OffloadError(f"{part}: memory and handles cannot be read: {error}") from error
        self._meters[part] = meter
        return used

    def close(self) -> None:
        """Stop and remove everything, in reverse order.

        It takes a bounded time; Ctrl-C does not interrupt it.
        """
        with uninterrupted(), contextlib.ExitStack() as last:
            if self._connected is None:
                return
            engine, self._connected = self._connected, None
            last.callback(engine.close)
            for output in self._outputs.values():
                last.callback(output.finish)
            last.callback(engine.remove_all)
            for part in tuple(self._meters):
                last.callback(self._close_meter, part)
            for part in self._outputs:
                last.callback(self._stop_if_possible, part)

    def _close_meter(self, part: str) -> None:
        if part in self._meters:
            self._meters.pop(part).close()

    def _stop_if_possible(self, part: str) -> None:
        with contextlib.suppress(OffloadError):  # a part that cannot be stopped is removed anyway
            self.stop(part)

    @property
    def _engine(self) -> Engine:
        assert self._connected is not None, "the testbed is used outside its `with` block"
        return self._connected

    def _start(self, name: str) -> None:
        """Start the part, or start it again if it has ended.

        Wait until it is ready, if it has an HTTP API.
        """
        assert not self.running(name), f"{name} is running already"
        setup, again = self._setups[name], name in self._outputs
        with docker_errors(), uninterrupted():
            container = self._containers.get(name) or self._create(name, setup)
            self._containers[name] = container
            log = None if setup.shown else self.out / "logs" / f"{name}.log"
            output = output_of(container)  # attached before the start, so that nothing is missed
            self._outputs[name] = Output(name, output, log, again=again)
            self._outputs[name].start()
            self._hogs[name] = ContainerHogs(name, self._engine.api, container)
            self._close_meter(name)
            container.start()
            with contextlib.suppress(Refusal):  # the part has ended already
                self._meters[name] = UsageMeter(self._engine.api, container.id)
        if KINDS[kind_of(name)].http is not None:
            self._wait_ready(name)

    def _create(self, name: str, setup: Setup) -> Any:
        """The container of a part, connected to all its networks.

        The network through which we control the part comes first.
        """
        kind = KINDS[kind_of(name)]
        flags = {**inside.addresses(name, self._setups), **setup.flags}
        flags, folders = inside.as_seen(name, flags, self.out)
        folders[CACHE.resolve()] = inside.COMPILED
        first, *others = kind.networks if kind.http is None else (CONTROL, *kind.networks)
        container = self._engine.create(
            Container(
                name=name,
                image=inside.IMAGES[inside.service_of(name, setup)],
                program=kind.program,
                command=[*setup.command.split(), *kind.command, *as_flags(flags)],
                network=self._networks[first],
                folders=folders,
                read_only=frozenset(
                    place for place in folders.values() if place.is_relative_to(inside.INPUTS)
                ),
                environment={PART: name},
                address=None if first == CONTROL else self._endpoint(first, name),
                ports=() if kind.http is None else (kind.http,),
                quota={} if setup.cpus is None else inside.quota(setup.cpus),
            )
        )
        for network in others:
            self._networks[network].connect(container, **self._endpoint(network, name))
        return container

    @docker_errors()
    def _wait_ready(self, name: str) -> None:
        """Poll until the part answers 200.

        If it ends before, or takes too long, the error contains its last output.
        """
        kind, output = KINDS[kind_of(name)], self._outputs[name]
        end_s = time.monotonic() + self.ready_s
        while (code := self.exit_code(name)) is None:
            address = self._published(name)
            with contextlib.suppress(OffloadError):
                if address is not None and ask(address, "GET", kind.ready)[0] == HTTPStatus.OK:
                    if kind_of(name) == WAN:
                        self._relays[name] = RelayClient(address)
                    return
            if time.monotonic() > end_s:
                raise OffloadError(
                    f"{name} was not ready within {self.ready_s:g} s; its log ends with:\n{output.tail()}"
                )
            time.sleep(POLL_S)
        output.finish()
        if code == USAGE_EXIT:
            raise ConfigError(output.tail())
        where = output.log or "its output"
        raise OffloadError(
            f"{name} ended during start with exit code {code}; {where} ends with:\n{output.tail()}"
        )

    def _published(self, name: str) -> str | None:
        """HOST:PORT of the HTTP API of a part, which changes with each start.

        None if the part has just ended.
        """
        ports = self._containers[name].attrs["NetworkSettings"]["Ports"]
        found = ports.get(f"{KINDS[kind_of(name)].http}/tcp")
        return f"{found[0]['HostIp']}:{found[0]['HostPort']}" if found else None

    def _link(self, server: str) -> RelayClient:
        assert relay_of(server) in self._relays, f"{relay_of(server)} was not started"
        return self._relays[relay_of(server)]

    def _servers(self, server: str | None) -> tuple[str, ...]:
        return servers_among(self._setups) if server is None else (server,)

    def _endpoint(self, network: str, part: str) -> dict[str, Any]:
        """The name and the address of a part on a network; the network itself has the first address."""
        subnet = ipaddress.ip_network(self._networks[network].attrs["IPAM"]["Config"][0]["Subnet"])
        return {"aliases": [part], "ipv4_address": str(subnet[2 + list(self._setups).index(part)])}
