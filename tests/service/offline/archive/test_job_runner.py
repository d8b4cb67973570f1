"""A plan over sessions: what is made, what is left as it is, and what fails alone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from devices.errors import UsageError
from service.offline.archive.jobs import MAX_LISTED_FAILURES, Job, Outcome, OutcomeCounts, run_job
from service.offline.archive.locations import find_session_locations
from service.offline.archive.query import find_sessions, run_query
from service.offline.archive.result_store import ResultStore
from service.offline.archive.tasks import ExportTask, VerifyTask
from service.offline.export import ExportOptions
from service.offline.worker_pool import Unfinished, map_in_processes
from storage.verify.data_folder import find_verdict, verify_path
from tests.service.offline.archives import IDS, STATIC, contents, long_session, made, ran, recording
from tests.service.sessions.pieces import calibration

CALIBRATED = replace(STATIC, calibration=calibration())
CSV = ExportTask(ExportOptions("csv"))


def states(found: dict[str, Outcome]) -> set[str]:
    return {outcome.state for outcome in found.values()}


def stamps(out: Path) -> dict[str, tuple[int, int]]:
    files = [path for path in out.rglob("*") if path.is_file()]
    return {str(path): (path.stat().st_mtime_ns, path.stat().st_ino) for path in files}


def test_a_result_that_is_there_is_not_made_again(archive: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = ran(CSV, archive, out)
    assert set(first) == set(IDS[:4])
    assert states(first) == {"made"}
    before = stamps(out)
    again = ran(CSV, archive, out)
    assert states(again) == {"there"}
    assert stamps(out) == before
    assert {n: o.facts for n, o in again.items()} == {n: o.facts for n, o in first.items()}


def test_a_long_session_is_done_in_pieces_by_whoever_is_free_and_is_the_same(
    tmp_path: Path,
) -> None:
    (tmp_path / "raw").mkdir()
    long = long_session(tmp_path / "raw" / "long.parquet")
    whole = ran(CALIBRATED, long, tmp_path / "whole")
    in_pieces = replace(CALIBRATED, piece_frames=1)
    given = list[str]()

    def seen(job: Job) -> Outcome | Unfinished:
        done = run_job(job)
        there = sorted(path.name for path in (tmp_path / "out" / ".pieces").rglob("*.json"))
        given.append(" ".join(there) if isinstance(done, Unfinished) else done.state)
        return done

    (place,) = find_session_locations([str(long)])
    job = Job(place, in_pieces, str(tmp_path / "out"))
    ((_, outcome),) = map_in_processes(seen, [job], 1)
    assert given == ["0000.json", "0000.json 0001.json", "0000.json 0001.json 0002.json", "made"]
    assert isinstance(outcome, Outcome)
    assert outcome.facts == whole["long"].facts
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")
    ResultStore(str(tmp_path / "out")).remove_work_folder()
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["long"]


def test_pieces_of_other_options_are_not_taken_and_go_with_the_result(tmp_path: Path) -> None:
    (tmp_path / "raw").mkdir()
    long = long_session(tmp_path / "raw" / "long.parquet")
    in_pieces, out = replace(CALIBRATED, piece_frames=1), str(tmp_path / "out")
    (place,) = find_session_locations([str(long)])
    for lag_ms in (100.0, 100.0, 50.0):
        assert isinstance(run_job(Job(place, replace(in_pieces, lag_ms=lag_ms), out)), Unfinished)
    folders = {path.name for path in (tmp_path / "out" / ".pieces" / "long").iterdir()}
    assert len(folders) == 2
    found = ran(replace(in_pieces, lag_ms=50.0), long, out)
    assert found["long"].state == "made"
    assert not (tmp_path / "out" / ".pieces" / "long").exists()
    ran(replace(CALIBRATED, lag_ms=50.0), long, tmp_path / "whole")
    assert contents(tmp_path / "out") == contents(tmp_path / "whole")


def test_a_result_of_other_options_or_another_input_is_made_anew(
    archive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    ran(CSV, archive, out)
    arrow = ran(ExportTask(ExportOptions("arrow")), archive, out)
    assert states(arrow) == {"made"}
    names = {path.name for path in (out / IDS[0]).iterdir()}
    assert names == {"frames.arrow", "export.made.json"}
    changed = archive / "sessions" / IDS[1]
    shutil.copytree(archive / "sessions" / IDS[2], changed, dirs_exist_ok=True)
    assert made(ran(ExportTask(ExportOptions("arrow")), archive, out)) == {IDS[1]}


@pytest.mark.parametrize("lost", ["export.made.json", "frames.csv"])
def test_a_result_of_which_a_part_is_missing_is_made_again(
    archive: Path, tmp_path: Path, lost: str
) -> None:
    out = tmp_path / "out"
    ran(CSV, archive, out)
    whole = (out / IDS[1] / "frames.csv").read_bytes()
    (out / IDS[1] / lost).unlink()
    assert made(ran(CSV, archive, out)) == {IDS[1]}
    assert (out / IDS[1] / "frames.csv").read_bytes() == whole


def test_one_session_fails_alone_and_says_why(archive: Path, tmp_path: Path) -> None:
    recording(archive, 4)
    frames = archive / "sessions" / IDS[1] / "frames.parquet"
    content = bytearray(frames.read_bytes())
    content[2000] ^= 1
    frames.write_bytes(content)
    (archive / "sessions" / IDS[2] / "session.json").unlink()
    found = ran(STATIC, archive, tmp_path / "out")
    reasons = {name: o.reason for name, o in found.items() if o.state == "failed"}
    assert set(reasons) == {IDS[1], IDS[2], IDS[4]}
    assert "hash" in reasons[IDS[1]]
    assert "session.json" in reasons[IDS[2]]
    assert "recording" in reasons[IDS[4]]
    assert {p.name for p in (tmp_path / "out").iterdir()} == {".work", IDS[0], IDS[3]}
    assert list((tmp_path / "out" / ".work").iterdir()) == []


def test_an_unforeseen_error_is_one_sessions_failure(
    archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(self: VerifyTask, source: Path, work: Path) -> dict[str, Any]:
        raise ZeroDivisionError(source.name)

    monkeypatch.setattr(VerifyTask, "process_session", broken)
    found = ran(VerifyTask(), archive, tmp_path / "out")
    assert states(found) == {"failed"}
    assert "this is a bug: ZeroDivisionError" in found[IDS[0]].reason


def test_two_sessions_of_one_name_do_not_take_each_others_place(
    archive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    ran(CSV, archive, out)
    other = tmp_path / "other" / IDS[0]
    shutil.copytree(archive / "sessions" / IDS[1], other)
    before = stamps(out)
    found = ran(CSV, other, out)
    assert "another session of this name" in found[IDS[0]].reason
    assert stamps(out) == before


def test_a_result_never_takes_the_place_of_its_session_and_stays_in_its_folder(
    archive: Path, tmp_path: Path
) -> None:
    before = stamps(archive / "sessions")
    (tmp_path / "link").symlink_to(archive / "sessions")
    for out in (archive / "sessions", tmp_path / "link"):
        found = ran(STATIC, archive, out)
        assert states(found) == {"failed"}
        assert "the place of the session itself" in found[IDS[0]].reason
    assert stamps(archive / "sessions") == before
    frames = archive / "sessions" / IDS[0] / "frames.parquet"
    for name in ("...parquet", ".parquet", ".work.parquet"):
        shutil.copy(frames, tmp_path / name)
        assert states(ran(CSV, tmp_path / name, tmp_path / "out" / "in")) == {"failed"}
    assert not (tmp_path / "out" / "in" / "export.made.json").exists()


def test_an_archive_that_was_moved_has_its_results(archive: Path, tmp_path: Path) -> None:
    ran(CSV, archive, tmp_path / "out")
    moved = archive.rename(tmp_path / "elsewhere")
    assert states(ran(CSV, moved, tmp_path / "out")) == {"there"}


def test_estimated_sessions_are_an_archive_that_can_be_proven_and_asked(
    archive: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    assert states(ran(STATIC, archive, out)) == {"made"}
    for name in IDS[:4]:
        report = verify_path(out / name)
        assert find_verdict(report) == "complete", report.to_json_dict()["problems"]
    asked = "SELECT session_id, number, peak_grf_n FROM stances ORDER BY ALL"
    ours = run_query(find_sessions([str(out)]), asked)
    theirs = run_query(find_sessions([str(archive)]), asked)
    assert ours.num_rows == 8
    assert ours.equals(theirs)  # estimated again with what it was sealed with
    assert states(ran(VerifyTask(), out, None)) == {"made"}


def test_a_damaged_session_has_a_proof_that_says_so(archive: Path, tmp_path: Path) -> None:
    (archive / "sessions" / IDS[1] / "markers.parquet").unlink()
    found = ran(VerifyTask(), archive, tmp_path / "out")
    verdicts = {name: outcome.facts["verdict"] for name, outcome in found.items()}
    assert verdicts == {**dict.fromkeys(IDS[:4], "complete"), IDS[1]: "damaged"}


def test_a_worker_of_another_version_refuses(archive: Path, tmp_path: Path) -> None:
    (place, *_) = find_session_locations([str(archive)])
    job = Job(place, CSV, str(tmp_path / "out"))
    with pytest.raises(UsageError, match="a worker is foottile"):
        run_job(replace(job, client_version="foottile 0.0.1 (000000000000)"))


def test_the_rest_of_a_killed_worker_is_removed_and_the_work_of_others_is_not(
    tmp_path: Path,
) -> None:
    from service.offline.archive.local_copies import _MACHINE, create_workspace

    work = tmp_path / "out" / ".work"
    with create_workspace(work) as ours:
        gone = work / f".{_MACHINE}.999999999.1.0123abcd.tmp"
        elsewhere = work / ".another-machine.999999999.1.0123abcd.tmp"
        gone.mkdir()
        elsewhere.mkdir()
        ResultStore(str(tmp_path / "out")).prepare_folder()
        assert sorted(work.iterdir()) == sorted([ours, elsewhere])


def test_a_summary_keeps_no_more_failures_than_it_shows() -> None:
    summary = OutcomeCounts()
    for number in range(100):
        summary.add_outcome(Outcome(str(number), "place", "failed", reason="why"))
    assert summary.states["failed"] == 100
    assert len(summary.failures) == MAX_LISTED_FAILURES
