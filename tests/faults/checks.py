"""Judges a round by what the harness saw itself. Each finding is a sentence; none: it is good."""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.faults.draws import Remains, Tree
from tests.faults.facts import Facts
from tests.faults.link_witness import Columns

_SYNC_S, _BATCH_S = 0.5, 0.05
_WAIT_SLACK_S = 1.0
"""A disk that works again is tried within a second."""
_STOP_S = 0.03
"""Frames that were on the link so long before the stop were surely taken before it."""
_GOOD, _DAMAGED, _LOSSY = 0, 1, 3
_NOT_READ_COUNTS = 65535


def findings(facts: Facts) -> list[str]:
    """Everything that is wrong."""
    if facts.session.get("state") != "sealed":
        return [f"the session is {facts.session.get('state')}: {facts.session.get('problem')}"]
    found = [*_ledger_sums(facts)]
    try:
        table = _table(facts)
    except (pa.ArrowException, OSError) as error:
        return [*found, f"the sealed file is damaged: {error}"]
    rows = _rows_by_part(facts, table)
    for compare in (
        _rows_are_the_ledgers,
        _nothing_promised_is_missing,
        _content_is_what_was_taken,
    ):
        found += compare(facts, rows)
    for check in _CHECKS:
        found += check(facts)
    return found


def bound_frames(facts: Facts, stream_id: str) -> int:
    """What a power cut may cost of a stream: half a second and a batch."""
    end = facts.ends.get(stream_id)
    # An fsync that takes a second leaves that second unsynced, and one more may be waiting.
    unsynced_s = _SYNC_S + (2 * end.slow_s if end is not None else 0.0)
    return math.ceil(facts.rate_hz * (unsynced_s + _BATCH_S))


def sessions_are_whole(tree: Tree, expected: str) -> list[str]:
    """What is wrong with the session folders of a data folder, wherever its server was stopped.

    Args:
        tree: the data folder.
        expected: id of a session that has to be there.
    """
    sessions = tree.get("sessions", {})
    assert isinstance(sessions, dict)
    found = []
    if "session.json" not in sessions.get(expected, {}):
        found.append(f"session {expected} is gone")
    for session_id, folder in sessions.items():
        assert isinstance(folder, dict)
        files = {name: node.content for name, node in folder.items() if isinstance(node, Remains)}
        state = ""
        if "session.json" in files:
            try:
                session = json.loads(files["session.json"])
                state = session["state"]
            except ValueError:
                found.append(f"session.json of {session_id} is damaged")
        sealed = files.get("frames.parquet")
        if sealed is not None:
            try:
                _read(sealed)
            except (pa.ArrowException, OSError) as error:
                found.append(f"frames.parquet of {session_id} is damaged: {error}")
        if state == "sealed" and (
            sealed is None or hashlib.sha256(sealed).hexdigest() != session["sha256"]
        ):
            found.append(f"the sealed file of {session_id} is not the one in session.json")
    return found


# --- the ledger and the file ----------------------------------------------------------------------


def _ledger_sums(facts: Facts) -> Iterator[str]:
    parts = facts.ledger["parts"]
    named = [(p["stream_id"], p["seq_first"], p["seq_last"]) for p in facts.session["parts"]]
    if named != [(p["stream_id"], p["seq_first"], p["seq_last"]) for p in parts]:
        yield f"the ledger's parts are not the session's {named}"
    for number, part in enumerate(parts):
        length = part["seq_last"] - part["seq_first"] + 1
        counts = [part["recorded"], *part["lost"].values(), part["pending"]]
        if sum(counts) != length or min(counts) < 0:
            yield f"part {number} does not sum up: {part}"
        if part["pending"]:
            yield f"part {number} is sealed with {part['pending']} frames pending"
    lossy = any(part["lost"] or part["max_lost_tail_frames"] for part in parts)
    if facts.ledger["lossy"] != lossy or facts.ledger["complete"] == lossy:
        yield f"complete={facts.ledger['complete']}, lossy={facts.ledger['lossy']} is not so"
    seen: set[tuple[str, int]] = set()
    for part in parts:
        span = {(part["stream_id"], seq) for seq in range(part["seq_first"], part["seq_last"] + 1)}
        if span & seen:
            yield f"parts overlap in stream {part['stream_id']}"
        seen |= span


def _table(facts: Facts) -> pa.Table | None:
    return None if facts.file is None else _read(facts.file)


def _read(content: bytes) -> pa.Table:
    with pq.ParquetFile(io.BytesIO(content), page_checksum_verification=True) as file:
        return file.read()


