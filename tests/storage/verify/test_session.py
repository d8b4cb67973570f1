"""A session's folder proves itself: every file of it against every other, and damage is named."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from service.sessions.inputs import SessionInputs
from service.sessions.sealing import write_sealed_files
from storage.clock.log import ClockOffset
from storage.documents import (
    append_json_checksum,
    verify_and_strip_json_checksum,
    write_checksummed_json,
)
from storage.intervals import Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Marker, Part, Session, SessionsFolder
from storage.sessions.ledger import StreamState, compute_ledger
from storage.sessions.videos import IncomingVideo
from storage.verify.data_folder import find_verdict, verify_path
from storage.verify.sealed_file import verify_sealed_file
from storage.verify.session import SessionReport, verify_session
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.storage.sessions.test_videos import INFO, TIMES

ID = "20200101T000000Z-00000a"
OTHER_ID = "20200101T000000Z-00000b"
STREAM_IDS = ("a" * 32, "b" * 32)
EVENTS = (Marker(id="e1", label="slip", t_ns=UTC_NS + 5),)


def array(boot: int = 0) -> ArrayInfo:
    return make_array(1, stream_id=STREAM_IDS[boot], utc_offset_ns=UTC_NS + boot)


def frames(first: int, last: int, boot: int = 0) -> FrameBatch:
    return make_frames(np.arange(first, last + 1), 1, utc_offset_ns=UTC_NS + boot)


def journal(data: Path, boot: int, *runs: tuple[int, int], **notes: Any) -> Journal:
    folder = data / "journal" / "bench" / STREAM_IDS[boot]
    held = Journal(folder, array(boot))
    for first, last in runs:
        for begin in range(first, last + 1, 5):
            held.append_new_frames(frames(begin, min(begin + 4, last), boot))
    held.close()
    StreamNotes(array_info=array(boot), **notes).save(folder)
    return held


def session(session_id: str = ID, **changes: Any) -> Session:
    content: dict[str, Any] = {
        "id": session_id,
        "name": "walk",
        "node": "bench",
        "state": "sealing",
        "started_t_ns": UTC_NS,
        "stopped_t_ns": UTC_NS + 10**9,
        "parts": (
            Part(stream_id=STREAM_IDS[0], seq_first=10, seq_last=49),
            Part(stream_id=STREAM_IDS[1], seq_first=0, seq_last=19),
        ),
        "scene": "test",
        "notes": "first try",
        "markers": EVENTS,
        "clock": (
            ClockOffset(
                stream_id=STREAM_IDS[0], t_mono_ns=1, server_minus_node_ns=2, uncertainty_ns=3
            ),
        ),
    }
    return Session(**content | changes)


def keep(data: Path, kept: Session, *, place: str = "sessions") -> Path:
    """As a server keeps it, with the hash of its own text."""
    SessionsFolder(data / place).save_session_json(kept)
    return data / place / kept.id


def sealed(data: Path, session_id: str = ID, **changes: Any) -> Path:
    """A sealed session of two parts, of which frames 20 to 24 of the first are lost."""
    begun = session(session_id, **changes)
    journals = {
        STREAM_IDS[0]: journal(data, 0, (0, 19), (25, 60)),
        STREAM_IDS[1]: journal(data, 1, (0, 19)),
    }
    lost = {STREAM_IDS[0]: Losses({"disk_full": [(20, 24)]})}
    states = {
        stream_id: StreamState(stored=held.stored, lost=lost.get(stream_id, Losses()))
        for stream_id, held in journals.items()
    }
    ledger = compute_ledger(begun.parts, states, has_all_parts=True)
    notes = {"lost": {stream_id: losses.to_pairs() for stream_id, losses in lost.items()}}
    folder = keep(data, begun)
    done = write_sealed_files(
        SessionInputs(begun, array(), journals, None, "none", (), notes), folder, ledger
    )
    return keep(data, done)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with a sealed session."""
    data = tmp_path_factory.mktemp("data")
    sealed(data)
    return data


@pytest.fixture
def folder(data: Path, tmp_path: Path) -> Path:
    """The folder of the sealed session, in a copy of its data folder."""
    shutil.copytree(data, tmp_path, dirs_exist_ok=True)
    return tmp_path / "sessions" / ID


