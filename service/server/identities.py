"""Secrets by which a server verifies its nodes, and machines that it refused.

A refused machine is listed until the server ends or a person accepts it; it retries every few
seconds.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

from devices.errors import ChangedError, DamagedFileError, StateError, StorageError
from service.identity import fingerprint_of, is_proven, make_secret
from service.link import PROTOCOL, Challenge, Close, HangUp, Proof
from storage.durable import put_aside
from storage.secret_file import SECRETS_NAME, read_secrets, write_secrets

log = logging.getLogger("foottile.nodes")


@dataclass(frozen=True)
class Claim:
    """Claim of a machine to be a node.

    Attributes:
        node: name of the node.
        challenge: challenge sent to the machine.
        answer: answer of the machine.
        address: peer address of the machine.
    """

    node: str
    challenge: Challenge
    answer: Proof
    """answer of the machine."""
    address: str


@dataclass(frozen=True)
class Replacement:
    """Machine that was refused because another one has the name.

    Attributes:
        secret: becomes the node's secret if a person accepts the machine.
        address: peer address of the machine.
        asked_t_ns: time of its last attempt, server's UTC.
    """

    secret: str
    address: str
    asked_t_ns: int

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the machine's secret."""
        return fingerprint_of(self.secret)


class NodeIdentities:
    """Secrets of all nodes of one server, in `nodes/NAME/secrets.json`.

    Args:
        data: the server's data folder.
    """

    def __init__(self, data: Path) -> None:
        self._nodes = data / "nodes"
        self.replacements: dict[str, Replacement] = {}
        """Machine that was refused last, by the name of the node."""
        self.problems: list[str] = []
        """Damage found, and the consequence, as text."""

    def secret_of(self, node: str) -> str | None:
        """Read the secret of a node; None if unknown or damaged.

        Args:
            node: its name, valid as a folder name.

        Raises:
            StorageError: it cannot be read now: no machine may be accepted as the node meanwhile.
        """
        path = self._path(node)
        try:
            return read_secrets(path).get(node)
        except DamagedFileError as error:
            # The true node sends it again. Otherwise a flipped bit would lock it out.
            self.problems.append(
                f"node {node}: {put_aside(path, error)}; "
                "the next machine that connects under this name is taken for it"
            )
            log.warning("%s", self.problems[-1])
            return None

    def challenge(self, node: str, server_id: str) -> Challenge:
        """Make the challenge for a machine that connects as this node.

        Raises:
            StorageError: as `secret_of`.
        """
        is_known = self.secret_of(node) is not None
        return Challenge(
            protocol=PROTOCOL, server_id=server_id, nonce=make_secret(), is_known=is_known
        )

    def is_proven(self, claim: Claim, now_t_ns: int) -> bool:
        """Return whether a claim is proven; False if the node has no secret here.

        Raises:
            HangUp: the name belongs to another machine.
            StorageError: as `secret_of`.
        """
        node, answer = claim.node, claim.answer
        secret = self.secret_of(node)
        if secret is None:
            return False
        if is_proven(secret, claim.challenge, node, answer):
            return True
        if answer.secret is not None:
            self.replacements[node] = Replacement(answer.secret, claim.address, now_t_ns)
        # The remedy comes first: a close reason has 123 bytes.
        raise HangUp(
            Close.WRONG_IDENTITY,
            f"accept this machine with `foottile accept-node {node}`: the name is another "
            "machine's",
        )

    def keep_first(self, claim: Claim) -> None:
        """Store the secret of a first contact. A failure is logged: frames matter more."""
        try:
            if claim.answer.secret is not None:
                self._keep(claim.node, claim.answer.secret)
                return
            why = "its disk stores none"
        except StorageError as error:
            why = str(error)
        log.warning(
            "no secret of node %s is stored; any machine may use its name: %s", claim.node, why
        )

    def accept(self, node: str, fingerprint: str) -> None:
        """Accept the machine that was refused last as the node from now on.

        Raises:
            StateError: no machine was refused.
            ChangedError: another machine than this one was refused last.
            StorageError: the disk is full or not writable; the former machine stays accepted.
        """
        asking = self.replacements.get(node)
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
        self._keep(node, asking.secret)
        log.warning("node %s is the machine %s from now on", node, fingerprint)

    def _keep(self, node: str, secret: str) -> None:
        write_secrets(self._path(node), {node: secret})
        self.replacements.pop(node, None)

    def _path(self, node: str) -> Path:
        return self._nodes / node / SECRETS_NAME
