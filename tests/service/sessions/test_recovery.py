"""After a crash everything that is on the disk becomes a session that proves itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from devices.errors import StorageError
from service.sessions import recovery as recover_module
from service.sessions.recovery import recover_locked_folder
from service.sessions.sealing import write_sealed_files
from storage.durable_files import lock_folder
from storage.journal.node.in_flight import InFlightWriter
from storage.journal.stream_notes import compute_max_lost_tail_frames
from storage.sessions.folder import Marker, Part, Session, SessionsFolder
from storage.sessions.reader import SealedFileReader
from storage.verify.data_folder import find_verdict, verify_path
from tests.builders.calibrations import make_calibration
from tests.service.sessions.crashed import (
    BOOT,
    ID,
    OTHER_BOOT,
    TAIL,
    info_of,
    loaded,
    outcomes,
    recovered,
    servers,
    session,
    state_of,
    stream,
    t_ns,
)
from tests.storage.faulty_disk import refusing


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A node's folder with a session of a hundred frames, whose end is known."""
    stream(tmp_path, info_of(), (0, 99), next_seq=100)
    session(tmp_path)
    return tmp_path


# --- a node alone ---------------------------------------------------------------------------------


def test_a_node_that_died_while_recording_leaves_a_sealed_session(tmp_path: Path) -> None:
    folder = stream(tmp_path, info_of(), (0, 999), closed=False)
    (segment,) = folder.glob("*.arrows")
    segment.write_bytes(segment.read_bytes() + b"half a batch")
    session(tmp_path, calibration=make_calibration("T01", "T02").model_dump(mode="json"))
    recovery = recover_locked_folder(tmp_path)
    assert (outcomes(recovery), recovery.problems) == (["sealed"], [])
    assert recovery.sessions[0].problem == ""
    assert recovery.cut_bytes == {f"bench/{BOOT}": len(b"half a batch")}
    done = loaded(tmp_path)
    assert (done.state, done.frames, done.stopped_t_ns) == ("sealed", 1000, t_ns(999))
    assert done.ledger is not None
    assert done.ledger.parts[0].max_lost_tail_frames == TAIL == 267
    assert (done.ledger.lossy, done.ledger.complete) == (True, False)
    for name in ("name", "subject", "notes", "tags", "markers", "scene"):
        assert getattr(done, name) == getattr(session(tmp_path / "other"), name)
    report = verify_path(tmp_path / "sessions" / ID)
    assert (report.problems, find_verdict(report)) == ([], "lossy")
    with SealedFileReader(tmp_path / "sessions" / ID / "frames.parquet") as reader:
        ((batch, columns),) = reader.read_batches("grf_n")
        assert reader.notes["scene"] == {"name": "test"}
        assert "emulated" not in reader.notes
    assert columns["grf_n"][batch.seq >= 500].mean() == pytest.approx(20.0, abs=0.1)


def test_a_second_run_finds_nothing_and_changes_nothing(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 99), closed=False)
    session(tmp_path)
    assert not recover_locked_folder(tmp_path, make_sessions=True).is_empty_or_all_waiting
    before = state_of(tmp_path)
    again = recover_locked_folder(tmp_path, make_sessions=True)
    assert again.is_empty_or_all_waiting
    assert again.sessions == []
    assert state_of(tmp_path) == before


def test_raw_frames_are_sealed_without_tare_or_calibration_and_the_session_says_so(
    tmp_path: Path,
) -> None:
    stream(tmp_path, info_of(), (0, 99))
    session(tmp_path)
    (one,) = recover_locked_folder(tmp_path).sessions
    assert "no calibration" in one.problem
    assert loaded(tmp_path).frames == 100


@pytest.mark.parametrize("has_restarted", [False, True])
def test_frames_in_flight_are_lost_only_if_the_machine_has_started_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, has_restarted: bool
) -> None:
    folder = stream(tmp_path, info_of(), (0, 99), closed=False)
    InFlightWriter(folder, info_of()).close()
    session(tmp_path)
    if has_restarted:
        monkeypatch.setattr("storage.journal.node.in_flight.read_kernel_boot_id", lambda: "other")
    _, ledger = recovered(tmp_path)
    assert ledger == loaded(tmp_path).ledger
    assert ledger.parts[0].max_lost_tail_frames == (TAIL if has_restarted else 0)
    assert ledger.complete != has_restarted
    assert find_verdict(verify_path(tmp_path)) == ("lossy" if has_restarted else "complete")


