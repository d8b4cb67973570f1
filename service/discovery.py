"""Discovery of servers and nodes in the local network, by multicast DNS (RFC 6762 and 6763).

It runs in the process's event loop beside everything else, and nothing depends on it: a failure is
a remark. An interface may come later: when addresses change, all sockets are opened anew.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Self

if TYPE_CHECKING:
    from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo, AsyncZeroconf

SERVERS = "_foottile._tcp.local."
SERVER_HOST = "foottile"
"""Host name and name of a server, without number and `.local`."""
NODES = "_foottile-node._tcp.local."
_POLL_S = 2.0
_ANSWER_TIMEOUT_MS = 700
"""Timeout of a question: an answer is delayed by a fifth of a second at most."""
_BROWSE_AGAIN_S = 10.0
"""Interval of new questions while nothing is found; the library's own grows to an hour."""
_NAMES_MAX = 100
_TEXT_MAX, _ITEMS_MAX = 255, 32
"""Bounds of a found service: letters of a text; texts, and addresses."""


@dataclass(frozen=True)
class Announcement:
    """Service of this process.

    Attributes:
        kind: `SERVERS` or `NODES`.
        name: name of the service; a number is appended if it is taken.
        host: its host name, without `.local`, with the same number.
        port: TCP port; 0 for a node.
        texts: keys and values of its TXT record.
        find_addresses: returns the addresses of this machine to announce.
    """

    kind: str
    name: str
    host: str
    port: int
    texts: Mapping[str, str]
    find_addresses: Callable[[], list[str]]


@dataclass(frozen=True)
class FoundService:
    """Service found in the network. Any machine there may have announced it.

    Attributes:
        name: name of the service.
        host: host name.
        port: TCP port.
        addresses: addresses in networks of this machine; if there is none, all.
        texts: keys and values of its TXT record.
    """

    name: str
    host: str
    port: int
    addresses: tuple[str, ...]
    texts: Mapping[str, str]

    @property
    def server_id(self) -> str:
        """Id of a server's data folder, as in `Challenge.server_id`."""
        return self.texts.get("id", "")

    @property
    def is_tls(self) -> bool:
        """True if the server announces TLS."""
        return self.texts.get("tls") == "1"

    @property
    def urls(self) -> list[str]:
        """URLs of a server."""
        scheme = "https" if self.is_tls else "http"
        hosts = (f"[{a.replace('%', '%25')}]" if ":" in a else a for a in self.addresses)
        return [f"{scheme}://{host}:{self.port}" for host in hosts]


class Discovery:
    """Discovery of one process, which runs while a block with it as context manager does.

    Args:
        browsed: kinds of services to look for.
        announcement: service to announce.
        on_announced: called with the host name, `.local`, under which this machine is now found.
        report: called with a message when it fails.
    """

    def __init__(
        self,
        browsed: Collection[str] = (),
        announcement: Announcement | None = None,
        *,
        on_announced: Callable[[str], None] = lambda host: None,
        report: Callable[[str], None],
    ) -> None:
        self._announcement = announcement
        self._on_announced = on_announced
        self._report = report
        self._reported = ""
        self._names: dict[str, dict[str, None]] = {kind: {} for kind in browsed}  # in their order
        self._browsed_s = 0.0
        self._interfaces: list[str | int] = []
        self._open: AsyncZeroconf | None = None
        self._browser: AsyncServiceBrowser | None = None
        self.is_installed = True
        """False once the library is found to be missing."""

    async def __aenter__(self) -> Self:
        self._running = asyncio.create_task(self._run_forever())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)

    async def _run_forever(self) -> None:
        """Announce and browse until cancelled, whatever happens to the network."""
        try:
            # In a thread: the import takes a third of a second on a Pi.
            library = await asyncio.to_thread(import_module, "zeroconf.asyncio")
        except ModuleNotFoundError:
            self.is_installed = False
            if self._names:
                self._report("to find a server by itself: pip install 'foottile[discovery]'")
            return
        logging.getLogger("zeroconf").setLevel(logging.CRITICAL)  # an unplugged cable is no error
        before: list[str | int] | None = None
        try:
            while True:
                try:
                    # An address is usable once it has been there for a while.
                    found = list_interfaces()
                    is_changed = found != self._interfaces and before in (None, found)
                    before = found
                    if is_changed:
                        await self._close()
                        if found:
                            self._open = library.AsyncZeroconf(interfaces=found)
                            await self._open.zeroconf.async_wait_for_start()
                            await self._browse(self._open)
                            await self._announce(self._open)
                        self._interfaces, self._reported = found, ""
                except Exception as error:  # of a network that changes, or a bug: never the end
                    self._report_failure(error)
                    with suppress(Exception):
                        await self._close()
                await asyncio.sleep(_POLL_S)
        finally:
            with suppress(Exception):
                await self._close()

    def _report_failure(self, error: Exception) -> None:
        what = f"servers and nodes are not found by themselves: {error!r}"
        if what != self._reported:
            self._report(what)
        self._reported = what

    async def list_found(self, kind: str) -> list[FoundService]:
        """Return the services that answer now, the newest last; none after a failure."""
        try:
            return await self._ask_all(kind)
        except Exception as error:  # a node publishes and measures without it
            self._report_failure(error)
            return []

    async def _ask_all(self, kind: str) -> list[FoundService]:
        from zeroconf.asyncio import AsyncServiceInfo

        opened = self._open
        if opened is None:
            return []
        infos = [AsyncServiceInfo(kind, name) for name in self._names[kind]]
        answers = await asyncio.gather(
            *(info.async_request(opened.zeroconf, _ANSWER_TIMEOUT_MS) for info in infos),
            return_exceptions=True,
        )
        described = [
            _describe(info) for info, here in zip(infos, answers, strict=True) if here is True
        ]
        found = [each for each in described if each is not None]
        now_s = asyncio.get_running_loop().time()
        if not found and now_s - self._browsed_s > _BROWSE_AGAIN_S and self._open is opened:
            await self._browse(opened)
        return found

    async def _browse(self, opened: AsyncZeroconf) -> None:
        from zeroconf import BadTypeInNameException, ServiceStateChange
        from zeroconf.asyncio import AsyncServiceBrowser, AsyncServiceInfo

        def on_change(
            zeroconf: object, service_type: str, name: str, state_change: ServiceStateChange
        ) -> None:
            names = self._names[service_type]
            names.pop(name, None)  # a changed one is the newest
            if state_change is not ServiceStateChange.Removed and len(names) < _NAMES_MAX:
                with suppress(BadTypeInNameException):  # any machine may announce any bytes
                    AsyncServiceInfo(service_type, name)
                    names[name] = None

        if self._browser is not None:
            await self._browser.async_cancel()
        if self._names:
            self._browsed_s = asyncio.get_running_loop().time()
            self._browser = AsyncServiceBrowser(
                opened.zeroconf, list(self._names), handlers=[on_change]
            )

    async def _announce(self, opened: AsyncZeroconf) -> None:
        """Announce the service, if there is one, under the first free name."""
        from zeroconf import NonUniqueNameException
        from zeroconf.asyncio import AsyncServiceInfo

        if (wanted := self._announcement) is None:
            return
        for number in range(1, _NAMES_MAX):
            mark = "" if number == 1 else f"-{number}"
            info = AsyncServiceInfo(
                wanted.kind,
                f"{_cut(wanted.name, mark)}.{wanted.kind}",
                port=wanted.port,
                properties=dict(wanted.texts),
                server=f"{_cut(wanted.host, mark)}.local.",
                parsed_addresses=[each.partition("%")[0] for each in wanted.find_addresses()],
            )
            if await _is_host_taken(opened, str(info.server)):
                continue
            with suppress(NonUniqueNameException):
                await opened.async_register_service(info)
                self._on_announced(str(info.server).rstrip("."))
                return
        self._report("no name is free in this network: this machine is not announced")

    async def _close(self) -> None:
        opened, self._open = self._open, None
        self._browser, self._interfaces = None, []
        for names in self._names.values():
            names.clear()
        if opened is not None:
            await opened.async_close()


