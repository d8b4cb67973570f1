"""What a server proves of sealed files that it opens often, and what it keeps of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest

from devices.errors import FileFormatError
from storage.parquet_hash import read_stated_and_actual_hash
from storage.sessions import footer, reader
from storage.sessions import reader as verified_file_cache
from storage.sessions.footer import SealedFileFooter
from storage.sessions.reader import SealedFileReader, VerifiedFileCache
from tests.storage.sessions.session_files import frames, write


@pytest.fixture
def hashed(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files of which all bytes were held against a hash, each time."""
    looked: list[Path] = []

    def counted(path: Path) -> tuple[str, str] | None:
        looked.append(path)
        return read_stated_and_actual_hash(path)

    monkeypatch.setattr(footer, "read_stated_and_actual_hash", counted)
    return looked


def test_a_file_that_is_opened_again_is_held_against_its_hash_once_and_anew_if_it_changed(
    tmp_path: Path, hashed: list[Path]
) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    for _ in range(3):
        files.open_reader(path).close()
    assert hashed == [path]
    whole = path.read_bytes()
    changed = whole.replace(b"temperature_raw_0", b"temperature_raw_x").replace(
        b"temperature_raw_1", b"temperature_raw_0"
    )
    path.write_bytes(
        changed.replace(b"temperature_raw_x", b"temperature_raw_1")
    )  # every page is as it was
    os.utime(path, ns=(1, 1))  # a kernel's ticks are milliseconds
    for _ in range(2):
        for only_slices in (False, True):
            with pytest.raises(FileFormatError, match="changed since it was sealed"):
                files.open_reader(path, only_slices=only_slices)
    path.write_bytes(whole)
    os.utime(path, ns=(2, 2))
    files.open_reader(path).close()
    assert hashed == [path, path]  # of the changed one its footer's own hash was enough


def test_for_slices_the_footer_is_proven_and_the_whole_file_when_all_of_it_is_read(
    tmp_path: Path, hashed: list[Path]
) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    for _ in range(2):
        files.open_reader(path, only_slices=True).close()
    assert hashed == []
    for _ in range(2):
        files.open_reader(path).close()
        files.open_reader(path, only_slices=True).close()
    assert hashed == [path]


def test_a_footer_is_read_once_and_anew_if_the_file_changed(tmp_path: Path) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    kept = [files.open_reader(path, only_slices=True).footer for _ in range(2)]
    assert kept[0] is kept[1]
    write(path, frames(30))
    with files.open_reader(path, only_slices=True) as session:
        assert session.footer is not kept[0]
        assert len(session.read_frames()) == 30


def test_a_file_that_is_replaced_while_it_is_opened_is_not_read_with_the_footer_of_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, files = write(tmp_path / "s.parquet", frames(20)), VerifiedFileCache()
    files.open_reader(path, only_slices=True).close()
    opened: list[bool] = []

    def replaced(*args: Any, footer: SealedFileFooter | None, **options: Any) -> SealedFileReader:
        if not opened:
            write(path, frames(30))
        opened.append(footer is not None)
        return SealedFileReader(*args, footer=footer, **options)

    monkeypatch.setattr(verified_file_cache, "SealedFileReader", replaced)
    with files.open_reader(path, only_slices=True) as session:
        assert len(session.read_frames()) == 30
    assert opened == [True, False]


def test_how_many_opened_files_are_remembered_is_bounded(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verified_file_cache, "_MAX_ENTRIES", 2)
    files = VerifiedFileCache()
    for number in range(4):
        files.open_reader(write(tmp_path / f"{number}.parquet", frames(5))).close()
    assert len(files._verified_stamps) == len(files._footers) == 2
    with pytest.raises(FileFormatError, match="cannot be read"):
        files.open_reader(tmp_path / "none.parquet")


def test_footers_are_kept_up_to_a_bound_of_their_bytes_the_ones_used_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hashed: list[Path]
) -> None:
    paths = [write(tmp_path / f"{number}.parquet", frames(5)) for number in range(3)]
    files = VerifiedFileCache()
    first = files.open_reader(paths[0]).footer
    monkeypatch.setattr(verified_file_cache, "_MAX_FOOTER_BYTES", 2 * first.size_bytes + 100)
    files.open_reader(paths[1]).close()
    assert files.open_reader(paths[0]).footer is first
    files.open_reader(paths[2]).close()
    assert files.open_reader(paths[0]).footer is first
    assert len(files._footers) == 2
    files.open_reader(paths[1]).close()
    assert hashed == paths  # what was forgotten is where its columns are, not that it is whole


def test_a_file_that_is_replaced_behind_its_footer_is_read_with_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "s.parquet", frames(20))
    footers: list[SealedFileFooter] = []

    def replaced(*args: Any, **options: Any) -> SealedFileFooter:
        footers.append(SealedFileFooter(*args, **options))
        if len(footers) == 1:
            write(path, frames(30))
        return footers[-1]

    monkeypatch.setattr(reader, "SealedFileFooter", replaced)
    with SealedFileReader(path, only_slices=True) as session:
        assert len(session.read_frames()) == 30
    assert len(footers) == 2
