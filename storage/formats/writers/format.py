"""Description of an export format: names, capabilities, encoder; and what encoders share.

Formats without structured metadata have them as lines of text.
"""

from __future__ import annotations

import io
import re
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.util import find_spec
from typing import Any

import numpy as np
import pyarrow as pa

from devices.arrays import Floats, Times
from devices.errors import Extra, UsageError, require_extra
from devices.frames import ArrayInfo
from storage.formats.export import Export, read_completeness_and_losses
from storage.schema import COLUMNS_BY_NAME, UNKNOWN_T_NS, Array

TABLE_OPTIONS = ("names", "times")
"""Options of every format that writes `Export.read_tables`."""


@dataclass(frozen=True)
class ExportFormat:
    """Export format of sessions.

    Attributes:
        name: name in requests and commands.
        title: name in menus.
        opened_by: some programs that open it.
        media_type: media type of HTTP.
        encoder: generator of the file's chunks, of one session; see the package.
        group_encoder: generator for several sessions on one time axis; None: one session only.
        suffix: ending of its files, without the dot; empty: the name.
        options: names of the supported fields of `FormatOptions`.
        takes_columns: True if columns can be selected; else they are fixed.
        needs_forces: True if a session without estimates cannot be written.
        needs_sealed: True if only sealed sessions can be written.
        has_markers_by_default: True if markers are included by default.
        frames_max: limit of frames; None: no limit.
        extra: extra that has to be installed; None: none.
        packages: modules of the extra that tell whether it is installed.
    """

    name: str
    title: str
    opened_by: str
    media_type: str
    encoder: Callable[[Sequence[Export]], Iterator[bytes]]
    group_encoder: Callable[[Sequence[Export]], Iterator[bytes]] | None = None
    suffix: str = ""
    options: tuple[str, ...] = ()
    takes_columns: bool = True
    needs_forces: bool = False
    needs_sealed: bool = False
    has_markers_by_default: bool = True
    frames_max: int | None = None
    extra: Extra | None = None
    packages: tuple[str, ...] = ()

    @property
    def ending(self) -> str:
        """Ending of its files, with the dot."""
        return f".{self.suffix or self.name}"

    @property
    def missing(self) -> str | None:
        """Extra that has to be installed; None if the format can be written here."""
        is_here = all(find_spec(package) is not None for package in self.packages)
        return None if is_here else self.extra

    def encode(self, export: Export) -> Iterator[bytes]:
        """Yield the file of one session in chunks.

        Raises:
            UsageError: a column or option is not supported, there are too many frames, or the
                slice begins after the session's end; raised before the first chunk.
        """
        self._check_export(export)
        with self._extra_context():
            yield from self.encoder([export])

    def encode_together_on_server_clock(self, exports: Sequence[Export]) -> Iterator[bytes]:
        """Yield one file of several sessions on one time axis, in chunks.

        Raises:
            UsageError: as for `encode`, for any session; the format holds one session only,
                or a session does not have the server's time.
        """
        if self.group_encoder is None:
            raise UsageError(f"{self.name} holds one session only")
        for export in exports:
            self._check_export(export)
            if export.clock is None:
                raise UsageError(
                    "the nodes' own clocks are no common axis", remedy="Ask for the server's clock"
                )
        with self._extra_context():
            yield from self.group_encoder(exports)

    @property
    def can_hold_several_sessions(self) -> bool:
        """True if one file can hold several sessions."""
        return self.group_encoder is not None

    def _extra_context(self) -> AbstractContextManager[None]:
        if self.extra is None:
            return nullcontext()
        return require_extra(self.extra, f"the format {self.name}")

    def _check_export(self, export: Export) -> None:
        for name in export.options.specified_names:
            if name not in self.options:
                known = ", ".join(self.options)
                raise UsageError(
                    f"{self.name} has no option {name!r}",
                    expected=f"of its options: {known}" if known else "none for this format",
                )
        if export.selection.columns and not self.takes_columns:
            raise UsageError(
                f"{self.name} has fixed columns, and none can be selected",
                remedy="Leave columns out, or ask for Parquet, Arrow or CSV",
            )
        if self.needs_forces and not export.has_forces:
            why = export.notes.get("estimates")
            raise UsageError(
                f"{self.name} holds forces, and this session has none"
                + (f": {why}" if isinstance(why, str) else ""),
                where=export.session_and_node_text,
                remedy="Add them with `foottile estimate`, or ask for its counts as Parquet, "
                "Arrow or CSV",
            )


