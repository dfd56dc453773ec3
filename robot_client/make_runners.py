"""Makes the runners of an offloader: one for each server, and one for onboard.

What a runner does is in `sites` and, for policy servers, in `openpi`.
"""

from collections.abc import Mapping
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.common.security.keys import robot_keys
from offboard.robot_client.openpi.endpoint import is_policy_server
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites import heartbeat
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, Runner


def make_runners(
    endpoint: str | None,
    sites: Mapping[str, str],
    *,
    keys: Path | str | None,
    policy: str,
    settings: Settings,
) -> list[Runner]:
    """Connected runners: of the server at `endpoint`, of each further one in `sites`, and of onboard.

    `keys`: the folder with the keys (None: no encryption). `policy`: the name of the policy.
    """
    if endpoint is not None and CLOUD in sites:
        raise ConfigError(f"sites: {CLOUD!r} is the name of the server at {endpoint}; choose another one")
    servers = ({} if endpoint is None else {CLOUD: endpoint}) | dict(sites)
    if keys is not None and not servers:
        raise ConfigError(f"keys: {keys} needs an endpoint, the server to use")
    heartbeat_s = heartbeat.EVERY_S if settings.beats(policy) else 0.0
    runners: list[Runner] = []
    background = Background()
    try:
        for site, one in servers.items():
            server = _server(
                site, one, keys=keys, heartbeat_s=heartbeat_s, settings=settings, background=background
            )
            runners.append(server)
        runners.append(OnboardRunner(states=settings.states, background=background))
    except BaseException:  # also after Ctrl-C, no thread or socket of the others is left
        for runner in runners:
            runner.close()
        raise
    return runners


def _server(
    site: str,
    endpoint: str,
    *,
    keys: Path | str | None,
    heartbeat_s: float,
    settings: Settings,
    background: Background,
) -> Runner:
    if is_policy_server(endpoint):
        from offboard.robot_client.openpi.policy_server import PolicyServerRunner  # its library is an extra

        return PolicyServerRunner(
            endpoint,
            site=site,
            heartbeat_s=heartbeat_s,
            seed=settings.seed,
            insecure=settings.insecure,
            background=background,
        )
    own = None if keys is None else robot_keys(Path(keys), site)
    return CloudRunner(
        endpoint,
        site=site,
        heartbeat_s=heartbeat_s,
        seed=settings.seed,
        keys=own,
        background=background,
        compress=settings.compress,
    )
