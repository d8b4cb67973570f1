"""Finder of a node's server, where no address is given.

A server of this user on this machine comes first, then the servers that announce themselves in the
network. Any machine there may announce one: a server with the id of one that shares a secret with
the node wins, although the id is not proven, and of several others a person chooses.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

from devices.errors import LinkError
from foottile.local_server import find_local_server
from service.discovery import SERVERS, Discovery, FoundService

LOCAL_URL = "http://127.0.0.1:8000"
"""Address of a server on this machine, if none is found."""
_ABSENCE_S = 60.0
"""Absence of the chosen server after which the others are named."""


def list_candidates(
    found: Sequence[FoundService],
    known_ids: Collection[str],
    *,
    chosen_id: str = "",
    needs_tls: bool = False,
) -> list[FoundService]:
    """Return the servers that a node may connect to; of several a person has to choose.

    Args:
        found: servers that announce themselves; of two with one id the later is meant.
        known_ids: ids of servers that share a secret with the node.
        chosen_id: id of the server that was chosen before; then there is no other.
        needs_tls: leave out servers without TLS.
    """
    servers = {each.server_id: each for each in found if each.is_tls or not needs_tls}
    if chosen_id:
        return [servers[chosen_id]] if chosen_id in servers else []
    return [each for name, each in servers.items() if name in known_ids] or list(servers.values())


def describe_candidates(candidates: Sequence[FoundService]) -> list[str]:
    """Return a line for each server, for a person who chooses."""
    return [f"{each.urls[0]} ({each.host}, {each.texts.get('machine')})" for each in candidates]


class ServerFinder:
    """Finder of the server of one node.

    Args:
        discovery: running discovery, which looks for servers.
        report: called with a message if the chosen server stays away and there are others.
        chosen_id: id of the server that a person has chosen.
        ca_path: with it, only servers with TLS count.
    """

    def __init__(
        self,
        discovery: Discovery,
        report: Callable[[str], None],
        *,
        chosen_id: str = "",
        ca_path: Path | None = None,
    ) -> None:
        self._discovery, self._report = discovery, report
        self._chosen_id = chosen_id
        self._needs_tls = ca_path is not None
        self._last: FoundService | None = None
        self._attempts = 0
        self._asked_s = self._others_named_s = -math.inf

    async def find(self, known_ids: Collection[str]) -> str:
        """Return the address of the server now; each attempt takes the next of its addresses.

        A server that has accepted the node stays chosen, and its last address is used while it
        does not answer.

        Args:
            known_ids: ids of servers that share a secret with the node.

        Raises:
            LinkError: a person has to choose, or no server with TLS is found.
        """
        if (local := find_local_server(LOCAL_URL)) is not None:
            return local.url
        if self._last is not None and self._last.server_id in known_ids:
            self._chosen_id = self._last.server_id
        found = await self._discovery.list_found(SERVERS) if self._discovery.is_installed else []
        needs_tls = self._needs_tls
        candidates = list_candidates(
            found, known_ids, chosen_id=self._chosen_id, needs_tls=needs_tls
        )
        now_s = time.monotonic()
        if candidates or not self._chosen_id or now_s - self._asked_s > _ABSENCE_S:
            self._others_named_s = now_s + _ABSENCE_S
        elif now_s > self._others_named_s and (
            others := list_candidates(found, (), needs_tls=needs_tls)
        ):
            self._others_named_s = math.inf
            self._report(
                "the server of this node is away, and others announce themselves: "
                f"{', '.join(describe_candidates(others))}. If it was replaced, restart the node, "
                "or name the server with --server"
            )
        self._asked_s = now_s
        if len(candidates) > 1:
            raise LinkError(
                f"{len(candidates)} servers announce themselves: "
                + ", ".join(describe_candidates(candidates)),
                remedy="Choose one with --server",
            )
        if candidates:
            self._last = candidates[0]
        if self._last is not None:
            self._attempts += 1
            urls = self._last.urls
            return urls[(self._attempts - 1) % len(urls)]
        if self._needs_tls or self._chosen_id:
            raise LinkError("the server is not found in this network", remedy="Start it")
        return LOCAL_URL
