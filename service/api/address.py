"""Addresses of a server: of this machine in its networks, and with the token for a node.

Imports nothing of the server itself, which takes long to import.
"""

from __future__ import annotations

import errno
import ipaddress
import logging
import re
import secrets
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import psutil

from devices.errors import DamagedFileError, LinkError, UsageError
from foottile.local_server import LocalServer, is_loopback, publish_local_server
from storage.durable_files import (
    read_small_file,
    translate_storage_errors,
    try_set_aside_and_describe,
    write_atomically,
)

log = logging.getLogger("foottile.serve")

TOKEN_NAME = "token"  # noqa: S105  # a name
"""File of the data folder with the generated token."""
_BACKLOG = 128
_SEND_TIMEOUT_MS = 60_000
"""Timeout of a peer that acknowledges no data: the kernel closes the connection, since no timeout
of ours sees how much of a download has arrived."""


def open_listening_socket(host: str, port: int) -> socket.socket:
    """Open a listening socket; port 0 is any free one.

    For a name with several addresses it is the first usable one, IPv4 first.

    Raises:
        LinkError: the port is in use, or the address is not this machine's.
    """
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except (OSError, UnicodeError) as error:
        raise LinkError(
            f"cannot listen on {host}: {error}",
            remedy="Name an address of this machine with --host, or 0.0.0.0 for all of them",
        ) from error
    problem: OSError | None = None
    for family, kind, protocol, _, address in sorted(found, key=lambda each: each[0]):
        try:
            return _bind_socket(family, kind, protocol, address)
        except OSError as error:
            problem = problem or error
    assert problem is not None  # noqa: S101  # getaddrinfo returns an address or raises
    raise LinkError(
        f"cannot listen on {host} port {port}: {problem.strerror}",
        remedy=_REMEDIES.get(
            problem.errno or 0, "Stop what uses the port, or choose another one with --port"
        ),
    ) from problem


_REMEDIES = {
    errno.EADDRNOTAVAIL: "Name an address of this machine with --host, or 0.0.0.0 for all of them",
    errno.EACCES: "Choose a port from 1024 on with --port",
    errno.EINVAL: "A link-local address needs its zone, the name of an interface: fe80::1%eth0",
}


def _bind_socket(family: int, kind: int, protocol: int, address: Any) -> socket.socket:
    listening = socket.socket(family, kind, protocol)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if address[0] == "::":  # IPv4, too, whatever the system's default
            listening.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # accepted sockets inherit this
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _SEND_TIMEOUT_MS)
        listening.bind(address)
        listening.listen(_BACKLOG)
    except BaseException:
        listening.close()
        raise
    return listening


def is_wildcard(host: str) -> bool:
    """Return whether a server on this address listens on all interfaces."""
    return host in ("0.0.0.0", "::", "")  # noqa: S104  # compared only


def list_urls(
    listening: socket.socket, host: str, advertised: str | None = None, *, scheme: str = "http"
) -> list[str]:
    """Return the URLs of a server, the most useful to others first.

    Args:
        listening: socket of the server.
        host: address or name to listen on.
        advertised: address or name to show instead of those found, as of `--advertise`.
        scheme: http or https.

    Raises:
        UsageError: `advertised` is no address.
    """
    bound, port = listening.getsockname()[:2]
    names = [host]
    if is_wildcard(host):
        found = (
            [] if advertised else list_addresses(include_ipv6=listening.family == socket.AF_INET6)
        )
        names = [*found, "127.0.0.1"]
    elif host == "localhost":  # another program may listen on its other address
        names = [bound]
    first = [] if advertised is None else [parse_advertised_url(advertised, port, scheme)]
    return list(dict.fromkeys([*first, *(_url(name, port, scheme) for name in names)]))


def list_announced_addresses(listening: socket.socket) -> list[str]:
    """Return the addresses of a server that others in its networks can reach."""
    bound = listening.getsockname()[0]
    if is_wildcard(bound):
        return list_addresses(
            include_ipv6=listening.family == socket.AF_INET6, exclude_virtual=True
        )
    return [] if is_loopback(bound) else [bound]


