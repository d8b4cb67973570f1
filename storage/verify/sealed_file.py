"""Verification of a sealed file by itself: its bytes, content, frame order and counts.

Facts that only `session.json` beside it could prove are listed in `unproven`. Exports are
recognised: files made from a session, which prove nothing themselves.
"""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import TypeAdapter, ValidationError

from devices.errors import FileFormatError
from storage.intervals import Intervals, Losses, LossPairs, union
from storage.parquet_hash import (
    HashPair,
    footer_stated_and_actual_hash,
    read_footer_or_empty,
    read_stated_and_actual_hash,
)
from storage.schema import COLUMNS_BY_NAME
from storage.sessions.folder import Ledger, Part, PartLedger
from storage.sessions.footer import ContentDigest
from storage.sessions.ledger import PartFrameSummary
from storage.sessions.reader import SealedFileReader
from storage.sessions.writer import EXPORT_COLUMN, EXPORT_KEY

_LOST = TypeAdapter(dict[str, LossPairs])
_PARTS = TypeAdapter(tuple[Part, ...])
_MAX_LISTED_GAPS = 2


@dataclass
class SealedFileReport:
    """Result of the verification of a sealed file.

    Attributes:
        path: the file.
        problems: messages of damage; empty: it is undamaged.
        unproven: facts that the file itself cannot prove.
        notes: notes about its session; empty if they cannot be read.
        ledger: the file's ledger; counted from the frames if it has none.
        parts: its frames, by part.
        frame_count: number of frames.
    """

    path: Path
    problems: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    ledger: Ledger | None = None
    parts: list[PartFrameSummary] = field(default_factory=list)
    frame_count: int = 0

    @property
    def session(self) -> dict[str, Any]:
        """Facts about the session in the file's notes."""
        content = self.notes.get("session")
        return content if isinstance(content, dict) else {}


def verify_sealed_file(path: Path) -> SealedFileReport:
    """Read a complete sealed file and verify it against its hashes and its ledger.

    Args:
        path: the file; it is never written.

    Raises:
        FileFormatError: there is no such file, or it is no sealed session.
    """
    report = SealedFileReport(path)
    hashes = _read_hashes(path)
    if hashes is not None and hashes.stated != hashes.actual:
        report.problems.append(
            "its bytes have changed since it was sealed, by the hash in its footer"
        )
    elif hashes is not None:
        own = footer_stated_and_actual_hash(read_footer_or_empty(path))
        if own is None or own[0] != own[1]:
            report.problems.append("its footer's own hash is of another footer")
    try:
        with SealedFileReader(path, skip_verification=True) as reader:
            _verify_content(reader, report, has_file_hash=hashes is not None)
    except FileFormatError as error:
        if not report.problems and not _was_sealed_session(path):
            raise
        report.problems.append(error.what)
    except Exception as error:  # damaged bytes may cause any error
        report.problems.append(f"it cannot be read: {error}")
    else:
        _check_ledger(report)
    return report


def find_ledger_mismatches(
    parts: list[PartFrameSummary], ledger: Ledger, lost_by_stream: dict[str, Losses]
) -> list[str]:
    """Return messages where a ledger does not fit the frames.

    Args:
        parts: the frames.
        ledger: the ledger.
        lost_by_stream: lost numbers by stream_id; of a stream without an entry only the count is
            checked against the gaps.
    """
    problems = find_ledger_contradictions(ledger)
    by_number = {part.part: part for part in parts}
    for strange in sorted(set(by_number) - set(range(len(ledger.parts)))):
        problems.append(f"there are frames of part {strange}, which is not in the ledger")
    for number, stated in enumerate(ledger.parts):
        found = by_number.get(number)
        frames = found.frames if found is not None else 0
        name = f"part {number}"
        if frames != stated.recorded:
            problems.append(f"{name}: {frames} frames, and the ledger has {stated.recorded}")
        held = found.numbers if found is not None else Intervals()
        span = Intervals([(stated.seq_first, stated.seq_last)] if _part_length(stated) else [])
        if beyond := held - span:
            first, last = next(iter(beyond))
            problems.append(
                f"{name}: frames {first} to {last} are outside of its range {stated.seq_first} to "
                f"{stated.seq_last}"
            )
        gaps = span - held
        accounted = sum(stated.lost.values()) + stated.pending
        if gaps.number_count != accounted:
            problems.append(
                f"{name}: {gaps.number_count} frames are missing ({_format_numbers(gaps)}), and "
                f"the ledger accounts for {accounted}"
            )
        if stated.stream_id in lost_by_stream:
            unnamed = gaps - lost_by_stream[stated.stream_id].numbers
            if unnamed and not stated.pending:
                problems.append(
                    f"{name}: frames {_format_numbers(unnamed)} are missing and not named lost"
                )
    return problems


