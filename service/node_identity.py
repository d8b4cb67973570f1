"""Proof that a node is the machine that had its name before (HMAC challenge-response).

Stream ids are public: every viewer reads them at `GET /nodes`. So each node shares a secret with
each server. At first contact the node creates it and stores it on disk before it sends it; the
server stores it before it answers with welcome. Afterwards only a proof is sent (`make_proof`),
with a nonce of the connection. Only a person may replace a secret.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets

from service.protocol.codec import SUBPROTOCOL
from service.protocol.link import PROTOCOL, Challenge, Proof

_BYTES = 32
_FINGERPRINT_GROUPS = 4


def generate_secret() -> str:
    """Generate 32 random bytes as hex digits, for a secret or a nonce."""
    return secrets.token_hex(_BYTES)


def make_proof(secret: str, challenge: Challenge, node: str) -> str:
    """Compute the proof that a node has the shared secret: HMAC-SHA-256 in hex digits.

    Args:
        secret: secret of this node and this server.
        challenge: the server's challenge on this connection.
        node: name of the node.
    """
    content = f"{SUBPROTOCOL} {PROTOCOL} {challenge.server_id} {challenge.nonce} {node}"
    return hmac.new(bytes.fromhex(secret), content.encode(), hashlib.sha256).hexdigest()


def is_proof_valid(secret: str, challenge: Challenge, node: str, answer: Proof) -> bool:
    """Return whether an answer proves the secret.

    The secret itself is valid as well: a machine accepted a moment ago may still send it.
    """
    if answer.secret is not None and hmac.compare_digest(answer.secret, secret):
        return True
    right = make_proof(secret, challenge, node)
    return answer.proof is not None and hmac.compare_digest(answer.proof, right)


def compute_fingerprint(secret: str) -> str:
    """Compute a secret's fingerprint for people: 16 hex digits, in groups."""
    digits = hashlib.sha256(bytes.fromhex(secret)).hexdigest()
    return "-".join(digits[4 * i : 4 * i + 4] for i in range(_FINGERPRINT_GROUPS))
