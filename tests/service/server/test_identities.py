"""Whatever dies or is replaced, a name belongs to one machine, and that machine gets in again."""

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
from service.node.options import ServerSecrets
from service.node_identity import compute_fingerprint, generate_secret, make_proof
from service.protocol import CloseConnection, LinkCloseCode, Proof
from service.server.identities import IdentityClaim, NodeIdentities
from storage.permissions import SECRETS_NAME
from tests.storage.faulty_disk import NO_SPACE, refusing

SERVER, NODE, NOW_T_NS = "5" * 32, "leg", 1_800_000_000 * 10**9
ADDRESS = "192.168.4.7"


class _Killed(Exception):  # noqa: N818  # no error: where a process ends
    pass


class Machine:
    """A node's end: its folder, and what it answers as `service.node.publisher` does."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.is_refused = False

    def connect(self, server: NodeIdentities, *, dies_after: str = "") -> bool:
        """Connect once; return whether the server welcomes it. A step may be its last one."""
        challenge = server.make_challenge(NODE, SERVER)
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
            server.try_store_first_secret(claim)
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


@settings(deadline=None, max_examples=60)
@given(
    happened=st.lists(
        st.sampled_from(
            ["share", "keep", "connects", "server restarts", "server loses it", "stranger"]
        ),
        max_size=8,
    )
)
def test_whatever_dies_when_the_machine_that_was_first_is_let_in_without_a_person(
    happened: list[str],
) -> None:
    with TemporaryDirectory() as folder:
        data = Path(folder) / "data"
        server, machine = NodeIdentities(data), Machine(Path(folder) / "machine")
        assert machine.connect(server)
        for what in happened:
            is_kept = (data / "nodes" / NODE / SECRETS_NAME).exists()
            if what in ("share", "keep"):
                with pytest.raises(_Killed):
                    machine.connect(server, dies_after=what)
            elif what == "connects":
                assert machine.connect(server)
            elif what == "server restarts":
                server = NodeIdentities(data)
            elif what == "server loses it":  # an older copy of its folder, say
                shutil.rmtree(data / "nodes", ignore_errors=True)
            elif is_kept:
                assert not Machine(Path(folder) / "stranger").connect(server)
        assert machine.connect(server)


def test_a_first_contact_that_dies_anywhere_locks_nobody_out(
    server: NodeIdentities, machine: Machine
) -> None:
    for step in ("share", "keep", "share"):
        with pytest.raises(_Killed):
            machine.connect(server, dies_after=step)
    assert machine.connect(server)


def test_a_person_decides_and_from_then_on_the_machine_before_is_refused(
    server: NodeIdentities, machine: Machine, stranger: Machine
) -> None:
    assert machine.connect(server)
    assert not stranger.connect(server)
    # It proved that it has a secret, and now shows it: else nobody could accept it.
    assert not stranger.connect(server)
    asking = server.refused_machines[NODE]
    assert (asking.fingerprint, asking.address) == (stranger.fingerprint, ADDRESS)
    server.accept_replacement(NODE, stranger.fingerprint)
    assert stranger.connect(server)
    assert not machine.connect(server)
    assert NODE not in server.refused_machines, "it has shown a proof only"
    assert not machine.connect(server)
    assert server.refused_machines[NODE].fingerprint == machine.fingerprint
    assert stranger.connect(NodeIdentities(server._nodes.parent))


def test_only_the_machine_that_was_looked_at_is_accepted(
    server: NodeIdentities, machine: Machine, stranger: Machine, tmp_path: Path
) -> None:
    with pytest.raises(StateError, match="no other machine"):
        server.accept_replacement(NODE, "0000-0000-0000-0000")
    assert machine.connect(server)
    third = Machine(tmp_path / "third")
    for other in (stranger, stranger, third, third):
        assert not other.connect(server)
    with pytest.raises(ChangedError, match=third.fingerprint):
        server.accept_replacement(NODE, stranger.fingerprint)
    assert machine.connect(server)


def test_a_disk_that_takes_nothing_leaves_the_machine_before_in_force(
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
            server.accept_replacement(NODE, fingerprint)
    assert machine.connect(server)
    assert server.refused_machines[NODE].fingerprint == fingerprint


def test_a_secret_that_was_damaged_is_named_and_the_node_is_let_in(
    server: NodeIdentities, machine: Machine, stranger: Machine, tmp_path: Path
) -> None:
    assert machine.connect(server)
    path = tmp_path / "data" / "nodes" / NODE / SECRETS_NAME
    path.write_bytes(path.read_bytes()[:-20])
    assert machine.connect(server)
    assert f"{SECRETS_NAME}.damaged-1" in " ".join(server.problems)
    assert not stranger.connect(server)


def test_a_secret_that_cannot_be_read_now_lets_nobody_in(
    server: NodeIdentities, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert machine.connect(server)
    with monkeypatch.context() as unreadable:
        unreadable.setattr("storage.durable_files.open", refusing(PermissionError), raising=False)
        with pytest.raises(StorageError):
            server.make_challenge(NODE, SERVER)
    assert machine.connect(server)


@pytest.mark.parametrize(
    "answer",
    [Proof, lambda: Proof(proof=generate_secret()), lambda: Proof(secret=generate_secret())],
)
def test_no_answer_but_the_right_one_is_that_of_the_node(
    server: NodeIdentities, machine: Machine, answer: Callable[[], Proof]
) -> None:
    assert machine.connect(server)
    claim = IdentityClaim(NODE, server.make_challenge(NODE, SERVER), answer(), ADDRESS)
    with pytest.raises(CloseConnection, match="foottile accept-node leg"):
        server.verify_or_refuse_claim(claim, NOW_T_NS)