def find_ledger_contradictions(ledger: Ledger) -> list[str]:
    """Return messages where a ledger contradicts itself."""
    problems = []
    for number, part in enumerate(ledger.parts):
        counted = part.recorded + sum(part.lost.values()) + part.pending
        if (
            counted != _part_length(part)
            or min(part.recorded, part.pending, *part.lost.values(), 0) < 0
        ):
            problems.append(
                f"part {number}: the ledger counts {counted} frames, and {part.seq_first} to "
                f"{part.seq_last} are {_part_length(part)}"
            )
    lossy = any(any(part.lost.values()) or part.max_lost_tail_frames for part in ledger.parts)
    if lossy != ledger.lossy:
        problems.append(f"the ledger says lossy: {ledger.lossy}, and its parts say {lossy}")
    if ledger.complete and (lossy or any(part.pending for part in ledger.parts)):
        problems.append("the ledger says that it is complete, and its parts say that it is not")
    return problems


def parse_lost_numbers(notes: dict[str, Any]) -> dict[str, Losses]:
    """Parse the lost numbers in a file's notes, by stream_id.

    Raises:
        FileFormatError: they cannot be parsed.
    """
    try:
        by_stream = _LOST.validate_python(notes.get("lost"))
        return {stream_id: Losses(pairs) for stream_id, pairs in by_stream.items()}
    except (ValidationError, ValueError) as error:
        raise FileFormatError(f"the numbers that are lost are not readable: {error}") from error


def _read_hashes(path: Path) -> HashPair | None:
    try:
        return read_stated_and_actual_hash(path)
    except OSError as error:
        raise FileFormatError(
            f"cannot be read: {error.strerror}", where=str(path), expected="a sealed session"
        ) from error


def _verify_content(
    reader: SealedFileReader, report: SealedFileReport, *, has_file_hash: bool
) -> None:
    report.notes = reader.notes
    digest = ContentDigest()
    try:
        for table in reader.read_tables():
            digest.add_table_and_collect_disorder(table)
    except (KeyError, ValueError, TypeError) as error:
        if isinstance(error, FileFormatError):
            raise
        raise FileFormatError(f"its columns cannot be read: {error}") from error
    report.parts = digest.order.parts
    report.frame_count = sum(part.frames for part in report.parts)
    report.problems += digest.order.problems
    report.problems += _find_content_mismatches(reader.content, digest.describe_content())
    if not has_file_hash:
        report.problems.append("it has no hashes: another program has rewritten it")
    _check_offset(report, reader.info.utc_offset_ns)


def _was_sealed_session(path: Path) -> bool:
    """Return whether it was a sealed session; if so it is reported as damaged, not as foreign."""
    try:
        with pq.ParquetFile(path) as file:
            metadata = file.schema_arrow.metadata or {}
    except Exception:  # unreadable: only the name is left to recognise it
        return path.name == "frames.parquet"
    return any(key.startswith(b"foottile.") for key in metadata)


def _find_content_mismatches(stated: dict[str, Any], found: dict[str, Any]) -> list[str]:
    problems = []
    if stated.get("frames") != found["frames"]:
        problems.append(f"{found['frames']} frames, and {stated.get('frames')} were sealed")
    if stated.get("parts") != found["parts"]:
        problems.append("the ranges of its parts have changed since it was sealed")
    stated_columns, found_columns = stated.get("columns", {}), found["columns"]
    if list(stated_columns) != list(found_columns):
        added = sorted(set(found_columns) - set(stated_columns))
        gone = sorted(set(stated_columns) - set(found_columns))
        changes = {"added": added, "gone": gone}.items()
        shown = "; ".join(f"{how}: {', '.join(names)}" for how, names in changes if names)
        problems.append(f"its columns have changed since it was sealed ({shown})")
    changed = [
        name
        for name in found_columns
        if name in stated_columns and found_columns[name] != stated_columns[name]
    ]
    if changed:
        shown = ", ".join(changed[:6]) + (" ..." if len(changed) > 6 else "")
        problems.append(f"the values of {shown} have changed since it was sealed")
    return problems


def _check_offset(report: SealedFileReport, utc_offset_ns: int) -> None:
    """Check part 0, whose stream the file describes; later parts have their own anchors."""
    first = next((part for part in report.parts if part.part == 0), None)
    if first is not None and first.offset_ns != utc_offset_ns:
        report.problems.append(
            f"part 0: t_ns - t_mono_ns is {first.offset_ns}, and the array's anchor {utc_offset_ns}"
        )


def _check_ledger(report: SealedFileReport) -> None:
    """Check the frames against the ledger in the notes, or count a ledger from the frames."""
    stated = report.notes.get("ledger")
    if stated is None:
        gaps = union(part.gaps for part in report.parts)
        if gaps:
            report.problems.append(
                f"frames {_format_numbers(gaps)} are missing, and nothing says why: it has no "
                "ledger"
            )
        report.ledger = Ledger(
            complete=not gaps,
            lossy=bool(gaps),
            parts=tuple(
                PartLedger(
                    stream_id="",
                    seq_first=part.seq_first,
                    seq_last=part.seq_last,
                    recorded=part.frames,
                    lost={"unknown": part.gaps.number_count} if part.gaps else {},
                    pending=0,
                )
                for part in report.parts
            ),
            missed_slots=0,
        )
        report.unproven.append("begin and end of its recording: it is of no recorded session")
        return
    try:
        report.ledger = Ledger.model_validate(stated)
        lost = parse_lost_numbers(report.notes)
        parts = _PARTS.validate_python(report.session.get("parts"))
    except (ValidationError, FileFormatError) as error:
        report.problems.append(f"its ledger is not readable: {error}")
        return
    report.problems += find_ledger_mismatches(report.parts, report.ledger, lost)
    intervals = [(p.stream_id, p.seq_first, p.seq_last) for p in parts]
    if intervals != [(p.stream_id, p.seq_first, p.seq_last) for p in report.ledger.parts]:
        report.problems.append("its ledger is of other parts than its session")


