"""Secrets by which a server verifies its nodes, and machines that it refused.

A refused machine is listed until the server ends or a person accepts it; it retries every few
seconds.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devices.errors import ChangedError, FileFormatError, StateError, StorageError
from service.node_identity import compute_fingerprint, generate_secret, is_proof_valid
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.link import PROTOCOL, Challenge, Proof
from storage.durable_files import try_set_aside_and_describe
from storage.permissions import SECRETS_NAME, read_secrets_or_empty, write_secrets

log = logging.getLogger("foottile.nodes")


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