def test_a_stream_whose_end_is_known_is_counted_to_it(tmp_path: Path) -> None:
    lost = {"disk_full": ((100, 119),)}
    stream(tmp_path, info_of(), (0, 99), next_seq=120, lost=lost, missed_slots=3)
    session(tmp_path, missed_slots_at_start=1)
    _, ledger = recovered(tmp_path)
    assert ledger.parts[0].lost == {"disk_full": 20}
    assert (ledger.parts[0].max_lost_tail_frames, ledger.missed_slots) == (0, 2)
    with SealedFileReader(tmp_path / "sessions" / ID / "frames.parquet") as reader:
        assert reader.notes["lost"] == {BOOT: {"disk_full": [[100, 119]]}}


def test_a_session_that_was_stopped_ends_where_it_was_stopped(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 199), closed=False)
    session(tmp_path, state="pending", stopped_t_ns=t_ns(150) + 1)
    one, ledger = recovered(tmp_path)
    assert one.session.parts[0].seq_last == 150
    assert ledger.complete


def test_several_parts_become_one_file(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 99), next_seq=100)
    stream(tmp_path, info_of(OTHER_BOOT), (0, 49), closed=False)
    parts = (
        Part(stream_id=BOOT, seq_first=5, seq_last=99),
        Part(stream_id=OTHER_BOOT, seq_first=0),
    )
    session(tmp_path, parts=parts)
    assert outcomes(recover_locked_folder(tmp_path)) == ["sealed"]
    assert loaded(tmp_path).frames == 145
    assert verify_path(tmp_path).to_json_dict()["problems"] == []


def test_a_session_of_which_nothing_reached_the_disk_is_sealed_as_that(tmp_path: Path) -> None:
    session(tmp_path)
    one, ledger = recovered(tmp_path)
    assert one.outcome == "sealed"
    assert ledger.parts[0].max_lost_tail_frames == compute_max_lost_tail_frames(1000.0)
    assert (loaded(tmp_path).frames, loaded(tmp_path).problem) == (0, "no frame was recorded")
    assert recover_locked_folder(tmp_path).is_empty_or_all_waiting


# --- a server -------------------------------------------------------------------------------------


def test_frames_that_a_node_may_still_bring_are_waited_for(tmp_path: Path) -> None:
    stream(servers(tmp_path), info_of(), (0, 99), (120, 199))
    session(tmp_path)
    parts = (Part(stream_id=BOOT, seq_first=50, seq_last=150),)
    session(tmp_path, ID[:-1] + "b", state="pending", stopped_t_ns=t_ns(150), parts=parts)
    parts = (Part(stream_id=BOOT, seq_first=130, seq_last=150),)
    session(tmp_path, ID[:-1] + "c", state="pending", stopped_t_ns=t_ns(150), parts=parts)
    before = (tmp_path / "sessions" / ID / "session.json").read_bytes()
    recovery = recover_locked_folder(tmp_path)
    assert outcomes(recovery) == ["waiting", "waiting", "sealed"]
    assert "20 frames may still come" in recovery.sessions[1].problem
    assert (tmp_path / "sessions" / ID / "session.json").read_bytes() == before
    assert recover_locked_folder(tmp_path).is_empty_or_all_waiting


def test_abandoned_frames_are_lost_with_this_reason(tmp_path: Path) -> None:
    stream(servers(tmp_path), info_of(), (0, 99), (120, 199))
    session(tmp_path)
    _, ledger = recovered(tmp_path, abandon_missing=True)
    assert ledger.parts[0].lost == {"abandoned": 20}
    assert ledger.parts[0].max_lost_tail_frames == TAIL
    assert loaded(tmp_path).frames == 180