def parse_advertised_url(advertised: str, port: int, scheme: str = "http") -> str:
    """Return the URL for `--advertise`: HOST, HOST:PORT, or a whole URL.

    Raises:
        UsageError: it is no address.
    """
    text = advertised.strip().rstrip("/")
    if "://" not in text:
        is_bare = text.count(":") > 1 and text[0] != "["
        text = _url(text, None, scheme) if is_bare else f"{scheme}://{text}"
        text += "" if re.search(r":\d+$", text.rpartition("]")[2]) else f":{port}"
    try:
        parts = urlsplit(text)
        name = parts.hostname or ""
        has_more = bool(parts.path or parts.query or parts.fragment or parts.username)
        is_right = parts.scheme in ("http", "https") and parts.port != 0 and not has_more
        is_right &= "[" in parts.netloc or _HOST_NAME.fullmatch(name) is not None or _is_ip(name)
    except ValueError:
        is_right = False
    if not is_right:
        raise UsageError(
            f"--advertise {advertised!r} is no address",
            expected="HOST, HOST:PORT, or https://HOST of a reverse proxy",
        )
    return text


def _url(name: str, port: int | None, scheme: str) -> str:
    host = f"[{name.replace('%', '%25')}]" if ":" in name else name
    return f"{scheme}://{host}" + ("" if port is None else f":{port}")


def _is_ip(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def list_own_names() -> tuple[str, ...]:
    """Return the names of this machine in its own network: host name, and NAME.local by mDNS.

    No domain is looked up: a network's DNS server could return any. A host name with a domain is
    used as it is and without it.
    """
    name = socket.gethostname().lower().rstrip(".")
    if not _HOST_NAME.fullmatch(name):
        return ()
    short = name.partition(".")[0]
    return tuple(dict.fromkeys((name, short, f"{short}.local")))


_HOST_NAME = re.compile(r"(?!\d+$)[a-z0-9](?:[a-z0-9-]{0,62}[a-z0-9])?(?:\.[a-z0-9-]{1,63}){0,8}")


def load_or_create_token(given: str | None, data: Path) -> str:
    """Return the server's token: the given one, else the one stored in the data folder.

    There is always one: through a reverse proxy, `ssh -L` or a container's port everybody comes
    from loopback.

    Raises:
        StorageError: it cannot be read or stored.
    """
    if given:
        return given
    path = data / TOKEN_NAME
    try:
        return read_token(data)
    except FileNotFoundError:
        pass
    except DamagedFileError as error:
        log.warning("%s, and a new token is generated", try_set_aside_and_describe(path, error))
    with translate_storage_errors(path):
        data.mkdir(parents=True, exist_ok=True)
        token = secrets.token_urlsafe(18)
        write_atomically(path, token.encode() + b"\n", mode=0o600)
    return token


def read_token(data: Path) -> str:
    """Read the token stored in a data folder.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: the file holds no token.
        StorageError: it cannot be read: only its user may.
    """
    path = data / TOKEN_NAME
    token = read_small_file(path).decode("ascii", "replace").strip()
    if not _TOKEN.fullmatch(token):
        raise DamagedFileError("it holds no token", where=str(path))
    return token


@contextmanager
def publish_token(listening: socket.socket, token: str, ca: Path | None = None) -> Iterator[None]:
    """Context manager: let programs of this user on this machine find the token.

    Args:
        listening: socket of the server.
        token: token of the server.
        ca: file of its CA or its certificate; None without TLS.
    """
    scheme = "http" if ca is None else "https"
    url = list_urls(listening, listening.getsockname()[0], scheme=scheme)[-1]
    with ExitStack() as stack:
        if is_loopback(urlsplit(url).hostname or ""):
            record = LocalServer(url, token, "" if ca is None else str(ca.absolute()))
            try:
                stack.enter_context(publish_local_server(record))
            except OSError as error:
                log.warning("%s: commands on this machine need FOOTTILE_TOKEN", error)
        yield


_TOKEN = re.compile(r"[!-~]{8,200}")
"""Valid token, also if a person has written it."""


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


def list_addresses(*, include_ipv6: bool, exclude_virtual: bool = False) -> list[str]:
    """Return the addresses of all interfaces that are up, the most useful one first.

    Args:
        include_ipv6: include IPv6 addresses.
        exclude_virtual: leave out containers, virtual machines and VPNs.
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
    return [
        each.address for each in sort_addresses(found) if not (exclude_virtual and each.is_virtual)
    ]


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
