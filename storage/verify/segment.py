"""Verification of one segment of a journal; nothing is repaired.

A writer may be appending, or a power cut may have stopped it: then an unclosed segment may end with
half a batch, and its index may have records of batches that never came to the disk. Those were
never promised. Everything else has to match its checksum.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from devices.errors import DamagedFileError, FileFormatError
from devices.frames import ArrayInfo
from storage.frame_rules import describe_first_broken_rule
from storage.intervals import Intervals
from storage.journal.segment import (
    INDEX_SUFFIX,
    RECORD_DTYPE,
    Records,
    find_end_offset,
    is_index_closed,
    is_record_intact,
    make_message_batch,
    mask_intact_records,
    read_existing_index,
    read_messages_until_damage,
    read_schema_and_first_offset,
    read_verified_payload,
    select_batch_records_by_checksum,
    seq_range_of,
)
from storage.schema import read_array_info, wire_schema
from storage.wire import MessageBatchDecoder, decode_message

_BATCHES_PER_CHECK = 256
"""Batches that are checked together: some thousand frames."""


@dataclass
class SegmentReport:
    """Result of the verification of a segment.

    Attributes:
        path: the segment.
        stored: numbers of frames whose bytes match their checksum.
        damaged: numbers of frames whose bytes do not.
        unsynced: numbers in the index at the end of an unclosed segment that are not on the disk:
            they were never promised.
        is_closed: True: it was closed in order.
        info: its array; None if that cannot be read.
        index: records of the undamaged batches.
        problems: messages of damage.
        remarks: other messages for people.
    """

    path: Path
    stored: Intervals = field(default_factory=Intervals)
    damaged: Intervals = field(default_factory=Intervals)
    unsynced: Intervals = field(default_factory=Intervals)
    is_closed: bool = False
    info: ArrayInfo | None = None
    index: Records = field(default_factory=lambda: np.zeros(0, RECORD_DTYPE))
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        return {
            "node": self.info.node if self.info is not None else None,
            "stream_id": self.info.stream_id if self.info is not None else None,
            "frames": self.stored.number_count,
            "held": list(self.stored),
            "damaged": list(self.damaged),
            "unsynced": self.unsynced.number_count,
            "closed": self.is_closed,
            "problems": self.problems,
        }


def verify_segment(path: Path) -> SegmentReport:
    """Verify every batch of a segment.

    Raises:
        FileFormatError: there is no such file.
    """
    report = SegmentReport(path)
    for each in (path, path.with_suffix(INDEX_SUFFIX)):
        if os.path.lexists(each) and (each.is_symlink() or not each.is_file()):
            report.problems.append(f"{each.name} is not a file")
            return report
    try:
        _verify(path, report)
    except FileNotFoundError as error:  # or deleted meanwhile
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except Exception as error:  # damaged bytes may cause any error
        report.problems.append(f"it cannot be read: {error}")
    return report


def _verify(path: Path, report: SegmentReport) -> None:
    try:
        # In this order, since a writer appends to the segment first: at most one batch of this
        # size has no record in the index that is read after it.
        size = path.stat().st_size
        index: Records | None = read_existing_index(path)
    except FileNotFoundError:
        if not path.exists():
            raise
        index = None
    report.is_closed = index is not None and is_index_closed(index)
    schema, header_bytes = _read_schema(path, report)
    if schema is None:
        # A segment that was created just before a power cut may be empty; one with frames may not.
        if report.is_closed or (index is not None and _has_any_batch(path, index)):
            report.problems.append("it does not begin with the description of an array")
        return
    if index is None:
        if size > header_bytes:
            report.problems.append(
                f"its index {path.with_suffix(INDEX_SUFFIX).name} is missing: nothing proves its "
                "frames; it is rebuilt when the journal is next opened"
            )
        return
    _BatchVerifier(report, schema, header_bytes).verify(index)
    end = max(header_bytes, find_end_offset(select_batch_records_by_checksum(index)))
    behind, at = 0, end
    for message in read_messages_until_damage(path, end, schema):
        at += len(message.payload)
        if at > size:
            break
        behind += 1
    if report.is_closed and size > end:
        report.problems.append(f"{size - end} bytes behind its last batch are in no index")
    elif behind > 1:
        report.problems.append(f"{behind} batches behind its last one are in no index: it was cut")
    elif behind:
        report.remarks.append("a batch behind its last one is in no index")


class _BatchVerifier:
    """Verifier of the batches of one segment, in the order of its index.

    Args:
        report: findings are added here.
        schema: schema of the segment.
        header_bytes: offset of its first batch.
    """

    def __init__(self, report: SegmentReport, schema: pa.Schema, header_bytes: int) -> None:
        self._report = report
        self._runs = MessageBatchDecoder(schema)
        self._info = read_array_info(schema, where="")
        self._end = header_bytes
        self._doubtful = Intervals()
        self._pending_problems: list[str] = []
        """Messages since the last undamaged batch."""

    def verify(self, index: Records) -> None:
        """Verify all batches of the index."""
        report, undamaged = self._report, [np.zeros(0, RECORD_DTYPE)]
        if report.is_closed:
            index = index[:-1]
        with report.path.open("rb") as file:
            for begin in range(0, len(index), _BATCHES_PER_CHECK):
                records = index[begin : begin + _BATCHES_PER_CHECK]
                if self._verify_group(file.fileno(), records):
                    undamaged.append(records)
                    continue
                for at, record in enumerate(records):
                    if self._verify_batch(file.fileno(), record, begin + at):
                        undamaged.append(records[at : at + 1])
        report.index = np.concatenate(undamaged)
        if report.is_closed:
            report.damaged = report.damaged | self._doubtful
            report.problems += self._pending_problems
        elif self._pending_problems:
            report.unsynced = self._doubtful
            report.remarks.append(
                f"{len(self._pending_problems)} batches at its end were not yet on the disk: they "
                "were never promised"
            )

    def _verify_group(self, descriptor: int, records: Records) -> bool:
        """Return whether a group of batches is undamaged; otherwise nothing is recorded."""
        offset, length = records["offset"], records["length"].astype(np.uint64)
        is_joined = bool((offset[1:] == (offset + length)[:-1]).all())
        first, last = seq_range_of(records[0])[0], seq_range_of(records[-1])[1]
        if not is_joined or offset[0] < self._end or not mask_intact_records(records).all():
            return False
        content = os.pread(descriptor, int(length.sum()), int(offset[0]))
        frames = self._runs.decode_or_none_if_damaged(make_message_batch(records, content))
        if frames is None or self._report.stored.restricted_to(first, last):
            return False
        ends = np.cumsum(records["count"], dtype=np.int64)
        t_ns_first, t_ns_last = frames.t_ns[ends - records["count"]], frames.t_ns[ends - 1]
        if (t_ns_first != records["t_ns_first"]).any() or (t_ns_last != records["t_ns_last"]).any():
            return False
        if describe_first_broken_rule(frames, self._info):
            return False
        self._report.stored.add_ranges(records["seq_first"], records["count"])
        self._report_pending()
        self._end = int(offset[-1] + length[-1])
        return True

    def _verify_batch(self, descriptor: int, record: np.void, at: int) -> bool:
        """Verify one batch; return whether it is undamaged and its frames belong there."""
        report = self._report
        if not is_record_intact(record):
            self._pending_problems.append(f"record {at} of its index is damaged")
            return False
        if not record["count"]:
            return False
        first, last = seq_range_of(record)
        payload = read_verified_payload(descriptor, record)
        if payload is None:
            self._pending_problems.append(
                f"frames {first} to {last} do not agree with their checksum"
            )
            self._doubtful.add(first, last)
            return False
        self._report_pending()
        wrong = _find_batch_problem(payload, record, self._runs.schema, self._info)
        if int(record["offset"]) < self._end:
            wrong = "they overlap other frames"
        self._end = int(record["offset"]) + int(record["length"])
        if not wrong and report.stored.restricted_to(first, last):
            wrong = "they are in it twice"
        if wrong:
            report.problems.append(f"frames {first} to {last}: {wrong}")
            return False
        report.stored.add(first, last)
        return True

    def _report_pending(self) -> None:
        """Report pending damage: a good batch behind it shows that it happened after writing."""
        self._report.damaged = self._report.damaged | self._doubtful
        self._report.problems += self._pending_problems
        self._doubtful, self._pending_problems = Intervals(), []


def _find_batch_problem(payload: bytes, record: np.void, schema: pa.Schema, info: ArrayInfo) -> str:
    """Return a message where the bytes contradict the index; empty if they do not."""
    try:
        batch = decode_message(payload, schema)
    except FileFormatError as error:
        return error.what
    if (int(batch.seq[0]), len(batch)) != (int(record["seq_first"]), int(record["count"])):
        return f"the batch holds {len(batch)} frames from {int(batch.seq[0])} on"
    if (int(batch.t_ns[0]), int(batch.t_ns[-1])) != (record["t_ns_first"], record["t_ns_last"]):
        return "the index has other instants than the batch"
    return describe_first_broken_rule(batch, info)


def _has_any_batch(path: Path, index: Records) -> bool:
    """Return whether any batch in the segment matches the index."""
    with path.open("rb") as file:
        batches = select_batch_records_by_checksum(index)
        return any(read_verified_payload(file.fileno(), record) is not None for record in batches)


def _read_schema(path: Path, report: SegmentReport) -> tuple[pa.Schema | None, int]:
    """Return a segment's expected schema and the length of its header; None: it has none."""
    schema, length = read_schema_and_first_offset(path)
    if schema is None:
        return None, 0
    try:
        report.info = read_array_info(schema, where=str(path))
    except FileFormatError as error:
        if isinstance(error, DamagedFileError):
            report.problems.append(error.what)
        return None, 0
    expected = wire_schema(report.info)
    if not schema.equals(expected, check_metadata=True):
        report.problems.append("its columns are not those of a stream of frames")
    return expected, length
