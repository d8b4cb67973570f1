"""What is kept of a session beside its frames; ids stay in the folder; which sessions are meant."""

from __future__ import annotations

import itertools
import os
import re
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, StorageError, UnknownError, UsageError
from storage.clock.log import ClockOffset
from storage.documents import append_json_checksum, verify_and_strip_json_checksum
from storage.sessions.folder import (
    Completeness,
    Ledger,
    Marker,
    Part,
    PartLedger,
    Session,
    SessionsFolder,
    make_session_id,
)
from storage.sessions.metadata import SessionFilter, parse_completeness, parse_iso_or_t_ns
from tests.storage.faulty_disk import NO_SPACE, failing_if, refusing

ID = "20200131T235959Z-0a1b2c"
STREAM_ID = "f" * 32
T_NS = 1_767_225_600_000_000_000
"""2026-01-01T00:00:00Z"""

BAD_IDS = [
    *("", ".", "..", "../x", "../" + ID, "/" + ID, "/etc/passwd", ID + "/..", ID + "/", "a/" + ID),
    *(ID + "\0", "\0" + ID, ID + "\n", " " + ID, ID + "0", ID[:-1], ID.upper()),
    ID.replace("Z", ""),
    *("\u0662" + ID[1:], ID[:9] + "\uff12" + ID[10:], "%2e%2e%2fx", "x" * 100_000),
]


def session(session_id: str = ID, **changes: Any) -> Session:
    content: dict[str, Any] = {
        "id": session_id,
        "name": "first walk",
        "node": "bench",
        "state": "recording",
        "started_t_ns": T_NS,
        "parts": (Part(stream_id=STREAM_ID, seq_first=0),),
        "scene": "mud",
    }
    return Session(**content | changes)


def whole() -> Session:
    return session(
        state="sealed",
        stopped_t_ns=10**18 + 1,
        parts=(
            Part(stream_id=STREAM_ID, seq_first=5, seq_last=9),
            Part(stream_id="0" * 32, seq_first=0, seq_last=2**62),
        ),
        subject='Ärmel \'n "Söhne"\n\u2028',
        notes="\x00\ud7ff🦶",
        tags=("a", "b", ""),
        markers=(Marker(id="e1", label="slip", t_ns=10**18 + 7),),
        clock=(
            ClockOffset(
                stream_id=STREAM_ID, t_mono_ns=1, server_minus_node_ns=-2, uncertainty_ns=3
            ),
        ),
        missed_slots_at_start=4,
        max_lost_tail_frames={STREAM_ID: 17},
        problem="none",
        ledger=Ledger(
            complete=False,
            lossy=True,
            parts=(
                PartLedger(
                    stream_id=STREAM_ID,
                    seq_first=5,
                    seq_last=9,
                    recorded=3,
                    lost={"evicted": 1},
                    pending=1,
                ),
            ),
            missed_slots=2,
        ),
        frames=5,
        duration_s=1 / 3,
        bytes=123,
        sha256="ab" * 32,
        calibration_id="c",
        absolute_scale="assumed",
    )


# --- ids ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", BAD_IDS, ids=lambda text: ascii(text)[:30])
def test_what_is_no_id_is_no_session_and_no_path(tmp_path: Path, bad: str) -> None:
    folder = SessionsFolder(tmp_path / "sessions")
    with pytest.raises(UnknownError) as caught:
        folder.get_path(bad)
    assert len(str(caught.value)) < 1000
    with pytest.raises(UnknownError):
        folder.load(bad)
    with pytest.raises(UnknownError):
        folder.save_session_json(session(bad))
    assert list(tmp_path.iterdir()) == []


@settings(max_examples=60)
@given(st.one_of(st.text(max_size=40), st.from_regex(r"\A\d{8}T\d{6}Z-[0-9a-f]{6}\Z")))
def test_a_sessions_path_is_directly_in_the_folder(text: str) -> None:
    try:
        path = SessionsFolder(Path("/data/sessions")).get_path(text)
    except UnknownError:
        return
    assert path.parent == Path("/data/sessions")
    assert re.fullmatch(r"[0-9TZ]{16}-[0-9a-f]{6}", path.name)


def test_ids_sort_by_time_and_are_of_utc() -> None:
    east = timezone(timedelta(hours=9))
    at = datetime(2020, 2, 1, 8, 59, 59, tzinfo=east)
    assert make_session_id(at).startswith("20200131T235959Z-")
    made = [make_session_id(at + timedelta(seconds=n)) for n in range(100)]
    assert made == sorted(made)
    folder = SessionsFolder(Path("x"))
    assert [folder.get_path(one).name for one in made] == made


