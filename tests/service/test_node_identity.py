"""A secret proves one node to one server, on one connection."""

from __future__ import annotations

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.protocol.link import (
    PROTOCOL,
    Challenge,
    Proof,
    compute_fingerprint,
    generate_secret,
    is_proof_valid,
    make_proof,
)

secrets = st.binary(min_size=32, max_size=32).map(bytes.hex)
names = st.text("abcdefgh0123._-", min_size=1, max_size=64)
challenges = st.builds(
    Challenge, protocol=st.just(PROTOCOL), server_id=secrets, nonce=secrets, is_known=st.just(True)
)


@given(secret=secrets, other=secrets, challenge=challenges, later=challenges, node=names)
def test_a_proof_is_of_one_secret_one_connection_and_one_name(
    secret: str, other: str, challenge: Challenge, later: Challenge, node: str
) -> None:
    proof = Proof(proof=make_proof(secret, challenge, node))
    assert is_proof_valid(secret, challenge, node, proof)
    assert is_proof_valid(secret, later, node, proof) == (
        (later.server_id, later.nonce) == (challenge.server_id, challenge.nonce)
    )
    assert is_proof_valid(other, challenge, node, proof) == (other == secret)
    assert not is_proof_valid(secret, challenge, node + "x", proof)
    assert secret not in proof.model_dump_json()


@given(secret=secrets, other=secrets, challenge=challenges, node=names)
def test_the_secret_itself_counts_and_no_other_one(
    secret: str, other: str, challenge: Challenge, node: str
) -> None:
    assert is_proof_valid(secret, challenge, node, Proof(secret=secret))
    assert is_proof_valid(secret, challenge, node, Proof(secret=other)) == (other == secret)


@pytest.mark.parametrize("proof", [Proof(), Proof(proof="0" * 64), Proof(secret="0" * 64)])
def test_an_empty_answer_proves_nothing(proof: Proof) -> None:
    challenge = Challenge(protocol=PROTOCOL, server_id="s", nonce=generate_secret(), is_known=True)
    assert not is_proof_valid(generate_secret(), challenge, "leg", proof)


@given(secret=secrets, other=secrets)
def test_fingerprints_tell_secrets_apart_and_do_not_show_them(secret: str, other: str) -> None:
    assert re.fullmatch(r"[0-9a-f]{4}(-[0-9a-f]{4}){3}", compute_fingerprint(secret))
    assert (compute_fingerprint(secret) == compute_fingerprint(other)) == (secret == other)
    assert compute_fingerprint(secret).replace("-", "") not in secret


def test_no_two_secrets_are_the_same() -> None:
    assert len({generate_secret() for _ in range(1000)}) == 1000