def _rows_by_part(facts: Facts, table: pa.Table | None) -> list[Columns]:
    """The file's columns by part, counts and status per tile as (n, tiles)."""
    if table is None:
        return [{"seq": np.array([], dtype=np.uint64)} for _ in facts.ledger["parts"]]
    columns: Columns = {}
    for name in ("seq", "t_mono_ns", "t_ns", "frame_flags", "part"):
        columns[name] = table.column(name).to_numpy()
    tiles = sum(1 for name in table.column_names if name.startswith("pressure_raw_"))
    for name in ("pressure_raw", "temperature_raw", "sample_offset_us", "tile_flags"):
        each = [table.column(f"{name}_{i}") for i in range(tiles)]
        if name in ("pressure_raw", "temperature_raw"):
            not_read = pa.scalar(_NOT_READ_COUNTS, pa.uint16())
            each = [column.fill_null(not_read) for column in each]
        columns[name] = np.stack([column.to_numpy() for column in each], axis=1)
    return [
        {name: values[columns["part"] == number] for name, values in columns.items()}
        for number in range(len(facts.ledger["parts"]))
    ]


def _file_is_the_one_it_says(facts: Facts) -> Iterator[str]:
    recorded = sum(part["recorded"] for part in facts.ledger["parts"])
    if facts.file is None:
        if recorded:
            yield "there is no sealed file to download"
        return
    folder = facts.sealed_root / "sessions" / facts.session["id"]
    sha256 = hashlib.sha256(facts.file).hexdigest()
    written = json.loads((folder / "session.json").read_text())
    if not sha256 == written["sha256"] == facts.session["sha256"]:
        yield "the file's SHA-256 is not the one in session.json"
    if (folder / "frames.parquet").read_bytes() != facts.file:
        yield "what was downloaded is not what is on the disk"
    for name in ("markers.parquet", "clock.parquet"):
        try:
            pq.read_table(folder / name, page_checksum_verification=True)
        except (pa.ArrowException, OSError) as error:
            yield f"{name} is damaged: {error}"


def _rows_are_the_ledgers(facts: Facts, rows: list[Columns]) -> Iterator[str]:
    for number, (part, columns) in enumerate(zip(facts.ledger["parts"], rows, strict=True)):
        seq = columns["seq"].astype(np.int64)
        if len(seq) != part["recorded"]:
            yield f"part {number} has {len(seq)} rows, the ledger {part['recorded']}"
        if not len(seq):
            continue
        if seq[0] < part["seq_first"] or seq[-1] > part["seq_last"]:
            yield f"part {number} has frames {seq[0]} to {seq[-1]}, outside of {part}"
        if (np.diff(seq) < 1).any():
            yield f"part {number}: seq does not rise"
        gaps = part["seq_last"] - part["seq_first"] + 1 - len(seq)
        if gaps != sum(part["lost"].values()) + part["pending"]:
            yield f"part {number} lacks {gaps} frames, which the ledger does not say"
        if (np.diff(columns["t_mono_ns"]) <= 0).any():
            yield f"part {number}: time does not rise"
        if len(np.unique(columns["t_ns"] - columns["t_mono_ns"])) != 1:
            yield f"part {number}: its clock has no single anchor"


# --- against the witness --------------------------------------------------------------------------


def _safely_before_stop_s(facts: Facts) -> float:
    if facts.stop_sigma_s is None:  # of frames that had come the harness knows by their promise
        return facts.witness.newest_promised_s(facts.stopped_s)
    return facts.stopped_s - _STOP_S - 2 * facts.stop_sigma_s


def _nothing_promised_is_missing(facts: Facts, rows: list[Columns]) -> Iterator[str]:
    parts = facts.ledger["parts"]
    before_s = _safely_before_stop_s(facts)
    for stream_id, promised in facts.witness.acknowledged().items():
        taken = facts.witness.frames(stream_id, before_s)
        if taken is None:
            continue
        mine = [number for number, part in enumerate(parts) if part["stream_id"] == stream_id]
        wanted = np.intersect1d(promised, taken["seq"])
        if mine:
            if mine[0] == 0:  # before that it was not recorded
                wanted = wanted[wanted >= parts[0]["seq_first"]]
        else:
            earlier = facts.witness.last_seq(stream_id, facts.started_s)
            wanted = wanted if earlier is None else wanted[wanted > earlier]
        here = [rows[number]["seq"] for number in mine]
        missing = np.setdiff1d(wanted, np.concatenate([np.array([], np.uint64), *here]))
        if len(missing):
            yield (
                f"{len(missing)} acknowledged frames are lost, {missing[0]} to {missing[-1]} of "
                f"stream {stream_id}"
            )


