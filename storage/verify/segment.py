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
from storage.frame_rules import broken_rule
from storage.intervals import Intervals
from storage.journal.segment_format import (
    INDEX_SUFFIX,
    RECORD,
    Records,
    are_whole,
    batches_in,
    end_of,
    is_closed,
    is_whole,
    messages_from,
    numbers,
    payload_of,
    read_header,
    read_index,
    run_of,
)
from storage.run import RunReader
from storage.schema import array_info, older_wire_schema, wire_schema
from storage.wire import decode

_RUN_BATCHES = 256
"""Batches that are checked together: some thousand frames."""


@dataclass
class SegmentReport:
    """Result of the verification of a segment.

    Attributes:
        path: the segment.
        held: numbers of frames whose bytes match their checksum.
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
    held: Intervals = field(default_factory=Intervals)
    damaged: Intervals = field(default_factory=Intervals)
    unsynced: Intervals = field(default_factory=Intervals)
    is_closed: bool = False
    info: ArrayInfo | None = None
    index: Records = field(default_factory=lambda: np.zeros(0, RECORD))
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        return {
            "node": self.info.node if self.info is not None else None,
            "boot_id": self.info.boot_id if self.info is not None else None,
            "frames": self.held.count,
            "held": list(self.held),
            "damaged": list(self.damaged),
            "unsynced": self.unsynced.count,
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
        index: Records | None = read_index(path)
    except FileNotFoundError:
        if not path.exists():
            raise
        index = None
    report.is_closed = index is not None and is_closed(index)
    schema, header_bytes = _schema_of(path, report)
    if schema is None:
        # A segment that was created just before a power cut may be empty; one with frames may not.
        if report.is_closed or (index is not None and _holds_any(path, index)):
            report.problems.append("it does not begin with the description of an array")
        return
    if index is None:
        if size > header_bytes:
            report.problems.append(
                f"its index {path.with_suffix(INDEX_SUFFIX).name} is missing: nothing proves its "
                "frames; it is rebuilt when the journal is next opened"
            )
        return
    _Batches(report, schema, header_bytes).check(index)
    end = max(header_bytes, end_of(batches_in(index)))
    behind, at = 0, end
    for message in messages_from(path, end, schema):
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


class _Batches:
    """Verifier of the batches of one segment, in the order of its index.

    Args:
        report: findings are added here.
        schema: schema of the segment.
        header_bytes: offset of its first batch.
    """

    def __init__(self, report: SegmentReport, schema: pa.Schema, header_bytes: int) -> None:
        self._report = report
        self._runs = RunReader(schema)
        self._info = array_info(schema, where="")
        self._end = header_bytes
        self._doubtful = Intervals()
        self._said: list[str] = []
        """Messages since the last undamaged batch."""

    def check(self, index: Records) -> None:
        """Verify all batches of the index."""
        report, undamaged = self._report, [np.zeros(0, RECORD)]
        if report.is_closed:
            index = index[:-1]
        with report.path.open("rb") as file:
            for begin in range(0, len(index), _RUN_BATCHES):
                records = index[begin : begin + _RUN_BATCHES]
                if self._is_right(file.fileno(), records):
                    undamaged.append(records)
                    continue
                for at, record in enumerate(records):
                    if self._is_good(file.fileno(), record, begin + at):
                        undamaged.append(records[at : at + 1])
        report.index = np.concatenate(undamaged)
        if report.is_closed:
            report.damaged = report.damaged | self._doubtful
            report.problems += self._said
        elif self._said:
            report.unsynced = self._doubtful
            report.remarks.append(
                f"{len(self._said)} batches at its end were not yet on the disk: they were never "
                "promised"
            )

    def _is_right(self, descriptor: int, records: Records) -> bool:
        """Return whether a group of batches is undamaged; otherwise nothing is recorded."""
        offset, length = records["offset"], records["length"].astype(np.uint64)
        is_joined = bool((offset[1:] == (offset + length)[:-1]).all())
        first, last = numbers(records[0])[0], numbers(records[-1])[1]
        if not is_joined or offset[0] < self._end or not are_whole(records).all():
            return False
        content = os.pread(descriptor, int(length.sum()), int(offset[0]))
        frames = self._runs.read(run_of(records, content))
        if frames is None or self._report.held.within(first, last):
            return False
        ends = np.cumsum(records["count"], dtype=np.int64)
        t_ns_first, t_ns_last = frames.t_ns[ends - records["count"]], frames.t_ns[ends - 1]
        if (t_ns_first != records["t_ns_first"]).any() or (t_ns_last != records["t_ns_last"]).any():
            return False
        if broken_rule(frames, self._info):
            return False
        self._report.held.add_stretches(records["seq_first"], records["count"])
        self._found_whole()
        self._end = int(offset[-1] + length[-1])
        return True

    def _is_good(self, descriptor: int, record: np.void, at: int) -> bool:
        """Verify one batch; return whether it is undamaged and its frames belong there."""
        report = self._report
        if not is_whole(record):
            self._said.append(f"record {at} of its index is damaged")
            return False
        if not record["count"]:
            return False
        first, last = numbers(record)
        payload = payload_of(descriptor, record)
        if payload is None:
            self._said.append(f"frames {first} to {last} do not agree with their checksum")
            self._doubtful.add(first, last)
            return False
        self._found_whole()
        wrong = _wrong_in(payload, record, self._runs.schema, self._info)
        if int(record["offset"]) < self._end:
            wrong = "they overlap other frames"
        self._end = int(record["offset"]) + int(record["length"])
        if not wrong and report.held.within(first, last):
            wrong = "they are in it twice"
        if wrong:
            report.problems.append(f"frames {first} to {last}: {wrong}")
            return False
        report.held.add(first, last)
        return True

    def _found_whole(self) -> None:
        """Report pending damage: a good batch behind it shows that it happened after writing."""
        self._report.damaged = self._report.damaged | self._doubtful
        self._report.problems += self._said
        self._doubtful, self._said = Intervals(), []


def _wrong_in(payload: bytes, record: np.void, schema: pa.Schema, info: ArrayInfo) -> str:
    """Return a message where the bytes contradict the index; empty if they do not."""
    try:
        batch = decode(payload, schema)
    except FileFormatError as error:
        return error.what
    if (int(batch.seq[0]), len(batch)) != (int(record["seq_first"]), int(record["count"])):
        return f"the batch holds {len(batch)} frames from {int(batch.seq[0])} on"
    if (int(batch.t_ns[0]), int(batch.t_ns[-1])) != (record["t_ns_first"], record["t_ns_last"]):
        return "the index has other instants than the batch"
    return broken_rule(batch, info)


def _holds_any(path: Path, index: Records) -> bool:
    """Return whether any batch in the segment matches the index."""
    with path.open("rb") as file:
        batches = batches_in(index)
        return any(payload_of(file.fileno(), record) is not None for record in batches)


def _schema_of(path: Path, report: SegmentReport) -> tuple[pa.Schema | None, int]:
    """Return a segment's expected schema and the length of its header; None: it has none."""
    schema, length = read_header(path)
    if schema is None:
        return None, 0
    try:
        report.info = array_info(schema, where=str(path))
    except FileFormatError as error:
        if isinstance(error, DamagedFileError):
            report.problems.append(error.what)
        return None, 0
    expected, older = wire_schema(report.info), older_wire_schema(report.info)
    if not any(schema.equals(one, check_metadata=True) for one in (expected, older)):
        report.problems.append("its columns are not those of a stream of frames")
    return expected, length
