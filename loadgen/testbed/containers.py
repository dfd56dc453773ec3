"""The Docker testbed: the parts as containers of the checkout's images, all gone when it is.

    robots --(near)--> wan --(far)--> cloud        wan and cloud --(control)--> 127.0.0.1 of the host

What a part is inside of its container is `inside.py`, what it says `output.py`.
"""

import contextlib
import ipaddress
import itertools
import os
import signal
import time
from collections.abc import Callable, Iterator, Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self

from offboard.common.errors import ConfigError, MissingExtra, OffloadError
from offboard.loadgen.relay.link.link_settings import as_flags
from offboard.loadgen.relay.relay_client import RelayClient, ask
from offboard.loadgen.testbed import container_part as inside
from offboard.loadgen.testbed.container_output import Output
from offboard.loadgen.testbed.container_part import FAR, NEAR, kind_of
from offboard.loadgen.testbed.docker_images import build_images, check_compose
from offboard.loadgen.testbed.owner import is_gone, owner, started
from offboard.loadgen.testbed.part import KILL_S, POLL_S, TERMINATE_S, USAGE_EXIT, leave, uninterrupted
from offboard.loadgen.testbed.testbed import CLOUD, PART, WAN, Setup, Usage
from offboard.loadgen.testbed.usage_meter import Meter

try:
    import docker
    from docker.errors import APIError, DockerException, NotFound
    from docker.types import IPAMConfig, IPAMPool, Mount
    from docker.utils.socket import SocketError, frames_iter
except ImportError as error:
    raise MissingExtra("--testbed: docker", "bench") from error

PREFIX = "offboard-run"
RUN, OWNER = "offboard.run", "offboard.owner"  # labels of every container and network
CONTROL = "control"
CACHE = Path(".cache/containers")  # the compiled planner, for all containers and all runs of this checkout
READY_S = 120.0  # compiling the planner for the first time takes most of it
ENGINE_S = 60.0  # for one answer of the engine
HOG_END_S = 10.0
PIDS_MAX = 512  # processes and threads of one container
SUBNET_TRIES = 5
PAUSE_TRIES = 10
_numbers = itertools.count(1)


@contextlib.contextmanager
def _renamed() -> Iterator[None]:
    """What the engine refuses, or does not answer in time, as OffloadError."""
    try:
        yield
    except (DockerException, OSError) as error:  # OSError: what `requests` raises
        raise OffloadError(f"docker: {_said(error)}") from error


