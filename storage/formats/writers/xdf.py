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
from storage.formats.writers.format import (
    ExportFormat,
    escape_xml_invalid_characters,
    get_instants_on_export_clock_ns,
    make_names_unique,
    to_floats_with_nan,
)
from storage.formats.writers.resampling import (
    find_consecutive_frames,
    make_resampling,
    make_sample_axis,
)
from storage.schema import COLUMNS_BY_NAME, SERVER_TIME_COLUMNS, UNKNOWN_T_NS, Array

_MAGIC = b"XDF:"
_FILE_HEADER, _STREAM_HEADER, _SAMPLES, _CLOCK_OFFSET, _STREAM_FOOTER = 1, 2, 3, 4, 6
_OFFSET_EVERY_NS = 5_000_000_000
"""Interval of clock offsets, as in LSL's recorder."""
_FLOAT64_COLUMNS = ("seq", "servo_counts", "servo_age_us")
"""Integers beyond the exact range of 32-bit floats."""
_TIME_COLUMNS = ("time_s", "time_utc", "t_ns", "t_mono_ns", "t_server_ns")
"""Columns that are no channels: every sample has its instant."""
_SAMPLES_MAX = 5_000_000
"""Limit of samples at a constant rate, computed in memory: hours of four tiles."""
_SERVER_TIME_BOUND = SERVER_TIME_COLUMNS[1].name
"""Bound of the server's time; with the server's clock always a channel."""


@dataclass
class _Stream:
    """Stream of the file, with the numbers for its footer."""

    number: int
    columns: Sequence[str]
    dtype: str
    sample_count: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    offsets: list[tuple[float, float]] = field(default_factory=list)

    def add_samples(self, at_s: Array) -> None:
        """Add samples to the numbers of the footer."""
        if len(at_s):
            self.first_s = self.first_s if self.sample_count else float(at_s[0])
            self.last_s = float(at_s[-1])
            self.sample_count += len(at_s)

    def encode_chunk(self, tag: int, content: bytes) -> bytes:
        """Return an encoded chunk of this stream."""
        return _encode_chunk(tag, struct.pack("<I", self.number) + content)

    def encode_footer(self) -> bytes:
        """Return the encoded footer, the stream's last chunk."""
        info = Element("info")
        span = {"first_timestamp": repr(self.first_s), "last_timestamp": repr(self.last_s)}
        _add_text_elements(info, {**span, "sample_count": str(self.sample_count)})
        offsets = SubElement(info, "clock_offsets")
        for at_s, value_s in self.offsets:
            _add_text_elements(
                SubElement(offsets, "offset"), {"time": repr(at_s), "value": repr(value_s)}
            )
        return self.encode_chunk(_STREAM_FOOTER, tostring(info))


def _encode(exports: Sequence[Export]) -> Iterator[bytes]:
    numbers = count(1)
    names = make_names_unique([export.array_info.node for export in exports])
    sessions = [_SessionEncoder(*each, numbers) for each in zip(exports, names, strict=True)]
    pieces = [session.read_chunks(is_alone=len(exports) == 1) for session in sessions]
    firsts = [next(each) for each in pieces]  # errors are raised before the first chunk
    yield _MAGIC + _encode_file_header(exports)
    for session, first, further in zip(sessions, firsts, pieces, strict=True):
        yield session.encode_marker_header()
        for piece in chain((first,), further):
            yield session.encode_frames(piece)
        yield session.encode_footers()


def _encode_file_header(exports: Sequence[Export]) -> bytes:
    """Return the file header, with the metadata of each session."""
    info = Element("info")
    _add_text_elements(info, {"version": "1.0", "software": exports[0].array_info.software})
    several = SubElement(info, "sessions") if len(exports) > 1 else None
    for export in exports:
        into = info if several is None else SubElement(several, "session")
        _add_text_elements(
            into, {k: str(v) for k, v in export.provenance_and_slice_metadata.items()}
        )
    return _encode_chunk(_FILE_HEADER, tostring(info, xml_declaration=True))


