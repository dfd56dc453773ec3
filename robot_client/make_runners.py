"""Makes the runners of an offloader: one for each server, and one for onboard.

What a runner does is in `sites` and, for policy servers, in `openpi`.
"""

from collections.abc import Mapping
from pathlib import Path

from offboard.common.security.keys import robot_keys
from offboard.robot_client.openpi.endpoint import is_policy_server
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import Runner


def make_runners(
    servers: Mapping[str, str], *, keys: Path | str | None, heartbeat_s: float, settings: Settings
) -> list[Runner]:
    """Connected runners; `servers` holds the endpoint of each server by name.

    `keys`: the folder with the keys (None: no encryption). `heartbeat_s`: seconds between heartbeats (0: no
    heartbeats).
    """
    runners: list[Runner] = []
    background = Background()
    try:
        for site, endpoint in servers.items():
            server = _server(
                site, endpoint, keys=keys, heartbeat_s=heartbeat_s, settings=settings, background=background
            )
            runners.append(server)
        runners.append(OnboardRunner(states=settings.states, background=background))
    except BaseException:
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
        endpoint, site=site, heartbeat_s=heartbeat_s, seed=settings.seed, keys=own, background=background
    )
