"""Makes the runners of an offloader: one for each server, and one for onboard.

What a runner does is in the other files of this folder.
"""

from collections.abc import Mapping
from pathlib import Path

from offboard.common.security.keys import robot_keys
from offboard.common.task_states import TaskStates
from offboard.robot_client.sites.background import Background
from offboard.robot_client.sites.cloud import CloudRunner
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import Runner


def make_runners(
    servers: Mapping[str, str],
    *,
    keys: Path | str | None,
    heartbeat_s: float,
    seed: int,
    states: TaskStates | None = None,
    compress: bool = True,
) -> list[Runner]:
    """Connected runners; `servers` holds the endpoint of each server by name.

    `keys`: the folder with the keys (None: no encryption).
    `heartbeat_s`: seconds between heartbeats (0: no heartbeats).
    `states`: those of the onboard worker (None: states of its own).
    `compress`: whether arguments may be compressed.
    """
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
    except BaseException:
        for runner in runners:
            runner.close()
        raise
    return runners
