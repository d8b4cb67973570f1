"""Recovery where what is on the disk is damaged: what is lost is named, the rest is kept."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

from service.sessions.recovery import recover_locked_folder
from storage.clock.log import ClockOffset
from storage.intervals import Losses
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Part
from storage.verify.data_folder import find_verdict, verify_path
from storage.verify.journal import verify_journal
from tests.builders.arrays import PERIOD_NS
from tests.service.sessions.crashed import (
    BOOT,
    ID,
    frames,
    info_of,
    loaded,
    recovered,
    servers,
    session,
    stream,
    t_ns,
)


def flip_a_bit(folder: Path) -> None:
    """Damage a batch in the middle of a journal."""
    (segment,) = folder.glob("*.arrows")
    content = bytearray(segment.read_bytes())
    content[len(content) // 2] ^= 1
    segment.write_bytes(content)


def test_frames_that_are_damaged_are_lost_and_the_others_kept(tmp_path: Path) -> None:
    folder = stream(tmp_path, info_of(), (0, 99), next_seq=100)
    flip_a_bit(folder)
    session(tmp_path)
    _, ledger = recovered(tmp_path)
    assert ledger.parts[0].lost == {"corrupt": 10}
    assert loaded(tmp_path).frames == 90
    notes = StreamNotes.load(folder)
    assert notes is not None
    assert Losses(notes.lost).by_reason["corrupt"].number_count == 10
    assert find_verdict(verify_path(tmp_path / "sessions" / ID)) == "lossy"


def test_damaged_frames_of_a_server_are_waited_for_until_abandoned(tmp_path: Path) -> None:
    data, again = tmp_path / "data", tmp_path / "again"
    folder = stream(servers(data), info_of(), (0, 99))
    flip_a_bit(folder)
    parts = (Part(stream_id=BOOT, seq_first=0, seq_last=99),)
    session(data, state="pending", stopped_t_ns=t_ns(99), parts=parts)
    shutil.copytree(data, again)
    (one,) = recover_locked_folder(data).sessions
    assert (one.outcome, one.problem) == ("waiting", "10 frames may still come from node bench")
    assert verify_journal(folder).to_json_dict()["lost"] == {"corrupt": 10}
    for folder in (data, again):  # in the first one they are cut off by now
        one, ledger = recovered(folder, abandon_missing=True)
        assert (one.outcome, ledger.parts[0].lost) == ("sealed", {"corrupt": 10})


def test_damaged_frames_of_a_session_that_was_being_sealed_are_abandoned(tmp_path: Path) -> None:
    flip_a_bit(stream(servers(tmp_path), info_of(), (0, 99)))
    parts = (Part(stream_id=BOOT, seq_first=0, seq_last=99),)
    session(tmp_path, state="sealing", stopped_t_ns=t_ns(99), parts=parts)
    one, ledger = recovered(tmp_path, abandon_missing=True)
    assert (one.outcome, ledger.parts[0].lost) == ("sealed", {"corrupt": 10})
    assert loaded(tmp_path).is_abandoned


def test_damaged_frames_of_no_session_are_lost_to_the_one_that_is_made(tmp_path: Path) -> None:
    flip_a_bit(stream(servers(tmp_path), info_of(), (0, 99)))
    (one,) = recover_locked_folder(tmp_path, make_sessions=True, abandon_missing=True).sessions
    assert one.ledger is not None
    assert (one.outcome, one.ledger.parts[0].lost) == ("sealed", {"corrupt": 10})


def test_a_damaged_batch_at_the_stop_is_lost_and_the_others_tell_the_end(tmp_path: Path) -> None:
    folder = stream(tmp_path, info_of(), (0, 99), next_seq=100)
    flip_a_bit(folder)  # in the batch of frames 30 to 39
    session(tmp_path, state="pending", stopped_t_ns=t_ns(35))
    session(tmp_path, ID[:-1] + "b", state="pending", stopped_t_ns=t_ns(20))
    here, other = recover_locked_folder(tmp_path).sessions
    assert (here.outcome, other.outcome) == ("sealed", "sealed")
    by_id = {one.session.id: one for one in (here, other)}
    assert by_id[ID[:-1] + "b"].session.parts[0].seq_last == 20
    ledger = by_id[ID].ledger
    assert ledger is not None
    assert ledger.parts[0].lost == {"corrupt": 6}
    assert ledger.parts[0].seq_last == 35


def test_a_stop_where_time_runs_back_fails_one_session_and_not_the_recovery(tmp_path: Path) -> None:
    folder = stream(servers(tmp_path), info_of(), (0, 99))
    journal = Journal.open_existing_and_recover(folder)
    late = frames(100, 109)
    back_ns = PERIOD_NS * 60
    journal.append_new_frames(
        replace(late, t_ns=late.t_ns - back_ns, t_mono_ns=late.t_mono_ns - back_ns)
    )
    journal.close()
    clock = ClockOffset(stream_id=BOOT, t_mono_ns=0, server_minus_node_ns=0, uncertainty_ns=1)
    session(tmp_path, state="pending", stopped_t_ns=t_ns(70), clock=(clock,))
    (one,) = recover_locked_folder(tmp_path).sessions
    assert one.outcome in ("failed", "waiting")
    assert one.problem


def test_notes_of_a_servers_stream_that_cannot_be_read_are_replaced(tmp_path: Path) -> None:
    folder = stream(servers(tmp_path), info_of(), (0, 99))
    (folder / "stream.json").write_bytes(b"{")
    assert "it has no hash" in recover_locked_folder(tmp_path).problems[0]
    assert recover_locked_folder(tmp_path).is_empty_or_all_waiting
