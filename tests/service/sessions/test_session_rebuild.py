"""A damaged `session.json` costs no frames: it is made again from a sealed file, else all wait."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from devices.errors import StateError
from service.server.session_store import SessionStore, Trash
from service.sessions.recovery import recover_locked_folder
from storage.clock.log import ClockLog, ClockOffset
from storage.documents import append_json_checksum, verify_and_strip_json_checksum
from storage.sessions.folder import Session, SessionsFolder
from storage.verify.data_folder import find_verdict, verify_path
from tests.builders.calibrations import make_calibration
from tests.service.sessions.crashed import BOOT, ID, info_of, loaded, session, stream, t_ns

LOST = {"subject": "", "notes": "", "tags": ()}


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A sealed session with markers, clock and estimates."""
    folder = stream(tmp_path, info_of(), (0, 599), next_seq=600)
    ClockLog(folder).append(
        ClockOffset(stream_id=BOOT, t_mono_ns=10**9, server_minus_node_ns=5, uncertainty_ns=300)
    )
    session(tmp_path, calibration=make_calibration("T01", "T02").model_dump(mode="json"))
    recover_locked_folder(tmp_path)
    assert find_verdict(verify_path(tmp_path)) == "complete"
    return tmp_path


def damage(data: Path) -> Path:
    path = data / "sessions" / ID / "session.json"
    path.write_bytes(path.read_bytes().replace(b'"walk"', b'"wall"'))
    return path


def book(data: Path) -> SessionStore:
    return SessionStore(SessionsFolder(data / "sessions"), Trash(data / "trash"), lambda _: None)


def assert_made_again(data: Path, before: Session) -> Session:
    made = loaded(data)
    assert made.problem is not None
    assert made == before.model_copy(update={**LOST, "problem": made.problem})
    assert find_verdict(verify_path(data)) == "complete"
    return made


@pytest.mark.parametrize("by", ["server", "recover"])
def test_a_damaged_session_json_is_rebuilt_from_the_files_beside_it(data: Path, by: str) -> None:
    before, path = loaded(data), damage(data)
    damaged = path.read_bytes()
    if by == "server":
        assert [one.id for one in book(data).iterate_newest_first()] == [ID]
    else:
        recovery = recover_locked_folder(data)
        assert (recovery.rebuilt_sessions, recovery.problems) == ([ID], [])
        assert recover_locked_folder(data).is_empty_or_all_waiting
    made = assert_made_again(data, before)
    assert made.problem == (
        "its session.json was damaged and was rebuilt from frames.parquet; lost are subject, "
        "notes and tags"
    )
    assert (path.parent / "session.json.damaged-1").read_bytes() == damaged


def test_a_session_json_in_the_trash_is_rebuilt_as_well(data: Path) -> None:
    before = loaded(data)
    damage(data)
    (data / "trash").mkdir()
    shutil.move(data / "sessions" / ID, data / "trash" / ID)
    trash = Trash(SessionsFolder(data / "trash").get_path(ID).parent)
    assert (ID in trash, trash.problems) == (True, [])
    trash.restore(ID, SessionsFolder(data / "sessions"))
    assert_made_again(data, before)


@pytest.mark.parametrize(
    ("name", "content", "lost", "verdict"),
    [
        ("markers", b"PAR1", "markers", "complete"),
        ("clock", None, "clock measurements", "damaged"),
    ],
)
def test_a_missing_session_json_is_rebuilt_and_other_losses_are_said(
    data: Path, name: str, content: bytes | None, lost: str, verdict: str
) -> None:
    folder = data / "sessions" / ID
    (folder / "session.json").unlink()
    (folder / f"{name}.parquet").unlink()
    if content is not None:
        (folder / f"{name}.parquet").write_bytes(content)
    (one,) = book(data).iterate_newest_first()
    assert getattr(one, name) == ()
    assert str(one.problem).endswith(f"lost are subject, notes and tags, {lost}")
    recover_locked_folder(data)
    assert find_verdict(verify_path(data)) == verdict


def test_a_session_that_nothing_proves_is_named_and_its_files_stay(data: Path) -> None:
    frames = data / "sessions" / ID / "frames.parquet"
    content = bytearray(frames.read_bytes())
    content[len(content) // 2] ^= 1
    frames.write_bytes(content)
    path = damage(data)
    before = path.read_bytes()
    found = book(data)
    assert (list(found.iterate_newest_first()), found.has_unreadable) == ([], True)
    assert "it was changed" in found.unreadable[ID]
    with pytest.raises(StateError, match="cannot be read"):
        found.get_session(ID)
    assert ID in " ".join(recover_locked_folder(data).problems)
    assert path.read_bytes() == before


def test_a_session_of_another_version_is_left_as_it_is(data: Path) -> None:
    path = data / "sessions" / ID / "session.json"
    text = verify_and_strip_json_checksum(path.read_bytes(), where="")
    text = text.replace(b'"walk"', b'"walk", "colour": "red"', 1)
    path.write_bytes(append_json_checksum(text))
    found = book(data)
    assert ID in found.unreadable
    assert path.read_bytes() == append_json_checksum(text)


def test_all_frames_of_an_unsealed_damaged_session_are_kept(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 99), next_seq=100)
    session(tmp_path, state="pending", stopped_t_ns=t_ns(99))
    path = damage(tmp_path)
    found = book(tmp_path)
    assert (found.has_unreadable, list(found.unreadable)) == (True, [ID])
    assert path.is_file()
    (tmp_path / "sessions" / "20200101T000000Z-0000ff").mkdir()  # begun, and killed
    assert list(book(tmp_path).unreadable) == [ID]