async def search_once(
    kinds: Collection[str], duration_s: float, report: Callable[[str], None]
) -> dict[str, list[FoundService]]:
    """Return the services of each kind that answer within a time."""
    async with Discovery(kinds, report=report) as discovery:
        await asyncio.sleep(duration_s)
        return {kind: await discovery.list_found(kind) for kind in kinds}


def list_interfaces() -> list[str | int]:
    """Return the IPv4 addresses, and the indexes of interfaces with IPv6, but for loopback."""
    adapters = _list_adapters()
    v4 = {str(ip.ip) for _, ip in adapters if ip.version == 4}
    return [*sorted(v4), *sorted({index for index, ip in adapters if ip.version == 6})]


def list_interface_addresses() -> list[str]:
    """Return all addresses of this machine, but for loopback."""
    return [str(ip.ip) for _, ip in _list_adapters()]


_Interface = ipaddress.IPv4Interface | ipaddress.IPv6Interface


def _list_adapters() -> list[tuple[int, _Interface]]:
    """Return index and address of all interfaces, but for loopback."""
    import ifaddr

    found = [
        (adapter.index or 0, ipaddress.ip_interface(f"{address}/{ip.network_prefix}"))
        for adapter in ifaddr.get_adapters()
        for ip in adapter.ips
        for address in (ip.ip if isinstance(ip.ip, str) else ip.ip[0],)
    ]
    return [(index, ip) for index, ip in found if not ip.ip.is_loopback]


async def _is_host_taken(opened: AsyncZeroconf, host: str) -> bool:
    """Return whether another machine answers to a host name."""
    from zeroconf import AddressResolver  # type: ignore[attr-defined]  # it is documented

    resolver = AddressResolver(host)
    await resolver.async_request(opened.zeroconf, _ANSWER_TIMEOUT_MS)
    return not set(resolver.parsed_addresses()) <= set(list_interface_addresses())


def _describe(info: AsyncServiceInfo) -> FoundService | None:
    """Return a service as a terminal may show it; None: it has what no server or node announces."""
    own = [ip.network for _, ip in _list_adapters()]

    def is_near(address: str) -> bool:
        ip = ipaddress.ip_address(address.partition("%")[0])
        return any(ip.version == network.version and ip in network for network in own)

    addresses = info.parsed_scoped_addresses()
    name, host = info.name.removesuffix(f".{info.type}"), str(info.server).rstrip(".")
    texts = {name: value or "" for name, value in info.decoded_properties.items()}
    shown = [name, host, *texts, *texts.values()]
    is_sound = all(each.isprintable() and len(each) <= _TEXT_MAX for each in shown)
    if not is_sound or not 0 < len(addresses) <= _ITEMS_MAX or len(texts) > _ITEMS_MAX:
        return None
    return FoundService(
        name=name,
        host=host,
        port=info.port or 0,
        addresses=tuple([*filter(is_near, addresses)] or addresses),
        texts=texts,
    )


_LABEL_BYTES_MAX = 63


def _cut(label: str, mark: str) -> str:
    """Return a label with a mark, cut to the length that DNS has for it."""
    return label[: _LABEL_BYTES_MAX - len(mark)] + mark
