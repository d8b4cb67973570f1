"""Addresses of this machine in its networks, the most useful first."""

from __future__ import annotations

import ipaddress
import re
import socket
from dataclasses import dataclass

import psutil

_VIRTUAL = re.compile(
    r"(?:docker|podman|br-[0-9a-f]{12}$|veth|virbr|vboxnet|vmnet|cni|flannel|cali|lxc|lxdbr|"
    r"tun|tap|wg|tailscale|zt|utun|bridge1\d\d$|vEthernet)"
)
"""Names of interfaces to containers, virtual machines and VPNs: no phone is behind them."""
_WIRELESS = re.compile(r"(?:wl|u?ap\d)")
_PRIVATE = tuple(
    ipaddress.ip_network(network)
    for network in ("10.0.0.0/8", "172.16.0.0/12", "192.168.0.0/16", "fc00::/7")
)


@dataclass(frozen=True)
class InterfaceAddress:
    """Address of an interface that is up.

    Attributes:
        interface: name of the interface.
        address: IPv4 or IPv6; a link-local IPv6 address has its zone.
        has_carrier: True: a cable is plugged in, or a network joined.
        is_first_host: True: first address of its network, as for a hotspot.
    """

    interface: str
    address: str
    has_carrier: bool = True
    is_first_host: bool = False

    @property
    def sort_key(self) -> tuple[bool, ...]:
        """Sort key: the address that a phone most probably reaches comes first.

        A hotspot of this machine comes before its cable to a laboratory: its address is private and
        the first of its network, and its interface is wireless.
        """
        ip = ipaddress.ip_address(self.address)
        return (
            self.is_virtual,
            not self.has_carrier,
            ip.is_link_local,
            not any(ip.version == network.version and ip in network for network in _PRIVATE),
            ip.version == 6,  # IPv6
            _WIRELESS.match(self.interface) is None,
            not self.is_first_host,
        )

    @property
    def is_virtual(self) -> bool:
        """True if it leads to containers, virtual machines or a VPN."""
        return _VIRTUAL.match(self.interface) is not None


def list_addresses(*, include_ipv6: bool) -> list[str]:
    """Return the addresses of all interfaces that are up, the most useful one first.

    Args:
        include_ipv6: include IPv6 addresses.
    """
    families = {socket.AF_INET, socket.AF_INET6} if include_ipv6 else {socket.AF_INET}
    states = psutil.net_if_stats()
    found = [
        InterfaceAddress(
            name,
            _with_zone(each.address, name),
            has_carrier=states[name].isup,
            is_first_host=_is_first_host(each.address, each.netmask),
        )
        for name, addresses in psutil.net_if_addrs().items()
        for each in addresses
        # `isup` of psutil needs a carrier, too: a hotspot may have none before a phone
        # joins.
        if each.family in families and name in states and "up" in states[name].flags.split(",")
    ]
    return [each.address for each in sort_addresses(found)]


def sort_addresses(found: list[InterfaceAddress]) -> list[InterfaceAddress]:
    """Return the addresses that others can reach, the most useful one first."""
    useful = [
        each
        for each in found
        if not ipaddress.ip_address(each.address).is_loopback
        and (each.has_carrier or not each.is_virtual)
    ]
    return sorted(useful, key=lambda each: each.sort_key)


def _with_zone(address: str, interface: str) -> str:
    is_bare = "%" not in address and ipaddress.ip_address(address).is_link_local
    return f"{address}%{interface}" if is_bare and ":" in address else address


def _is_first_host(address: str, netmask: str | None) -> bool:
    if netmask is None or ":" in address:
        return False
    network = ipaddress.ip_interface(f"{address}/{netmask}").network
    return ipaddress.ip_address(address) == network.network_address + 1
