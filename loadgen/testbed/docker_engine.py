"""The Docker engine: makes, finds and removes the containers and networks of one testbed run.

The only file that imports the Docker SDK; errors of the SDK become OffloadError. What a container runs is
decided by `docker_testbed`.
"""

import contextlib
import itertools
import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, MissingExtra, OffloadError
from offboard.loadgen.testbed.process_owner import is_gone, owner, started

try:
    import docker
    from docker.errors import APIError, DockerException, NotFound
    from docker.types import IPAMConfig, IPAMPool, Mount
    from docker.utils.socket import SocketError, frames_iter
except ImportError as error:
    raise MissingExtra("--testbed: docker", "bench") from error

PREFIX = "offboard-run"
RUN, OWNER = "offboard.run", "offboard.owner"  # labels of every container and network
ANSWER_S = 60.0  # longest wait for one answer of the engine
PIDS_MAX = 512  # processes and threads of one container
SUBNET_TRIES = 5
Refusal = APIError  # the engine refused one request
_numbers = itertools.count(1)


@contextlib.contextmanager
def docker_errors() -> Iterator[None]:
    """Raises OffloadError if the engine refuses a request or does not answer in time. Also a decorator."""
    try:
        yield
    except (DockerException, OSError) as error:  # OSError: from `requests`
        raise OffloadError(f"docker: {reason(error)}") from error


def reason(error: Exception) -> str:
    """The engine's own words for an error."""
    return str(getattr(error, "explanation", None) or error)


@dataclass(frozen=True)
class Container:
    """Everything that a new container needs.

    `folders` are bind mounts: our folder -> folder in the container, read-only if it is in `read_only`.
    `ports` are published on free ports of 127.0.0.1. `address` is the fixed address on `network`; None: any.
    """

    name: str
    image: str
    program: str
    command: list[str]
    network: Any
    folders: Mapping[Path, Path]
    read_only: frozenset[Path] = frozenset()
    environment: Mapping[str, str] = field(default_factory=dict)
    address: Mapping[str, Any] | None = None
    ports: tuple[int, ...] = ()
    quota: Mapping[str, int] = field(default_factory=dict)


def new_run() -> str:
    """A name for a testbed run that no other run on this machine has."""
    return f"{os.getpid()}-{started(os.getpid())}-{next(_numbers)}"


class Engine:
    """A connection to the engine. Everything that it makes is labelled with `run` and with this process."""

    def __init__(self, run: str) -> None:
        self._run = run
        try:
            self._client = docker.from_env(timeout=ANSWER_S)
        except (DockerException, OSError) as error:
            raise ConfigError(f"--testbed: docker: the engine does not answer: {reason(error)}") from error

    @property
    def api(self) -> Any:
        """The low-level client of the SDK."""
        return self._client.api

    def close(self) -> None:
        """Disconnect; what was made stays."""
        self._client.close()

    def remove_all(self) -> None:
        """Remove every container and network of this run."""
        self._remove(self._run)

    def create(self, wanted: Container) -> Any:
        """Make a container that is as isolated as possible and runs as our own user."""
        options: dict[str, Any] = dict(wanted.quota)
        if wanted.ports:
            options["ports"] = dict.fromkeys(wanted.ports, ("127.0.0.1", None))
        if wanted.address is not None:
            endpoint = self.api.create_endpoint_config(**wanted.address)
            options["networking_config"] = {wanted.network.name: endpoint}
        return self._client.containers.create(
            wanted.image,
            wanted.command,
            entrypoint=[wanted.program],
            name=self._name(wanted.name),
            labels=self._labels(),
            environment=dict(wanted.environment),
            network=wanted.network.name,
            user=f"{os.getuid()}:{os.getgid()}",
            mounts=[
                Mount(str(place), str(folder), type="bind", read_only=place in wanted.read_only)
                for folder, place in wanted.folders.items()
            ],
            # A part that is cut off finds no names. It must not ask other servers, and must give up soon.
            dns=["127.0.0.1"],
            dns_search=["."],
            dns_opt=["timeout:1", "attempts:1"],
            init=True,  # a part as process 1 would ignore SIGTERM until it installs a handler
            healthcheck={"test": ["NONE"]},  # the health check of the image uses the part's CPU every 2 s
            log_config={"type": "none"},
            cap_drop=["ALL"],
            security_opt=["no-new-privileges:true"],
            pids_limit=PIDS_MAX,
            **options,
        )

    def create_open_network(self, name: str) -> Any:
        """A network that the host can reach; its members cannot reach each other."""
        options = {"com.docker.network.bridge.enable_icc": "false"}
        return self._client.networks.create(self._name(name), labels=self._labels(), options=options)

    def create_closed_network(self, name: str) -> Any:
        """A network without a way out, on which we choose the addresses."""
        full, create = self._name(name), self._client.networks.create
        for _ in range(SUBNET_TRIES):
            # Docker allows fixed addresses only in a subnet that we name. Let it find a free one first.
            found = create(full, labels=self._labels())
            found.reload()
            pool = IPAMPool(subnet=found.attrs["IPAM"]["Config"][0]["Subnet"])
            found.remove()
            try:
                ipam = IPAMConfig(pool_configs=[pool])
                network = create(full, labels=self._labels(), internal=True, ipam=ipam)
            except APIError as error:
                refused = error  # another program took the subnet in between
            else:
                network.reload()
                return network
        raise refused

    def remove_left_behind(self) -> None:
        """Remove the containers and networks of testbeds whose process is gone."""
        found = [
            *self._client.containers.list(all=True, sparse=True, filters={"label": OWNER}),
            *self._client.networks.list(filters={"label": OWNER}),
        ]
        for run in {one.attrs["Labels"][RUN] for one in found if is_gone(one.attrs["Labels"][OWNER])}:
            with contextlib.suppress(OffloadError):  # another testbed may be removing the same ones
                self._remove(run)

    @docker_errors()
    def _remove(self, run: str) -> None:
        """Remove everything of a run; tries all, then raises the first failure."""
        failed: list[Exception] = []
        label = {"label": f"{RUN}={run}"}
        for container in self._client.containers.list(all=True, sparse=True, filters=label):
            _try_to(failed, container.remove, force=True, v=True)
        for network in self._client.networks.list(filters=label):
            _try_to(failed, network.remove)
        if failed:
            raise failed[0]

    def _name(self, name: str) -> str:
        return f"{PREFIX}-{self._run}-{name}"

    def _labels(self) -> dict[str, str]:
        return {RUN: self._run, OWNER: owner(os.getpid())}


def output_of(container: Any) -> Iterator[bytes]:
    """The output of a container until it ends. Attaches at once, before the first chunk is asked for."""
    return _chunks(container.attach_socket())


def _chunks(attached: Any) -> Iterator[bytes]:
    # Close the response, which closes the socket; closing the socket first breaks the response.
    with (
        contextlib.closing(getattr(attached, "_response", attached)),
        contextlib.suppress(OSError, SocketError),
    ):
        for _, chunk in frames_iter(attached, tty=False):
            yield chunk


def _try_to(failed: list[Exception], remove: Callable[..., object], **how: bool) -> None:
    try:
        remove(**how)
    except NotFound:
        pass
    except (DockerException, OSError) as error:
        failed.append(error)
