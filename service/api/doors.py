"""Who is inside: how many connections there may be at once, and who leaves when there are more.

A connection *waits* while nothing is asked on it: its headers are not whole, it is idle between two
requests, it is a node that has not said hello, or it has been closed and does not read. It costs a
descriptor and serves nobody, so it never keeps anyone out: if there are too many, the one that
waits longest goes, of the address that has most. A request and a screen are *busy*: beyond their
bounds they are refused. Nodes have places of their own, which nobody else can take.
"""

from __future__ import annotations

import logging
import resource
import time
from collections import Counter
from typing import Annotated, Protocol

from pydantic import BaseModel, Field, IPvAnyNetwork

log = logging.getLogger("foottile.doors")

_Seconds = Annotated[float, Field(gt=0, le=3600, allow_inf_nan=False)]
_Connections = Annotated[int, Field(ge=1, le=100_000)]

RESERVE = 32
"""Places for those whose first words are still to come, however many are busy."""
OWN_FILES = 96
"""Descriptors that recording needs: journals, logs and locks, a session that is being sealed."""
_FILES_MAX = 65_536
_SAY_EVERY_S = 60.0
_IPV4 = 4


class Bounds(BaseModel):
    """How much of it those may have who have shown no token: a table of settings."""

    max_connections: _Connections = 512
    """Requests and screens at once; beyond them 503, or 1013 on a websocket. Nodes do not count."""
    max_connections_per_address: _Connections = 256
    """The same from one address. A phone's hotspot is one address, and so is a reverse proxy that
    is not trusted."""
    max_nodes: _Connections = 32
    """Nodes at once."""
    max_header_bytes: Annotated[int, Field(ge=4096, le=1 << 20)] = 32 << 10
    """Longest request line and headers; beyond them 431."""
    header_timeout_s: _Seconds = 10.0
    """A request's headers have to come within; else 408, or the connection is closed."""
    body_timeout_s: _Seconds = 20.0
    """A request's body has to come within; else 408."""
    idle_timeout_s: _Seconds = 30.0
    """A connection may wait for its next request for so long."""
    trusted_proxy: tuple[IPvAnyNetwork, ...] = ()
    """Addresses of reverse proxies whose X-Forwarded-For and X-Forwarded-Proto count."""

    @property
    def trusted_peers(self) -> list[str]:
        """The same as addresses of peers: a socket of IPv6 has an IPv4 peer as ::ffff:A.B.C.D."""
        mapped = [
            f"::ffff:{proxy.network_address}/{96 + proxy.prefixlen}"
            for proxy in self.trusted_proxy
            if proxy.version == _IPV4
        ]
        return [*map(str, self.trusted_proxy), *mapped]


class Visitor(Protocol):
    """A connection's transport."""

    def abort(self) -> None:
        """Close it now."""


class Doors:
    """The connections of one server; used from one event loop.

    Args:
        bounds: how many there may be.
        files_max: how many descriptors the process may have.
    """

    def __init__(self, bounds: Bounds, files_max: int) -> None:
        self.bounds = bounds
        # A download has a file of its own beside its connection.
        self.connections_max = min(bounds.max_connections, max(16, (files_max - OWN_FILES) // 2))
        if self.connections_max < bounds.max_connections:
            log.warning(
                "this process may open only %d files: at most %d connections at once, not %d; "
                "raise it with `ulimit -n`",
                *(files_max, self.connections_max, bounds.max_connections),
            )
        self._waiting: dict[Visitor, str] = {}
        self._busy: dict[Visitor, str] = {}
        self._nodes: dict[Visitor, str] = {}
        self._leaving: set[Visitor] = set()
        self._said_s: dict[str, float] = {}

    @property
    def is_full(self) -> bool:
        """Is there no place even for somebody who only wants to say who they are?"""
        inside = len(self._waiting) + len(self._busy) + len(self._nodes) + len(self._leaving)
        return inside >= self.connections_max + RESERVE + self.bounds.max_nodes

    @property
    def nodes_are_full(self) -> bool:
        """Are as many nodes connected as may be?"""
        return len(self._nodes) >= self.bounds.max_nodes

    def come(self, visitor: Visitor, address: str) -> None:
        """Somebody has connected, and waits; another one may have to go for that."""
        if visitor in self._busy or visitor in self._nodes:
            return
        self._waiting.setdefault(visitor, address)
        while len(self._waiting) > max(RESERVE, self.connections_max - len(self._busy)):
            self.turn_out()

    def admit(self, visitor: Visitor, client: str | None = None) -> bool:
        """A request or a screen, from one that waited; False: there are too many.

        Args:
            visitor: the connection.
            client: address of whoever asks, if a trusted proxy stands between; None: the peer's.
        """
        if visitor in self._busy:
            return True
        address = client if client is not None else self._waiting.get(visitor, "")
        from_there = sum(1 for each in self._busy.values() if each == address)
        if len(self._busy) >= self.connections_max:
            self.say("full", f"{len(self._busy)} connections at once: further ones are refused")
            return False
        if from_there >= self.bounds.max_connections_per_address:
            what = f"{from_there} connections at once from {address}: further ones are refused"
            self.say(f"full for {address}", what)
            return False
        self._waiting.pop(visitor, None)
        self._busy[visitor] = address
        return True

    def admit_node(self, visitor: Visitor) -> bool:
        """A node, from one that waited and has said its first word; False: there are too many."""
        if visitor in self._nodes:
            return True
        if self.nodes_are_full:
            return False
        address = self._waiting.pop(visitor, None)
        if address is not None:
            self._nodes[visitor] = address
        return True

    def rest(self, visitor: Visitor) -> None:
        """What it asked for is done: it waits again."""
        address = self._busy.pop(visitor, None) or self._nodes.pop(visitor, None)
        if address is not None:
            self._waiting[visitor] = address

    def go(self, visitor: Visitor) -> None:
        """It is closed."""
        for those in (self._waiting, self._busy, self._nodes):
            those.pop(visitor, None)
        self._leaving.discard(visitor)

    def turn_out(self) -> None:
        """Close the one that waits longest, of the address that has most that wait."""
        if not self._waiting:
            return
        address, _ = Counter(self._waiting.values()).most_common(1)[0]
        visitor = next(who for who, where in self._waiting.items() if where == address)
        del self._waiting[visitor]
        self._leaving.add(visitor)
        visitor.abort()

    def say(self, what: str, line: str) -> None:
        """Log a line, but not again within a minute: a flood must not fill the log as well."""
        now_s = time.monotonic()
        if now_s - self._said_s.get(what, -_SAY_EVERY_S) >= _SAY_EVERY_S:
            self._said_s = {**dict(list(self._said_s.items())[-100:]), what: now_s}
            log.warning("%s", line)


def open_files_max() -> int:
    """How many descriptors this process may have."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def raise_open_files() -> None:
    """Let this process have as many descriptors as it may ask for: 1024 is a shell's habit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, _FILES_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
