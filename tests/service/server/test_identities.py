"""Identities of nodes: a name belongs to one machine until a person accepts another one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import ChangedError, StateError, StorageError
from service.node.server_secrets import ServerSecrets
from service.protocol.codec import CloseConnection, LinkCloseCode
from service.protocol.link import Proof, compute_fingerprint, generate_secret, make_proof
from service.server.nodes import IdentityClaim, NodeIdentities
from storage.permissions import SECRETS_NAME
from tests.storage.faulty_disk import NO_SPACE, refusing

SERVER, NODE, NOW_T_NS = "5" * 32, "leg", 1_800_000_000 * 10**9
ADDRESS = "192.168.4.7"


class _Killed(Exception):  # noqa: N818  # no error: the end of a process
    pass


class Machine:
    """A node's end: its folder, and its proofs, like those of `service.node.publisher`."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.is_refused = False

    def connect(self, server: NodeIdentities, *, dies_after: str = "") -> bool:
        """Connect once; return whether the server welcomes it. A step may be its last one."""
        challenge = server.read_secret_and_make_challenge(NODE, SERVER)
        secret = ServerSecrets(self.folder, lambda _: None).get_or_create_secret(SERVER)
        if dies_after == "share":
            raise _Killed
        if secret is not None and challenge.is_known and not self.is_refused:
            answer = Proof(proof=make_proof(secret, challenge, NODE))
        else:
            answer = Proof(secret=secret)
        claim = IdentityClaim(NODE, challenge, answer, ADDRESS)
        try:
            verified = server.verify_or_refuse_claim(claim, NOW_T_NS)
        except CloseConnection as end:
            self.is_refused = end.code == LinkCloseCode.WRONG_IDENTITY
            return False
        if verified == "first_contact":
            server.try_store_claimed_secret(claim)
        if dies_after == "keep":
            raise _Killed
        self.is_refused = False
        return True

    @property
    def fingerprint(self) -> str:
        secret = ServerSecrets(self.folder, lambda _: None).get_or_create_secret(SERVER)
        assert secret is not None
        return compute_fingerprint(secret)


@pytest.fixture
def server(tmp_path: Path) -> NodeIdentities:
    return NodeIdentities(tmp_path / "data")


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path / "machine")


@pytest.fixture
def stranger(tmp_path: Path) -> Machine:
    return Machine(tmp_path / "stranger")


EVENTS = ["share", "keep", "connects", "server restarts", "server loses it", "stranger"]


@settings(deadline=None, max_examples=60)
@given(events=st.lists(st.sampled_from(EVENTS), max_size=8))
def test_the_first_machine_is_accepted_whatever_dies(events: list[str]) -> None:
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        server, machine = NodeIdentities(data), Machine(Path(folder) / "machine")
        for event in events:
            is_stored = (data / "nodes" / NODE / SECRETS_NAME).exists()
            if event in ("share", "keep"):
                with pytest.raises(_Killed):
                    machine.connect(server, dies_after=event)
            elif event == "connects":
                assert machine.connect(server)
            elif event == "server restarts":
                server = NodeIdentities(data)
            elif event == "server loses it":  # with an older copy of its folder
                shutil.rmtree(data / "nodes", ignore_errors=True)
            elif is_stored:
                assert not Machine(Path(folder) / "stranger").connect(server)
        assert machine.connect(server)


def test_no_challenge_comes_twice(server: NodeIdentities) -> None:
    challenges = [server.read_secret_and_make_challenge(NODE, SERVER) for _ in range(10)]
    assert len({challenge.nonce for challenge in challenges}) == 10, "a proof could be replayed"


def test_an_accepted_machine_replaces_the_first_one(
    server: NodeIdentities, machine: Machine, stranger: Machine
) -> None:
    assert machine.connect(server)
    assert not stranger.connect(server)
    # At first it proved its secret; now it shows it, so that a person can accept it.
    assert not stranger.connect(server)
    refused = server.refused_machines[NODE]
    assert (refused.fingerprint, refused.address) == (stranger.fingerprint, ADDRESS)
    server.accept_last_refused_machine(NODE, stranger.fingerprint)
    assert stranger.connect(server)
    assert not machine.connect(server)
    assert NODE not in server.refused_machines, "it showed a proof only"
    assert not machine.connect(server)
    assert server.refused_machines[NODE].fingerprint == machine.fingerprint
    assert stranger.connect(NodeIdentities(server._nodes.parent))


def test_only_the_last_refused_machine_is_accepted(
    server: NodeIdentities, machine: Machine, stranger: Machine, tmp_path: Path
) -> None:
    with pytest.raises(StateError, match="no other machine"):
        server.accept_last_refused_machine(NODE, "0000-0000-0000-0000")
    assert machine.connect(server)
    third = Machine(tmp_path / "third")
    for other in (stranger, stranger, third, third):
        assert not other.connect(server)
    with pytest.raises(ChangedError, match=third.fingerprint):
        server.accept_last_refused_machine(NODE, stranger.fingerprint)
    assert machine.connect(server)


def test_a_full_disk_leaves_the_first_machine_accepted(
    server: NodeIdentities,
    machine: Machine,
    stranger: Machine,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert machine.connect(server)
    for _ in range(2):
        assert not stranger.connect(server)
    fingerprint = stranger.fingerprint
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", refusing(*NO_SPACE))
        with pytest.raises(StorageError):
            server.accept_last_refused_machine(NODE, fingerprint)
    assert machine.connect(server)
    assert server.refused_machines[NODE].fingerprint == fingerprint


def test_a_damaged_secret_is_named_and_stored_again(
    server: NodeIdentities, machine: Machine, stranger: Machine, tmp_path: Path
) -> None:
    assert machine.connect(server)
    path = tmp_path / "data" / "nodes" / NODE / SECRETS_NAME
    path.write_bytes(path.read_bytes()[:-20])
    assert machine.connect(server)
    assert f"{SECRETS_NAME}.damaged-1" in " ".join(server.problems)
    assert not stranger.connect(server)


def test_an_unreadable_secret_refuses_every_machine(
    server: NodeIdentities, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert machine.connect(server)
    with monkeypatch.context() as unreadable:
        unreadable.setattr("storage.durable_files.open", refusing(PermissionError), raising=False)
        with pytest.raises(StorageError):
            server.read_secret_and_make_challenge(NODE, SERVER)
    assert machine.connect(server)


@pytest.mark.parametrize(
    "answer",
    [Proof, lambda: Proof(proof=generate_secret()), lambda: Proof(secret=generate_secret())],
)
def test_a_wrong_proof_is_refused(
    server: NodeIdentities, machine: Machine, answer: Callable[[], Proof]
) -> None:
    assert machine.connect(server)
    claim = IdentityClaim(
        NODE, server.read_secret_and_make_challenge(NODE, SERVER), answer(), ADDRESS
    )
    with pytest.raises(CloseConnection, match="foottile accept-node leg"):
        server.verify_or_refuse_claim(claim, NOW_T_NS)
