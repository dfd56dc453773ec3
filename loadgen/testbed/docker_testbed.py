"""The Docker testbed: runs the parts as containers of the checkout's images, and removes them with itself.

    robots --(near)--> relays --(far)--> servers       relays, servers --(control)--> 127.0.0.1 of the host

`docker_engine` makes containers and networks; `container_part` says what a part is inside its container.
"""

import contextlib
import ipaddress
import signal
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any

from offboard.common.errors import OffloadError
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.relay_client import RelayClient, ask
from offboard.loadgen.testbed import container_part as inside
from offboard.loadgen.testbed.container_part import FAR, KINDS, NEAR, ContainerHogs, UsageMeter
from offboard.loadgen.testbed.docker_engine import (
    Engine,
    Refusal,
    build_images,
    check_compose,
    docker_errors,
    new_run,
    output_of,
    reason,
)
from offboard.loadgen.testbed.real_testbed import (
    KILL_S,
    TERMINATE_S,
    Output,
    RealTestbed,
    poll_until_ready,
    uninterrupted,
)
from offboard.loadgen.testbed.testbed import PART, WAN, Setup, Usage, kind_of, servers_among, servers_behind

CONTROL = "control"
# The compiled planner, shared by all containers and all runs of this checkout.
CACHE = Path(".cache/containers")
READY_S = 120.0  # the first compilation of the planner takes most of it
PAUSE_TRIES = 10


class DockerTestbed(RealTestbed):
    """Robots --> relay --> server, each in its own container; `run` labels everything that the testbed makes.

    Robots can reach only the relays, and only the relays can reach a server; these networks have no way out.
    We control relays and servers over a third network. A part keeps its addresses, and its container
    when it is started again, so that after a cut the same connections go on.

    All containers run as our own user, so that we own the files under `out`, and share one cache of the
    compiled planner. The next testbed removes what a killed one left behind.
    `containers` are those of the parts that were started, as the Docker SDK represents them.
    """

    def __init__(self, out: Path, setups: Mapping[str, Setup] | None = None) -> None:
        super().__init__(out, setups, READY_S)
        self.run = new_run()
        self.containers: dict[str, Any] = {}
        self._connected: Engine | None = None
        self._networks: dict[str, Any] = {}
        self._outputs: dict[str, Output] = {}
        self._hogs: dict[str, ContainerHogs] = {}
        self._meters: dict[str, UsageMeter] = {}

    def __enter__(self) -> "DockerTestbed":
        super().__enter__()
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

    def running(self, part: str) -> bool:
        return part in self._outputs and self.exit_code(part) is None

    @docker_errors()
    def exit_code(self, part: str) -> int | None:
        container = self.containers[part]
        container.reload()
        state = container.attrs["State"]
        return None if state["Running"] else inside.as_popen(state["ExitCode"])

    @docker_errors()
    def kill(self, part: str) -> None:
        container = self.containers[part]
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
        container = self.containers[part]
        container.reload()
        if container.status == "paused":
            container.unpause()
        container.stop(timeout=round(TERMINATE_S))
        self._outputs[part].finish()

    @docker_errors()
    def pause(self, part: str) -> None:
        for left in reversed(range(PAUSE_TRIES)):
            try:
                self.containers[part].pause()
                return
            except Refusal as error:  # a part that its quota stops at this instant may not freeze in time
                if not left or "freeze" not in reason(error):
                    raise

    @docker_errors()
    def resume(self, part: str) -> None:
        self.containers[part].unpause()

    @docker_errors()
    def set_cpus(self, part: str, cpus: float) -> None:
        self.containers[part].update(**inside.quota(cpus))

    @docker_errors()
    def held(self, part: str) -> str | None:
        container = self.containers[part]
        container.reload()
        quota_us, period_us = (container.attrs["HostConfig"][name] for name in ("CpuQuota", "CpuPeriod"))
        return f"{quota_us / period_us:g} CPU over {period_us / 1e3:g} ms by Docker" if quota_us else None

    @docker_errors()
    def set_hogs(self, part: str, count: int) -> None:
        self._hogs[part].set(count)

    @docker_errors()
    def cut(self, part: str) -> None:
        for network in KINDS[kind_of(part)].networks:
            self._networks[network].disconnect(self.containers[part])

    @docker_errors()
    def join(self, part: str) -> None:
        for network in KINDS[kind_of(part)].networks:
            self._networks[network].connect(self.containers[part], **self._endpoint(network, part))

    @docker_errors()
    def usage(self, part: str) -> Usage:
        meter = self._meters.pop(part, None) or UsageMeter(self._engine.api, self.containers[part].id)
        try:
            used = meter.read()
        except OSError as error:
            meter.close()
            raise OffloadError(f"{part}: memory and handles cannot be read: {error}") from error
        self._meters[part] = meter
        return used

    def close(self) -> None:
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
        assert not self.running(name), f"{name} is running already"
        setup, again = self._setups[name], name in self._outputs
        with docker_errors(), uninterrupted():
            container = self.containers.get(name) or self._create(name, setup)
            self.containers[name] = container
            log = None if setup.shown else self._log(name)
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
        options: dict[str, Any] = {} if setup.cpus is None else inside.quota(setup.cpus)
        if kind.http is None:
            first, *others = kind.networks
            options["networking_config"] = self._engine.fixed_address(
                self._networks[first], self._endpoint(first, name)
            )
        else:
            first, others = CONTROL, list(kind.networks)
            options["ports"] = {kind.http: ("127.0.0.1", None)}  # on a free port
        container = self._engine.create(
            name,
            inside.IMAGES[inside.service_of(name, setup)],
            [*setup.command.split(), *kind.command, *as_flags(flags)],
            folders=folders,
            entrypoint=[kind.program],
            environment={PART: name},
            network=self._networks[first].name,
            **options,
        )
        for network in others:
            self._networks[network].connect(container, **self._endpoint(network, name))
        return container

    @docker_errors()
    def _wait_ready(self, name: str) -> None:
        """Wait until the part answers 200; otherwise the error contains its last output."""
        kind, output = KINDS[kind_of(name)], self._outputs[name]

        def ready() -> bool:
            address = self._published(name)
            if address is None or ask(address, "GET", kind.ready)[0] != HTTPStatus.OK:
                return False
            if kind_of(name) == WAN:
                (server,) = servers_behind(name, servers_among(self._setups))
                self._relays[server] = RelayClient(address)
            return True

        def exit_code() -> int | None:
            code = self.exit_code(name)
            if code is not None:
                output.finish()
            return code

        log = output.log or "its output"
        poll_until_ready(name, ready, exit_code, tail=output.tail, log=log, timeout_s=self.ready_s)

    def _published(self, name: str) -> str | None:
        """HOST:PORT of the HTTP API of a part, which changes with each start; None if it has just ended."""
        ports = self.containers[name].attrs["NetworkSettings"]["Ports"]
        found = ports.get(f"{KINDS[kind_of(name)].http}/tcp")
        return f"{found[0]['HostIp']}:{found[0]['HostPort']}" if found else None

    def _endpoint(self, network: str, part: str) -> dict[str, Any]:
        """The name and the address of a part on a network; the network itself has the first address."""
        subnet = ipaddress.ip_network(self._networks[network].attrs["IPAM"]["Config"][0]["Subnet"])
        return {"aliases": [part], "ipv4_address": str(subnet[2 + list(self._setups).index(part)])}
