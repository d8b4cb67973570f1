"""XDF writer (LabStreamingLayer): streams of samples with their instants, and markers.

Layout: https://github.com/sccn/xdf/wiki/Specifications. Each part of a session has a stream of
32-bit floats, with estimates and counts, and a stream of 64-bit floats, for numbers that need them;
the session has a stream of markers. Instants are the node's, in seconds since 1970. With the
server's clock, clock offsets to the server's time follow every few seconds, as in LSL's recorder.
No rate is stated, so that readers keep the instants. With the option `rate`, samples have a stated
constant rate, in one stream for all parts. Several sessions follow one another with separate
streams; readers align them by the offsets.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, count
from xml.etree.ElementTree import Element, SubElement, tostring

import numpy as np
import pyarrow as pa

from devices.errors import UsageError
from storage.formats.export import Export
from storage.formats.written.format import Format
from storage.formats.written.steady import axis_of, steady
from storage.formats.written.together import distinct, instants_of
from storage.formats.written.xml_text import xml_text
from storage.schema import KNOWN, NO_INSTANT, SERVER_TIME, Array

_MAGIC = b"XDF:"
_FILE_HEADER, _STREAM_HEADER, _SAMPLES, _CLOCK_OFFSET, _STREAM_FOOTER = 1, 2, 3, 4, 6
_OFFSET_EVERY_NS = 5_000_000_000
"""Interval of clock offsets, as in LSL's recorder."""
_COUNTERS = ("seq", "servo_counts", "servo_age_us")
"""Integers beyond the exact range of 32-bit floats."""
_TIMES = ("time_s", "time_utc", "t_ns", "t_mono_ns", "t_server_ns")
"""Columns that are no channels: every sample has its instant."""
_SAMPLES_MAX = 5_000_000
"""Limit of samples at a constant rate, computed in memory: hours of four tiles."""
_BOUND = SERVER_TIME[1].name
"""Bound of the server's time; with the server's clock always a channel."""


@dataclass
class _Stream:
    """Stream of the file, with the numbers for its footer."""

    number: int
    columns: Sequence[str]
    dtype: str
    samples: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    offsets: list[tuple[float, float]] = field(default_factory=list)

    def count(self, at_s: Array) -> None:
        """Add samples to the numbers of the footer."""
        if len(at_s):
            self.first_s = self.first_s if self.samples else float(at_s[0])
            self.last_s = float(at_s[-1])
            self.samples += len(at_s)

    def chunk(self, tag: int, content: bytes) -> bytes:
        """Return an encoded chunk of this stream."""
        return _chunk(tag, struct.pack("<I", self.number) + content)

    def footer(self) -> bytes:
        """Return the encoded footer, the stream's last chunk."""
        info = Element("info")
        span = {"first_timestamp": repr(self.first_s), "last_timestamp": repr(self.last_s)}
        _texts(info, {**span, "sample_count": str(self.samples)})
        offsets = SubElement(info, "clock_offsets")
        for at_s, value_s in self.offsets:
            _texts(SubElement(offsets, "offset"), {"time": repr(at_s), "value": repr(value_s)})
        return self.chunk(_STREAM_FOOTER, tostring(info))


def _write(export: Export) -> Iterator[bytes]:
    return _write_together([export])


def _write_together(exports: Sequence[Export]) -> Iterator[bytes]:
    numbers = count(1)
    names = distinct([export.info.node for export in exports])
    sessions = [_Session(*each, numbers) for each in zip(exports, names, strict=True)]
    pieces = [session.pieces(is_alone=len(exports) == 1) for session in sessions]
    firsts = [next(each) for each in pieces]  # errors are raised before the first chunk
    yield _MAGIC + _header(exports)
    for session, first, further in zip(sessions, firsts, pieces, strict=True):
        yield session.begin()
        for piece in chain((first,), further):
            yield session.piece(piece)
        yield session.footers()


def _header(exports: Sequence[Export]) -> bytes:
    """Return the file header, with the metadata of each session."""
    info = Element("info")
    _texts(info, {"version": "1.0", "software": exports[0].info.software})
    several = SubElement(info, "sessions") if len(exports) > 1 else None
    for export in exports:
        into = info if several is None else SubElement(several, "session")
        _texts(into, {k: str(v) for k, v in export.about.items()})
    return _chunk(_FILE_HEADER, tostring(info, xml_declaration=True))