def test_two_sessions_of_one_second_have_different_ids(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = iter(["000001", "000002"])
    monkeypatch.setattr("secrets.token_hex", lambda n: next(drawn))
    now = datetime(2020, 1, 1, tzinfo=UTC)
    assert [make_session_id(now) for _ in "ab"] == [
        "20200101T000000Z-000001",
        "20200101T000000Z-000002",
    ]


def test_ids_are_newest_first_and_other_names_are_none(tmp_path: Path) -> None:
    folder = SessionsFolder(tmp_path)
    made = [f"2020013{i}T000000Z-00000{i}" for i in (1, 0, 5, 3)]
    for one in made:
        folder.save_session_json(session(one))
    for name in ("lost+found", ".20200131T235959Z-0a1b2c.tmp", "20200131"):
        (tmp_path / name).mkdir()
    assert list(folder.list_ids_newest_first()) == sorted(made, reverse=True)


def test_a_folder_that_is_not_there_yet_has_no_sessions(tmp_path: Path) -> None:
    assert list(SessionsFolder(tmp_path / "none").list_ids_newest_first()) == []
    (tmp_path / "file").write_bytes(b"")
    assert list(SessionsFolder(tmp_path / "file").list_ids_newest_first()) == []


# --- save and load --------------------------------------------------------------------------------


def test_a_session_survives_its_file_and_the_next_replaces_it(tmp_path: Path) -> None:
    folder = SessionsFolder(tmp_path / "data" / "sessions")
    for kept in (session(), whole()):
        folder.save_session_json(kept)
        assert folder.load(ID) == kept
        assert [p.name for p in folder.get_path(ID).iterdir()] == ["session.json"]


@given(st.text(max_size=30), st.lists(st.text(max_size=5), max_size=3))
@settings(max_examples=30)
def test_whatever_a_person_writes_is_kept_as_it_is(
    tmp_path_factory: pytest.TempPathFactory, text: str, tags: list[str]
) -> None:
    folder = SessionsFolder(tmp_path_factory.mktemp("sessions"))
    kept = session(name=text, notes=text[::-1], subject=text, tags=tuple(tags))
    folder.save_session_json(kept)
    assert folder.load(ID) == kept


def test_a_session_that_is_not_there_is_unknown(tmp_path: Path) -> None:
    folder = SessionsFolder(tmp_path)
    with pytest.raises(UnknownError, match=ID):
        folder.load(ID)
    (tmp_path / ID).mkdir()
    with pytest.raises(UnknownError, match=ID):
        folder.load(ID)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (b'"recording"', b'"resting"'),
        (b'"mud"', b"null"),
        (b'"started_t_ns"', b'"begun_t_ns"'),
        (b'"seq_first": 0', b'"seq_first": 0.5'),
        (b"{", b'{"further": 1,'),
    ],
)
def test_what_is_no_session_is_refused_by_path(tmp_path: Path, old: bytes, new: bytes) -> None:
    folder = SessionsFolder(tmp_path)
    folder.save_session_json(session())
    path = folder.get_path(ID) / "session.json"
    content = path.read_bytes()
    assert old in content
    path.write_bytes(
        append_json_checksum(verify_and_strip_json_checksum(content, where="").replace(old, new, 1))
    )
    with pytest.raises(FileFormatError, match="by another version") as caught:
        folder.load(ID)
    assert caught.value.where == str(path)


@pytest.mark.parametrize("sync", range(4))
def test_a_failed_first_save_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sync: int
) -> None:
    real, calls = os.fsync, itertools.count()
    fails = failing_if(lambda _: next(calls) == sync, real, *NO_SPACE)
    (tmp_path / "sessions").mkdir()
    folder = SessionsFolder(tmp_path / "sessions")
    monkeypatch.setattr(os, "fsync", fails)
    try:
        folder.save_session_json(session())
    except StorageError:
        assert list((tmp_path / "sessions").iterdir()) == []
    else:
        assert sync == next(calls) == 3  # of the folder's name, the file, and the file's name
    folder.save_session_json(session())
    assert folder.load(ID) == session()


def test_a_failed_later_save_keeps_the_session_and_its_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = SessionsFolder(tmp_path)
    folder.save_session_json(session())
    frames = folder.get_path(ID) / "frames.parquet"
    frames.write_bytes(b"frames")
    with monkeypatch.context() as full:
        full.setattr(os, "fsync", refusing(*NO_SPACE))
        with pytest.raises(StorageError, match="No space left"):
            folder.save_session_json(whole())
    assert folder.load(ID) == session()
    folder.save_session_json(whole())
    assert folder.load(ID) == whole()
    assert frames.read_bytes() == b"frames"
    assert {path.name for path in folder.get_path(ID).iterdir()} == {frames.name, "session.json"}


