"""The flags of a robot: which servers it may use, and how it chooses a site."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

from offboard.common.config import flag_of, part_of, setting, settings_of
from offboard.common.errors import ConfigError
from offboard.common.variants import IN_GROUP
from offboard.robot_client import policies, predictors
from offboard.robot_client.policies.objectives import MEAN, S_PER_QUALITY, Energy
from offboard.robot_client.settings import DECISIONS, DecisionOptions, ObjectiveOptions, Settings
from offboard.robot_client.sites.endpoint import check_dns, check_site, is_dns
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, TIMEOUT_S

_server_setting = partial(setting, group="servers")
POLICY_HELP = (
    f"{policies.HELP}. `default` stands for {policies.DEFAULT}: run a task where it should finish first, "
    "try the other site now and then, and start the task there as well if the first site is late"
)


@dataclass(frozen=True)
class _Servers:
    cloud: str | None = _server_setting(
        None, "server to use; without any server, all tasks run onboard", metavar="tcp://HOST:PORT"
    )
    site: tuple[str, ...] = _server_setting(
        (),
        "a further server, with a name, or GROUP/NAME for one of several equal servers; ws:// or wss:// is a "
        "policy server; dns://HOST:PORT is a server at each address of HOST, of which 4 are used at a time; "
        "repeat the flag for more",
        rare=True,
        metavar="NAME=ENDPOINT",
    )
    sites: Path | None = _server_setting(
        None,
        "TOML file of servers with endpoint, key and group (docs/formats.md), read again every 2 s",
        rare=True,
        metavar="FILE",
    )
    keys: Path | None = _server_setting(
        None,
        "folder with robot.key_secret (made by `robot-client keys`) and server.key (copied from the server; "
        "NAME.key for the server of --site NAME); without it, nothing is encrypted",
        metavar="DIR",
    )
    insecure: bool = _server_setting(
        False,
        "allow ws:// to a policy server beyond this computer, and dns:// and --sites without --keys: anyone "
        "on the way can read and change what is sent",
        rare=True,
    )


@dataclass(frozen=True)
class Waits:
    """How long the robot waits for an answer; `[robot]` of a scenario has it, too."""

    timeout_s: float = _server_setting(
        TIMEOUT_S,
        "time to wait for an answer of a server before the task runs onboard, in seconds",
        name="timeout",
        minimum=0.001,
        maximum=3600,
    )


# The help shows the fields of the last base class first.
@dataclass(frozen=True)
class ServerFlags(Waits, _Servers):
    """Which servers the robot may use, and how long it waits for them."""

    connect_s: float = _server_setting(
        10.0,
        "time to wait for the servers at start, in seconds",
        rare=True,
        name="connect",
        minimum=0.0,
        maximum=3600,
    )

    def check_servers(self) -> None:
        if self.cloud is not None:
            check_site("--cloud", self.cloud, insecure=self.insecure)
        if self.sites is not None and self.site:
            raise ConfigError(f"--sites: {self.sites} cannot be combined with --site; list all servers in it")
        if self.keys is not None and self.cloud is None and not (self.site or self.sites):
            raise ConfigError(f"--keys: {self.keys} needs --cloud, the server to use")
        self.further()

    @property
    def changing(self) -> str | None:
        """The flag of servers that may change during the run."""
        if self.sites is not None:
            return "--sites"
        return next((f"--site {name}" for name, one in self.further().items() if is_dns(one)), None)

    def further(self) -> dict[str, str]:
        """The endpoint of each --site, by its name."""
        found: dict[str, str] = {}
        for entry in self.site:
            name, equals, endpoint = entry.partition("=")
            parts = name.split(IN_GROUP)
            if not (equals and len(parts) <= 2 and all(part.isidentifier() for part in parts)):
                allowed = "NAME=tcp://HOST:PORT or NAME=ws://HOST:PORT, where NAME may be GROUP/NAME"
                raise ConfigError(f"--site: {entry!r} is not {allowed}")
            free = CLOUD if self.cloud is None and is_dns(endpoint) else ""
            if name in {ONBOARD, CLOUD, *found} - {free}:
                raise ConfigError(f"--site: {entry!r}: the name {name!r} is already taken")
            if is_dns(endpoint):
                check_dns(f"--site {name}", endpoint)
            else:
                check_site(f"--site {name}", endpoint, insecure=self.insecure)
            found[name] = endpoint
        return found


@dataclass(frozen=True, kw_only=True)
class _PolicyFlag:
    policy: str = setting(
        policies.DEFAULT, f"rule that chooses the site: {POLICY_HELP}", group=DECISIONS, metavar="NAME"
    )


@dataclass(frozen=True, kw_only=True)
class DecisionFlags(ObjectiveOptions, DecisionOptions, _PolicyFlag):
    """How the robot decides where a task runs."""

    def check_decisions(self) -> None:
        policies.check_name(self.policy, "--policy")
        if self.predictor is not None:
            predictors.check_name(self.predictor, "--predictor")
        flags = {field.name: f"--{flag_of(field)}" for field in settings_of(type(self))}
        self.check_objective(flags.__getitem__)
        if self.objective != MEAN and not policies.weighs_cost(self.policy):
            raise ConfigError(f"--objective: {self.objective} changes nothing with --policy {self.policy}")
        by_deadline = self.objective == "deadline"
        if self.s_per_quality != S_PER_QUALITY and (by_deadline or not policies.weighs_cost(self.policy)):
            ignored_by = "--objective deadline" if by_deadline else f"--policy {self.policy}"
            raise ConfigError(f"--s-per-quality: {self.s_per_quality:g} changes nothing with {ignored_by}")

    def settings(self) -> Settings:
        """The rare options of the offloader."""
        return part_of(Settings, self, objective=self.make(), energy=part_of(Energy, self))
