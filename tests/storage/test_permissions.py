"""Files and folders are their user's, whatever the umask was; secrets are nobody else's."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from storage.documents import write_checksummed_json
from storage.durable_files import make_synced_folder, write_atomically
from storage.permissions import (
    SECRETS_NAME,
    read_secrets_or_empty,
    set_umask_and_create_private_folder,
    write_secrets,
)


@pytest.fixture(autouse=True)
def _umask() -> Iterator[None]:
    before = os.umask(0)
    yield
    os.umask(before)


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def written(folder: Path) -> tuple[int, int]:
    """Modes of a folder and a file that are made in it."""
    make_synced_folder(folder / "inner")
    write_atomically(folder / "inner" / "file", b"x")
    return mode_of(folder / "inner"), mode_of(folder / "inner" / "file")


def test_a_folder_that_is_made_is_its_users(tmp_path: Path) -> None:
    set_umask_and_create_private_folder(tmp_path / "a" / "data")
    assert mode_of(tmp_path / "a" / "data") == 0o700
    assert written(tmp_path / "a" / "data") == (0o700, 0o600)


@pytest.mark.parametrize(
    "found",
    [
        (),
        ("server.json", "journal"),
        (".lock",),
        (".lock", ".writable", "journal", "nodes", "server.json", "sessions", "token", "trash"),
        (".lock", "server.json.damaged-1", ".server.json.4711.815.0123abcd.tmp"),
    ],
    ids=str,
)
def test_an_open_folder_of_ours_is_closed(tmp_path: Path, found: tuple[str, ...]) -> None:
    for name in found:
        (tmp_path / name).touch()
    tmp_path.chmod(0o755)
    set_umask_and_create_private_folder(tmp_path)
    assert mode_of(tmp_path) == 0o700


@pytest.mark.parametrize("name", ["journal", "nodes", "sessions", "Documents"])
def test_a_users_folder_stays_open_and_our_files_in_it_are_closed(
    tmp_path: Path, name: str
) -> None:
    (tmp_path / "thesis.tex").touch()
    (tmp_path / name).mkdir()
    tmp_path.chmod(0o755)
    for _ in range(2):
        set_umask_and_create_private_folder(tmp_path)
        assert mode_of(tmp_path) == 0o755
        assert written(tmp_path) == (0o700, 0o600)
        for ours in (".lock", "server.json"):  # what a start leaves is there at the second one
            (tmp_path / ours).touch()


@pytest.mark.parametrize("mode", [0o750, 0o770, 0o2750])
def test_a_group_that_the_owner_let_in_may_read(tmp_path: Path, mode: int) -> None:
    tmp_path.chmod(mode)
    set_umask_and_create_private_folder(tmp_path)
    assert mode_of(tmp_path) == mode
    folder, file = written(tmp_path)
    assert (folder & 0o777, file) == (0o750, 0o640)


# --- secrets --------------------------------------------------------------------------------------


@settings(max_examples=20)
@given(st.dictionaries(st.text(), st.binary(min_size=32, max_size=32).map(bytes.hex), max_size=4))
def test_secrets_are_read_back_and_only_by_their_owner(secrets: dict[str, str]) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "new" / SECRETS_NAME
        assert read_secrets_or_empty(path) == {}
        os.umask(0o027)  # a group may read the rest
        write_secrets(path, secrets)
        assert read_secrets_or_empty(path) == secrets
        assert mode_of(path) == 0o600


@pytest.mark.parametrize(
    "content", [b'{"secrets":[]}', b'{"secrets":{"leg":5}}', b'{"secrets":{"a":"deadbeef"}}']
)
def test_another_file_is_no_file_of_secrets(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / SECRETS_NAME
    write_checksummed_json(path, content)
    with pytest.raises(FileFormatError, match=r"secrets\.json: written by another") as found:
        read_secrets_or_empty(path)
    assert "deadbeef" not in f"{found.value}{found.value.__cause__}"
