"""A session's folder proves itself: every file of it against every other."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from service.sessions.sealing import seal
from service.sessions.sources import Sources
from storage.checked_json import with_check
from storage.clock.log import ClockOffset
from storage.intervals import Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Event, Part, Session, SessionFolder
from storage.sessions.ledger import StreamState, ledger_of
from storage.verify.data import verdict_of, verify
from storage.verify.file import verify_file
from storage.verify.session import SessionReport, verify_session
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames

ID = "20200101T000000Z-00000a"
OTHER_ID = "20200101T000000Z-00000b"
BOOTS = ("a" * 32, "b" * 32)
EVENTS = (Event(id="e1", label="slip", t_ns=UTC_NS + 5),)


def array(boot: int = 0) -> ArrayInfo:
    return make_array(1, boot_id=BOOTS[boot], utc_offset_ns=UTC_NS + boot)


def frames(first: int, last: int, boot: int = 0) -> FrameBatch:
    return make_frames(np.arange(first, last + 1), 1, utc_offset_ns=UTC_NS + boot)


def journal(data: Path, boot: int, *runs: tuple[int, int], **notes: Any) -> Journal:
    folder = data / "journal" / "bench" / BOOTS[boot]
    held = Journal(folder, array(boot))
    for first, last in runs:
        for begin in range(first, last + 1, 5):
            held.append(frames(begin, min(begin + 4, last), boot))
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
            Part(boot_id=BOOTS[0], seq_first=10, seq_last=49),
            Part(boot_id=BOOTS[1], seq_first=0, seq_last=19),
        ),
        "scene": "test",
        "notes": "first try",
        "events": EVENTS,
        "clock": (
            ClockOffset(boot_id=BOOTS[0], t_mono_ns=1, server_minus_node_ns=2, uncertainty_ns=3),
        ),
    }
    return Session(**content | changes)


def keep(data: Path, kept: Session, *, place: str = "sessions") -> Path:
    """As a server keeps it, with the hash of its own text."""
    SessionFolder(data / place).save(kept)
    return data / place / kept.id


def sealed(data: Path, session_id: str = ID, **changes: Any) -> Path:
    """A sealed session of two parts, of which frames 20 to 24 of the first are lost."""
    begun = session(session_id, **changes)
    journals = {
        BOOTS[0]: journal(data, 0, (0, 19), (25, 60)),
        BOOTS[1]: journal(data, 1, (0, 19)),
    }
    lost = {BOOTS[0]: Losses({"disk_full": [(20, 24)]})}
    states = {
        boot_id: StreamState(held=held.held, lost=lost.get(boot_id, Losses()))
        for boot_id, held in journals.items()
    }
    ledger = ledger_of(begun.parts, states, finished=True)
    notes = {"lost": {boot_id: losses.as_pairs() for boot_id, losses in lost.items()}}
    folder = keep(data, begun)
    done = seal(Sources(begun, array(), journals, None, "none", (), notes), folder, ledger)
    return keep(data, done)


def problems(folder: Path) -> str:
    return "; ".join(verify_session(folder).problems)


def edited(folder: Path, change: Any) -> None:
    path = folder / "session.json"
    content = json.loads(path.read_bytes())
    content.pop("check", None)
    change(content)
    path.write_bytes(with_check(json.dumps(content).encode()))


# --- what is whole --------------------------------------------------------------------------------


def test_a_whole_session_is_proven_and_nothing_is_touched(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    before = {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}
    report = verify_session(folder)
    assert (report.problems, report.unproven) == ([], [])
    assert verdict_of(report) == "lossy"
    content = report.as_dict()
    assert set(content) == {
        *("complete", "lossy", "parts", "missed_slots"),
        *("id", "problems", "sha256", "unproven"),
    }
    assert (content["complete"], content["lossy"], content["id"]) == (False, True, ID)
    assert content["parts"][0] == {
        "boot_id": BOOTS[0],
        "seq_first": 10,
        "seq_last": 49,
        "recorded": 35,
        "lost": {"disk_full": 5},
        "pending": 0,
        "unsynced_tail_max": 0,
    }
    assert before == {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


def test_a_session_without_a_frame_is_whole(tmp_path: Path) -> None:
    begun = session(parts=(Part(boot_id=BOOTS[0], seq_first=0, seq_last=-1),))
    ledger = ledger_of(begun.parts, {}, finished=True)
    folder = keep(tmp_path, begun)
    keep(tmp_path, seal(Sources(begun, array(), {}, None, "none", (), {}), folder, ledger))
    assert problems(folder) == ""
    (folder / "frames.parquet").write_bytes(b"")
    assert "no frame recorded" in problems(folder)


def test_a_session_that_was_pulled_is_proven_too(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    kept = Session.model_validate(
        {
            k: v
            for k, v in json.loads((folder / "session.json").read_bytes()).items()
            if k != "check"
        }
    )
    view = kept.model_dump(
        mode="json",
        exclude={"ledger", "events", "clock", "scene_content", "calibration"},
        exclude_defaults=False,
    )
    view.pop("missed_slots_at_start")
    view.pop("unsynced_tail_max")
    pulled = tmp_path / "pulled" / ID
    pulled.mkdir(parents=True)
    shutil.copy(folder / "frames.parquet", pulled)
    (pulled / "session.json").write_text(json.dumps({**view, "complete": "lossy"}))
    assert kept.ledger is not None
    (pulled / "ledger.json").write_text(kept.ledger.model_dump_json())
    report = verify_session(pulled)
    assert report.problems == []
    assert verdict_of(report) == "lossy"
    edited_ledger = kept.ledger.model_copy(update={"lossy": False, "complete": True})
    (pulled / "ledger.json").write_text(edited_ledger.model_dump_json())
    assert "ledgers" in problems(pulled)


def test_a_lone_file_says_what_it_cannot_prove(tmp_path: Path) -> None:
    path = sealed(tmp_path) / "frames.parquet"
    report = verify(path)
    assert isinstance(report, SessionReport)
    assert report.as_dict()["id"] == ID
    assert verdict_of(report) == "lossy"
    assert "session.json" in " ".join(report.unproven)


# --- damage ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("frames.parquet", "frames.parquet is missing"),
        ("session.json", "session.json is missing"),
        ("events.parquet", "events.parquet is missing"),
        ("clock.parquet", "clock.parquet is missing"),
    ],
)
def test_a_file_that_is_missing_is_damage(tmp_path: Path, name: str, said: str) -> None:
    folder = sealed(tmp_path)
    (folder / name).unlink()
    assert said in problems(folder)
    report = verify_session(folder)
    assert report.as_dict()["id"] == ID
    assert verdict_of(report) == "damaged"


@pytest.mark.parametrize("name", ["session.json", "frames.parquet", "events.parquet"])
def test_a_file_of_another_session_in_its_place_is_seen(tmp_path: Path, name: str) -> None:
    one = sealed(tmp_path / "one")
    two = sealed(tmp_path / "two", OTHER_ID, events=(EVENTS[0].model_copy(update={"id": "e2"}),))
    shutil.copy(two / name, one / name)
    assert problems(one)
    assert problems(two) == ""


def test_a_session_in_another_one_s_folder_is_seen(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    folder.rename(folder.with_name(OTHER_ID))
    report = verify(tmp_path)
    assert any("lies in the folder of" in said for said in report.as_dict()["problems"])


@settings(max_examples=120, deadline=None)
@given(st.data())
def test_one_flipped_bit_in_its_description_or_frames_is_found(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    base = tmp_path_factory.getbasetemp() / "flipped_session"
    folder = base / "sessions" / ID
    if not folder.exists():
        sealed(base)
    path = folder / data.draw(st.sampled_from(["session.json", "frames.parquet"]))
    whole = path.read_bytes()
    content = bytearray(whole)
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        path.write_bytes(content)
        assert verify_session(folder).problems != []
    finally:
        path.write_bytes(whole)


@pytest.mark.parametrize("name", ["session.json", "frames.parquet"])
def test_a_file_that_was_cut_anywhere_is_damage(tmp_path: Path, name: str) -> None:
    path = sealed(tmp_path) / name
    whole = path.read_bytes()
    for size in (*range(0, len(whole), 211), len(whole) - 1):
        path.write_bytes(whole[:size])
        assert verify_session(path.parent).problems != [], size


def raised(name: str, value: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        content[name] = value

    return change


def in_ledger(name: str, value: Any) -> Any:
    def change(content: dict[str, Any]) -> None:
        content["ledger"]["parts"][0][name] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (raised("id", OTHER_ID), "says id"),
        (raised("node", "other"), "says node"),
        (raised("frames", 54), "says frames 54"),
        (raised("bytes", 54), "says bytes 54"),
        (raised("sha256", "0" * 64), "not the file that session.json names"),
        (raised("sha256", None), "not the file that session.json names"),
        (raised("duration_s", 3.0), "lasted 3.0 s"),
        (raised("stopped_t_ns", 5), "says stopped_t_ns"),
        (raised("calibration_id", "x"), "says calibration_id"),
        (raised("absolute_scale", "measured"), "says absolute_scale"),
        (raised("ledger", None), "its ledger is missing"),
        (raised("events", []), "other events"),
        (lambda c: c["clock"][0].update(uncertainty_ns=4), "clock.parquet has other rows"),
        (in_ledger("recorded", 40), "ledgers of session.json and frames.parquet"),
        (in_ledger("lost", {}), "ledgers of session.json and frames.parquet"),
        (in_ledger("pending", 5), "still to come"),
        (lambda c: c["parts"].pop(), "not of the same parts"),
        (lambda c: c["parts"][0].update(seq_last=50), "not of the same parts"),
    ],
)
def test_an_edit_that_forges_the_check_is_held_against_the_file(
    tmp_path: Path, change: Any, said: str
) -> None:
    folder = sealed(tmp_path)
    edited(folder, change)
    assert said in problems(folder)


def test_an_edited_note_is_seen_by_the_check_alone(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    path = folder / "session.json"
    text = path.read_bytes()
    path.write_bytes(text.replace(b"first try", b"third try"))
    assert "was changed" in problems(folder)
    content = json.loads(text)
    del content["check"]
    path.write_text(json.dumps(content))
    report = verify_session(folder)
    assert report.problems == []
    assert "notes" in " ".join(report.unproven)


def test_a_damaged_table_beside_it_is_seen(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    for name in ("events.parquet", "clock.parquet"):
        whole = (folder / name).read_bytes()
        (folder / name).write_bytes(whole[:-9])
        assert name in problems(folder)
        pq.write_table(pq.read_table(folder / "frames.parquet").select(["seq"]), folder / name)
        assert name in problems(folder)
        (folder / name).write_bytes(whole)


# --- not sealed -----------------------------------------------------------------------------------


def test_a_session_that_waits_is_counted_from_the_journals(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 19), (25, 60), lost={"disk_full": ((20, 21),)}, missed_slots=9)
    (tmp_path / "nodes").mkdir()
    folder = keep(tmp_path, session(state="pending", missed_slots_at_start=4))
    report = verify_session(folder)
    assert report.problems == []
    assert verdict_of(report) == "pending"
    content = report.as_dict()
    assert (content["complete"], content["sha256"], content["missed_slots"]) == (False, None, 5)
    first, second = content["parts"]
    assert (first["recorded"], first["lost"], first["pending"]) == (35, {"disk_full": 2}, 3)
    assert (second["recorded"], second["pending"]) == (0, 20)
    shutil.rmtree(tmp_path / "nodes")  # a node has what there is
    first, second = verify_session(folder).as_dict()["parts"]
    assert (first["lost"], first["pending"]) == ({"disk_full": 2, "node_restarted": 3}, 0)
    assert second["lost"] == {"node_restarted": 20}


def test_a_session_that_is_recorded_reaches_to_the_newest_frame(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 29))
    parts = (Part(boot_id=BOOTS[0], seq_first=5),)
    folder = keep(tmp_path, session(state="recording", parts=parts, stopped_t_ns=None))
    report = verify_session(folder)
    assert report.ledger is not None
    assert (report.ledger.parts[0].seq_last, report.ledger.parts[0].recorded) == (29, 25)
    assert verdict_of(report) == "pending"
    lonely = tmp_path / "far" / "off" / ID
    shutil.copytree(folder, lonely)
    report = verify_session(lonely)
    assert "journals are not here" in " ".join(report.unproven)
    assert verify_session(lonely, data=tmp_path).frames == 25


def test_damage_in_a_journal_that_it_needs_is_its_own(tmp_path: Path) -> None:
    journal(tmp_path, 0, (0, 60))
    (path,) = (tmp_path / "journal" / "bench" / BOOTS[0]).glob("*.arrows")
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    parts = (Part(boot_id=BOOTS[0], seq_first=0, seq_last=60),)
    report = verify_session(keep(tmp_path, session(state="pending", parts=parts)))
    assert "do not agree with their checksum" in "; ".join(report.problems)
    assert report.ledger is not None
    assert report.ledger.parts[0].lost == {"corrupt": 5}


def test_what_changes_while_it_is_read_is_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = sealed(tmp_path)
    before = (folder / "session.json").read_bytes()
    edited(folder, raised("sha256", "0" * 64))
    from storage.verify import session as module

    calls = []

    def meanwhile(path: Path) -> Any:
        calls.append(path)
        (folder / "session.json").write_bytes(before)
        return verify_file(path)

    monkeypatch.setattr(module, "verify_file", meanwhile)
    assert verify_session(folder).problems == []
    assert len(calls) == 2


# --- a data folder --------------------------------------------------------------------------------


def test_a_data_folder_is_all_of_its_sessions_and_journals(tmp_path: Path) -> None:
    sealed(tmp_path)
    deleted = keep(tmp_path, session(OTHER_ID, state="pending"), place="trash")
    (tmp_path / "sessions" / "20200101T000000Z-00000c").mkdir()  # begun, and killed
    report = verify(tmp_path)
    assert verdict_of(report) == "lossy"
    content = report.as_dict()
    assert set(content) == {"sessions", "journals", "problems", "unproven", "set_aside"}
    assert [one["id"] for one in content["sessions"]] == [ID, OTHER_ID]
    assert [one["frames"] for one in content["journals"]] == [56, 20]
    assert content["problems"] == []
    (deleted / "session.json").write_bytes(b"{")
    assert verdict_of(verify(tmp_path)) == "damaged"


def test_whatever_is_named_is_found(tmp_path: Path) -> None:
    folder = sealed(tmp_path)
    stream = tmp_path / "journal" / "bench" / BOOTS[0]
    for path in (folder, folder / "session.json", stream, stream / "stream.json", tmp_path):
        assert verify(path).as_dict()["problems"] == []
    for path in stream.glob("0*"):
        assert verify(path).as_dict()["closed"] is True
    (tmp_path / "empty").mkdir()
    for path in (tmp_path / "none", tmp_path / "empty"):
        with pytest.raises(FileFormatError):
            verify(path)
