"""Limits on connections: how many at once, and which one is closed if there are more.

A connection is *idle* while it has no request: its headers are incomplete, it is between two
requests, it is a node before hello, or it has been closed and does not read. It uses a descriptor
only, so it never keeps others out: if there are too many, the one idle longest is closed, of the
address with the most. A request and a subscriber are *busy*: beyond their limits they are refused.
Nodes have reserved places.
"""

from __future__ import annotations

import logging
import resource
import time
from collections import Counter
from typing import Protocol

from service.api.settings import LimitSettings

log = logging.getLogger("foottile.connections")


RESERVE = 32
"""Places for connections before their first request, however many are busy."""
OWN_FILES = 96
"""Descriptors that recording needs: journals, logs, locks, and a session being sealed."""
_FILES_MAX = 65_536
_LOG_PERIOD_S = 60.0


class Connection(Protocol):
    """Transport of a connection."""

    def abort(self) -> None:
        """Close the connection now."""


class ConnectionLimiter:
    """Connections of one server, with their limits; used from one event loop.

    Args:
        limits: limits of connections.
        files_max: descriptors that the process may have.
    """

    def __init__(self, limits: LimitSettings, files_max: int) -> None:
        self.limits = limits
        # A download needs a descriptor beside its connection.
        self.connections_max = min(limits.max_connections, max(16, (files_max - OWN_FILES) // 2))
        if self.connections_max < limits.max_connections:
            log.warning(
                "this process may open only %d files: at most %d connections at once, not %d; "
                "raise it with `ulimit -n`",
                *(files_max, self.connections_max, limits.max_connections),
            )
        self._idle: dict[Connection, str] = {}
        self._busy: dict[Connection, str] = {}
        self._nodes: dict[Connection, str] = {}
        self._closing: set[Connection] = set()
        self._logged_s: dict[str, float] = {}

    @property
    def is_full(self) -> bool:
        """True if not even an idle connection fits."""
        inside = len(self._idle) + len(self._busy) + len(self._nodes) + len(self._closing)
        return inside >= self.connections_max + RESERVE + self.limits.max_nodes

    @property
    def has_max_nodes(self) -> bool:
        """True if the limit of nodes is reached."""
        return len(self._nodes) >= self.limits.max_nodes

    def add_connection(self, connection: Connection, address: str) -> None:
        """Add a new connection as idle, closing another idle one if there are too many."""
        if connection in self._busy or connection in self._nodes:
            return
        self._idle.setdefault(connection, address)
        while len(self._idle) > max(RESERVE, self.connections_max - len(self._busy)):
            self.evict_idle()

    def acquire(self, connection: Connection, client_address: str | None = None) -> bool:
        """Make an idle connection busy with a request or subscription; False: limit reached.

        Args:
            connection: the connection.
            client_address: address of the client behind a trusted proxy; None: the peer's.
        """
        if connection in self._busy:
            return True
        address = client_address if client_address is not None else self._idle.get(connection, "")
        from_there = sum(1 for each in self._busy.values() if each == address)
        if len(self._busy) >= self.connections_max:
            self.log_limited(
                "full", f"{len(self._busy)} connections at once: further ones are refused"
            )
            return False
        if from_there >= self.limits.max_connections_per_address:
            what = f"{from_there} connections at once from {address}: further ones are refused"
            self.log_limited(f"full for {address}", what)
            return False
        self._idle.pop(connection, None)
        self._busy[connection] = address
        return True

    def acquire_node(self, connection: Connection) -> bool:
        """Make an idle connection a node's after its first message; False: limit reached."""
        if connection in self._nodes:
            return True
        if self.has_max_nodes:
            return False
        address = self._idle.pop(connection, None)
        if address is not None:
            self._nodes[connection] = address
        return True

    def release(self, connection: Connection) -> None:
        """Make a connection idle: its request is done."""
        address = self._busy.pop(connection, None) or self._nodes.pop(connection, None)
        if address is not None:
            self._idle[connection] = address

    def remove_connection(self, connection: Connection) -> None:
        """Remove a closed connection."""
        for places in (self._idle, self._busy, self._nodes):
            places.pop(connection, None)
        self._closing.discard(connection)

    def evict_idle(self) -> None:
        """Close the connection that is idle longest, of the address with most idle ones."""
        if not self._idle:
            return
        address, _ = Counter(self._idle.values()).most_common(1)[0]
        visitor = next(who for who, where in self._idle.items() if where == address)
        del self._idle[visitor]
        self._closing.add(visitor)
        visitor.abort()

    def log_limited(self, topic: str, line: str) -> None:
        """Log a line, at most once a minute per topic: a flood must not fill the log."""
        now_s = time.monotonic()
        if now_s - self._logged_s.get(topic, -_LOG_PERIOD_S) >= _LOG_PERIOD_S:
            self._logged_s = {**dict(list(self._logged_s.items())[-100:]), topic: now_s}
            log.warning("%s", line)


def open_files_max() -> int:
    """Return the number of descriptors that this process may have."""
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def raise_open_files_limit() -> None:
    """Raise the soft limit of descriptors to the hard one: 1024 is the default of a shell."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _FILES_MAX if hard == resource.RLIM_INFINITY else min(hard, _FILES_MAX)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
