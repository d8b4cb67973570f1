"""`foottile verify` and `foottile recover` as a user meets them."""

from __future__ import annotations

import builtins
import errno
import fcntl
import io
import json
import shutil
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq
import pytest

from service.server.data_folder import SERVER_NAME, ServerIdentity
from storage.documents import write_checksummed_json, write_document
from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.folder import Part, Session, SessionsFolder
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.service.cli.commands.test_any_value import PLACES
from tests.service.cli.outcome import Run, Simulate
from tests.service.recording import read_table
from tests.storage.faulty_disk import flip_bits

ID = "20200101T000000Z-00000a"
OTHER_ID = "20200101T000000Z-00000b"
BOOT = "a" * 32


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A node's folder after a crash: a session was being recorded, frames 0 to 99 are there."""
    root, info = tmp_path / "data", make_array(stream_id=BOOT)
    folder = root / "journal" / "bench" / BOOT
    journal = Journal(folder, info)
    journal.append_new_frames(make_frames(100, tile_flags=7))
    journal.close()
    StreamNotes(array_info=info, next_seq=100).save(folder)
    begun(root)
    return root


def begun(root: Path, session_id: str = ID, *, last: int | None = None) -> None:
    kept = Session(
        id=session_id,
        name="walk",
        node="bench",
        state="recording",
        started_t_ns=UTC_NS,
        parts=(Part(stream_id=BOOT, seq_first=0, seq_last=last),),
        scene="test",
    )
    SessionsFolder(root / "sessions").save_session_json(kept)


def test_a_crash_is_recovered_and_proven(run: Run, data: Path) -> None:
    before = run("verify", ID, "--data", data)
    assert before.code == 3
    assert "pending, 100 recorded" in before.out
    assert "not every session is sealed" in before.out
    recovered = run("recover", data)
    assert (recovered.code, recovered.err.count("journal bench/")) == (0, 1)
    assert f"session {ID} (walk): sealed and verified, 100 frames" in recovered.out
    assert run("recover", data, "--json").printed()["sessions"] == []
    assert "nothing to recover" in run("recover", data).out
    after = run("verify", data)
    assert after.code == 0
    assert f"session {ID} (walk): complete, 100 recorded" in after.out
    assert after.out.splitlines()[-1] == (
        "Everything is whole, and every frame that was sampled is there."
    )


def test_json_of_one_session_is_its_ledger(run: Run, data: Path) -> None:
    recovered = json.loads(run("recover", data, "--json").out)
    (one,) = recovered["sessions"]
    assert (one["outcome"], one["complete"], one["parts"][0]["recorded"]) == ("sealed", True, 100)
    path = data / "sessions" / ID / "frames.parquet"
    alone = run("verify", path).out
    assert "not proven: that it is the file in session.json" in alone
    assert "whole and complete" not in alone
    for target, code in ((data / "sessions" / ID, 0), (path, 4)):
        verified = run("verify", target, "--json")
        content = json.loads(verified.out)
        assert verified.code == code
        assert content["problems"] == []
        assert content["complete"] is True
        assert content["sha256"] == one["sha256"]
        assert {name: content[name] for name in ("lossy", "parts", "missed_slots")} == {
            name: one[name] for name in ("lossy", "parts", "missed_slots")
        }
    folder = json.loads(run("verify", data, "--json").out)
    assert list(folder) == ["sessions", "journals", "problems", "unproven", "set_aside"]
    assert folder["sessions"][0]["id"] == ID
    assert folder["journals"][0]["held"] == [[0, 99]]


def test_damage_is_named_with_exit_code_1(run: Run, data: Path) -> None:
    run("recover", data)
    path = data / "sessions" / ID / "frames.parquet"
    flip_bits(path, 300)
    for target in (path, path.parent, data):
        found = run("verify", target)
        assert found.code == 1
        assert found.out.count("  damaged: ") == 1
        assert "do not trust" in found.out.splitlines()[-1]
        assert "`foottile pull ID" in found.out.splitlines()[-1]
    assert json.loads(run("verify", path, "--json").out)["complete"] is False


def test_a_loss_is_exit_code_3(run: Run, data: Path) -> None:
    begun(data, OTHER_ID, last=149)
    recovered = run("recover", data)
    assert recovered.code == 3
    assert "150 frames" not in recovered.out
    assert "100 frames, 50 lost" in recovered.out
    found = run("verify", data)
    assert found.code == 3
    assert "lossy, 100 recorded, 50 lost (node_restarted)" in found.out


def test_a_journal_and_its_segment_are_proven_alone(run: Run, data: Path) -> None:
    stream = data / "journal" / "bench" / BOOT
    assert "100 frames in 1 segments" in run("verify", stream).out
    (segment,) = stream.glob("*.arrows")
    assert "100 frames, closed" in run("verify", segment).out
    assert json.loads(run("verify", segment, "--json").out)["held"] == [[0, 99]]


