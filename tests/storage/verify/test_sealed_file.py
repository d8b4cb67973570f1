"""A sealed file proves itself: every kind of damage is found from the file alone."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.parquet_hash import FOOTER_HASH_KEY, read_stated_and_actual_hash
from storage.sessions.folder import Ledger, Part, PartLedger
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import EXPORT_KEY, SealedFileWriter
from storage.verify.sealed_file import (
    find_ledger_contradictions,
    recognise_export_and_check_not_cut_off,
    verify_sealed_file,
)
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import make_frames

STREAM_IDS = ("a" * 32, "b" * 32)


def frames(*numbers: int, offset_ns: int = UTC_NS) -> FrameBatch:
    """Frames in which everything is known."""
    counts = np.random.default_rng(len(numbers)).integers(0, 100, (len(numbers), 1))
    known: dict[str, Any] = {"servo_counts": 5, "servo_age_us": 7, "reference_force_n": 9.0}
    known |= {"pressure_raw": counts, "temperature_raw": counts[::-1]}
    return make_frames(numbers, 1, utc_offset_ns=offset_ns, **known)


def counted(first: int, last: int, boot: int = 0, **lost: int) -> PartLedger:
    length = last - first + 1
    return PartLedger(
        stream_id=STREAM_IDS[boot],
        seq_first=first,
        seq_last=last,
        recorded=length - sum(lost.values()),
        lost=lost,
        pending=0,
    )


def notes_of(*parts: PartLedger) -> dict[str, Any]:
    lossy = any(part.lost for part in parts)
    ledger = Ledger(complete=not lossy, lossy=lossy, parts=parts, missed_slots=0)
    facts = {"stream_id", "seq_first", "seq_last"}
    session_parts = [Part(**part.model_dump(include=facts)).model_dump() for part in parts]
    session = {"id": "20200101T000000Z-000000", "node": "bench", "parts": session_parts}
    return {"ledger": ledger.model_dump(mode="json"), "session": session, "lost": {}}


def write(path: Path, notes: dict[str, Any], *parts: FrameBatch) -> Path:
    with SealedFileWriter(path, make_array(1, stream_id=STREAM_IDS[0]), notes) as writer:
        for number, batch in enumerate(parts):
            if len(batch):
                writer.append_frames(batch, {"part": np.full(len(batch), number, np.uint16)})
    return path


def walk(path: Path) -> Path:
    """Two parts, 60 frames of 100 and three frames lost."""
    present = [n for n in range(10, 70) if n not in (20, 21, 40)]
    parts = (counted(10, 69, disk_full=3), counted(0, 39, boot=1))
    lost = {"lost": {STREAM_IDS[0]: {"disk_full": [[20, 21], [40, 40]]}}}
    batches = (frames(*present), frames(*range(40), offset_ns=5))
    return write(path, notes_of(*parts) | lost, *batches)


def problems(path: Path) -> str:
    return "; ".join(verify_sealed_file(path).problems)


def rewritten(path: Path, table: pa.Table, notes: dict[str, Any] | None = None) -> Path:
    """The table sealed again by our own writer: hashes agree, whatever it says."""
    with SealedFileReader(path) as reader:
        info, said = reader.info, notes if notes is not None else reader.notes
    names = [name.removesuffix("_0") for name in table.column_names]
    values = {}
    for name, flat in zip(names, table.column_names, strict=True):
        column = table.column(flat).to_numpy()
        values[name] = column[:, None] if flat.endswith("_0") else column
    part = {"part": values.pop("part")}
    with SealedFileWriter(path, info, said) as writer:
        writer.append_frames(FrameBatch(**values), part)
    return path


# --- what is whole --------------------------------------------------------------------------------


def test_a_whole_file_proves_its_ledger(tmp_path: Path) -> None:
    report = verify_sealed_file(walk(tmp_path / "s.parquet"))
    assert (report.problems, report.unproven) == ([], [])
    assert report.frame_count == 97
    assert report.ledger is not None
    assert [part.recorded for part in report.ledger.parts] == [57, 40]
    assert report.session["id"] == "20200101T000000Z-000000"


def test_a_file_of_no_session_is_proven_as_far_as_it_goes(tmp_path: Path) -> None:
    report = verify_sealed_file(write(tmp_path / "s.parquet", {}, frames(*range(50))))
    assert report.problems == []
    assert report.ledger is not None
    assert report.ledger.complete
    assert "no recorded session" in " ".join(report.unproven)
    gap = verify_sealed_file(write(tmp_path / "gap.parquet", {}, frames(0, 1, 5)))
    assert "frames 2 to 4 are missing, and nothing says why" in "; ".join(gap.problems)


def test_what_is_no_sealed_file_is_refused(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign.parquet"
    pq.write_table(pa.table({"a": [1]}), foreign)
    with pytest.raises(FileFormatError, match=foreign.name):
        verify_sealed_file(foreign)


# --- damage ---------------------------------------------------------------------------------------


def test_a_footer_hash_of_another_footer_is_found(tmp_path: Path) -> None:
    # slices of such a file would be refused
    path = walk(tmp_path / "s.parquet")
    before = FOOTER_HASH_KEY + b"\x18\x40"
    head, rest = path.read_bytes().split(before)
    flipped = head + before + (b"0" if rest[:1] != b"0" else b"1") + rest[1:]
    stated, _ = read_stated_and_actual_hash(path) or ("", "")
    unhashed = flipped.replace(stated.encode(), b"0" * 64)
    digits = hashlib.sha256(unhashed).hexdigest().encode()
    path.write_bytes(flipped.replace(stated.encode(), digits))
    assert problems(path) == "its footer's own hash is of another footer"


def test_a_file_that_another_program_wrote_anew_says_so(tmp_path: Path) -> None:
    path = walk(tmp_path / "s.parquet")
    pq.write_table(pq.read_table(path), path)
    assert problems(path) == "it has no hashes: another program has rewritten it"


@pytest.mark.parametrize(
    ("slices", "said"),
    [
        (
            [(0, 57)],
            [
                "part 1: 0 frames, and the ledger has 40",
                "part 1: 40 frames are missing (0 to 39), and the ledger accounts for 0",
            ],
        ),
        ([(0, 30), (31, 97)], ["part 0: 56 frames, and the ledger has 57", "and not named lost"]),
        ([(0, 5), (4, 97)], ["part 0: frame 14 follows frame 14", "58 frames, and the ledger has"]),
        ([(3, 7), (0, 3), (7, 97)], ["frame 10 follows frame 16"]),
    ],
    ids=["a part is gone", "a row is gone", "a row stands twice", "rows are out of order"],
)
def test_rows_are_held_against_the_ledger(
    tmp_path: Path, slices: list[tuple[int, int]], said: list[str]
) -> None:
    path = walk(tmp_path / "s.parquet")
    assert pq.ParquetFile(path).num_row_groups == 2
    table = pq.read_table(path)
    rewritten(path, pa.concat_tables([table.slice(a, b - a) for a, b in slices]))
    found = problems(path)
    assert [text for text in said if text not in found] == []


def test_a_shifted_time_is_seen(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", {}, frames(0, 1, 2, offset_ns=UTC_NS + 1))
    assert "the array's anchor" in problems(path)
    batch = frames(0, 1, 2)
    t_ns = batch.t_ns + np.array([0, 0, 9])
    path = write(tmp_path / "two.parquet", {}, replace(batch, t_ns=t_ns))
    assert "t_ns of frame 2 is not" in problems(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"recorded": 58, "lost": {"disk_full": 2}}, "57 frames, and the ledger has 58"),
        ({"recorded": 58}, "the ledger counts 61 frames, and 10 to 69 are 60"),
        ({"seq_last": 68}, "frames 69 to 69 are outside"),
        ({"lost": {"disk_full": 4}, "pending": -1}, "the ledger counts"),
        ({"seq_first": 9, "recorded": 58}, "4 frames are missing"),
    ],
)
def test_an_edited_ledger_is_found(tmp_path: Path, change: dict[str, Any], said: str) -> None:
    path = walk(tmp_path / "s.parquet")
    with SealedFileReader(path) as reader:
        notes = json.loads(json.dumps(reader.notes))
    notes["ledger"]["parts"][0] |= change
    rewritten(path, pq.read_table(path), notes)
    assert said in problems(path)
    assert "of other parts than its session" in problems(path) or "seq" not in str(change)


def test_numbers_named_lost_are_those_that_are_missing(tmp_path: Path) -> None:
    path = walk(tmp_path / "s.parquet")
    with SealedFileReader(path) as reader:
        notes = json.loads(json.dumps(reader.notes))
    notes["lost"] = {STREAM_IDS[0]: {"disk_full": [[20, 20], [40, 41]]}}
    rewritten(path, pq.read_table(path), notes)
    assert "frames 21 are missing and not named lost" in problems(path)


@pytest.mark.parametrize("notes", [{"ledger": 7}, {"ledger": {}}, {"lost": 3}, {"session": 4}])
def test_unreadable_notes_are_a_problem(tmp_path: Path, notes: dict[str, Any]) -> None:
    path = write(tmp_path / "s.parquet", notes_of(counted(0, 2)) | notes, frames(0, 1, 2))
    report = verify_sealed_file(path)
    assert report.problems != []


def test_a_ledger_that_contradicts_itself_is_seen() -> None:
    def said(complete: bool, lossy: bool, *parts: PartLedger) -> list[str]:
        return find_ledger_contradictions(
            Ledger(complete=complete, lossy=lossy, parts=parts, missed_slots=0)
        )

    assert said(True, False, counted(0, 9)) == []
    assert said(False, True, counted(0, 9, evicted=3)) == []
    assert len(said(False, False, counted(0, 9, evicted=3))) == 1
    assert len(said(True, True, counted(0, 9, evicted=3))) == 1
    assert len(said(True, True, counted(0, 9))) == 1
    assert said(True, False, counted(5, 4)) == []


@pytest.mark.parametrize("source", [b"{", b"[1]", b"\xff", b"[" * 200_000])
def test_an_export_is_recognised_when_its_source_cannot_be_read(
    tmp_path: Path, source: bytes
) -> None:
    path = tmp_path / "export.parquet"
    pq.write_table(pa.table({"t_ns": [1]}).replace_schema_metadata({EXPORT_KEY: source}), path)
    report = recognise_export_and_check_not_cut_off(path)
    assert report is not None
    assert report.source == {}
    assert report.problems == []
