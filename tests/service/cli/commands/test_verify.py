"""`foottile verify` and `foottile recover` as a user meets them."""

from __future__ import annotations

import fcntl
import json
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from storage.journal.journal import Journal
from storage.journal.stream_notes import StreamNotes
from storage.sessions.file import SessionReader, SessionWriter
from storage.sessions.folder import Part, Session, SessionFolder
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames
from tests.service.cli.outcome import Run

ID = "20200101T000000Z-00000a"
OTHER_ID = "20200101T000000Z-00000b"
BOOT = "a" * 32


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A node's folder after a crash: a session was being recorded, frames 0 to 99 are there."""
    root, info = tmp_path / "data", make_array(boot_id=BOOT)
    folder = root / "journal" / "bench" / BOOT
    journal = Journal(folder, info)
    journal.append(make_frames(100, status=7))
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
        parts=(Part(boot_id=BOOT, seq_first=0, seq_last=last),),
        scene="test",
    )
    SessionFolder(root / "sessions").save(kept)


def test_a_crash_is_recovered_and_proven(run: Run, data: Path) -> None:
    before = run("verify", ID, "--data", data)
    assert before.code == 3
    assert "pending, 100 recorded" in before.out
    assert "not every session is sealed" in before.out
    recovered = run("recover", data)
    assert (recovered.code, recovered.err.count("journal bench/")) == (0, 1)
    assert f"session {ID} (walk): sealed and proven, 100 frames" in recovered.out
    assert run("recover", data, "--json").printed()["sessions"] == []
    assert "nothing to recover" in run("recover", data).out
    after = run("verify", data)
    assert after.code == 0
    assert f"session {ID} (walk): complete, 100 recorded" in after.out
    assert after.out.splitlines()[-1] == "Everything is whole and complete."


def test_json_of_one_session_is_its_ledger(run: Run, data: Path) -> None:
    recovered = json.loads(run("recover", data, "--json").out)
    (one,) = recovered["sessions"]
    assert (one["outcome"], one["complete"], one["parts"][0]["recorded"]) == ("sealed", True, 100)
    path = data / "sessions" / ID / "frames.parquet"
    for target in (data / "sessions" / ID, path):
        verified = run("verify", target, "--json")
        content = json.loads(verified.out)
        assert verified.code == 0
        assert content["problems"] == []
        assert content["complete"] is True
        assert content["sha256"] == one["sha256"]
        assert {name: content[name] for name in ("lossy", "parts", "missed_slots")} == {
            name: one[name] for name in ("lossy", "parts", "missed_slots")
        }
    folder = json.loads(run("verify", data, "--json").out)
    assert list(folder) == ["sessions", "journals", "problems"]
    assert folder["sessions"][0]["id"] == ID
    assert folder["journals"][0]["held"] == [[0, 99]]


def test_damage_is_said_and_is_exit_code_1(run: Run, data: Path) -> None:
    run("recover", data)
    path = data / "sessions" / ID / "frames.parquet"
    content = bytearray(path.read_bytes())
    content[300] ^= 1
    path.write_bytes(content)
    for target in (path, path.parent, data):
        found = run("verify", target)
        assert found.code == 1
        assert "  damaged: " in found.out
        assert "do not trust" in found.out.splitlines()[-1]
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


def test_what_is_lone_says_what_it_does_not_prove(run: Run, data: Path) -> None:
    run("recover", data)
    run("verify", data / "sessions" / ID / "frames.parquet").fails(0, "not proven: ")


@pytest.mark.parametrize("command", ["verify", "recover"])
def test_a_name_of_nothing_is_wrong_usage(run: Run, command: str) -> None:
    assert run(command, "nowhere").code == 2


def test_what_foottile_did_not_write_is_exit_code_1(run: Run, tmp_path: Path) -> None:
    (tmp_path / "some").mkdir()
    (tmp_path / "some" / "notes.txt").write_text("a walk")
    assert run("verify", "some").code == 1
    assert "foottile wrote" in run("verify", "some").err
    assert run("verify", "some/notes.txt").code == 1
    assert run("recover", "some").code == 2


def test_a_folder_that_is_used_is_not_recovered_but_verified(run: Run, data: Path) -> None:
    with (data / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        refused = run("recover", data)
        assert (refused.code, run("verify", data).code) == (1, 3)
    assert "a foottile server or node uses this folder" in refused.err


def test_on_a_server_what_may_come_is_waited_for_unless_given_up(run: Run, data: Path) -> None:
    (data / "nodes").mkdir()
    waiting = run("recover", data)
    assert waiting.code == 3
    assert "waits for its node" in waiting.out
    assert "--give-up" in waiting.err
    assert "sealed and proven" in run("recover", data, "--give-up").out


def test_frames_of_no_session_are_recovered_if_asked(run: Run, data: Path) -> None:
    (data / "sessions" / ID / "session.json").unlink()
    assert "nothing to recover" in run("recover", data).out
    found = run("recover", data, "--streams")
    assert found.code == 0
    assert f"(recovered bench {BOOT}): sealed and proven, 100 frames" in found.out


def test_estimates_of_frames_out_of_order_are_refused(run: Run, data: Path, tmp_path: Path) -> None:
    run("recover", data)
    path = data / "sessions" / ID / "frames.parquet"
    with SessionReader(path) as reader:
        info, whole = reader.info, reader.frames()
    mixed = tmp_path / "mixed.parquet"
    with SessionWriter(mixed, info, {}) as writer:
        writer.append(whole.rows(50, 60), {})
        writer.append(whole.rows(0, 50), {})
    assert len(pq.read_table(mixed)) == 60
    out = tmp_path / "out.parquet"
    found = run("estimate", mixed, "--out", out, "--calibration", "paper-eq2-shape")
    found.fails(1, "out of order: part 0: frame 0 follows frame 59")
    assert not out.exists()
