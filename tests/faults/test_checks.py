"""The judge is judged: one good round, and each thing that may be wrong with it, put in by hand."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.frames import FrameBatch
from storage.schema import wire_schema
from storage.wire import encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import make_frames
from tests.faults.checks import findings, sessions_are_whole
from tests.faults.draws import Remains, Tree
from tests.faults.facts import End, Facts
from tests.faults.link_witness import Ack, Sent, Witness
from tests.faults.product import Product
from tests.faults.stories import Story

EVERYTHING = Product(node_journal=True, node_record=True, verify=True, recover=True)
ID = "20260101T000000Z-000000"
STREAMS = ("a" * 32, "b" * 32)
FRAMES = 200
Change = Callable[[Facts, dict[str, Any]], None]


def parquet(parts: list[np.ndarray[Any, Any]], *, padc_off: int = 0) -> bytes:
    """A sealed file with these numbers in each part."""
    tables = []
    for number, seqs in enumerate(parts):
        taken = batch(0, int(seqs.max()) + 1 if len(seqs) else 1)
        rows = seqs.astype(np.int64)
        columns = {name: getattr(taken, name)[rows] for name in ("seq", "t_mono_ns", "t_ns")}
        columns["frame_flags"] = taken.frame_flags[rows]
        columns["part"] = np.full(len(rows), number, np.uint16)
        for name in ("pressure_raw", "temperature_raw", "sample_offset_us", "tile_flags"):
            columns[f"{name}_0"] = getattr(taken, name)[rows, 0]
        columns["pressure_raw_0"] = columns["pressure_raw_0"] + np.uint16(padc_off)
        tables.append(pa.table(columns))
    sink = io.BytesIO()
    pq.write_table(pa.concat_tables(tables), sink, write_page_checksum=True)
    return sink.getvalue()


def seal(facts: Facts, content: bytes) -> None:
    """Have this as the sealed file."""
    facts.file = content
    facts.session["sha256"] = hashlib.sha256(content).hexdigest()
    folder = facts.sealed_root / "sessions" / ID
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "session.json").write_text(json.dumps(facts.session))
    (folder / "frames.parquet").write_bytes(content)
    for name in ("markers.parquet", "clock.parquet"):
        pq.write_table(pa.table({"t_ns": pa.array([], pa.int64())}), folder / name)


def batch(first: int, count: int) -> FrameBatch:
    """At a hundred frames a second, with the number in everything that is read."""
    seq = np.arange(first, first + count)
    counts = seq[:, None] % 1000
    return make_frames(
        seq,
        1,
        period_ns=10_000_000,
        utc_offset_ns=0,
        pressure_raw=counts,
        temperature_raw=counts,
        sample_offset_us=counts,
        tile_flags=counts % 256,
    )


@pytest.fixture
def facts(tmp_path: Path) -> Facts:
    """A node that was killed after 200 frames and took 200 more in another stream, all of them
    acknowledged; the session begins with frame 50."""
    witness = Witness()
    for number, stream_id in enumerate(STREAMS):
        info = make_array(1, stream_id=stream_id)
        witness.infos[stream_id] = info
        for first in range(0, FRAMES, 10):
            at_s = 10.0 * number + first * 0.01
            payload = encode_frames(batch(first, 10), wire_schema(info))
            witness.sent.append(Sent(stream_id, payload, at_s))
            witness.acks.append(Ack(stream_id, first, first + 9, at_s + 0.2))
    firsts = (50, 0)
    parts: list[dict[str, Any]] = [
        {"stream_id": stream_id, "seq_first": first, "seq_last": FRAMES - 1}
        for stream_id, first in zip(STREAMS, firsts, strict=True)
    ]
    made = Facts(
        Story(1, ()),
        witness,
        tmp_path / "server",
        tmp_path / "node",
        100.0,
        started_s=0.505,
        stopped_s=15.0,
        ends={STREAMS[0]: End("killed", FRAMES - 1, 5.0)},
        session={"id": ID, "state": "sealed", "parts": parts},
        verify_code=0,
    )
    made.ledger = {
        "complete": True,
        "lossy": False,
        "parts": [
            {
                **part,
                "recorded": FRAMES - part["seq_first"],
                "lost": {},
                "pending": 0,
                "max_lost_tail_frames": 0,
            }
            for part in parts
        ],
        "missed_slots": 0,
    }
    seal(made, parquet([np.arange(first, FRAMES) for first in firsts]))
    return made


def without(facts: Facts, gone: range, part: int = 0) -> None:
    """Frames are missing, and the ledger says so: named as lost."""
    rows = [np.arange(p["seq_first"], p["seq_last"] + 1) for p in facts.ledger["parts"]]
    rows[part] = np.setdiff1d(rows[part], gone)
    entry = facts.ledger["parts"][part]
    entry["recorded"] -= len(gone)
    entry["lost"] = {"corrupt": len(gone)}
    lossy(facts)
    seal(facts, parquet(rows))


def shorter(facts: Facts, by: int, tail: int) -> None:
    """The first part ends earlier, and its tail is open; the server had acknowledged no more."""
    last = FRAMES - 1 - by
    entry = facts.ledger["parts"][0]
    entry |= {"seq_last": last, "recorded": entry["recorded"] - by, "max_lost_tail_frames": tail}
    facts.session["parts"][0]["seq_last"] = last
    facts.witness.acks = [a for a in facts.witness.acks if a.stream_id != STREAMS[0]]
    if tail:
        lossy(facts)
    seal(facts, parquet([np.arange(50, last + 1), np.arange(FRAMES)]))


def lossy(facts: Facts) -> None:
    facts.ledger |= {"complete": False, "lossy": True}
    facts.verify_code = 3


def power(facts: Facts) -> None:
    facts.ends[STREAMS[0]] = End("power", FRAMES - 1, 5.0)


def test_a_good_round_has_no_findings(facts: Facts) -> None:
    assert findings(facts, EVERYTHING) == []


def test_what_a_power_cut_may_cost_is_no_finding_if_it_is_stated(facts: Facts) -> None:
    power(facts)
    shorter(facts, by=30, tail=50)
    assert findings(facts, EVERYTHING) == []


def only(facts: Facts, *words: str) -> None:
    """There are findings, and they are about this."""
    found = findings(facts, EVERYTHING)
    assert found
    for word in words:
        assert any(word in finding for finding in found), found


def test_acknowledged_frames_that_are_missing_are_found_though_the_ledger_owns_up(
    facts: Facts,
) -> None:
    without(facts, range(100, 103))
    only(facts, "3 acknowledged frames are lost, 100 to 102", "lost {'corrupt': 3}, where 0 may be")


def test_an_acknowledged_stream_that_is_no_part_is_found(facts: Facts) -> None:
    del facts.ledger["parts"][1], facts.session["parts"][1]
    seal(facts, parquet([np.arange(50, FRAMES)]))
    only(facts, "200 acknowledged frames are lost", "is no part of it")


def test_a_tail_that_is_shorter_than_what_is_missing_is_found(facts: Facts) -> None:
    power(facts)
    shorter(facts, by=30, tail=20)
    only(facts, "ends with 169 and at most 20 more, but 199 was taken")


def test_a_tail_that_is_longer_than_half_a_second_is_found(facts: Facts) -> None:
    power(facts)
    shorter(facts, by=30, tail=80)
    only(facts, "max_lost_tail_frames 80 is more than 5")


def test_a_process_that_was_killed_may_neither_lose_nor_state_a_tail(facts: Facts) -> None:
    shorter(facts, by=0, tail=1)
    only(facts, "max_lost_tail_frames 1 is more than 0")


def test_what_a_killed_process_had_sent_is_missed(facts: Facts) -> None:
    shorter(facts, by=1, tail=0)
    only(facts, "ends with 198 and at most 0 more, but 199 was taken")


def test_another_content_than_was_taken_is_found(facts: Facts) -> None:
    seal(facts, parquet([np.arange(50, FRAMES), np.arange(FRAMES)], padc_off=1))
    only(facts, "pressure_raw of 150 frames is not that of what went over the link")


def test_a_frame_that_is_there_twice_is_found(facts: Facts) -> None:
    twice = np.sort(np.append(np.arange(50, FRAMES - 1), 60))
    seal(facts, parquet([twice, np.arange(FRAMES)]))
    only(facts, "seq does not rise")


def test_a_session_that_begins_too_late_is_found(facts: Facts) -> None:
    facts.started_s = 0.3
    only(facts, "it begins with 50")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"recorded": 149}, "does not sum up"),
        ({"recorded": 140, "pending": 10}, "10 frames pending"),
        ({"lost": {"corrupt": 1}}, "does not sum up"),
        ({"max_lost_tail_frames": 5}, "lossy=False is not so"),
        ({"seq_first": 49}, "are not the session's"),
    ],
)
def test_a_ledger_that_does_not_add_up_is_found(
    facts: Facts, change: dict[str, Any], words: str
) -> None:
    facts.ledger["parts"][0] |= change
    only(facts, words)


def test_a_damaged_file_is_found(facts: Facts) -> None:
    assert facts.file is not None
    damaged = bytearray(facts.file)
    damaged[200] ^= 1
    seal(facts, bytes(damaged))
    only(facts, "damaged")


def test_another_file_than_was_sealed_is_found(facts: Facts) -> None:
    content = facts.file
    seal(facts, parquet([np.arange(50, FRAMES), np.arange(FRAMES)], padc_off=1))
    facts.file = content
    only(facts, "SHA-256", "not what is on the disk")


def test_a_session_that_is_not_sealed_is_found(facts: Facts) -> None:
    facts.session["state"] = "pending"
    only(facts, "the session is pending")


def test_a_verify_that_says_otherwise_is_found(facts: Facts) -> None:
    facts.verify_code = 1
    only(facts, "foottile verify ended with 1")


# --- session folders wherever they were left ------------------------------------------------------


def tree_of(**files: bytes) -> Tree:
    folder: Tree = {name: Remains(content, 0o644) for name, content in files.items()}
    return {"sessions": {ID: folder}}


def test_session_folders_are_whole_or_it_is_said_what_is_not() -> None:
    sealed = parquet([np.arange(10)])
    sha256 = hashlib.sha256(sealed).hexdigest()
    recording = b'{"state": "recording"}'
    done = json.dumps({"state": "sealed", "sha256": sha256}).encode()
    good = [
        tree_of(**{"session.json": recording}),
        tree_of(**{"session.json": recording, "frames.parquet": sealed}),
        tree_of(**{"session.json": done, "frames.parquet": sealed, ".frames.parquet.tmp": b"?"}),
    ]
    for tree in good:
        assert sessions_are_whole(tree, ID) == []
    bad = [
        {},
        tree_of(),
        tree_of(**{"session.json": b""}),
        tree_of(**{"session.json": recording, "frames.parquet": sealed[:-9]}),
        tree_of(**{"session.json": done}),
        tree_of(**{"session.json": done, "frames.parquet": parquet([np.arange(9)])}),
    ]
    for tree in bad:
        assert sessions_are_whole(tree, ID)
