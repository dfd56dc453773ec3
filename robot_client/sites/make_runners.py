"""Makes the runners of an offloader: one for each server, and one for onboard.

What a runner does is in the other files of this folder.
"""

from collections.abc import Mapping
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.common.security.keys import robot_keys
from offboard.common.task_states import TaskStates
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, Runner


def make_runners(
    endpoint: str | None,
    sites: Mapping[str, str],
    *,
    keys: Path | str | None,
    heartbeat_s: float,
    seed: int,
    states: TaskStates | None = None,
    compress: bool = True,
) -> list[Runner]:
    """Connected runners: of the server at `endpoint`, of each further one in `sites`, and of onboard.

    `keys`: the folder with the keys (None: no encryption).
    `heartbeat_s`: seconds between heartbeats (0: no heartbeats).
    `states`: those of the onboard worker (None: states of its own).
    `compress`: whether arguments may be compressed.
    """
    if endpoint is not None and CLOUD in sites:
        raise ConfigError(f"sites: {CLOUD!r} is the name of the server at {endpoint}; choose another one")
    servers = ({} if endpoint is None else {CLOUD: endpoint}) | dict(sites)
    if keys is not None and not servers:
        raise ConfigError(f"keys: {keys} needs an endpoint, the server to use")
    runners: list[Runner] = []
    background = Background()
    try:
        for site, endpoint in servers.items():
            own = None if keys is None else robot_keys(Path(keys), site)
            server = CloudRunner(
                endpoint,
                site=site,
                heartbeat_s=heartbeat_s,
                seed=seed,
                keys=own,
                background=background,
                compress=compress,
            )
            runners.append(server)
        runners.append(OnboardRunner(states=states, background=background))
    except BaseException:  # also after Ctrl-C, no thread or socket of the others is left
        for runner in runners:
            runner.close()
        raise
    return runners
