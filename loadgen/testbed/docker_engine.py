"""The Docker engine: builds the images, and makes and removes the containers and networks of one testbed run.

The only file that imports the Docker SDK; errors of the SDK become OffloadError. What a container runs is
decided by `docker_testbed`.
"""

import contextlib
import itertools
import os
import socket
import subprocess
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from offboard.common.errors import ConfigError, MissingExtra, OffloadError
from offboard.loadgen.progress import progress
from offboard.loadgen.testbed.container_part import INPUTS

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
COMPOSE_FILE = Path("docker-compose.yml")
COMPOSE_VERSION = ("docker", "compose", "version")
BUILD = ("docker", "compose", "--progress", "quiet", "-f", str(COMPOSE_FILE), "build")
ASK_S = 30.0
BUILD_S = 1800.0
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
    return str(getattr(error, "explanation", None) or error)


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
        self._remove(self._run)

    def create(
        self, name: str, image: str, command: list[str], *, folders: Mapping[Path, Path], **options: Any
    ) -> Any:
        """Make a container that is as isolated as possible and runs as our own user.

        `folders` are bind mounts: our folder -> folder in the container, read-only if it is in INPUTS.
        """
        return self._client.containers.create(
            image,
            command,
            name=self._name(name),
            labels=self._labels(),
            user=f"{os.getuid()}:{os.getgid()}",
            mounts=[
                Mount(str(place), str(folder), type="bind", read_only=place.is_relative_to(INPUTS))
                for folder, place in folders.items()
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

    def fixed_address(self, network: Any, endpoint: Mapping[str, Any]) -> dict[str, Any]:
        """The option `networking_config` of a new container that has this endpoint on its network."""
        return {network.name: self.api.create_endpoint_config(**endpoint)}

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
        """Remove everything of a run, the containers before their networks; tries all, whatever fails."""
        label = {"label": f"{RUN}={run}"}
        with contextlib.ExitStack() as last:
            for network in self._client.networks.list(filters=label):
                last.callback(_remove_unless_gone, network)
            for container in self._client.containers.list(all=True, sparse=True, filters=label):
                last.callback(_remove_unless_gone, container, force=True, v=True)

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


def check_compose() -> None:
    """ConfigError if images cannot be built here."""
    if not COMPOSE_FILE.is_file():
        raise ConfigError(f"--testbed: docker: {COMPOSE_FILE} not found; run this in a checkout of Offboard")
    try:
        asked = subprocess.run(COMPOSE_VERSION, capture_output=True, text=True, timeout=ASK_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ConfigError(f"--testbed: docker cannot be run: {error}") from error
    if asked.returncode != 0:
        message = (asked.stderr.strip() or "no message").splitlines()[-1]
        raise ConfigError(f"--testbed: docker: `{' '.join(COMPOSE_VERSION)}` failed: {message}")


def build_images(services: Iterable[str]) -> None:
    """Build the images of these Compose services; Docker skips what has not changed."""
    build = (*BUILD, *services)
    try:
        with progress("building images"):
            code = subprocess.run(build, timeout=BUILD_S, check=False).returncode
    except subprocess.TimeoutExpired as error:
        raise OffloadError(f"`{' '.join(build)}` has not ended after {BUILD_S:g} s") from error
    if code != 0:
        raise OffloadError(f"`{' '.join(build)}` failed with exit code {code}")


def owner(pid: int) -> str:
    """A name that no other process ever has, on any machine: host, process namespace, pid and start time."""
    return f"{_host()}/{pid}/{started(pid)}"


def is_gone(name: str) -> bool:
    """Whether the process with this name is known to be gone; False for a process of another host."""
    host, pid, _ = name.rsplit("/", 2)
    return host == _host() and name != owner(int(pid))


def started(pid: int) -> int | None:
    """The start time of a process, in kernel ticks since boot; None if there is no such process."""
    try:
        return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19])
    except OSError:
        return None


def _host() -> str:
    return f"{socket.gethostname()}/{Path('/proc/self/ns/pid').readlink()}"


def _remove_unless_gone(made: Any, **how: bool) -> None:
    with contextlib.suppress(NotFound):
        made.remove(**how)
