"""Where sessions are: folders, files, globs, manifests, and filesystems that are not this one."""

from __future__ import annotations

import shutil
from pathlib import Path

import fsspec
import pytest

from devices.errors import FileFormatError, UsageError
from service.offline.archive.local_copies import (
    get_sealed_frames_path,
    hash_session,
    open_local_session,
)
from service.offline.archive.locations import (
    SessionLocation,
    find_session_locations,
    parse_session_location,
    read_bytes,
)
from service.offline.archive.manifest import read_rows
from storage.sessions.reader import SealedFileReader
from tests.service.offline.archives import IDS


def names(*places: str | Path) -> list[str]:
    return sorted(
        place.session_id for place in find_session_locations([str(place) for place in places])
    )


def test_a_place_is_a_data_folder_a_folder_of_sessions_one_of_them_or_a_glob(archive: Path) -> None:
    four, sessions = list(IDS[:4]), archive / "sessions"
    (sessions / "notes").mkdir()
    assert names(archive) == four
    assert names(sessions) == four
    assert names(sessions / IDS[1]) == [IDS[1]]
    assert names(f"{sessions}/*-00000[12]") == [IDS[1], IDS[2]]
    assert names(sessions / IDS[0], sessions / IDS[3]) == [IDS[0], IDS[3]]


def test_a_lone_file_is_a_session_with_its_own_name(archive: Path, tmp_path: Path) -> None:
    shutil.copy(archive / "sessions" / IDS[0] / "frames.parquet", tmp_path / "hops.parquet")
    (place,) = find_session_locations([str(tmp_path / "hops.parquet")])
    assert place == SessionLocation(str(tmp_path / "hops.parquet"), "hops", is_single_file=True)
    assert len(hash_session(place)) == 64
    inside = parse_session_location(f"{archive}/sessions/{IDS[0]}/frames.parquet")
    assert inside == SessionLocation(f"{archive}/sessions/{IDS[0]}", IDS[0])


def test_a_place_that_is_not_there_is_refused_before_anything_is_given(archive: Path) -> None:
    for missing in ("nowhere", f"{archive}/*.parquet", "memory://nowhere", "nosuch://bucket/a"):
        with pytest.raises(UsageError, match=r"no (place|session)"):
            find_session_locations([str(archive), missing])


def test_sessions_are_found_and_staged_in_any_filesystem(archive: Path) -> None:
    memory = fsspec.filesystem("memory")
    memory.put(f"{archive}/sessions/", "/lab/sessions/", recursive=True)
    try:
        assert names("memory://lab") == list(IDS[:4])
        assert names(f"memory://lab/sessions/{IDS[2]}") == [IDS[2]]
        place = parse_session_location(f"memory://lab/sessions/{IDS[2]}")
        here = parse_session_location(f"{archive}/sessions/{IDS[2]}")
        assert hash_session(place) == hash_session(here)
        with open_local_session(place) as folder, open_local_session(here) as original:
            assert original == archive / "sessions" / IDS[2]
            copied = {path.name: path.read_bytes() for path in folder.iterdir()}
            assert copied == {path.name: path.read_bytes() for path in original.iterdir()}
            with SealedFileReader(get_sealed_frames_path(folder)) as session:
                assert session.frame_count == 400
        assert not folder.exists()
        file = f"memory://lab/sessions/{IDS[2]}/frames.parquet"
        changed = bytearray(read_bytes(file))
        changed[1000] ^= 1
        memory.pipe(f"/lab/sessions/{IDS[2]}/frames.parquet", bytes(changed))
        with (
            pytest.raises(FileFormatError, match="does not have the hash"),
            open_local_session(place),
        ):
            pass
        with pytest.raises(FileFormatError, match="no such file"):
            hash_session(parse_session_location("memory://lab/sessions/nothing"))
    finally:
        memory.rm("/lab", recursive=True)


def test_a_manifest_names_sessions_relative_to_itself(tmp_path: Path) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_text("session,reference\na/b,r.csv\n\ns3://bucket/x , r.csv\n")
    rows = list(read_rows(manifest, {"session", "reference"}))
    assert [row["session"] for row in rows] == [str(tmp_path / "a" / "b"), "s3://bucket/x"]
    assert rows[1]["reference"] == "r.csv"


PLAIN = "session,reference,units\r\na/Größe,r.csv,\r\nb,s.csv,grf=N\r\n"


@pytest.mark.parametrize(
    "content",
    [
        PLAIN.encode(),
        PLAIN.encode("utf-8-sig"),
        PLAIN.encode("cp1252"),
        PLAIN.replace(",", "\t").encode("utf-16"),
        PLAIN.replace(",", ";").encode("cp1252"),
        (PLAIN + ",,\r\n ,,\r\n").encode(),
        PLAIN.replace("\r\n", ",,\r\n").encode(),
        ("sep=;\r\n" + PLAIN.replace(",", ";") + ";;\r\n").encode("utf-8-sig"),
        (",,\r\n" + PLAIN).encode(),
        PLAIN.replace(",", " , ").encode(),
    ],
)
def test_a_manifest_is_read_as_spreadsheets_save_it(tmp_path: Path, content: bytes) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_bytes(content)
    rows = list(read_rows(manifest, {"session", "reference", "units"}))
    assert rows == [
        {"session": str(tmp_path / "a" / "Größe"), "reference": "r.csv", "units": ""},
        {"session": str(tmp_path / "b"), "reference": "s.csv", "units": "grf=N"},
    ]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("", UsageError),
        ("name\nx\n", UsageError),
        ("session,session\nx,y\n", UsageError),
        ("session,other\nx,y\n", UsageError),
        ("session\n\x00\xff\n", UsageError),
        ("session,reference\nx\n", FileFormatError),
        ("session,reference\n,y\n", FileFormatError),
    ],
)
def test_a_manifest_that_is_none_is_refused(
    tmp_path: Path, text: str, error: type[Exception]
) -> None:
    manifest = tmp_path / "list.csv"
    manifest.write_bytes(text.encode("latin-1"))
    with pytest.raises(error):
        list(read_rows(manifest, {"session", "reference"}))