def test_a_foreign_file_is_exit_code_1(run: Run, tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    (tmp_path / "some" / "notes.txt").write_text("a walk")
    assert run("verify", "some").code == 1
    assert "foottile wrote" in run("verify", "some").err
    assert run("verify", "some/notes.txt").code == 1


def test_a_folder_that_is_used_is_not_recovered_but_verified(run: Run, data: Path) -> None:
    with (data / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        refused = run("recover", data)
        assert (refused.code, run("verify", data).code) == (1, 3)
    assert "a foottile server or node uses this folder" in refused.err


def test_recover_waits_for_the_frames_of_a_node_unless_they_are_abandoned(
    run: Run, data: Path
) -> None:
    (data / "nodes").mkdir()
    waiting = run("recover", data)
    assert waiting.code == 3
    assert "waits for its node" in waiting.out
    assert "--abandon-missing" in waiting.err
    assert "sealed and verified" in run("recover", data, "--abandon-missing").out


def test_frames_of_no_session_are_recovered_if_asked(run: Run, data: Path) -> None:
    (data / "sessions" / ID / "session.json").unlink()
    assert "nothing to recover" in run("recover", data).out
    found = run("recover", data, "--streams")
    assert found.code == 0
    assert f"(recovered bench {BOOT}): sealed and verified, 100 frames" in found.out


def test_estimates_of_frames_out_of_order_are_refused(run: Run, data: Path, tmp_path: Path) -> None:
    run("recover", data)
    path = data / "sessions" / ID / "frames.parquet"
    with SealedFileReader(path) as reader:
        info, whole = reader.info, reader.read_frames()
    mixed = tmp_path / "mixed.parquet"
    with SealedFileWriter(mixed, info, {}) as writer:
        writer.append_frames(whole.slice_rows(50, 60), {})
        writer.append_frames(whole.slice_rows(0, 50), {})
    assert len(pq.read_table(mixed)) == 60
    out = tmp_path / "out.parquet"
    found = run("estimate", mixed, "--out", out, "--calibration", "paper-eq2-shape")
    found.fails(1, "out of order: part 0: frame 0 follows frame 59")
    assert not out.exists()


@pytest.mark.parametrize("to", ["parquet", "arrow", "csv"])
def test_an_export_names_its_source_and_proves_nothing(
    run: Run, data: Path, tmp_path: Path, to: str
) -> None:
    run("recover", data)
    out = tmp_path / f"slice.{to}"
    columns = () if to == "csv" else ("--columns", "seq,t_ns")  # or a csv has no notes
    part = ("--start-s", "0.1", "--end-s", "0.15", *columns)
    assert run("export", ID, "--data", data, "--out", out, "--format", to, *part).code == 0
    table = read_table(out.read_bytes(), to)
    assert table["seq"].to_pylist() == [*range(50, 75)]
    assert to == "csv" or table.column_names == ["seq", "t_ns"]
    found = run("verify", out)
    assert found.code == 4
    assert found.out.splitlines()[-1].startswith("An export: it proves nothing")
    assert "damaged" not in found.out
    export = json.loads(run("verify", out, "--json").out)
    assert (export["export"], export["proves"], export["problems"]) == (to, [], [])
    assert f"session {ID}" in found.out
    sealed = data / "sessions" / ID / "frames.parquet"
    with SealedFileReader(sealed) as reader:
        assert export["source"]["content_sha256"] == reader.content_sha256
    source = [export["source"][name] for name in ("start_s", "end_s", "clock")]
    assert source == [0.1, 0.15, "node"]
    if to != "csv":  # of which any line may be the last
        out.write_bytes(out.read_bytes()[:-200])
        assert run("verify", out).code == 1


def test_an_export_in_the_place_of_a_sealed_file_is_damage(run: Run, data: Path) -> None:
    run("recover", data)
    sealed = data / "sessions" / ID / "frames.parquet"
    out = data / "export.parquet"
    run("export", ID, "--data", data, "--out", out, "--format", "parquet")
    out.replace(sealed)
    assert run("verify", sealed.parent).code == 1


def test_a_simulated_and_an_estimated_file_are_whole_but_of_no_recorded_session(
    run: Run, simulate: Simulate, tmp_path: Path
) -> None:
    raw = simulate("raw.parquet", "standing", "--seconds", 2, "--no-estimates")
    estimated = tmp_path / "estimated.parquet"
    calibrated = ("--calibration", "paper-eq2-shape", "--models", "unwrap,static")
    run("estimate", raw, "--out", estimated, *calibrated)
    for path in (raw, estimated):
        found = run("verify", path)
        assert (found.code, "  damaged" in found.out) == (4, False)
        assert "not proven: begin and end of its recording" in found.out


def test_every_other_file_of_a_data_folder_is_looked_at(run: Run, data: Path) -> None:
    run("recover", data)
    node = data / "nodes" / "bench"
    node.mkdir(parents=True)
    write_checksummed_json(node / "tares.json", b'{"tares": []}')
    (node / "tares.json.damaged-1").write_text("x")
    found = run("verify", data)
    assert found.code == 0
    assert "nodes/bench/tares.json.damaged-1: set aside" in found.out
    (node / "hello.json").write_text('{"a": 1}')
    found = run("verify", data)
    assert (found.code, "damaged: nodes/bench/hello.json" in found.out) == (1, True)
    flip_bits(node / "tares.json", 5)
    found = run("verify", data)
    assert (found.code, "damaged: nodes/bench/tares.json" in found.out) == (1, True)


@pytest.mark.parametrize("kind", ["folder", "nowhere", "loop", "pipe", "empty"])
def test_verify_names_a_file_that_was_replaced(run: Run, data: Path, kind: str) -> None:
    run("recover", data)
    (data / "nodes" / "bench").mkdir(parents=True)
    write_checksummed_json(data / "nodes" / "bench" / "hello.json", b'{"a": 1}')
    write_document(data / SERVER_NAME, ServerIdentity(server_id="5" * 32))
    paths = [path for path in data.rglob("*") if path.is_file() and path.name != ".lock"]
    assert len(paths) == 11
    for path in paths:
        aside = path.rename(data.parent / "aside")
        PLACES[kind](path)
        found = run("verify", data)
        # Of a segment and its index either may be named.
        named = path.stem if path.suffix in (".arrows", ".idx") else path.name
        assert named in found.out, path
        # An index that is lost with the power is no damage: what it lacks was never promised.
        assert (found.code == 1) is not (path.suffix == ".idx" and kind == "empty")
        if path.is_dir() and not path.is_symlink():
            path.rmdir()
        else:
            path.unlink()
        aside.rename(path)
    assert run("verify", data).code == 0


def test_verify_goes_on_behind_a_folder_that_is_none(run: Run, data: Path) -> None:
    begun(data, OTHER_ID, last=99)
    run("recover", data)
    shutil.rmtree(data / "sessions" / ID)
    (data / "sessions" / ID).write_text("no folder")
    (data / "journal" / "bench" / ("b" * 32)).symlink_to("nowhere")
    found = json.loads(run("verify", data, "--json").out)
    assert [one["id"] for one in found["sessions"]] == [OTHER_ID]
    assert len(found["problems"]) == 2


@pytest.mark.parametrize("place", [f"sessions/{ID}", f"journal/bench/{BOOT}", "journal/bench"])
def test_verify_does_not_follow_a_link_in_the_place_of_a_folder(
    run: Run, data: Path, place: str
) -> None:
    elsewhere = (data / place).rename(data.parent / "elsewhere")
    (data / place).symlink_to(elsewhere)
    found = run("verify", data)
    assert found.code == 1
    assert f"damaged: {place}" in found.out
    assert "links are not followed" in found.out


def test_a_list_of_sessions_goes_on_behind_a_damaged_one(run: Run, data: Path) -> None:
    begun(data, OTHER_ID, last=49)
    path = data / "sessions" / ID / "session.json"
    path.write_bytes(path.read_bytes().replace(b"walk", b"talk"))
    (data / "sessions" / "20200101T000000Z-0000ff").mkdir()
    found = run("sessions", "--data", data, "--json")
    assert [one["id"] for one in found.printed()["items"]] == [OTHER_ID]
    assert f"session {ID} is left out" in found.err
    assert "0000ff" not in found.err


def test_a_list_of_sessions_shows_the_part_that_was_not_sampled(run: Run, data: Path) -> None:
    run("recover", data)
    folder = SessionsFolder(data / "sessions")
    session = folder.load(ID)
    assert session.ledger is not None
    ledger = session.ledger.model_copy(update={"missed_slots": 25})
    folder.save_session_json(session.model_copy(update={"ledger": ledger}))
    assert "sealed, 20 % not" in run("sessions", "--data", data).out  # as wide as a terminal
    (listed,) = run("sessions", "--data", data, "--json").printed()["items"]
    assert (listed["missed_slots"], listed["lost"]) == (25, {})
    assert listed["not_sampled_share"] == pytest.approx(25 / (25 + listed["frames"]))
    verified = run("verify", data)
    assert "100 recorded, 20 % not sampled (25 slots)" in verified.out
    sql = "SELECT lossy, not_sampled_frames, not_sampled_share FROM sessions"
    assert run("query", sql, data, "--json").printed()["rows"] == [
        {"lossy": False, "not_sampled_frames": 25, "not_sampled_share": 0.2}
    ]


def test_verify_names_unreadable_files(
    run: Run, data: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("recover", data)
    forbidden = {str(path) for path in (data / "sessions" / ID).iterdir()}
    forbidden |= {str(path) for path in data.glob("journal/*/*/*")}
    opened = builtins.open

    def guarded(path: object, *args: Any, **options: Any) -> Any:
        if str(path) in forbidden:
            raise PermissionError(errno.EACCES, "Permission denied")
        return opened(path, *args, **options)  # type: ignore[call-overload]  # as given

    monkeypatch.setattr(builtins, "open", guarded)
    monkeypatch.setattr(io, "open", guarded)
    found = run("verify", data)
    assert found.code == 1
    for name in ("session.json", "stream.json"):
        assert name in found.out
