"""Proof that a node is the machine that had its name before.

Stream ids are public: every viewer reads them at `GET /nodes`. So each node shares a secret with
each server. The node makes it at first contact and keeps it on its disk before it sends it; the
server keeps it before it answers with welcome. Afterwards only `make_proof` crosses the link, made
with a nonce of this connection. Only a person replaces a secret.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets

from service.link import PROTOCOL, SUBPROTOCOL, Challenge, Proof

_BYTES = 32
_FINGERPRINT_GROUPS = 4


def make_secret() -> str:
    """Return 32 random bytes as hex digits; of a nonce, too."""
    return secrets.token_hex(_BYTES)


def make_proof(secret: str, challenge: Challenge, node: str) -> str:
    """Return the proof, as hex digits, that a node has the secret that it shares with a server.

    Args:
        secret: of this node and this server.
        challenge: as the server sent it on this connection.
        node: name of the node.
    """
    said = f"{SUBPROTOCOL} {PROTOCOL} {challenge.server_id} {challenge.nonce} {node}"
    return hmac.new(bytes.fromhex(secret), said.encode(), hashlib.sha256).hexdigest()


def is_proven(secret: str, challenge: Challenge, node: str, answer: Proof) -> bool:
    """Return whether an answer comes from the machine with this secret.

    A machine that was accepted a moment ago may still send the secret itself: it counts as well.
    """
    if answer.secret is not None and hmac.compare_digest(answer.secret, secret):
        return True
    right = make_proof(secret, challenge, node)
    return answer.proof is not None and hmac.compare_digest(answer.proof, right)


def fingerprint_of(secret: str) -> str:
    """Return 16 hex digits, in groups, by which a person tells two machines apart."""
    digits = hashlib.sha256(bytes.fromhex(secret)).hexdigest()
    return "-".join(digits[4 * i : 4 * i + 4] for i in range(_FINGERPRINT_GROUPS))
