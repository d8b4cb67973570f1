"""Secrets are read back as they were written, by their owner only."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import DamagedFileError, StorageError
from storage.permissions import SECRETS_NAME, read_secrets_or_empty, write_secrets
from tests.storage.faulty_disk import NO_SPACE, refusing

SECRETS = {"leg": "5" * 64}


@given(st.dictionaries(st.text(), st.binary(min_size=32, max_size=32).map(bytes.hex), max_size=4))
def test_what_was_written_is_read(secrets: dict[str, str]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "new" / SECRETS_NAME
        assert read_secrets_or_empty(path) == {}
        write_secrets(path, secrets)
        assert read_secrets_or_empty(path) == secrets


def test_only_the_owner_may_read_them_also_where_a_group_reads_the_rest(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_secrets(tmp_path / SECRETS_NAME, SECRETS)
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / SECRETS_NAME).stat().st_mode) == 0o600


@pytest.mark.parametrize(
    "content",
    [b"", b"\0" * 80, b"[]", b'{"secrets":[]}', b'{"secrets":{"leg":5}}', b'{"secrets":{"a":"5"}}'],
)
def test_what_is_no_file_of_secrets_is_called_damaged(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / SECRETS_NAME
    path.write_bytes(content)
    with pytest.raises(DamagedFileError) as refused:
        read_secrets_or_empty(path)
    assert SECRETS_NAME in str(refused.value)


def test_a_flipped_bit_is_noticed(tmp_path: Path) -> None:
    path = tmp_path / SECRETS_NAME
    write_secrets(path, SECRETS)
    path.write_bytes(path.read_bytes().replace(b"55", b"54", 1))
    with pytest.raises(DamagedFileError):
        read_secrets_or_empty(path)


def test_a_disk_that_takes_nothing_leaves_the_secret_as_it_was(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / SECRETS_NAME
    write_secrets(path, SECRETS)
    monkeypatch.setattr(os, "fsync", refusing(*NO_SPACE))
    with pytest.raises(StorageError):
        write_secrets(path, {"leg": "6" * 64})
    assert read_secrets_or_empty(path) == SECRETS
