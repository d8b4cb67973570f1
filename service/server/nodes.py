"""The nodes that a server knows, and which of them may connect."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from pathlib import Path

from pydantic import ValidationError

from devices.errors import (
    FileFormatError,
    FootTileError,
    LinkError,
    UnknownError,
)
from service.link import PROTOCOL, Hello
from service.server.node import IS_BOOT_ID, ServerNode

log = logging.getLogger("foottile.nodes")

_NODES_MAX = 1000
"""Whoever says ever new names fills neither memory nor disk."""
_NODE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}")


class ServerNodes:
    """All nodes of a server.

    Args:
        data: the server's data folder.

    Raises:
        StorageError: it cannot be read.
        FileFormatError: a file in it is damaged.
    """

    def __init__(self, data: Path) -> None:
        self._data = data
        self._nodes: dict[str, ServerNode] = {}
        for path in sorted((data / "nodes").glob("*/hello.json")):
            try:
                content = path.read_bytes()
                if _protocol_of(content) != PROTOCOL:
                    log.warning("%s is of another version: not known until it connects", path)
                    continue
                hello = Hello.model_validate_json(content)
            except (OSError, ValidationError) as error:
                raise FileFormatError(
                    f"not a node's description: {error}",
                    where=str(path),
                    remedy="Move it away; it is written again when the node connects",
                ) from error
            self._nodes[hello.array_info.node] = self._make(hello)

    def __iter__(self) -> Iterator[ServerNode]:
        return iter(self._nodes.values())

    def find(self, name: str) -> ServerNode | None:
        """The node called `name`; None if there is none."""
        return self._nodes.get(name)

    def get(self, name: str) -> ServerNode:
        """The node called `name`.

        Raises:
            UnknownError: there is none.
        """
        if name not in self._nodes:
            known = ", ".join(self._nodes) or "none so far"
            raise UnknownError(f"no node {name[:80]!r}", expected=f"one of: {known}")
        return self._nodes[name]

    def greet(self, hello: Hello) -> ServerNode:
        """The node that says this hello, made if it is new. It is not attached yet.

        Raises:
            LinkError: a name in it cannot be a folder's, its streams contradict each other or what
                it said before, or its files here are damaged.
        """
        info = hello.array_info
        _check(hello)
        if info.node not in self._nodes:
            if len(self._nodes) >= _NODES_MAX:
                raise LinkError(
                    f"this server knows {len(self._nodes)} nodes already",
                    remedy="Delete the folders in nodes/ of those that are gone, and start it anew",
                )
            try:
                self._nodes[info.node] = self._make(hello)
            except FootTileError as error:
                raise LinkError(f"node {info.node!r} cannot be taken in: {error}") from error
        node = self._nodes[info.node]
        for said in (info, *(each.array_info for each in hello.earlier)):
            known = node.streams.get(said.boot_id)
            if known is not None and known.info != said:
                raise LinkError(f"stream {said.boot_id} was announced with another array")
        return node

    def forget(self, name: str) -> None:
        """A node that said hello for the first time, and could not be taken in after all."""
        self._nodes.pop(name, None)

    def _make(self, hello: Hello) -> ServerNode:
        name = hello.array_info.node
        return ServerNode(self._data / "nodes" / name, self._data / "journal" / name, hello)


def _check(hello: Hello) -> None:
    streams = [hello.array_info, *(each.array_info for each in hello.earlier)]
    for info in streams:
        if not _NODE_NAME.fullmatch(info.node) or not IS_BOOT_ID.fullmatch(info.boot_id):
            raise LinkError(
                f"node {info.node[:80]!r} with boot_id {info.boot_id[:80]!r}",
                expected="a name of letters, digits, '.', '_' and '-', and 32 hex digits",
            )
        if not info.tiles:
            raise LinkError(f"node {info.node!r} has no tiles")
        if info.node != hello.array_info.node:
            raise LinkError(f"an earlier stream of node {hello.array_info.node!r} is {info.node!r}")
    if len({info.boot_id for info in streams}) < len(streams):
        raise LinkError(f"node {hello.array_info.node!r} names a stream twice")


def _protocol_of(content: bytes) -> object:
    try:
        said = json.loads(content)
    except ValueError:
        return PROTOCOL  # it is damaged, which is said elsewhere
    return said.get("protocol") if isinstance(said, dict) else PROTOCOL