class _SessionEncoder:
    """Encoder of a session's streams.

    Args:
        export: export of the session.
        name: prefix of its streams' names.
        numbers: iterator of unique stream numbers of the file.
    """

    def __init__(self, export: Export, name: str, numbers: Iterator[int]) -> None:
        self._export, self._name, self._numbers = export, name, numbers
        self._channel_quantities = {
            name: of
            for name, of in export.map_columns_to_quantities().items()
            if of not in _TIME_COLUMNS and not pa.types.is_string(COLUMNS_BY_NAME[of].type)
        }
        if export.clock is not None:
            self._channel_quantities[_SERVER_TIME_BOUND] = _SERVER_TIME_BOUND
        self._streams: list[_Stream] = []
        self._parts: dict[int, list[_Stream]] = {}
        self._marker_stream: _Stream | None = None
        self._next_offset_ns: dict[int, int] = {}
        self._rate_hz = 0.0
        """Constant rate of the samples; 0: each has its own instant."""
        self._marked_rows: Mapping[str, Array] | None = None

    def read_chunks(self, *, is_alone: bool) -> Iterator[Mapping[str, Array]]:
        """Read the frames in chunks; beside other sessions they need the server's time."""
        export = self._export
        columns = [*self._channel_quantities, *export.instant_columns, *export.marker_columns]
        requested = list(dict.fromkeys(columns))
        if export.options.rate is not None:
            yield self._read_resampled(requested, is_alone=is_alone)
            return
        for piece in export.read_chunks(requested):
            if not is_alone:
                get_instants_on_export_clock_ns(export, piece)
            yield piece

    def _read_resampled(self, requested: Sequence[str], *, is_alone: bool) -> Mapping[str, Array]:
        """Read all frames as samples at a constant rate.

        Numbers are interpolated; counts and flags are those of the nearer frame.
        """
        export = self._export
        flat = export.read_all([*requested, "seq"], frames_max=_SAMPLES_MAX)
        if not is_alone:
            get_instants_on_export_clock_ns(export, flat)
        t_ns = export.to_session_axis_ns(flat)
        if not len(t_ns):
            raise UsageError(
                "no frame is in this slice",
                where=export.session_and_node_text,
                expected="a slice with frames, of which a rate can be told",
            )
        axis = make_sample_axis([(t_ns, export.array_info.nominal_rate_hz)], _SAMPLES_MAX)
        follows = find_consecutive_frames(axis, t_ns, flat["seq"], flat.get("part"))
        placed = make_resampling(axis, t_ns, follows)
        self._rate_hz = axis.rate_hz
        samples: dict[str, Array] = {
            "t_ns": axis.begin_ns + np.rint(placed.elapsed_s * 1e9).astype(np.int64)
        }
        for name, of in self._channel_quantities.items():
            values = to_floats_with_nan(of, flat[name])
            is_real = pa.types.is_floating(COLUMNS_BY_NAME[of].type)
            resample = placed.interpolate if is_real else placed.resample_nearest
            samples[name] = resample(values)
        if "t_server_ns" in flat:
            is_known = flat["t_server_ns"] != UNKNOWN_T_NS
            offset_ns = placed.resample_nearest(
                np.where(is_known, flat["t_server_ns"] - t_ns, np.nan)
            )
            is_finite = np.isfinite(offset_ns)
            samples["t_server_ns"] = np.where(
                is_finite,
                samples["t_ns"] + np.where(is_finite, offset_ns, 0.0).astype(np.int64),
                UNKNOWN_T_NS,
            )
        if self._export.markers is not None:
            self._marked_rows = {"t_ns": t_ns, "marker": flat["marker"]}
        return samples

    def encode_marker_header(self) -> bytes:
        """Return the header of the stream of markers; empty without markers."""
        if self._export.markers is None:
            return b""
        self._marker_stream, header = self._add_stream("markers", "Markers", ["label"], "string")
        return header

    def encode_frames(self, piece: Mapping[str, Array]) -> bytes:
        """Return the encoded chunks of a chunk of frames."""
        content = bytearray()
        parts = np.zeros(len(piece["t_ns"]), dtype=np.uint16)
        if not self._rate_hz:
            parts = piece.get("part", parts)
        # Without frames there is an empty stream as well, which states the channels.
        for part in np.unique(parts).tolist() or [0]:
            rows = parts == part
            content += self._encode_part(part, {name: v[rows] for name, v in piece.items()})
        return bytes(content)

    def encode_footers(self) -> bytes:
        """Return the footers of all streams; a stream without a footer is incomplete."""
        return b"".join(stream.encode_footer() for stream in self._streams)

    def _encode_part(self, part: int, flat: Mapping[str, Array]) -> bytes:
        content = bytearray()
        if part not in self._parts:
            self._parts[part] = []
            of_part = f" part {part}" if part else ""
            for name, format_ in (("frames", "float32"), ("counters", "double64")):
                columns = [
                    column
                    for column, of in self._channel_quantities.items()
                    if (of in _FLOAT64_COLUMNS) == (name == "counters")
                ]
                if columns:
                    stream, header = self._add_stream(name + of_part, "Force", columns, format_)
                    self._parts[part].append(stream)
                    content += header
        at_s = self._axis_times_ns(flat) * 1e-9
        if len(at_s):
            content += self._encode_clock_offsets(part, flat)
            for stream in self._parts[part]:
                stream.add_samples(at_s)
                content += stream.encode_chunk(_SAMPLES, self._encode_samples(stream, at_s, flat))
            marked = self._marked_rows or flat
            content += self._encode_markers(self._axis_times_ns(marked) * 1e-9, marked)
        return bytes(content)

    def _axis_times_ns(self, flat: Mapping[str, Array]) -> Array:
        """Return the instants (n,) on the session's time axis; resampled ones already are."""
        return flat["t_ns"] if self._rate_hz else self._export.to_session_axis_ns(flat)

    def _encode_samples(self, stream: _Stream, at_s: Array, flat: Mapping[str, Array]) -> bytes:
        row = np.dtype([("bytes", "u1"), ("s", "<f8"), ("v", stream.dtype, len(stream.columns))])
        rows = np.zeros(len(at_s), dtype=row)
        rows["bytes"], rows["s"] = 8, at_s
        for i, name in enumerate(stream.columns):
            rows["v"][:, i] = to_floats_with_nan(self._channel_quantities[name], flat[name])
        return struct.pack("<BI", 4, len(at_s)) + rows.tobytes()

    def _encode_clock_offsets(self, part: int, flat: Mapping[str, Array]) -> bytes:
        content = bytearray()
        if "t_server_ns" not in flat:
            return b""
        known = np.flatnonzero(flat["t_server_ns"] != UNKNOWN_T_NS)
        t_ns, t_server_ns = self._axis_times_ns(flat)[known], flat["t_server_ns"][known]
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
                content += stream.encode_chunk(_CLOCK_OFFSET, struct.pack("<dd", *pair))
        return bytes(content)

    def _encode_markers(self, at_s: Array, flat: Mapping[str, Array]) -> bytes:
        if self._marker_stream is None:
            return b""
        rows = [row for row, text in enumerate(flat["marker"]) if text is not None]
        content = bytearray(struct.pack("<BI", 4, len(rows)))
        for row in rows:
            text = flat["marker"][row].encode()
            content += struct.pack("<BdBI", 8, at_s[row], 4, len(text)) + text
        self._marker_stream.add_samples(at_s[rows])
        return self._marker_stream.encode_chunk(_SAMPLES, bytes(content)) if rows else b""

    def _add_stream(
        self, name: str, kind: str, columns: Sequence[str], format_: str
    ) -> tuple[_Stream, bytes]:
        """Add a stream; return it and its encoded header."""
        dtype = {"float32": "<f4", "double64": "<f8", "string": ""}[format_]
        stream = _Stream(next(self._numbers), columns, dtype)
        self._streams.append(stream)
        node = self._export.array_info.node
        info = Element("info")
        texts = {"name": f"{self._name} {name}", "type": kind, "channel_count": str(len(columns))}
        rate = repr(self._rate_hz) if self._rate_hz and format_ != "string" else "0"
        texts |= {"nominal_srate": rate, "channel_format": format_}
        source = f"{node} {self._export.provenance_and_slice_metadata.get('session') or ''} {name}"
        _add_text_elements(info, {**texts, "source_id": source, "version": "1.1", "hostname": node})
        desc = SubElement(info, "desc")
        _add_text_elements(desc, {"nominal_rate_hz": repr(self._export.array_info.nominal_rate_hz)})
        channels = SubElement(desc, "channels")
        for column in columns:
            of = COLUMNS_BY_NAME.get(self._channel_quantities.get(column, ""))
            unit, meaning = (of.unit, of.description) if of else ("1", "what people marked")
            channel = {"label": column, "unit": unit, "type": kind, "description": meaning}
            if of is not None and of.per_tile:
                tile = self._export.array_info.tiles[int(column.removeprefix(f"{of.name}_"))]
                channel["serial"] = tile.serial
            _add_text_elements(SubElement(channels, "channel"), channel)
        return stream, stream.encode_chunk(_STREAM_HEADER, tostring(info, xml_declaration=True))


def _encode_chunk(tag: int, content: bytes) -> bytes:
    return struct.pack("<BIH", 4, len(content) + 2, tag) + content


def _add_text_elements(parent: Element, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        SubElement(parent, name).text = escape_xml_invalid_characters(text)


XDF = ExportFormat(
    "xdf",
    "XDF",
    "pyxdf, beside LabStreamingLayer",
    "application/x-xdf",
    _encode,
    group_encoder=_encode,
    options=("rate",),
)