class DockerTestbed:
    """Robots --> relay --> cloud, each in a container of its own; `run` labels all that is made.

    Robots reach nothing but the relay, and the relay reaches the cloud, on networks without a way out; the
    relay and the cloud are commanded and asked over a third. A part keeps its address on a network for good:
    when a cut ends, the same connections go on. For the same reason it is one container from start to start.

    All containers run as whoever runs us: files under `out` are ours, and they share one cache of the
    compiled planner. Ctrl-C and SIGTERM leave the `with` block by an exception; what a killed testbed left
    behind is removed by the next. Use it from the main thread only: there signals can be kept waiting.
    """

    def __init__(
        self, out: Path, setups: Mapping[str, Setup] | None = None, *, ready_s: float = READY_S
    ) -> None:
        self.out = out
        self.ready_s = ready_s
        self.run = f"{os.getpid()}-{started(os.getpid())}-{next(_numbers)}"
        self._setups = {CLOUD: Setup(), WAN: Setup()} | dict(setups or {})
        self._client: Any = None
        self._networks: dict[str, Any] = {}
        self._containers: dict[str, Any] = {}
        self._outputs: dict[str, Output] = {}
        self._hogs: dict[str, list[str]] = {}  # what was executed, by its id
        self._meters: dict[str, Meter] = {}
        self._relay: RelayClient | None = None
        self._terminate_before: Any = None

    def __enter__(self) -> Self:
        self._terminate_before = signal.signal(signal.SIGTERM, leave)
        try:
            check_compose()
            self._client = _connect()
            build_images()
            with _renamed(), uninterrupted():
                self.out.mkdir(parents=True, exist_ok=True)
                CACHE.mkdir(parents=True, exist_ok=True)
                self._remove_left_behind()
                for name in (NEAR, FAR, CONTROL):
                    self._networks[name] = self._make_network(name)
        except BaseException:  # Ctrl-C too: nobody else would remove what was made so far
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.close()
        finally:
            signal.signal(signal.SIGTERM, self._terminate_before)

    def start(self, *parts: str) -> None:
        for name in parts or (CLOUD, WAN):
            self._start(name)

    def running(self, part: str) -> bool:
        return part in self._outputs and self.exit_code(part) is None

    @_renamed()
    def exit_code(self, part: str) -> int | None:
        container = self._containers[part]
        container.reload()
        state = container.attrs["State"]
        return None if state["Running"] else inside.as_popen(state["ExitCode"])

    @_renamed()
    def kill(self, part: str) -> None:
        container = self._containers[part]
        try:
            container.kill(signal.SIGKILL)
        except APIError:  # it has ended already, or it is paused and this engine kills no paused one
            container.reload()
            if container.status == "paused":
                container.unpause()
                container.kill(signal.SIGKILL)
            elif container.attrs["State"]["Running"]:
                raise
        container.wait(timeout=KILL_S)
        self._outputs[part].finish()

    @_renamed()
    def stop(self, part: str) -> None:
        container = self._containers[part]
        container.reload()
        if container.status == "paused":
            container.unpause()
        container.stop(timeout=round(TERMINATE_S))
        self._outputs[part].finish()

    @_renamed()
    def pause(self, part: str) -> None:
        for left in reversed(range(PAUSE_TRIES)):
            try:
                self._containers[part].pause()
                return
            except APIError as error:  # a part that its quota holds this instant may not freeze in time
                if not left or "freeze" not in _said(error):
                    raise

    @_renamed()
    def resume(self, part: str) -> None:
        self._containers[part].unpause()

    @_renamed()
    def set_cpus(self, part: str, cpus: float) -> None:
        self._containers[part].update(**inside.quota(cpus))

    @_renamed()
    def held(self, part: str) -> str | None:
        container = self._containers[part]
        container.reload()
        quota_us, period_us = (container.attrs["HostConfig"][name] for name in ("CpuQuota", "CpuPeriod"))
        return f"{quota_us / period_us:g} CPU over {period_us / 1e3:g} ms by Docker" if quota_us else None

    @_renamed()
    def set_hogs(self, part: str, count: int) -> None:
        container, hogs = self._containers[part], self._hogs[part]
        while len(hogs) > count:
            self._end_hog(part, len(hogs))
            hogs.pop()
        while len(hogs) < count:
            hog = self._client.api.exec_create(container.id, inside.hog(len(hogs) + 1))
            self._client.api.exec_start(hog["Id"], detach=True)
            hogs.append(hog["Id"])

    def set_link(self, **changes: Any) -> dict[str, Any]:
        return self._link().set_link(changes)

    def link(self) -> dict[str, Any]:
        return self._link().link()

    def reset(self) -> None:
        self._link().reset()

    @_renamed()
    def cut(self, part: str) -> None:
        for network in kind_of(part).networks:
            self._networks[network].disconnect(self._containers[part])

    @_renamed()
    def join(self, part: str) -> None:
        for network in kind_of(part).networks:
            self._networks[network].connect(self._containers[part], **self._endpoint(network, part))

    @_renamed()
    def usage(self, part: str) -> Usage:
        meter = self._meters.pop(part, None) or Meter(self._client.api, self._containers[part].id)
        try:
            used = meter.read()
        except OSError as error:
            meter.close()
            raise OffloadError(f"{part}: what it uses cannot be read: {error}") from error
        self._meters[part] = meter
        return used

    def close(self) -> None:
        """Stop and remove all, last started first. Ctrl-C does not interrupt it; it takes a bounded time."""
        with uninterrupted(), contextlib.ExitStack() as last:
            if self._client is None:
                return
            client, self._client = self._client, None
            last.callback(client.close)
            for output in self._outputs.values():
                last.callback(output.finish)
            last.callback(_remove, client, f"{RUN}={self.run}")
            for part in tuple(self._meters):
                last.callback(self._close_meter, part)
            for part in self._outputs:
                last.callback(self._stop_at_last, part)

    def _close_meter(self, part: str) -> None:
        if part in self._meters:
            self._meters.pop(part).close()

    def _stop_at_last(self, part: str) -> None:
        with contextlib.suppress(OffloadError):  # then it is removed as it is
            self.stop(part)

    def _start(self, name: str) -> None:
        """Start the part, again if it has ended, and wait until it is ready where that can be asked."""
        assert not self.running(name), f"{name} is running already"
        setup, again = self._setups[name], name in self._outputs
        with _renamed(), uninterrupted():
            container = self._containers.get(name) or self._create(name, setup)
            self._containers[name] = container
            log = None if setup.shown else self.out / "logs" / f"{name}.log"
            said = _chunks(container.attach_socket())  # before the start, so that nothing is missed
            self._outputs[name] = Output(name, said, log, again=again)
            self._outputs[name].start()
            self._hogs[name] = []  # they ended with it
            self._close_meter(name)
            container.start()
            with contextlib.suppress(APIError):  # it has ended by now
                self._meters[name] = Meter(self._client.api, container.id)
        if kind_of(name).http is not None:
            self._wait_ready(name)

    def _create(self, name: str, setup: Setup) -> Any:
        kind = kind_of(name)
        flags, folders = inside.as_seen(name, setup.flags, self.out)
        folders[CACHE.resolve()] = inside.COMPILED
        first, *others = kind.networks if kind.http is None else (CONTROL, *kind.networks)
        options: dict[str, Any] = {} if setup.cpus is None else inside.quota(setup.cpus)
        if kind.http is not None:
            options["ports"] = {kind.http: ("127.0.0.1", None)}
        if first != CONTROL:
            endpoint = self._client.api.create_endpoint_config(**self._endpoint(first, name))
            options["networking_config"] = {self._networks[first].name: endpoint}
        container = self._client.containers.create(
            kind.image,
            [*kind.command, *as_flags(flags)],
            name=f"{PREFIX}-{self.run}-{name}",
            labels=self._labels(),
            environment={PART: name},
            network=self._networks[first].name,
            user=f"{os.getuid()}:{os.getgid()}",
            mounts=[
                Mount(str(place), str(folder), type="bind", read_only=place.is_relative_to(inside.INPUTS))
                for folder, place in folders.items()
            ],
            # Who is cut off has no name on `near` and `far`, and is not looked for elsewhere, nor for long.
            dns=["127.0.0.1"],
            dns_search=["."],
            dns_opt=["timeout:1", "attempts:1"],
            init=True,  # a part as process 1 would not hear SIGTERM before it handles it
            healthcheck={"test": ["NONE"]},  # the image's own takes from the part's CPU every 2 s
            log_config={"type": "none"},
            cap_drop=["ALL"],
            security_opt=["no-new-privileges:true"],
            pids_limit=PIDS_MAX,
            **options,
        )
        for network in others:
            self._networks[network].connect(container, **self._endpoint(network, name))
        return container

    @_renamed()
    def _wait_ready(self, name: str) -> None:
        """Poll until it answers 200; an error with what it said if it ends first, or takes too long."""
        kind, output = kind_of(name), self._outputs[name]
        end_s = time.monotonic() + self.ready_s
        while (code := self.exit_code(name)) is None:
            address = self._published(name)
            with contextlib.suppress(OffloadError):
                if address is not None and ask(address, "GET", kind.ready)[0] == HTTPStatus.OK:
                    if name == WAN:
                        self._relay = RelayClient(address)
                    return
            if time.monotonic() > end_s:
                raise OffloadError(
                    f"{name} was not ready within {self.ready_s:g} s; it logged:\n{output.tail()}"
                )
            time.sleep(POLL_S)
        output.finish()
        if code == USAGE_EXIT:
            raise ConfigError(output.tail())
        where = output.log or "its output"
        raise OffloadError(f"{name} ended at start, exit code {code}; {where} ends with:\n{output.tail()}")

    def _published(self, name: str) -> str | None:
        """HOST:PORT of its HTTP side, another one after each start; None where it has just ended."""
        ports = self._containers[name].attrs["NetworkSettings"]["Ports"]
        found = ports.get(f"{kind_of(name).http}/tcp")
        return f"{found[0]['HostIp']}:{found[0]['HostPort']}" if found else None

    def _link(self) -> RelayClient:
        assert self._relay is not None, f"{WAN} was not started"
        return self._relay

    def _end_hog(self, part: str, number: int) -> None:
        end_s = time.monotonic() + HOG_END_S
        while self._client.api.exec_inspect(self._hogs[part][number - 1])["Running"]:
            if time.monotonic() > end_s:
                raise OffloadError(f"{part}: hog {number} has not ended after {HOG_END_S:g} s")
            self._containers[part].exec_run(inside.end_hog(number))  # again: it may only just have begun

    def _labels(self) -> dict[str, str]:
        return {RUN: self.run, OWNER: owner(os.getpid())}

    def _make_network(self, name: str) -> Any:
        """`control`, whose members do not reach each other; or one without a way out, its addresses ours."""
        full, make = f"{PREFIX}-{self.run}-{name}", self._client.networks.create
        if name == CONTROL:
            options = {"com.docker.network.bridge.enable_icc": "false"}
            return make(full, labels=self._labels(), options=options)
        for _ in range(SUBNET_TRIES):
            # Docker gives out fixed addresses in a subnet that was named only: have it find a free one.
            found = make(full, labels=self._labels())
            found.reload()
            pool = IPAMPool(subnet=found.attrs["IPAM"]["Config"][0]["Subnet"])
            found.remove()
            try:
                ipam = IPAMConfig(pool_configs=[pool])
                network = make(full, labels=self._labels(), internal=True, ipam=ipam)
            except APIError as error:
                refused = error  # somebody else took it in between
            else:
                network.reload()
                return network
        raise refused

    def _endpoint(self, network: str, part: str) -> dict[str, Any]:
        """The name and address of a part on a network, which has the first address itself."""
        subnet = ipaddress.ip_network(self._networks[network].attrs["IPAM"]["Config"][0]["Subnet"])
        return {"aliases": [part], "ipv4_address": str(subnet[2 + list(self._setups).index(part)])}

    def _remove_left_behind(self) -> None:
        """Remove what was made by testbeds whose process is gone, not what a living one uses."""
        found = [
            *self._client.containers.list(all=True, sparse=True, filters={"label": OWNER}),
            *self._client.networks.list(filters={"label": OWNER}),
        ]
        for run in {one.attrs["Labels"][RUN] for one in found if is_gone(one.attrs["Labels"][OWNER])}:
            with contextlib.suppress(OffloadError):  # another testbed may be at it too
                _remove(self._client, f"{RUN}={run}")