def test_a_folder_without_a_whole_file_is_no_session(tmp_path: Path) -> None:
    # As a kill leaves it between making the folder and writing into it.
    folder = SessionsFolder(tmp_path)
    (tmp_path / ID).mkdir()
    assert folder.load_all() == ([], {})
    (tmp_path / ID / ".session.json.1.2.0123abcd.tmp").write_bytes(b"{")
    assert folder.load_all() == ([], {})
    (tmp_path / ID / "frames.parquet").write_bytes(b"")
    assert list(folder.load_all()[1]) == [ID]
    (tmp_path / ID[::-1]).write_bytes(b"")  # no id
    (tmp_path / ID.replace("a", "b")).write_bytes(b"")  # no folder
    assert sorted(folder.load_all()[1]) == sorted([ID, ID.replace("a", "b")])


def chosen(choice: SessionFilter, one: Session, complete: Completeness = True) -> bool:
    return choice.accepts(one, lambda _: complete)


def test_no_filter_accepts_every_session() -> None:
    assert chosen(SessionFilter(), session())


def test_one_of_the_nodes_and_all_tags_are_needed() -> None:
    one = session(tags=("Mud", "third"))
    assert chosen(SessionFilter(nodes=("right", "bench")), one)
    assert not chosen(SessionFilter(nodes=("benc",)), one)
    assert chosen(SessionFilter(tags=("mud", " THIRD ")), one)
    assert not chosen(SessionFilter(tags=("mud", "fourth")), one)
    assert not chosen(SessionFilter(tags=("mu",)), one)


def test_a_time_range_has_its_begin_and_not_its_end() -> None:
    assert chosen(SessionFilter(from_t_ns=T_NS, to_t_ns=T_NS + 1), session())
    assert not chosen(SessionFilter(from_t_ns=T_NS + 1), session())
    assert not chosen(SessionFilter(to_t_ns=T_NS), session())


@pytest.mark.parametrize("wanted", [True, False, "lossy"])
@pytest.mark.parametrize("found", [True, False, "lossy"])
def test_sessions_are_filtered_by_completeness(wanted: Completeness, found: Completeness) -> None:
    assert chosen(SessionFilter(complete=wanted), session(), found) == (wanted == found)


def test_frames_of_excluded_sessions_are_not_counted() -> None:
    def counting(_: Session) -> Completeness:
        pytest.fail("it is of another node")

    assert not SessionFilter(nodes=("right",), complete=True).accepts(session(), counting)


@given(
    st.datetimes(datetime(1970, 1, 2), datetime(2261, 1, 1)),  # as it is written
    st.integers(-23 * 60, 23 * 60),
)
def test_a_time_is_the_same_in_each_notation(at: datetime, offset_minutes: int) -> None:
    utc = at.replace(tzinfo=UTC)
    t_ns = parse_iso_or_t_ns(utc.isoformat(), where="from")
    assert datetime.fromtimestamp(t_ns // 10**9, UTC) == utc.replace(microsecond=0)
    assert t_ns % 10**9 == utc.microsecond * 1000
    elsewhere = utc.astimezone(timezone(timedelta(minutes=offset_minutes)))
    for written in (at.isoformat(), elsewhere.isoformat(), str(at), f" {at.isoformat()}Z"):
        assert parse_iso_or_t_ns(written, where="from") == t_ns
    if t_ns >= 10**8:
        assert parse_iso_or_t_ns(str(t_ns), where="from") == t_ns


def test_a_date_is_its_midnight() -> None:
    assert parse_iso_or_t_ns("2026-01-01", where="from") == T_NS


@pytest.mark.parametrize(
    "said",
    [
        *("", "yesterday", "2026", "2026-13-01", "-5", "1969-12-31", "9999-01-01", "9" * 400),
        *("NaN", "1e18", "2026-01-01T00:00:00 01:00", "\N{FULLWIDTH DIGIT ONE}" * 10),
    ],
)
def test_what_is_no_time_is_refused_with_an_example(said: str) -> None:
    with pytest.raises(UsageError, match="is no instant") as refused:
        parse_iso_or_t_ns(said, where="--from")
    assert "--from" in str(refused.value)
    assert "2026-11-24T08:00" in str(refused.value)


def test_a_completeness_is_one_of_three_words() -> None:
    assert [parse_completeness(said, where="x") for said in ("true", "false", "lossy")] == [
        True,
        False,
        "lossy",
    ]
    with pytest.raises(UsageError, match="true, false or lossy"):
        parse_completeness("True", where="--complete")


def test_the_share_that_was_not_sampled_is_of_all_slots_those_that_are_still_to_come_too() -> None:
    part = PartLedger(
        stream_id="a", seq_first=0, seq_last=89, recorded=10, lost={"evicted": 30}, pending=50
    )
    ledger = Ledger(complete=False, lossy=True, parts=(part,), missed_slots=30)
    assert ledger.not_sampled_share == 0.25
    assert Ledger(complete=True, lossy=False, parts=(), missed_slots=0).not_sampled_share == 0.0