def problems(folder: Path) -> str:
    return "; ".join(verify_session(folder).problems)


def edited(folder: Path, place: str = "", **changes: Any) -> None:
    """Change session.json, its first part, its ledger's or its first clock row; rightly hashed."""
    path = folder / "session.json"
    content = json.loads(path.read_bytes())
    content.pop("check", None)
    if place:
        ((content["ledger"]["parts"] if place == "ledger" else content[place])[0]).update(changes)
    else:
        content.update(changes)
    path.write_bytes(append_json_checksum(json.dumps(content).encode()))


# --- what is whole --------------------------------------------------------------------------------


def test_a_whole_session_is_proven_and_nothing_is_touched(folder: Path) -> None:
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}
    report = verify_session(folder)
    assert (report.problems, report.unproven) == ([], [])
    assert find_verdict(report) == "lossy"
    content = report.to_json_dict()
    assert set(content) == {
        *("complete", "lossy", "parts", "missed_slots"),
        *("id", "problems", "sha256", "unproven"),
    }
    assert (content["complete"], content["lossy"], content["id"]) == (False, True, ID)
    assert content["parts"][0] == {
        "stream_id": STREAM_IDS[0],
        "seq_first": 10,
        "seq_last": 49,
        "recorded": 35,
        "lost": {"disk_full": 5},
        "pending": 0,
        "max_lost_tail_frames": 0,
    }
    assert before == {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


def test_a_session_without_a_frame_is_whole(tmp_path: Path) -> None:
    begun = session(parts=(Part(stream_id=STREAM_IDS[0], seq_first=0, seq_last=-1),))
    ledger = compute_ledger(begun.parts, {}, has_all_parts=True)
    folder = keep(tmp_path, begun)
    inputs = SessionInputs(begun, array(), {}, None, "none", (), {})
    keep(tmp_path, write_sealed_files(inputs, folder, ledger))
    assert problems(folder) == ""
    (folder / "frames.parquet").write_bytes(b"")
    assert "no frame recorded" in problems(folder)


def test_a_session_that_was_pulled_is_proven_too(tmp_path: Path, folder: Path) -> None:
    kept = SessionsFolder(folder.parent).load(ID)
    view = kept.model_dump(
        mode="json",
        exclude={"ledger", "markers", "clock", "scene_content", "calibration"},
        exclude_defaults=False,
    )
    view.pop("missed_slots_at_start")
    view.pop("max_lost_tail_frames")
    pulled = tmp_path / "pulled" / ID
    pulled.mkdir(parents=True)
    shutil.copy(folder / "frames.parquet", pulled)
    content = json.dumps({**view, "complete": "lossy"}).encode()
    write_checksummed_json(pulled / "session.json", content)
    assert kept.ledger is not None
    write_checksummed_json(pulled / "ledger.json", kept.ledger.model_dump_json().encode())
    report = verify_session(pulled)
    assert report.problems == []
    assert find_verdict(report) == "lossy"
    edited_ledger = kept.ledger.model_copy(update={"lossy": False, "complete": True})
    write_checksummed_json(pulled / "ledger.json", edited_ledger.model_dump_json().encode())
    assert "ledgers" in problems(pulled)


def test_a_lone_file_says_what_it_cannot_prove(tmp_path: Path) -> None:
    path = sealed(tmp_path) / "frames.parquet"
    report = verify_path(path)
    assert isinstance(report, SessionReport)
    assert report.to_json_dict()["id"] == ID
    assert find_verdict(report) == "lossy"
    assert "session.json" in " ".join(report.unproven)


# --- not sealed -----------------------------------------------------------------------------------


def test_a_session_that_waits_is_counted_from_the_journals(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 19), (25, 60), lost={"disk_full": ((20, 21),)}, missed_slots=9)
    (tmp_path / "nodes").mkdir()
    folder = keep(tmp_path, session(state="pending", missed_slots_at_start=4))
    report = verify_session(folder)
    assert report.problems == []
    assert find_verdict(report) == "pending"
    content = report.to_json_dict()
    assert (content["complete"], content["sha256"], content["missed_slots"]) == (False, None, 5)
    first, second = content["parts"]
    assert (first["recorded"], first["lost"], first["pending"]) == (35, {"disk_full": 2}, 3)
    assert (second["recorded"], second["pending"]) == (0, 20)
    shutil.rmtree(tmp_path / "nodes")  # a node has what there is
    first, second = verify_session(folder).to_json_dict()["parts"]
    assert (first["lost"], first["pending"]) == ({"disk_full": 2, "node_restarted": 3}, 0)
    assert second["lost"] == {"node_restarted": 20}