def _connect() -> Any:
    """The engine, or ConfigError in one line where none answers."""
    try:
        return docker.from_env(timeout=ENGINE_S)
    except (DockerException, OSError) as error:
        raise ConfigError(f"--testbed: docker: no engine answers: {_said(error)}") from error


@_renamed()
def _remove(client: Any, label: str) -> None:
    """Every container and network of this label; all are tried, then the first failure is raised."""
    failed: list[Exception] = []
    for container in client.containers.list(all=True, sparse=True, filters={"label": label}):
        _try(failed, container.remove, force=True, v=True)
    for network in client.networks.list(filters={"label": label}):
        _try(failed, network.remove)
    if failed:
        raise failed[0]


def _try(failed: list[Exception], remove: Callable[..., object], **how: bool) -> None:
    try:
        remove(**how)
    except NotFound:
        pass
    except (DockerException, OSError) as error:
        failed.append(error)


def _chunks(attached: Any) -> Iterator[bytes]:
    """What the container says, until it ends."""
    # Closing what `attached` belongs to closes it; the other way round leaves that in disorder.
    with (
        contextlib.closing(getattr(attached, "_response", attached)),
        contextlib.suppress(OSError, SocketError),
    ):
        for _, chunk in frames_iter(attached, tty=False):
            yield chunk


def _said(error: Exception) -> str:
    return str(getattr(error, "explanation", None) or error)
