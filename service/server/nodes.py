"""Registry of the nodes of a server: their names, streams and secrets, and machines refused.

A refused machine is listed until the server ends or a person accepts it; it retries every few
seconds.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devices.errors import (
    ChangedError,
    DamagedFileError,
    FileFormatError,
    FootTileError,
    LinkError,
    StateError,
    StorageError,
    UnknownError,
    escape_control_chars,
)
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.link import (
    PROTOCOL,
    Challenge,
    Hello,
    Proof,
    compute_fingerprint,
    generate_secret,
    is_proof_valid,
    is_stream_id,
)
from service.server.node import HELLO_NAME, ServerNode
from storage.documents import read_document
from storage.durable_files import translate_storage_errors, try_set_aside_and_describe
from storage.permissions import SECRETS_NAME, read_secrets_or_empty, write_secrets

log = logging.getLogger("foottile.nodes")

_NODES_MAX = 1000
"""Limit on node names, so that ever new names fill neither memory nor disk."""
_READABLE_PROTOCOLS = (5, 6)
"""Protocols of a stored hello that can be read: 6 differs from 5 only by vitals."""
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
        self._left_out: dict[str, str] = {}
        """Nodes of which nothing is known until they connect, by name: why, as text."""
        with translate_storage_errors(data):
            folders = sorted(path for path in (data / "nodes").glob("*") if path.is_dir())
        for folder in folders:
            try:
                hello = _read_hello(folder / HELLO_NAME)
            except FileNotFoundError:
                continue
            except DamagedFileError as error:
                aside = try_set_aside_and_describe(folder / HELLO_NAME, error)
                self._problems.append(_log_problem(f"node {folder.name}: {aside}"))
                continue
            except (FileFormatError, StorageError) as error:
                text = f"node {folder.name} is left out until it connects: {error}"
                self._left_out[folder.name] = _log_problem(text)
                continue
            try:
                self._nodes[folder.name] = self._create_node(hello)
            except FootTileError as error:
                self._problems.append(_log_problem(f"node {folder.name} is left out: {error}"))

    @property
    def file_problems(self) -> list[str]:
        """Damage found in the files of nodes, and the consequence, as text."""
        left_out = [text for name, text in self._left_out.items() if name not in self._nodes]
        return [*self._problems, *left_out, *(text for node in self for text in node.file_problems)]

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


def _log_problem(text: str) -> str:
    text = escape_control_chars(text)
    log.warning("%s", text)
    return text


def _read_hello(path: Path) -> Hello:
    """Read the last hello of a node.

    Raises:
        FileNotFoundError: there is none.
        DamagedFileError: it is damaged, or of another node.
        FileFormatError: it is of another version.
        StorageError: it cannot be read now.
    """
    hello = read_document(path, Hello)
    if hello.protocol not in _READABLE_PROTOCOLS:
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
        if not is_valid_node_name(info.node) or not is_stream_id(info.stream_id):
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


@dataclass(frozen=True)
class IdentityClaim:
    """Claim of a machine to be a node.

    Attributes:
        node: name of the node.
        challenge: challenge sent to the machine.
        proof: answer of the machine.
        address: peer address of the machine.
    """

    node: str
    challenge: Challenge
    proof: Proof
    address: str


@dataclass(frozen=True)
class RefusedMachine:
    """Machine that was refused because another one has the name.

    Attributes:
        secret: becomes the node's secret if a person accepts the machine.
        address: peer address of the machine.
        requested_t_ns: time of its last attempt, server's UTC.
    """

    secret: str
    address: str
    requested_t_ns: int

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the machine's secret."""
        return compute_fingerprint(self.secret)


ProvenOrFirstContact = Literal["proven", "first_contact"]


class NodeIdentities:
    """Secrets of all nodes of one server, in `nodes/NAME/secrets.json`.

    Args:
        data: the server's data folder.
    """

    def __init__(self, data: Path) -> None:
        self._nodes = data / "nodes"
        self.refused_machines: dict[str, RefusedMachine] = {}
        """Machine that was refused last, by the name of the node."""
        self.problems: list[str] = []
        """Damage found, and the consequence, as text."""

    def read_secret_or_set_aside(self, node: str) -> str | None:
        """Read the secret of a node; None if there is none, or if it is damaged and set aside.

        Args:
            node: its name, valid as a folder name.

        Raises:
            StorageError: it cannot be read now: no machine may be accepted as the node meanwhile.
        """
        path = self._path(node)
        try:
            return read_secrets_or_empty(path).get(node)
        except FileFormatError as error:
            # The true node sends it again. Otherwise a flipped bit would lock it out.
            self.problems.append(
                f"node {node}: {try_set_aside_and_describe(path, error)}; "
                "the next machine that connects under this name is taken for it"
            )
            log.warning("%s", self.problems[-1])
            return None

    def read_secret_and_make_challenge(self, node: str, server_id: str) -> Challenge:
        """Make the challenge for a machine that connects as this node.

        Raises:
            StorageError: as `read_secret_or_set_aside`.
        """
        is_known = self.read_secret_or_set_aside(node) is not None
        return Challenge(
            protocol=PROTOCOL, server_id=server_id, nonce=generate_secret(), is_known=is_known
        )

    def verify_or_refuse_claim(self, claim: IdentityClaim, now_t_ns: int) -> ProvenOrFirstContact:
        """Refuse a false claim; a node without a secret here makes its first contact.

        Raises:
            CloseConnection: the name belongs to another machine.
            StorageError: as `read_secret_or_set_aside`.
        """
        node, answer = claim.node, claim.proof
        secret = self.read_secret_or_set_aside(node)
        if secret is None:
            return "first_contact"
        if is_proof_valid(secret, claim.challenge, node, answer):
            return "proven"
        if answer.secret is not None:
            self.refused_machines[node] = RefusedMachine(answer.secret, claim.address, now_t_ns)
        # The remedy comes first: a close reason has 123 bytes.
        raise CloseConnection(
            LinkCloseCode.WRONG_IDENTITY,
            f"accept this machine with `foottile accept-node {node}`: the name is another "
            "machine's",
        )

    def try_store_claimed_secret(self, claim: IdentityClaim) -> None:
        """Try to store the secret of a first contact; a failure is logged: frames matter more."""
        try:
            if claim.proof.secret is not None:
                self._store_secret(claim.node, claim.proof.secret)
                return
            why = "its disk stores none"
        except StorageError as error:
            why = str(error)
        log.warning(
            "no secret of node %s is stored; any machine may use its name: %s", claim.node, why
        )

    def accept_last_refused_machine(self, node: str, fingerprint: str) -> None:
        """Accept the machine that was refused last as the node from now on.

        Raises:
            StateError: no machine was refused.
            ChangedError: another machine than this one was refused last.
            StorageError: the disk is full or not writable; the former machine stays accepted.
        """
        asking = self.refused_machines.get(node)
        if asking is None:
            raise StateError(
                f"no other machine was refused as {node!r}",
                remedy="Start it; it retries every few seconds",
            )
        if asking.fingerprint != fingerprint:
            raise ChangedError(
                f"another machine was refused as {node!r} meanwhile: {asking.fingerprint}",
                expected=f"the machine {fingerprint}",
                remedy="Compare it with the fingerprint that the machine itself prints",
            )
        self._store_secret(node, asking.secret)
        log.warning("node %s is the machine %s from now on", node, fingerprint)

    def _store_secret(self, node: str, secret: str) -> None:
        write_secrets(self._path(node), {node: secret})
        self.refused_machines.pop(node, None)

    def _path(self, node: str) -> Path:
        return self._nodes / node / SECRETS_NAME