def test_an_unreached_stop_bounds_the_abandoned_tail(tmp_path: Path) -> None:
    stream(servers(tmp_path), info_of(), (0, 99))
    at_stop = {BOOT: 10**9}
    stopped_t_ns = t_ns(99) + 10**9 + 4 * 10**9
    session(
        tmp_path, state="pending", stopped_t_ns=stopped_t_ns, server_minus_node_ns_at_stop=at_stop
    )
    assert outcomes(recover_locked_folder(tmp_path)) == ["waiting"]
    (one,) = recover_locked_folder(tmp_path, abandon_missing=True).sessions
    assert one.session.max_lost_tail_frames == {BOOT: 2000}


def test_a_session_that_was_stopped_is_ended_by_its_clock(tmp_path: Path) -> None:
    stream(servers(tmp_path), info_of(), (0, 99))
    at_stop = {BOOT: 10**9}
    stopped_t_ns = t_ns(50) + 10**9
    session(
        tmp_path, state="pending", stopped_t_ns=stopped_t_ns, server_minus_node_ns_at_stop=at_stop
    )
    (one,) = recover_locked_folder(tmp_path).sessions
    assert (one.outcome, one.session.parts[0].seq_last) == ("sealed", 50)


def test_frames_abandoned_before_the_crash_are_not_waited_for(tmp_path: Path) -> None:
    stream(servers(tmp_path), info_of(), (0, 99), (120, 199))
    parts = (Part(stream_id=BOOT, seq_first=0, seq_last=150),)
    session(tmp_path, state="pending", stopped_t_ns=t_ns(150), parts=parts, is_abandoned=True)
    one, ledger = recovered(tmp_path)
    assert (one.outcome, ledger.parts[0].lost) == ("sealed", {"abandoned": 20})


def test_a_stop_among_frames_that_are_lost_is_placed_by_the_rate(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 99), (150, 199), next_seq=200, lost={"evicted": ((100, 149),)})
    session(tmp_path, state="pending", stopped_t_ns=t_ns(119) + 1)
    one, ledger = recovered(tmp_path)
    assert one.session.parts[0].seq_last == 119
    assert ledger.parts[0].lost == {"evicted": 20}


# --- streams of no session ------------------------------------------------------------------------


def test_frames_of_no_session_become_one_if_asked(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 199), next_seq=200)
    session(
        tmp_path,
        state="pending",
        stopped_t_ns=t_ns(149),
        parts=(Part(stream_id=BOOT, seq_first=50, seq_last=149),),
    )
    assert outcomes(recover_locked_folder(tmp_path)) == ["sealed"]
    at = datetime(2020, 1, 2, tzinfo=UTC)
    recovery = recover_locked_folder(tmp_path, make_sessions=True, now=lambda: at)
    assert outcomes(recovery) == ["sealed", "sealed"]
    found = [one.session for one in recovery.sessions]
    assert [s.parts[0].seq_first for s in found] == [0, 150]
    assert [s.frames for s in found] == [50, 50]
    assert {s.name for s in found} == {f"recovered bench {BOOT}"}
    assert [s.started_t_ns for s in found] == [t_ns(0), t_ns(150)]
    assert all(s.id.startswith("20200102T000000Z-") for s in found)
    assert recover_locked_folder(tmp_path, make_sessions=True).is_empty_or_all_waiting
    assert find_verdict(verify_path(tmp_path)) == "complete"


def test_a_deleted_session_is_not_brought_back(tmp_path: Path) -> None:
    stream(tmp_path, info_of(), (0, 99), next_seq=100)
    session(tmp_path, state="sealed")
    (tmp_path / "trash").mkdir()
    (tmp_path / "sessions" / ID).rename(tmp_path / "trash" / ID)
    assert recover_locked_folder(tmp_path, make_sessions=True).sessions == []


# --- what else a crash leaves ---------------------------------------------------------------------


@pytest.mark.process
def test_temporary_files_of_dead_processes_are_removed(data: Path) -> None:
    dead = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], stdout=-1)
    stale = data / "sessions" / ID / f".frames.parquet.{int(dead.stdout)}.7.0123abcd.tmp"
    stale.write_bytes(b"PAR1")
    assert recover_locked_folder(data).removed_temporaries == [stale]
    assert not stale.exists()