def test_a_session_that_is_recorded_reaches_to_the_newest_frame(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 29))
    parts = (Part(stream_id=STREAM_IDS[0], seq_first=5),)
    folder = keep(tmp_path, session(state="recording", parts=parts, stopped_t_ns=None))
    report = verify_session(folder)
    assert report.ledger is not None
    assert (report.ledger.parts[0].seq_last, report.ledger.parts[0].recorded) == (29, 25)
    assert find_verdict(report) == "pending"
    lonely = tmp_path / "far" / "off" / ID
    shutil.copytree(folder, lonely)
    report = verify_session(lonely)
    assert "journals are not here" in " ".join(report.unproven)
    ledger = verify_session(lonely, data_folder=tmp_path).ledger
    assert ledger is not None
    assert ledger.recorded == 25


def test_damage_in_a_journal_that_it_needs_is_its_own(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 60))
    (path,) = (tmp_path / "journal" / "bench" / STREAM_IDS[0]).glob("*.arrows")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    parts = (Part(stream_id=STREAM_IDS[0], seq_first=0, seq_last=60),)
    report = verify_session(keep(tmp_path, session(state="pending", parts=parts)))
    assert "do not agree with their checksum" in "; ".join(report.problems)
    assert report.ledger is not None
    assert report.ledger.parts[0].lost == {"corrupt": 5}


def test_what_changes_while_it_is_read_is_read_again(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (folder / "session.json").read_bytes()
    edited(folder, sha256="0" * 64)
    from storage.verify import session as module

    calls = []

    def meanwhile(path: Path) -> Any:
        calls.append(path)
        (folder / "session.json").write_bytes(before)
        return verify_sealed_file(path)

    monkeypatch.setattr(module, "verify_sealed_file", meanwhile)
    assert verify_session(folder).problems == []
    assert len(calls) == 2


# --- a data folder --------------------------------------------------------------------------------


def test_a_data_folder_is_all_of_its_sessions_and_journals(tmp_path: Path) -> None:
    sealed(tmp_path)
    deleted = keep(tmp_path, session(OTHER_ID, state="pending"), place="trash")
    (tmp_path / "sessions" / "20200101T000000Z-00000c").mkdir()  # begun, and killed
    report = verify_path(tmp_path)
    assert find_verdict(report) == "lossy"
    content = report.to_json_dict()
    assert set(content) == {"sessions", "journals", "problems", "unproven", "set_aside"}
    assert [one["id"] for one in content["sessions"]] == [ID, OTHER_ID]
    assert [one["frames"] for one in content["journals"]] == [56, 20]
    assert content["problems"] == []
    (deleted / "session.json").write_bytes(b"{")
    assert find_verdict(verify_path(tmp_path)) == "damaged"


def test_whatever_is_named_is_found(tmp_path: Path, folder: Path) -> None:
    stream = tmp_path / "journal" / "bench" / STREAM_IDS[0]
    for path in (folder, folder / "session.json", stream, stream / "stream.json", tmp_path):
        assert verify_path(path).to_json_dict()["problems"] == []
    for path in stream.glob("0*"):
        assert verify_path(path).to_json_dict()["closed"] is True
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "none", tmp_path / "empty"):
        with pytest.raises(FileFormatError):
            verify_path(path)


# --- damage ---------------------------------------------------------------------------------------


FILES = ("session.json", "frames.parquet", "markers.parquet", "clock.parquet")


def test_a_file_that_is_missing_is_damage(folder: Path) -> None:
    for name in FILES:
        content = (folder / name).read_bytes()
        (folder / name).unlink()
        report = verify_session(folder)
        assert f"{name} is missing" in "; ".join(report.problems)
        assert report.to_json_dict()["id"] == ID
        assert find_verdict(report) == "damaged"
        (folder / name).write_bytes(content)


