"""Registry of the nodes of a server, with checks of their names and streams."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from pathlib import Path

from devices.errors import (
    DamagedFileError,
    FileFormatError,
    FootTileError,
    LinkError,
    StorageError,
    UnknownError,
    escape_control_chars,
)
from service.protocol.link import PROTOCOL, Hello
from service.server.node import BOOT_ID_PATTERN, HELLO_NAME, ServerNode
from storage.documents import read_document
from storage.durable_files import translate_storage_errors, try_set_aside_and_describe

log = logging.getLogger("foottile.nodes")

_NODES_MAX = 1000
"""Limit on node names, so that ever new names fill neither memory nor disk."""
_NODE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,63}")


class NodeRegistry:
    """All nodes of a server.

    A node whose description is damaged is unknown until its next hello; its journals, sessions and
    tares stay on the disk until then.

    Args:
        data: the server's data folder.

    Raises:
        StorageError: it cannot be read.
    """

    def __init__(self, data: Path) -> None:
        self._data = data
        self._nodes: dict[str, ServerNode] = {}
        self._problems: list[str] = []
        with translate_storage_errors(data):
            folders = sorted(path for path in (data / "nodes").glob("*") if path.is_dir())
        for folder in folders:
            try:
                hello = _read_hello(folder / HELLO_NAME)
            except FileNotFoundError:
                continue
            except DamagedFileError as error:
                self._add_problem(
                    f"node {folder.name}: {try_set_aside_and_describe(folder / HELLO_NAME, error)}"
                )
                continue
            except (FileFormatError, StorageError) as error:
                self._add_problem(f"node {folder.name} is left out until it connects: {error}")
                continue
            try:
                self._nodes[folder.name] = self._create_node(hello)
            except FootTileError as error:
                self._add_problem(f"node {folder.name} is left out: {error}")

    @property
    def file_problems(self) -> list[str]:
        """Damage found in the files of nodes, and the consequence, as text."""
        return self._problems + [text for node in self for text in node.file_problems]

    def _add_problem(self, text: str) -> None:
        text = escape_control_chars(text)
        log.warning("%s", text)
        self._problems.append(text)

    def __iter__(self) -> Iterator[ServerNode]:
        return iter(self._nodes.values())

    def find(self, name: str) -> ServerNode | None:
        """Return the node called `name`; None if there is none."""
        return self._nodes.get(name)

    def get(self, name: str) -> ServerNode:
        """Return the node called `name`.

        Raises:
            UnknownError: no node has this name.
        """
        if name not in self._nodes:
            names = ", ".join(self._nodes) or "none so far"
            raise UnknownError(f"no node {name[:80]!r}", expected=f"one of: {names}")
        return self._nodes[name]

    def check_hello_and_get_or_create(self, hello: Hello) -> ServerNode:
        """Return the node that sent this hello, created if new. It is not connected yet.

        Raises:
            LinkError: a name in it is no folder name, its streams contradict each other or an
                earlier hello, or the node's files are damaged.
        """
        info = hello.array_info
        _check_hello(hello)
        if info.node not in self._nodes:
            if len(self._nodes) >= _NODES_MAX:
                raise LinkError(
                    f"this server has {len(self._nodes)} nodes already",
                    remedy="Delete the folders of unused nodes in nodes/, and restart the server",
                )
            try:
                self._nodes[info.node] = self._create_node(hello)
            except FootTileError as error:
                raise LinkError(f"node {info.node!r} cannot be accepted: {error}") from error
        node = self._nodes[info.node]
        for announced in (info, *(each.array_info for each in hello.earlier)):
            stored = node.streams.get(announced.stream_id)
            if stored is not None and stored.info != announced:
                raise LinkError(f"stream {announced.stream_id} was announced with another array")
        return node

    def remove_from_memory(self, name: str) -> None:
        """Remove a node whose first hello could not be accepted from memory; its files stay."""
        self._nodes.pop(name, None)

    def _create_node(self, hello: Hello) -> ServerNode:
        name = hello.array_info.node
        return ServerNode(self._data / "nodes" / name, self._data / "journal" / name, hello)


def _read_hello(path: Path) -> Hello:
    """Read the last hello of a node.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: it is damaged, or of another node.
        FileFormatError: it is of another version.
        StorageError: it cannot be read now.
    """
    hello = read_document(path, Hello)
    if hello.protocol != PROTOCOL:
        raise FileFormatError(
            f"written by another version, of protocol {hello.protocol}", where=str(path)
        )
    try:
        _check_hello(hello)
    except LinkError as error:
        raise DamagedFileError(f"not this node's last hello: {error}", where=str(path)) from error
    if hello.array_info.node != path.parent.name:
        raise DamagedFileError(f"it is of node {hello.array_info.node!r}", where=str(path))
    return hello


def is_valid_node_name(name: str) -> bool:
    """Return whether a text is valid as the name of a node and of its folder."""
    return _NODE_NAME.fullmatch(name) is not None


def _check_hello(hello: Hello) -> None:
    streams = [hello.array_info, *(each.array_info for each in hello.earlier)]
    for info in streams:
        if not is_valid_node_name(info.node) or not BOOT_ID_PATTERN.fullmatch(info.stream_id):
            raise LinkError(
                f"node {info.node[:80]!r} with stream_id {info.stream_id[:80]!r}",
                expected="a name of letters, digits, '.', '_' and '-', and 32 hex digits",
            )
        if not info.tiles:
            raise LinkError(f"node {info.node!r} has no tiles")
        if info.node != hello.array_info.node:
            raise LinkError(f"an earlier stream of node {hello.array_info.node!r} is {info.node!r}")
    if len({info.stream_id for info in streams}) < len(streams):
        raise LinkError(f"node {hello.array_info.node!r} names a stream twice")