def test_events_that_were_not_written_in_time_are_written_anew(data: Path) -> None:
    recover_locked_folder(data)
    done = loaded(data)
    marked = done.model_copy(
        update={"markers": (*done.markers, Marker(id="e2", label="fall", t_ns=1))}
    )
    SessionsFolder(data / "sessions").save_session_json(marked)
    assert verify_path(data).to_json_dict()["problems"]
    assert recover_locked_folder(data).rewritten_markers == [ID]
    assert verify_path(data).to_json_dict()["problems"] == []
    assert recover_locked_folder(data).is_empty_or_all_waiting


def test_unreadable_files_are_named_and_hold_up_nothing_else(data: Path) -> None:
    bad = data / "sessions" / (ID[:-1] + "b")
    bad.mkdir()
    (bad / "session.json").write_bytes(b"{")
    hopeless = data / "journal" / "bench" / OTHER_BOOT
    hopeless.mkdir()
    (hopeless / f"{0:020d}.arrows").write_bytes(b"nothing of ours")
    recovery = recover_locked_folder(data)
    assert outcomes(recovery) == ["sealed"]
    text = "; ".join(recovery.problems)
    assert bad.name in text
    assert OTHER_BOOT in text


@pytest.mark.parametrize("target", [None, "nowhere", "a file"], ids=["itself", "nothing", "a file"])
def test_a_session_that_is_no_folder_is_named_and_holds_up_nothing_else(
    data: Path, target: str | None
) -> None:
    bad = data / "sessions" / (ID[:-1] + "b")
    if target == "a file":
        bad.write_bytes(b"x")
    else:
        bad.symlink_to(target or bad.name)
    recovery = recover_locked_folder(data)
    assert outcomes(recovery) == ["sealed"]
    assert bad.name in "; ".join(recovery.problems)


def test_a_file_that_does_not_prove_itself_is_not_called_recovered(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:

    def careless(*arguments: Any) -> Session:
        done = write_sealed_files(*arguments)
        path = data / "sessions" / ID / "frames.parquet"
        content = bytearray(path.read_bytes())
        content[100] ^= 1
        path.write_bytes(content)
        return done

    monkeypatch.setattr(recover_module, "write_sealed_files", careless)
    (one,) = recover_locked_folder(data).sessions
    assert one.outcome == "failed"
    assert "changed since it was sealed" in one.problem
    assert loaded(data).state == "sealing"
    monkeypatch.undo()
    assert outcomes(recover_locked_folder(data)) == ["sealed"]


def test_a_full_disk_leaves_the_session_for_the_next_run(
    data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        recover_module, "write_sealed_files", refusing(StorageError, "no space left")
    )
    (one,) = recover_locked_folder(data).sessions
    assert (one.outcome, loaded(data).state) == ("failed", "sealing")
    monkeypatch.undo()
    assert outcomes(recover_locked_folder(data)) == ["sealed"]


class Killed(BaseException):
    """As good as SIGKILL for what is on the disk: nothing after it is done."""


@pytest.mark.slow
def test_killed_at_any_write_the_next_run_comes_to_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = tmp_path / "begun"
    stream(begun, info_of(), (0, 99), closed=False)
    session(begun)
    once = tmp_path / "once"
    shutil.copytree(begun, once)
    recover_locked_folder(once)
    wanted = state_of(once)
    real, rounds, left = os.fsync, 0, 1
    while left:
        rounds += 1
        again = tmp_path / f"round-{rounds}"
        shutil.copytree(begun, again)
        allowed = rounds

        def counted(descriptor: int) -> None:
            nonlocal allowed
            allowed -= 1
            if allowed < 0:
                raise Killed
            real(descriptor)

        monkeypatch.setattr(os, "fsync", counted)
        try:
            recover_locked_folder(again)
            left = 0
        except Killed:
            pass
        monkeypatch.setattr(os, "fsync", real)
        recover_locked_folder(again)
        assert state_of(again) == wanted, rounds
    assert rounds > 5


def test_a_folder_in_use_is_left_alone(tmp_path: Path) -> None:
    with (
        lock_folder(tmp_path),
        pytest.raises(StorageError, match="server or node uses"),
        lock_folder(tmp_path),
    ):
        pass
    with lock_folder(tmp_path):
        pass