def test_a_file_of_another_session_in_its_place_is_seen(folder: Path, tmp_path: Path) -> None:
    markers = (EVENTS[0].model_copy(update={"id": "e2"}),)
    other = sealed(tmp_path / "other", OTHER_ID, markers=markers)
    for name in FILES[:3]:
        content = (folder / name).read_bytes()
        shutil.copy(other / name, folder / name)
        assert problems(folder), name
        (folder / name).write_bytes(content)
    assert problems(folder) == problems(other) == ""


def test_a_session_in_another_one_s_folder_is_seen(tmp_path: Path, folder: Path) -> None:
    folder.rename(folder.with_name(OTHER_ID))
    report = verify_path(tmp_path)
    assert any("lies in the folder of" in said for said in report.to_json_dict()["problems"])


def test_a_damaged_or_exchanged_file_is_one_finding(tmp_path: Path) -> None:
    path = sealed(tmp_path) / "frames.parquet"
    whole = path.read_bytes()
    other = (sealed(tmp_path, OTHER_ID) / "frames.parquet").read_bytes()
    for content in (whole + b"x", whole[:300] + b"x" + whole[301:], other, b"x"):
        path.write_bytes(content)
        (problem,) = verify_session(path.parent).problems
        assert problem.startswith("frames.parquet")
        assert (f"it is of session {OTHER_ID}" in problem) == (content == other)


FIRST_PART = {"stream_id": STREAM_IDS[0], "seq_first": 10, "seq_last": 49}


@pytest.mark.parametrize(
    ("place", "change", "said"),
    [
        ("", {"id": OTHER_ID}, "says id"),
        ("", {"node": "other"}, "says node"),
        ("", {"frames": 54}, "says frames 54"),
        ("", {"bytes": 54}, "says bytes 54"),
        ("", {"sha256": "0" * 64}, "not the file that session.json names"),
        ("", {"sha256": None}, "not the file that session.json names"),
        ("", {"duration_s": 3.0}, "lasted 3.0 s"),
        ("", {"stopped_t_ns": 5}, "says stopped_t_ns"),
        ("", {"calibration_id": "x"}, "says calibration_id"),
        ("", {"absolute_scale": "measured"}, "says absolute_scale"),
        ("", {"ledger": None}, "its ledger is missing"),
        ("", {"markers": []}, "other events"),
        ("", {"parts": [FIRST_PART]}, "not of the same parts"),
        ("clock", {"uncertainty_ns": 4}, "clock.parquet has other rows"),
        ("ledger", {"recorded": 40}, "ledgers of session.json and frames.parquet"),
        ("ledger", {"lost": {}}, "ledgers of session.json and frames.parquet"),
        ("ledger", {"pending": 5}, "still to come"),
        ("parts", {"seq_last": 50}, "not of the same parts"),
    ],
)
def test_an_edit_with_a_right_checksum_is_found(
    folder: Path, place: str, change: dict[str, Any], said: str
) -> None:
    edited(folder, place, **change)
    assert said in problems(folder)


def test_an_edited_note_is_seen_by_the_check_alone(folder: Path) -> None:
    path = folder / "session.json"
    text = path.read_bytes()
    path.write_bytes(text.replace(b"first try", b"third try"))
    assert "was changed" in problems(folder)
    path.write_bytes(verify_and_strip_json_checksum(text, where=""))
    assert "no hash" in problems(folder)


def test_a_damaged_table_beside_it_is_seen(folder: Path) -> None:
    for name in ("markers.parquet", "clock.parquet"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[:-9])
        assert name in problems(folder)
        pq.write_table(pq.read_table(folder / "frames.parquet").select(["seq"]), folder / name)
        assert name in problems(folder)
        (folder / name).write_bytes(whole)


def test_videos_are_verified_with_their_session(folder: Path) -> None:
    before = verify_session(folder).to_json_dict()
    with IncomingVideo(folder, "walk.mp4") as incoming:
        incoming.write(b"film")
        video = incoming.keep(lambda _: (INFO, TIMES))
    assert verify_session(folder).to_json_dict() == before
    (folder / f"video-{video.id}" / "film.mp4").write_bytes(b"flim")
    assert problems(folder) == f"video {video.id}: walk.mp4 was changed: its SHA-256 is another one"
    assert find_verdict(verify_session(folder)) == "damaged"
