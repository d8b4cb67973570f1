"""Proves one segment of a journal as it lies on the disk; nothing is mended.

It may be written meanwhile, or have been until the power failed: behind the last batch of a segment
that was not closed there may be half a batch, and its index may name some that never came to the
disk. Those were never promised. Everything else has to agree with its checksum.
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
    batches_in,
    end_of,
    is_closed,
    is_whole,
    messages_from,
    numbers,
    payload_of,
    read_header,
    read_index,
)
from storage.schema import array_info, older_wire_schema, wire_schema
from storage.wire import decode


@dataclass
class SegmentReport:
    """What one segment proves.

    Attributes:
        path: the segment.
        held: numbers of frames whose bytes agree with their checksum.
        damaged: numbers of frames whose bytes do not.
        unsynced: numbers that the index names at the end of a segment that was not closed, and that
            are not on the disk: they were never promised.
        is_closed: was it closed in order?
        info: the array it is of; None if that cannot be read.
        index: records of the batches that are held.
        problems: what is wrong with it.
        remarks: what a person should know, and is no damage.
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
        """As JSON has it (docs/formats.md)."""
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
    """Check every batch of a segment.

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
        # In this order, for a writer appends to the segment first: what was there before the
        # index was read, and is not in the index, is one batch at most.
        size = path.stat().st_size
        index: Records | None = read_index(path)
    except FileNotFoundError:
        if not path.exists():
            raise
        index = None
    report.is_closed = index is not None and is_closed(index)
    schema, header_bytes = _schema_of(path, report)
    if schema is None:
        # A segment just begun when the power failed may be empty; one with frames may not.
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
    _check_batches(report, index, schema, header_bytes)
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


def _check_batches(
    report: SegmentReport, index: Records, schema: pa.Schema, header_bytes: int
) -> None:
    doubtful, said = Intervals(), list[str]()
    good = []
    end, info = header_bytes, array_info(schema, where="")
    descriptor = os.open(report.path, os.O_RDONLY)
    try:
        for at, record in enumerate(index):
            if not is_whole(record):
                said.append(f"record {at} of its index is damaged")
                continue
            if not record["count"]:
                continue
            first, last = numbers(record)
            payload = payload_of(descriptor, record)
            if payload is None:
                said.append(f"frames {first} to {last} do not agree with their checksum")
                doubtful.add(first, last)
                continue
            # Damage followed by a good batch happened after writing.
            report.damaged, doubtful = report.damaged | doubtful, Intervals()
            report.problems += said
            said = []
            wrong = _wrong_in(payload, record, schema, info)
            if int(record["offset"]) < end:
                wrong = "they stand where other frames stand as well"
            end = int(record["offset"]) + int(record["length"])
            if not wrong and report.held.within(first, last):
                wrong = "they are in it twice"
            if wrong:
                report.problems.append(f"frames {first} to {last}: {wrong}")
                continue
            report.held.add(first, last)
            good.append(at)
    finally:
        os.close(descriptor)
    report.index = index[good]
    if report.is_closed:
        report.damaged = report.damaged | doubtful
        report.problems += said
    elif said:
        report.unsynced = doubtful
        report.remarks.append(
            f"{len(said)} batches at its end were not yet on the disk: they were never promised"
        )


def _wrong_in(payload: bytes, record: np.void, schema: pa.Schema, info: ArrayInfo) -> str:
    """Why the bytes are not what the index says; empty if they are."""
    try:
        batch = decode(payload, schema)
    except FileFormatError as error:
        return error.what
    if (int(batch.seq[0]), len(batch)) != (int(record["seq_first"]), int(record["count"])):
        return f"the batch holds {len(batch)} frames from {int(batch.seq[0])} on"
    if (int(batch.t_ns[0]), int(batch.t_ns[-1])) != (record["t_ns_first"], record["t_ns_last"]):
        return "the index says other instants than the batch"
    return broken_rule(batch, info)


def _holds_any(path: Path, index: Records) -> bool:
    """Does any batch in the segment agree with the index?"""
    with path.open("rb") as file:
        batches = batches_in(index)
        return any(payload_of(file.fileno(), record) is not None for record in batches)


def _schema_of(path: Path, report: SegmentReport) -> tuple[pa.Schema | None, int]:
    """Schema that a segment should begin with, and how many bytes it takes; None: it has none."""
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
