"""The servers behind a name of DNS, with the answers that resolvers give."""

import socket
from collections.abc import Sequence

import pytest

from offboard.common.errors import CloudBroken, ConfigError
from offboard.robot_client.discovery.roster import Server
from offboard.robot_client.discovery.server_lists import DnsName
from offboard.robot_client.sites.endpoint import check_dns


def answer(monkeypatch: pytest.MonkeyPatch, *addresses: str) -> None:
    found = [
        (socket.AF_INET6 if ":" in one else socket.AF_INET, socket.SOCK_STREAM, 6, "", (one, 5555))
        for one in addresses
    ]

    def getaddrinfo(*_: object, **__: object) -> Sequence[object]:
        return found

    monkeypatch.setattr(socket, "getaddrinfo", getaddrinfo)


def test_each_address_is_a_server_of_the_group(monkeypatch: pytest.MonkeyPatch) -> None:
    """They have the key of the group, and the order of the answer does not matter."""
    name = DnsName("cloud", "dns://planners.local:5555", b"key")
    answer(monkeypatch, "10.0.0.8", "10.0.0.7", "10.0.0.8")
    assert name.read() == [
        Server("cloud/10.0.0.7", "tcp://10.0.0.7:5555", b"key"),
        Server("cloud/10.0.0.8", "tcp://10.0.0.8:5555", b"key"),
    ]


def test_a_server_with_two_kinds_of_address_counts_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """IPv6 addresses are used only if there is no IPv4 address; those of one link are never used."""
    name = DnsName("cloud", "dns://planners.local:5555", None)
    answer(monkeypatch, "fd00::7", "10.0.0.7")
    assert [one.endpoint for one in name.read()] == ["tcp://10.0.0.7:5555"]
    answer(monkeypatch, "fd00::7", "fe80::1%eth0")
    assert name.read() == [Server("cloud/fd00::7", "tcp://[fd00::7]:5555")]


def test_a_name_with_addresses_of_one_link_only_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is no empty list, which would take all servers away."""
    answer(monkeypatch, "fe80::1%eth0")
    with pytest.raises(CloudBroken, match=r"planners\.local: no address that can be used"):
        DnsName("cloud", "dns://planners.local:5555", None).read()


def test_a_name_without_address_is_an_error() -> None:
    """`.invalid` never has one (RFC 2606); the error names the host."""
    with pytest.raises(CloudBroken, match=r"planners\.invalid: "):
        DnsName("cloud", "dns://planners.invalid:5555", None).read()


@pytest.mark.parametrize("endpoint", ["dns://a", "dns://a:0", "dns://a:70000", "dns://:5", "dns://a b:5"])
def test_a_wrong_endpoint_is_refused(endpoint: str) -> None:
    """The error names flag, value and what is allowed."""
    with pytest.raises(ConfigError, match=r"--site cloud: 'dns:.* is not dns://HOST:PORT"):
        check_dns("--site cloud", endpoint)