class _Session:
    """Encoder of a session's streams.

    Args:
        export: export of the session.
        name: prefix of its streams' names.
        numbers: iterator of unique stream numbers of the file.
    """

    def __init__(self, export: Export, name: str, numbers: Iterator[int]) -> None:
        self._export, self._name, self._numbers = export, name, numbers
        self._chosen = {
            name: of
            for name, of in export.chosen().items()
            if of not in _TIMES and not pa.types.is_string(KNOWN[of].type)
        }
        if export.clock is not None:
            self._chosen[_BOUND] = _BOUND
        self._streams: list[_Stream] = []
        self._parts: dict[int, list[_Stream]] = {}
        self._marks: _Stream | None = None
        self._next_offset_ns: dict[int, int] = {}
        self._rate_hz = 0.0
        """Constant rate of the samples; 0: each has its own instant."""
        self._marked_rows: Mapping[str, Array] | None = None

    def pieces(self, *, is_alone: bool) -> Iterator[Mapping[str, Array]]:
        """Read the frames in chunks; beside other sessions they need the server's time."""
        export = self._export
        asked = [*self._chosen, "t_ns"]
        asked += ["part"] if "part" in export.content.names else []
        asked += ["t_server_ns"] if export.clock is not None else []
        asked += ["event"] if export.marks is not None else []
        if export.options.rate is not None:
            yield self._at_constant_rate(asked, is_alone=is_alone)
            return
        for piece in export.pieces(asked):
            if not is_alone:
                instants_of(export, piece)
            yield piece

    def _at_constant_rate(self, asked: Sequence[str], *, is_alone: bool) -> Mapping[str, Array]:
        """Read all frames as samples at a constant rate.

        Numbers are interpolated; counts and flags are those of the nearer frame.
        """
        export = self._export
        flat = export.whole(list(dict.fromkeys([*asked, "seq"])), frames_max=_SAMPLES_MAX)
        if not is_alone:
            instants_of(export, flat)
        t_ns = export.at_ns(flat)
        if not len(t_ns):
            raise UsageError(
                "no frame is in this slice",
                where=export.called,
                expected="a slice with frames, of which a rate can be told",
            )
        axis = axis_of([(t_ns, export.info.nominal_rate_hz)], _SAMPLES_MAX)
        placed = steady(axis, t_ns, flat["seq"], flat.get("part"))
        self._rate_hz = axis.rate_hz
        samples: dict[str, Array] = {
            "t_ns": axis.begin_ns + np.rint(placed.time_s * 1e9).astype(np.int64)
        }
        for name, of in self._chosen.items():
            values = _numbers(flat[name], of)
            is_whole = pa.types.is_integer(KNOWN[of].type) or pa.types.is_boolean(KNOWN[of].type)
            samples[name] = placed.nearest(values) if is_whole else placed.between(values)
        if "t_server_ns" in flat:
            is_known = flat["t_server_ns"] != NO_INSTANT
            offset_ns = placed.nearest(np.where(is_known, flat["t_server_ns"] - t_ns, np.nan))
            is_finite = np.isfinite(offset_ns)
            samples["t_server_ns"] = np.where(
                is_finite,
                samples["t_ns"] + np.where(is_finite, offset_ns, 0.0).astype(np.int64),
                NO_INSTANT,
            )
        if self._export.marks is not None:
            self._marked_rows = {"t_ns": t_ns, "event": flat["event"]}
        return samples

    def begin(self) -> bytes:
        """Return the header of the stream of markers; empty without markers."""
        if self._export.marks is None:
            return b""
        self._marks, header = self._opened("marks", "Markers", ["label"], "string")
        return header

    def piece(self, piece: Mapping[str, Array]) -> bytes:
        """Return the encoded chunks of a chunk of frames."""
        content = bytearray()
        parts = np.zeros(len(piece["t_ns"]), dtype=np.uint16)
        if not self._rate_hz:
            parts = piece.get("part", parts)
        # Without frames there is an empty stream as well, which states the channels.
        for part in np.unique(parts).tolist() or [0]:
            rows = parts == part
            content += self._of_part(part, {name: v[rows] for name, v in piece.items()})
        return bytes(content)

    def footers(self) -> bytes:
        """Return the footers of all streams; a stream without a footer is incomplete."""
        return b"".join(stream.footer() for stream in self._streams)

    def _of_part(self, part: int, flat: Mapping[str, Array]) -> bytes:
        content = bytearray()
        if part not in self._parts:
            self._parts[part] = []
            counters = [name for name, of in self._chosen.items() if of in _COUNTERS]
            others = [name for name, of in self._chosen.items() if of not in _COUNTERS]
            of_part = f" part {part}" if part else ""
            for name, columns, format_ in (
                ("frames", others, "float32"),
                ("counters", counters, "double64"),
            ):
                if columns:
                    stream, header = self._opened(name + of_part, "Force", columns, format_)
                    self._parts[part].append(stream)
                    content += header
        at_s = self._at_ns(flat) * 1e-9
        if len(at_s):
            content += self._offsets(part, flat)
            for stream in self._parts[part]:
                stream.count(at_s)
                content += stream.chunk(_SAMPLES, self._samples(stream, at_s, flat))
            marked = self._marked_rows or flat
            content += self._marked(self._at_ns(marked) * 1e-9, marked)
        return bytes(content)

    def _at_ns(self, flat: Mapping[str, Array]) -> Array:
        """Return the instants (n,) on the session's time axis; resampled ones already are."""
        return flat["t_ns"] if self._rate_hz else self._export.at_ns(flat)

    def _samples(self, stream: _Stream, at_s: Array, flat: Mapping[str, Array]) -> bytes:
        row = np.dtype([("bytes", "u1"), ("s", "<f8"), ("v", stream.dtype, len(stream.columns))])
        rows = np.zeros(len(at_s), dtype=row)
        rows["bytes"], rows["s"] = 8, at_s
        for i, name in enumerate(stream.columns):
            rows["v"][:, i] = _numbers(flat[name], self._chosen[name])
        return struct.pack("<BI", 4, len(at_s)) + rows.tobytes()

    def _offsets(self, part: int, flat: Mapping[str, Array]) -> bytes:
        content = bytearray()
        if "t_server_ns" not in flat:
            return b""
        known = np.flatnonzero(flat["t_server_ns"] != NO_INSTANT)
        t_ns, t_server_ns = self._at_ns(flat)[known], flat["t_server_ns"][known]
        if not len(t_ns):
            return b""
        begin_ns = self._next_offset_ns.get(part, int(t_ns[0]))
        # Offsets due by each frame: after a pause of days only one is written.
        count = np.maximum(0, (t_ns - begin_ns) // _OFFSET_EVERY_NS + 1)
        for row in np.flatnonzero(np.diff(count, prepend=0) > 0):
            pair = float(t_ns[row]) * 1e-9, float(t_server_ns[row] - t_ns[row]) * 1e-9
            self._next_offset_ns[part] = int(t_ns[row]) + _OFFSET_EVERY_NS
            for stream in self._parts[part]:
                stream.offsets.append(pair)
                content += stream.chunk(_CLOCK_OFFSET, struct.pack("<dd", *pair))
        return bytes(content)

    def _marked(self, at_s: Array, flat: Mapping[str, Array]) -> bytes:
        if self._marks is None:
            return b""
        rows = [row for row, text in enumerate(flat["event"]) if text is not None]
        content = bytearray(struct.pack("<BI", 4, len(rows)))
        for row in rows:
            text = flat["event"][row].encode()
            content += struct.pack("<BdBI", 8, at_s[row], 4, len(text)) + text
        self._marks.count(at_s[rows])
        return self._marks.chunk(_SAMPLES, bytes(content)) if rows else b""

    def _opened(
        self, name: str, kind: str, columns: Sequence[str], format_: str
    ) -> tuple[_Stream, bytes]:
        """Add a stream; return it and its encoded header."""
        dtype = {"float32": "<f4", "double64": "<f8", "string": ""}[format_]
        stream = _Stream(next(self._numbers), columns, dtype)
        self._streams.append(stream)
        node = self._export.info.node
        info = Element("info")
        texts = {"name": f"{self._name} {name}", "type": kind, "channel_count": str(len(columns))}
        rate = repr(self._rate_hz) if self._rate_hz and format_ != "string" else "0"
        texts |= {"nominal_srate": rate, "channel_format": format_}
        source = f"{node} {self._export.about.get('session') or ''} {name}"
        _texts(info, {**texts, "source_id": source, "version": "1.1", "hostname": node})
        desc = SubElement(info, "desc")
        _texts(desc, {"nominal_rate_hz": repr(self._export.info.nominal_rate_hz)})
        channels = SubElement(desc, "channels")
        for column in columns:
            of = KNOWN[self._chosen[column]] if column in self._chosen else None
            unit, meaning = (of.unit, of.description) if of else ("1", "what people marked")
            channel = {"label": column, "unit": unit, "type": kind, "description": meaning}
            if of is not None and of.per_tile:
                tile = self._export.info.tiles[int(column.removeprefix(f"{of.name}_"))]
                channel["serial"] = tile.serial
            _texts(SubElement(channels, "channel"), channel)
        return stream, stream.chunk(_STREAM_HEADER, tostring(info, xml_declaration=True))


def _numbers(values: Array, column: str) -> Array:
    """Return a column as float64, NaN where unknown."""
    missing = KNOWN[column].missing
    numbers = values.astype(np.float64)
    if missing is not None:
        numbers[values == missing] = np.nan
    return numbers


def _chunk(tag: int, content: bytes) -> bytes:
    return struct.pack("<BIH", 4, len(content) + 2, tag) + content


def _texts(parent: Element, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        SubElement(parent, name).text = xml_text(text)


XDF = Format(
    "xdf",
    "XDF",
    "pyxdf, beside LabStreamingLayer",
    "application/x-xdf",
    _write,
    write_together=_write_together,
    options=("rate",),
)
