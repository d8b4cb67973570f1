"""The secrets by which a server tells its nodes from other machines, and machines that it refused.

A refused machine is remembered until the server ends or a person accepts it; it asks again by
itself every few seconds.
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
    """A machine's claim to be a node.

    Attributes:
        node: name of the node.
        challenge: what the machine was asked.
        answer: what it answered.
        address: where it connected from.
    """

    node: str
    challenge: Challenge
    answer: Proof
    address: str


@dataclass(frozen=True)
class Replacement:
    """A machine that asked to connect under the name of another one, and was refused.

    Attributes:
        secret: it comes into force if a person accepts the machine.
        address: where it connected from.
        asked_t_ns: when, server's UTC.
    """

    secret: str
    address: str
    asked_t_ns: int

    @property
    def fingerprint(self) -> str:
        """What the machine shows of its secret."""
        return fingerprint_of(self.secret)


class NodeIdentities:
    """The secrets of all nodes of one server, in `nodes/NAME/secrets.json`.

    Args:
        data: the server's data folder.
    """

    def __init__(self, data: Path) -> None:
        self._nodes = data / "nodes"
        self.replacements: dict[str, Replacement] = {}
        """The machine that asked last, by the name of the node."""
        self.problems: list[str] = []
        """What was found damaged, and what became of it, in words."""

    def secret_of(self, node: str) -> str | None:
        """Return the secret of a node; None if it is not known, or was damaged.

        Args:
            node: its name, fit for a folder.

        Raises:
            StorageError: it cannot be read now. Nobody may be taken for the node meanwhile.
        """
        path = self._path(node)
        try:
            return read_secrets(path).get(node)
        except DamagedFileError as error:
            # The true node sends it again. Without this it would be locked out for a flipped bit.
            self.problems.append(
                f"node {node}: {put_aside(path, error)}; "
                "the next machine that connects under this name is taken for it"
            )
            log.warning("%s", self.problems[-1])
            return None

    def challenge(self, node: str, server_id: str) -> Challenge:
        """Return what a machine that connects as this node is asked.

        Raises:
            StorageError: as `secret_of`.
        """
        is_known = self.secret_of(node) is not None
        return Challenge(
            protocol=PROTOCOL, server_id=server_id, nonce=make_secret(), is_known=is_known
        )

    def is_proven(self, claim: Claim, now_t_ns: int) -> bool:
        """Return whether a claim is proven; False: no secret of the node is known.

        Raises:
            HangUp: the name belongs to another machine.
            StorageError: as `secret_of`.
        """
        node, answer = claim.node, claim.answer
        known = self.secret_of(node)
        if known is None:
            return False
        if is_proven(known, claim.challenge, node, answer):
            return True
        if answer.secret is not None:
            self.replacements[node] = Replacement(answer.secret, claim.address, now_t_ns)
        # The way out first: a reason has 123 bytes.
        raise HangUp(
            Close.WRONG_IDENTITY,
            f"accept this machine with `foottile accept-node {node}`: the name is another "
            "machine's",
        )

    def keep_first(self, claim: Claim) -> None:
        """Keep the secret of a first contact. Without room for it the frames are worth having."""
        try:
            if claim.answer.secret is not None:
                self._keep(claim.node, claim.answer.secret)
                return
            why = "its disk keeps none"
        except StorageError as error:
            why = str(error)
        log.warning("no secret of node %s is kept; any machine may take it: %s", claim.node, why)

    def accept(self, node: str, fingerprint: str) -> None:
        """Take the machine that asked last for the node from now on.

        Raises:
            StateError: no machine asks.
            ChangedError: another one than this asked last.
            StorageError: the disk is full or not writable; the machine before stays in force.
        """
        asking = self.replacements.get(node)
        if asking is None:
            raise StateError(
                f"no other machine asks to connect as {node!r}",
                remedy="Start it; it asks again by itself every few seconds",
            )
        if asking.fingerprint != fingerprint:
            raise ChangedError(
                f"another machine asked to connect as {node!r} meanwhile: {asking.fingerprint}",
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