def make_names_unique(names: Sequence[str]) -> list[str]:
    """Return the names with a number appended to repeated ones, such as `left_2`."""
    unique: list[str] = []
    for name in names:
        number, candidate = 1, name
        while candidate in unique:
            number += 1
            candidate = f"{name}_{number}"
        unique.append(candidate)
    return unique


def get_instants_on_export_clock_ns(export: Export, columns: Mapping[str, Array]) -> Times:
    """Return the instants of frames on the export's clock, int64[n].

    Args:
        export: export of the frames.
        columns: `t_ns`, `part` if the session has parts, `t_server_ns` with the server's clock.

    Raises:
        UsageError: the server's time of some frames is unknown.
    """
    t_ns: Times = (
        export.to_session_axis_ns(columns) if export.clock is None else columns["t_server_ns"]
    )
    unknown = int((t_ns == UNKNOWN_T_NS).sum())
    if unknown:
        raise UsageError(
            f"the server's time is not known for {unknown} frames",
            where=export.session_and_node_text,
            remedy="Ask for the node's clock, or a slice of a part whose clock was compared",
        )
    return t_ns


def to_floats_with_nan(quantity_name: str, values: Array) -> Array:
    """Return a column of any type as float64, NaN where unknown."""
    found = values.astype(np.float64)
    missing = COLUMNS_BY_NAME[quantity_name].missing_value
    if missing is not None:
        found[values == missing] = np.nan
    return found


class DrainedBuffer(io.BytesIO):
    """Buffer of written bytes until they are drained; not seekable."""

    def __init__(self) -> None:
        super().__init__()
        self._drained_bytes = 0

    def seekable(self) -> bool:
        """Return False: drained bytes are gone."""
        return False

    def seek(self, offset: int, whence: int = 0) -> int:
        """Raise UnsupportedOperation: zipfile tries `seek` instead of `seekable`."""
        raise io.UnsupportedOperation("seek")

    def tell(self) -> int:
        """Return the position in the whole file, drained bytes included."""
        return self._drained_bytes + super().tell()

    def drain(self) -> bytes:
        """Remove and return the bytes written since the last call."""
        piece = self.getvalue()
        self._drained_bytes += len(piece)
        super().seek(0)
        self.truncate()
        return piece


def encode_tables(
    tables: Iterator[pa.Table], open_writer: Callable[[DrainedBuffer, pa.Schema], Any]
) -> Iterator[bytes]:
    """Yield a file of tables: a chunk for each table, and a last chunk for the file's end.

    Args:
        tables: at least one table; all have one schema.
        open_writer: function that returns a writer with `write_table` and `close`.
    """
    first = next(tables)
    sink = DrainedBuffer()
    writer = open_writer(sink, first.schema)
    writer.write_table(first)
    yield sink.drain()
    for table in tables:
        writer.write_table(table)
        yield sink.drain()
    writer.close()
    yield sink.drain()


