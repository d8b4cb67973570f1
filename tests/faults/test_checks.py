"""The judge is judged: one good round, and each thing that may be wrong with it, put in by hand."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable
from functools import partial
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
from tests.faults.stories import Story

ID = "20260101T000000Z-000000"
STREAMS = ("a" * 32, "b" * 32)
FRAMES = 200


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


def cut_off(facts: Facts, by: int, tail: int, longest_wait_s: float = 0.0) -> None:
    """The node's power failed: the first part ends earlier, and its tail is open."""
    facts.ends[STREAMS[0]] = End("power", FRAMES - 1, 5.0, longest_wait_s=longest_wait_s)
    shorter(facts, by, tail)


def test_a_good_round_has_no_findings(facts: Facts) -> None:
    assert findings(facts) == []


def test_a_stated_loss_of_a_power_cut_is_no_finding(facts: Facts) -> None:
    cut_off(facts, by=30, tail=50)
    assert findings(facts) == []


def test_a_bound_remembers_an_earlier_wait_for_the_disk_and_a_loss_does_not(facts: Facts) -> None:
    cut_off(facts, by=30, tail=80, longest_wait_s=2.0)
    assert findings(facts) == []
    without(facts, gone=range(70, 150))
    assert any("lost {'corrupt': 80}, where 5" in finding for finding in findings(facts))


@pytest.mark.parametrize(("last", "is_good"), [(89, True), (88, False)])
def test_of_a_clock_never_measured_the_session_has_all_that_was_acknowledged_before_the_stop(
    facts: Facts, last: int, is_good: bool
) -> None:
    facts.stopped_s, facts.stop_sigma_s = 11.05, None  # 89 was acknowledged at 11.0, 99 at 11.1
    facts.ledger["parts"][1] |= {"seq_last": last, "recorded": last + 1}
    facts.session["parts"][1]["seq_last"] = last
    seal(facts, parquet([np.arange(50, FRAMES), np.arange(last + 1)]))
    assert (findings(facts) == []) is is_good
    facts.stop_sigma_s = 0.0
    assert findings(facts)


def _without_the_second_stream(facts: Facts) -> None:
    del facts.ledger["parts"][1], facts.session["parts"][1]
    seal(facts, parquet([np.arange(50, FRAMES)]))


def _with_other_counts(facts: Facts) -> None:
    seal(facts, parquet([np.arange(50, FRAMES), np.arange(FRAMES)], padc_off=1))


def _with_a_frame_twice(facts: Facts) -> None:
    twice = np.sort(np.append(np.arange(50, FRAMES - 1), 60))
    seal(facts, parquet([twice, np.arange(FRAMES)]))


def _with_a_flipped_bit(facts: Facts) -> None:
    assert facts.file is not None
    seal(facts, facts.file[:200] + bytes([facts.file[200] ^ 1]) + facts.file[201:])


def _with_another_file(facts: Facts) -> None:
    content = facts.file
    _with_other_counts(facts)
    facts.file = content


def _with_a_ledger(facts: Facts, **change: Any) -> None:
    facts.ledger["parts"][0] |= change


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (
            partial(without, gone=range(100, 103)),  # though the ledger owns up
            ["3 acknowledged frames are lost, 100 to 102", "lost {'corrupt': 3}, where 0 may be"],
        ),
        (_without_the_second_stream, ["200 acknowledged frames are lost", "is no part of it"]),
        (
            partial(cut_off, by=30, tail=20),
            ["ends with 169 and at most 20 more, but 199 was taken"],
        ),
        (partial(cut_off, by=30, tail=80), ["max_lost_tail_frames 80 is more than 5"]),
        # A process that was killed may neither lose nor state a tail.
        (partial(shorter, by=0, tail=1), ["max_lost_tail_frames 1 is more than 0"]),
        (partial(shorter, by=1, tail=0), ["ends with 198 and at most 0 more, but 199 was taken"]),
        (_with_other_counts, ["pressure_raw of 150 frames is not that of what went over the link"]),
        (_with_a_frame_twice, ["seq does not rise"]),
        (lambda facts: setattr(facts, "started_s", 0.3), ["it begins with 50"]),
        (partial(_with_a_ledger, recorded=149), ["does not sum up"]),
        (partial(_with_a_ledger, recorded=140, pending=10), ["10 frames pending"]),
        (partial(_with_a_ledger, lost={"corrupt": 1}), ["does not sum up"]),
        (partial(_with_a_ledger, max_lost_tail_frames=5), ["lossy=False is not so"]),
        (partial(_with_a_ledger, seq_first=49), ["are not the session's"]),
        (_with_a_flipped_bit, ["damaged"]),
        (_with_another_file, ["SHA-256", "not what is on the disk"]),
        (lambda facts: facts.session.update(state="pending"), ["the session is pending"]),
        (lambda facts: setattr(facts, "verify_code", 1), ["foottile verify ended with 1"]),
    ],
    ids=lambda value: value[0] if isinstance(value, list) else "",
)
def test_each_fault_of_a_round_is_found(
    facts: Facts, spoil: Callable[[Facts], None], words: list[str]
) -> None:
    spoil(facts)
    found = findings(facts)
    for word in words:
        assert any(word in finding for finding in found), found


# --- session folders wherever they were left ------------------------------------------------------


def test_session_folders_are_whole_or_it_is_said_what_is_not() -> None:
    sealed = parquet([np.arange(10)])
    recording = b'{"state": "recording"}'
    sha256 = hashlib.sha256(sealed).hexdigest()
    done = json.dumps({"state": "sealed", "sha256": sha256}).encode()

    def found(*contents: bytes) -> list[str]:
        names = ["session.json", "frames.parquet", ".frames.parquet.tmp"]
        folder: Tree = {n: Remains(c, 0o644) for n, c in zip(names, contents, strict=False)}
        return sessions_are_whole({"sessions": {ID: folder}}, ID)

    for good in ([recording], [recording, sealed], [done, sealed, b"?"]):
        assert found(*good) == []
    assert sessions_are_whole({}, ID) == found() == [f"session {ID} is gone"]
    assert found(b"") == [f"session.json of {ID} is damaged"]
    (said,) = found(recording, sealed[:-9])
    assert said.startswith(f"frames.parquet of {ID} is damaged")
    for bad in ([done], [done, parquet([np.arange(9)])]):
        assert found(*bad) == [f"the sealed file of {ID} is not the one in session.json"]
