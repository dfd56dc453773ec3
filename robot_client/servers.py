"""Connects an offloader to its servers: those with an endpoint, and those of lists that change.

What a runner does is in `sites` and, for policy servers, in `policy_servers`; how lists are followed is in
`discovery`.
"""

import os
import socket
from collections.abc import Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path

from offboard.common.errors import ConfigError
from offboard.common.security.keys import checked_key, policy_token, robot_keys
from offboard.common.variants import group_of
from offboard.robot_client.cloud.cloud_runner import CloudRunner
from offboard.robot_client.discovery.present_sites import PresentSites
from offboard.robot_client.discovery.roster import Roster, Server
from offboard.robot_client.discovery.server_lists import DnsName, Following, SitesFile, Source
from offboard.robot_client.policies import BOTH
from offboard.robot_client.settings import Settings
from offboard.robot_client.sites.endpoint import check_endpoint, is_dns, is_policy_server
from offboard.robot_client.sites.heartbeat import EVERY_S, Background
from offboard.robot_client.sites.onboard import OnboardRunner
from offboard.robot_client.sites.runner import CLOUD, ONBOARD, Runner

Sites = Mapping[str, str] | Path | str


def connect_sites(
    endpoint: str | None,
    sites: Sites,
    *,
    keys: Path | str | None,
    policy: str,
    settings: Settings,
) -> PresentSites:
    """The server at `endpoint`, the further ones in `sites`, and onboard; see `Offloader.connect`."""
    named = {} if isinstance(sites, Path | str) else dict(sites)
    if endpoint is not None and CLOUD in named:
        raise ConfigError(f"sites: {CLOUD!r} is the name of the server at {endpoint}; choose another one")
    servers = ({} if endpoint is None else {CLOUD: endpoint}) | named
    if keys is not None and not (servers or sites):
        raise ConfigError(f"keys: {keys} needs an endpoint, the server to use")
    folder = None if keys is None else Path(keys)
    key_of = partial(_key_of, folder, insecure=settings.insecure)
    fixed = {site: one for site, one in servers.items() if not is_dns(one)}
    names = servers.keys() - fixed.keys()
    sources: list[Source] = [DnsName(site, servers[site], key_of(site, None)) for site in sorted(names)]
    if isinstance(sites, Path | str):
        taken = {ONBOARD, BOTH, *fixed}
        sources.append(SitesFile(Path(sites), key_of, taken, insecure=settings.insecure))
    heartbeat_s = EVERY_S if settings.beats(policy) else 0.0
    background = Background()
    connect = partial(
        _connect, keys=folder, heartbeat_s=heartbeat_s, settings=settings, background=background
    )
    with ExitStack() as opened:  # also after Ctrl-C, no thread or socket is left
        runners: list[Runner] = []
        for site, one in fixed.items():
            runners.append(connect(Server(site, one)))
            opened.callback(runners[-1].close)
        runners.append(OnboardRunner(states=settings.states, background=background))
        opened.callback(runners[-1].close)
        seed = f"{settings.seed} {socket.gethostname()} {os.getpid()}"  # the robots of a fleet spread out
        present = PresentSites(
            runners,
            roster=Roster(settings.known, seed) if sources else None,
            connect=connect,
            tended=True,
        )
        opened.callback(present.close)
        present.awaited.update({one: f"the addresses of {servers[one]} are not known yet" for one in names})
        for source in sources:
            if isinstance(source, SitesFile):  # a mistake in it is an error now
                present.follow(source.read() or (), source.name)
            Following(source, present, float(settings.reread_s)).start()
        opened.pop_all()
    return present


def read_servers(operand: str, keys: Path | None) -> list[Server]:
    """The server at tcp://HOST:PORT, or those at dns://HOST:PORT or in a sites file now."""
    key_of = partial(_key_of, keys, insecure=True)
    if is_dns(operand):
        return DnsName(CLOUD, operand, key_of(CLOUD, None)).read()
    if operand.endswith(".toml"):
        return SitesFile(Path(operand), key_of, {ONBOARD, BOTH}, insecure=True).read() or []
    check_endpoint("ENDPOINT", operand)
    return [Server(CLOUD, operand)]


def _connect(
    server: Server, *, keys: Path | None, heartbeat_s: float, settings: Settings, background: Background
) -> Runner:
    if is_policy_server(server.endpoint):
        from offboard.robot_client.policy_servers.policy_server import (
            PolicyServerRunner,
        )  # its library is an extra

        return PolicyServerRunner(
            server.endpoint,
            site=server.site,
            heartbeat_s=heartbeat_s,
            seed=settings.seed,
            insecure=settings.insecure,
            token=settings.tokens.get(server.site) or server.token or policy_token(keys, server.site),
            convert=settings.convert.get(server.site),
            background=background,
        )
    return CloudRunner(
        server.endpoint,
        site=server.site,
        heartbeat_s=heartbeat_s,
        seed=settings.seed,
        keys=None if keys is None else robot_keys(keys, server.site, server.key),
        background=background,
        compress=settings.compress,
    )


def _key_of(folder: Path | None, site: str, given: str | None, *, insecure: bool) -> bytes | None:
    """The public key that a listed server must have: its own one, or that of its group."""
    if folder is not None:
        return robot_keys(folder, group_of(site)).server if given is None else checked_key("key", given)
    if insecure and given is None:
        return None
    raise ConfigError(
        f"sites: {site} is found in a list that changes, so it needs keys (keys=, --keys), which prove that "
        "it is the right server; or allow others with --insecure (in a program: Settings(insecure=True))"
    )