def format_metadata(export: Export, begin_ns: int) -> dict[str, str]:
    """Return the metadata of an export by name, as ASCII text.

    A format that resamples or fills replaces the entries concerned.

    Args:
        export: the export.
        begin_ns: instant of its first sample, on the requested clock.
    """
    about, notes = export.provenance_and_slice_metadata, export.notes
    seconds, rest = divmod(begin_ns, 1_000_000_000)
    begin = datetime.fromtimestamp(seconds, tz=UTC).strftime("%Y-%m-%dT%H:%M:%S")
    clock = "the node's" if export.clock is None else "the server's"
    texts = {
        "SESSION": str(about.get("session") or "none: simulated or estimated by itself"),
        "NODE": export.array_info.node,
        "COMPLETE": _completeness_text(notes, export.provenance),
        "TIME_BASE": str(about["time_base"]),
        "AXES": str(about["axes"]),
        "RESAMPLED": str(about["resampled"]),
        "FILLED": str(about["filled"]),
        "MASKED": str(about["masked"]),
        "BEGIN_T_NS": str(begin_ns),
        "BEGIN_UTC": f"{begin}.{rest:09d}Z by {clock} clock"
        + (
            "" if export.array_info.clock_set or export.clock is not None else ", which was not set"
        ),
        "SLICE": f"{export.selection.start_s or 0.0:g} s to "
        + ("the end" if export.selection.end_s is None else f"{export.selection.end_s:g} s"),
        "CONTENT_SHA256": str(about.get("content_sha256") or "not sealed"),
        "CALIBRATION": _calibration_text(notes),
        "SCALE": str(notes.get("absolute_scale") or "not known"),
        "SOFTWARE": export.array_info.software,
        **make_tile_row_metadata(export.array_info),
    }
    return {name: to_ascii_line(text) for name, text in texts.items()}


def _completeness_text(notes: Mapping[str, object], source: Mapping[str, object]) -> str:
    complete, lost = read_completeness_and_losses(notes, source)
    if complete is None:
        return "not known: there is no ledger"
    losses = ", ".join(f"{count} {reason}" for reason, count in lost.items() if count)
    if complete == "lossy":
        text = f"lossy: {losses or 'frames are missing'}"
    else:
        text = "complete" if complete else f"not complete: it is {source.get('state', 'pending')}"
    ledger = notes.get("ledger")
    missed = ledger.get("missed_slots") if isinstance(ledger, dict) else None
    return f"{text}; {missed} slots in which no frame was taken" if missed else text


def format_largest_clock_bound(uncertainty_s: Floats | None) -> dict[str, str]:
    """Return the metadata entry with the largest bound of the server's time; empty if unknown.

    Args:
        uncertainty_s: bound of each sample; NaN for samples without frames. None: no clock.
    """
    if uncertainty_s is None or not np.isfinite(uncertainty_s).any():
        return {}
    return {
        "CLOCK_UNCERTAINTY": f"the truth is within {np.nanmax(uncertainty_s) * 1e3:.3f} ms of the "
        "axis at most; between two sessions, within the sum of both"
    }


def to_ascii_line(text: str) -> str:
    """Return text without accents, other characters outside ASCII as code points (U+1F600)."""
    line = " ".join(text.split())
    plain = unicodedata.normalize("NFKD", line)
    letters = (c for c in plain if not unicodedata.combining(c))
    return "".join(c if c.isascii() and c.isprintable() else f"U+{ord(c):04X}" for c in letters)


def _calibration_text(notes: Mapping[str, object]) -> str:
    found = notes.get("calibration")
    if not isinstance(found, dict):
        return "not known"
    return ", ".join(f"{name} {value}" for name, value in found.items() if isinstance(value, str))


def make_tile_row_metadata(info: ArrayInfo) -> dict[str, str]:
    """Return the facts about the row's place for a file; empty for an array without a row."""
    rows = [
        f"{axis} = {1e3 * place_m:g} mm"
        for axis, place_m in zip("xy", info.row_place_m, strict=True)
        if place_m is not None
    ]
    if not rows:
        return {}
    text = f"COP not measured along {' and '.join(row[0] for row in rows)}: tiles in one row"
    return {"ROW": f"{text}; points are at {', '.join(rows)} in the foot frame"}


_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def escape_xml_invalid_characters(text: str) -> str:
    r"""Return text with characters that XML does not allow as escapes: `\\ufffe`."""
    return _NOT_IN_XML.sub(lambda found: found[0].encode("unicode_escape").decode(), text)
