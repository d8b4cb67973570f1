"""A session whose folder was renamed or copied by hand is told of by name, and left as it is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from service.server.session_store import SessionStore, Trash
from service.sessions.recovery import recover_locked_folder
from storage.durable_files import lock_folder
from storage.sessions.folder import Part, Session, SessionsFolder, SessionState
from storage.verify.data_folder import find_verdict, verify_path
from tests.builders.arrays import UTC_NS
from tests.service.cli.outcome import Run

ID, OTHER_ID = "20200101T000000Z-00000a", "20200101T000000Z-00000b"


def put(data: Path, session_id: str = ID, state: SessionState = "recording") -> Path:
    session = Session(
        id=session_id,
        name="walk",
        node="bench",
        state=state,
        started_t_ns=UTC_NS,
        parts=(Part(stream_id="a" * 32, seq_first=0, seq_last=9),),
        scene="test",
    )
    folder = SessionsFolder(data / "sessions")
    folder.save_session_json(session)
    return folder.get_path(session_id)


def renamed(data: Path, name: str, **facts: SessionState) -> Path:
    path = put(data, **facts)
    return path.rename(path.with_name(name))


def files_in(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file() and path.name != ".lock")
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


NAMES = ["walk 3", f"{ID} (copy)", ID.lower(), f"{ID}.bak", "x\x1b[2Jy", OTHER_ID]


@pytest.mark.parametrize("name", NAMES)
def test_a_renamed_folder_is_named_with_its_id_by_every_command(
    run: Run, tmp_path: Path, name: str
) -> None:
    data = tmp_path / "data"
    renamed(data, name)
    before = files_in(data)
    shown = name.replace("\x1b", "\\x1b")
    listed = run("sessions", "--data", data)
    assert listed.code == 0
    for text in (listed.err, run("verify", data).out, run("recover", data).out):
        assert ID in text
        assert shown in text
        assert "\x1b" not in text
    assert find_verdict(verify_path(data)) == "damaged"
    assert files_in(data) == before


@pytest.mark.parametrize("name", NAMES[:2])
def test_a_copy_is_named_and_neither_is_merged_nor_deleted(
    run: Run, tmp_path: Path, name: str
) -> None:
    data = tmp_path / "data"
    path = put(data)
    shutil.copytree(path, path.with_name(name))
    before = files_in(data / "sessions" / name)
    listed = run("sessions", "--data", data)
    assert listed.out.count(ID) == 1
    assert f"is a copy of session {ID}" in listed.err
    with lock_folder(data):
        recovery = recover_locked_folder(data, abandon_missing=True)
    assert [found.session.id for found in recovery.sessions] == [ID]
    assert any("copy" in problem for problem in recovery.problems)
    assert files_in(data / "sessions" / name) == before


@pytest.mark.parametrize(("state", "is_held"), [("sealed", False), ("recording", True)])
def test_a_server_names_a_renamed_session_and_keeps_its_frames(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, state: SessionState, is_held: bool
) -> None:
    renamed(tmp_path, "walk 3", state=state)
    (tmp_path / "sessions" / "holiday pictures").mkdir()
    folder = SessionsFolder(tmp_path / "sessions")
    book = SessionStore(folder, Trash(tmp_path / "trash"), lambda _: None)
    assert list(book.unreadable) == ["walk 3"]
    assert ID in book.unreadable["walk 3"]
    assert any("walk 3" in problem for problem in book.problems)
    assert book.has_unreadable is is_held
    assert "walk 3" in caplog.text
    assert ID in caplog.text
    path = tmp_path / "sessions"
    (path / "walk 3").rename(path / ID)
    again = SessionStore(folder, Trash(tmp_path / "trash"), lambda _: None)
    assert (again.problems, again.get_session(ID).name) == ([], "walk")
