"""A node keeps the secret that it shares with a server before anybody is told of it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from service.node.server_secrets import ServerSecrets
from storage.permissions import SECRETS_NAME, read_secrets_or_empty
from tests.storage.faulty_disk import NO_SPACE, refusing

ONE, OTHER = "1" * 32, "2" * 32


@pytest.fixture
def reports() -> list[str]:
    return []


@pytest.fixture
def secrets(tmp_path: Path, reports: list[str]) -> ServerSecrets:
    return ServerSecrets(tmp_path, reports.append)


def test_each_server_has_a_secret_of_its_own_that_is_on_the_disk(
    tmp_path: Path, secrets: ServerSecrets, reports: list[str]
) -> None:
    shared = {server: secrets.get_or_create_secret(server) for server in (ONE, OTHER)}
    assert read_secrets_or_empty(tmp_path / SECRETS_NAME) == shared
    assert shared[ONE] != shared[OTHER]
    again = ServerSecrets(tmp_path, reports.append)
    assert {server: again.get_or_create_secret(server) for server in shared} == shared
    assert reports == []


def test_a_disk_that_takes_nothing_keeps_no_secret_and_none_is_shared(
    tmp_path: Path, secrets: ServerSecrets, reports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", refusing(*NO_SPACE))
        assert secrets.get_or_create_secret(ONE) is None
        assert secrets.get_or_create_secret(ONE) is None
        assert len(reports) == 1, "said once"
        assert not (tmp_path / SECRETS_NAME).exists()
    assert secrets.get_or_create_secret(ONE) is not None


def test_a_file_that_cannot_be_read_now_is_not_replaced(
    secrets: ServerSecrets, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = secrets.get_or_create_secret(ONE)
    with monkeypatch.context() as unreadable:
        unreadable.setattr("storage.durable_files.open", refusing(PermissionError), raising=False)
        assert secrets.get_or_create_secret(ONE) is None
    assert secrets.get_or_create_secret(ONE) == known


def test_a_damaged_file_is_set_aside_and_another_secret_is_made(
    tmp_path: Path, secrets: ServerSecrets, reports: list[str]
) -> None:
    known = secrets.get_or_create_secret(ONE)
    (tmp_path / SECRETS_NAME).write_bytes(b"{}")
    assert secrets.get_or_create_secret(ONE) not in (None, known)
    assert (tmp_path / f"{SECRETS_NAME}.damaged-1").exists()
    assert "until a person accepts it" in " ".join(reports)


def test_the_secrets_of_the_newest_servers_only_are_kept(
    tmp_path: Path, secrets: ServerSecrets, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("service.node.server_secrets._SERVERS_MAX", 3)
    shared = {server: secrets.get_or_create_secret(server) for server in "abcde"}
    assert read_secrets_or_empty(tmp_path / SECRETS_NAME) == {s: shared[s] for s in "cde"}