def _content_is_what_was_taken(facts: Facts, rows: list[Columns]) -> Iterator[str]:
    for number, (part, sealed) in enumerate(zip(facts.ledger["parts"], rows, strict=True)):
        if not len(sealed["seq"]):
            continue
        for whose, taken in (
            ("what went over the link", facts.witness.frames(part["stream_id"])),
            ("the node's journal", facts.kept_by_node.get(part["stream_id"])),
        ):
            if taken is None:
                continue
            _, here, there = np.intersect1d(sealed["seq"], taken["seq"], return_indices=True)
            for name, values in sealed.items():
                if name in taken and not np.array_equal(values[here], taken[name][there]):
                    differ = values[here] != taken[name][there]
                    count = np.count_nonzero(differ.reshape(len(here), -1).any(axis=1))
                    yield f"part {number}: {name} of {count} frames is not that of {whose}"


def _losses_are_allowed(facts: Facts) -> Iterator[str]:
    full = facts.story.small_disk_of == "node"
    for number, part in enumerate(facts.ledger["parts"]):
        stream_id, lost = part["stream_id"], dict(part["lost"])
        if full:
            lost.pop("disk_full", None)
        end, tail = facts.ends.get(stream_id), part["max_lost_tail_frames"]
        bound = bound_frames(facts, stream_id)
        allowed = bound if end is not None and end.how == "power" else 0
        if sum(lost.values()) > allowed:
            yield f"part {number} lost {lost}, where {allowed} may be: {end}"
        # The stated bound remembers how long frames had to wait before.
        stated = allowed
        if allowed and end is not None and end.longest_wait_s:
            waited_s = end.longest_wait_s + _WAIT_SLACK_S
            stated = max(allowed, math.ceil(facts.rate_hz * (waited_s + _BATCH_S)))
        if tail > stated:
            yield f"part {number}: max_lost_tail_frames {tail} is more than {stated}: {end}"
        seen = facts.witness.last_seq(stream_id, _safely_before_stop_s(facts))
        known = [seq for seq in (seen, _taken_by_node(facts, stream_id)) if seq is not None]
        if known and not full and part["seq_last"] + tail < max(known):
            yield (
                f"part {number} ends with {part['seq_last']} and at most {tail} more, but "
                f"{max(known)} was taken: {end}"
            )


def _taken_by_node(facts: Facts, stream_id: str) -> int | None:
    """The last frame of a stream that ended before the session was stopped, if it is known."""
    end = facts.ends.get(stream_id)
    return end.last_seq if end is not None and end.at_s < facts.stopped_s else None


def _streams_are_all_there(facts: Facts) -> Iterator[str]:
    """Each stream of which frames were taken while it was recorded is a part."""
    named = {part["stream_id"] for part in facts.ledger["parts"]} | facts.elsewhere
    first = facts.ledger["parts"][0]["stream_id"] if facts.ledger["parts"] else None
    order = [*facts.witness.infos]
    before = set(order[: order.index(first)]) if first in order else set()
    promised = facts.witness.acknowledged()
    for stream_id in sorted({*order, *facts.kept_by_node} - named - before):
        seen = facts.witness.last_seq(stream_id, _safely_before_stop_s(facts))
        known = [seq for seq in (seen, _taken_by_node(facts, stream_id)) if seq is not None]
        end = facts.ends.get(stream_id)
        if not known or (
            # Nobody may know of what began less than half a second before the power failed.
            end is not None
            and end.how == "power"
            and stream_id not in promised
            and max(known) < facts.rate_hz * (_SYNC_S + _BATCH_S)
        ):
            continue
        yield f"stream {stream_id} was taken while it was recorded, and is no part of it: {end}"


def _begins_with_the_start(facts: Facts) -> Iterator[str]:
    parts = facts.ledger["parts"]
    if not parts:
        yield "the session has no part"
        return
    before = facts.witness.last_seq(parts[0]["stream_id"], facts.started_s)
    if before is not None and parts[0]["seq_first"] > before + 1:
        yield f"it begins with {parts[0]['seq_first']}; when it was started {before} was there"
    if facts.story.alone and parts[0]["seq_first"] != 0:
        yield f"the node records from its start on, and the session begins with {parts[0]}"


def _verified(facts: Facts) -> Iterator[str]:
    is_lossy = facts.ledger["lossy"] or facts.lossy_elsewhere
    expected = _LOSSY if is_lossy else _GOOD
    if facts.verify_code != expected:
        yield f"foottile verify ended with {facts.verify_code}: {facts.verify_said[-500:]}"


_CHECKS = (
    *(_file_is_the_one_it_says, _losses_are_allowed, _streams_are_all_there),
    *(_begins_with_the_start, _verified),
)


def summary_of(ledger: dict[str, Any]) -> str:
    """Recorded/lost/pending/tail of each part."""
    return "  ".join(
        f"{part['recorded']}/{sum(part['lost'].values())}/{part['pending']}"
        f"/{part['max_lost_tail_frames']}"
        for part in ledger.get("parts", ())
    )