def _part_length(part: PartLedger) -> int:
    return max(0, part.seq_last - part.seq_first + 1)


def _format_numbers(numbers: Intervals) -> str:
    pairs = list(numbers)
    shown = ", ".join(str(a) if a == b else f"{a} to {b}" for a, b in pairs[:_MAX_LISTED_GAPS])
    return shown + (
        f" and {len(pairs) - _MAX_LISTED_GAPS} more gaps" if len(pairs) > _MAX_LISTED_GAPS else ""
    )


RECOGNISED_FORMATS = frozenset({"parquet", "arrow", "csv"})
"""Export formats that are recognised."""
_ARROW_BEGIN = b"ARROW1\0\0"
_HEADER_MAX = 1 << 20
_SEMICOLONS = re.compile(r'"[^";,]*";')
_TILE_COLUMN = re.compile("|".join(f"{c.name}_." for c in COLUMNS_BY_NAME.values() if c.per_tile))
"""Column of one tile: the quantity, then number or serial."""


@dataclass
class ExportReport:
    """Facts about an export.

    Attributes:
        path: the file.
        format: format of the file.
        source: session, hashes of its file, and selection; empty if the export states none.
        problems: messages of damage; empty: it can be read to its end.
    """

    path: Path
    format: str
    source: dict[str, Any] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        return {
            "export": self.format,
            "source": self.source,
            "proves": [],
            "problems": self.problems,
        }


def recognise_export_and_check_not_cut_off(path: Path) -> ExportReport | None:
    """Recognise an export; read Parquet and Arrow to their end, and both ends of CSV.

    Returns:
        None if it is no export: a sealed session, another file, or too damaged to tell.
    """
    with path.open("rb") as file:
        begin = file.read(4)
    if begin == b"PAR1":
        return _read_parquet_export(path)
    if begin == _ARROW_BEGIN[:4]:
        return _read_arrow_export(path)
    return _read_csv_export(path)


def _read_parquet_export(path: Path) -> ExportReport | None:
    try:
        file = pq.ParquetFile(path, page_checksum_verification=True)
        metadata = file.schema_arrow.metadata or {}
    except Exception:  # damaged bytes may cause any error
        return None
    with file:
        if EXPORT_KEY not in metadata:
            return None
        report = ExportReport(path, "parquet", _parse_source(metadata))
        try:
            for group in range(file.num_row_groups):
                file.read_row_group(group)
        except Exception as error:  # damaged bytes may cause any error
            report.problems.append(f"it cannot be read: {error}")
    return report


def _read_arrow_export(path: Path) -> ExportReport | None:
    try:
        with pa.OSFile(str(path), "r") as file:
            file.seek(len(_ARROW_BEGIN))  # a stream begins there, which needs no footer
            with pa.ipc.open_stream(file) as stream:
                metadata = stream.schema.metadata or {}
            if EXPORT_KEY not in metadata:
                return None
            report = ExportReport(path, "arrow", _parse_source(metadata))
            try:
                with pa.ipc.open_file(file) as whole:
                    for i in range(whole.num_record_batches):
                        whole.get_batch(i).validate()
            except Exception as error:  # damaged bytes may cause any error
                report.problems.append(f"it cannot be read: {error}")
    except Exception:  # damaged bytes may cause any error
        return None
    return report


def _read_csv_export(path: Path) -> ExportReport | None:
    with path.open("rb") as file:
        lines = [file.readline(_HEADER_MAX) for _ in range(2)]
    try:
        header, row = (line.decode("utf-8").rstrip("\r\n") for line in lines)
        between = ";" if _SEMICOLONS.match(header) else ","
        names, *cells = csv.reader([header, row] if row else [header], delimiter=between)
    except (UnicodeDecodeError, ValueError, csv.Error):
        return None
    known_names = {*COLUMNS_BY_NAME, EXPORT_COLUMN}
    if not names or not all(name in known_names or _TILE_COLUMN.match(name) for name in names):
        return None
    first = dict(zip(names, *cells, strict=False)) if cells else {}
    report = ExportReport(path, "csv", _parse_json_object(first.get(EXPORT_COLUMN, "")))
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        if file.read() != b"\n":
            report.problems.append("its last row is cut off; export it again")
    return report


def _parse_source(metadata: dict[bytes, bytes]) -> dict[str, Any]:
    return _parse_json_object(metadata.get(EXPORT_KEY, b""))


def _parse_json_object(text: str | bytes) -> dict[str, Any]:
    try:
        source = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return source if isinstance(source, dict) else {}
