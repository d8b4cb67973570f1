"""Export of a session or a slice: frames in chunks, and metadata.

Columns are the flat columns of a sealed file, for every format. Memory is bounded if the format
writes each chunk before it reads the next. Frames are not resampled here.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Literal, get_args

import numpy as np
import pyarrow as pa

from devices.arrays import Times
from devices.errors import UsageError
from devices.frames import FRAME_COLUMNS, ArrayInfo, FrameBatch
from storage.clock.table import ClockTable
from storage.formats.markers import PlacedMarkers
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.schema import (
    ARRAY_INFO_KEY,
    COLUMNS_BY_NAME,
    MARKER_COLUMNS,
    MEASURED_COLUMNS,
    SERVER_TIME_COLUMNS,
    TIME_COLUMNS,
    UNKNOWN_T_NS,
    Array,
    to_flat_column,
)
from storage.sessions.footer import NOTES_KEY
from storage.sessions.metadata import load_clock_table
from storage.sessions.reader import SealedFileReader
from storage.sessions.time_axis import NODE_AXIS, TIME_AXIS_NOTE, TimeAxis
from storage.sessions.writer import EXPORT_KEY

Completeness = bool | Literal["lossy"] | None
"""Completeness of a session: True, False or "lossy". None: unknown, as for a simulation."""

AXES_TEXT = (
    "Foot frame: x forward, y to the left, z along the segment towards the ankle, origin at the "
    "ankle joint. Ground frame (cop_ground_*): the same axes levelled, z up, origin on the ground "
    "under the ankle at angle 0. Forces are those of the ground on the foot, positive upwards."
)
MASKED_TEXT = (
    "Unknown estimates are missing, and estimate_flags says why: no centre of "
    "pressure without contact or in doubt (16), no GRF with a tile saturated (1) or missing (32). "
    "Of tiles in one row the COP is not measured across the row. "
    "They are not replaced."
)
_NODE_TIME_BASE = "The node's clock (t_ns), UTC since 1970, as set on the node."
_SERVER_TIME_BASE = (
    "The server's clock (t_server_ns), UTC since 1970, within t_server_uncertainty_ns; the node's "
    "own is t_ns."
)


def read_completeness_and_losses(
    notes: Mapping[str, object], provenance: Mapping[str, object]
) -> tuple[Completeness, dict[str, int]]:
    """Return the completeness of a session, and its number of lost frames by reason."""
    if "state" in provenance:  # not sealed: frames may follow
        return False, {}
    ledger = notes.get("ledger")
    if not isinstance(ledger, dict):
        return None, {}
    lost: Counter[str] = Counter()
    for part in ledger["parts"]:
        lost.update(part["lost"])
    return "lossy" if ledger["lossy"] else bool(ledger["complete"]), dict(lost)


ClockName = Literal["node", "server"]
CLOCK_NAMES: tuple[ClockName, ...] = get_args(ClockName)
"""Clocks of an export: the node's time only, or the server's time as well."""

_DERIVED_COLUMN_REMEDIES = {
    column.name: "Ask for the clock `server` as well" for column in SERVER_TIME_COLUMNS
}
_DERIVED_COLUMN_REMEDIES |= {column.name: "Ask for markers as well" for column in MARKER_COLUMNS}

_TIME_NAMES = tuple(column.name for column in TIME_COLUMNS)

FlatColumns = Mapping[str, Array]
"""Flat columns by name, n rows each; unknown numbers as in memory."""


@dataclass(frozen=True)
class FrameSource:
    """Source of the frames of a session.

    Attributes:
        quantity_names: its quantities, of `storage.schema.COLUMNS_BY_NAME`, in the order of their
            columns.
        read_columns: reads the named flat columns, and possibly more, of frames in order, in
            chunks.
        begin_t_ns: `t_ns` of the session's first frame.
        end_t_ns: latest instant on the time axis; None: `read_columns` yields all frames of the
            session, also outside of the slice, and can be called once.
        axis: time axis of the session.
    """

    quantity_names: Sequence[str]
    read_columns: Callable[[Sequence[str]], Iterable[FlatColumns]]
    begin_t_ns: int
    end_t_ns: int | None = None
    axis: TimeAxis = NODE_AXIS


def make_one_pass_frame_source(
    frame_chunks: Iterable[tuple[FrameBatch, Mapping[str, Array]]],
    span_ns: tuple[int, int] | None = None,
    axis: TimeAxis = NODE_AXIS,
) -> FrameSource:
    """Return a source of given frames that can be read once; consume the first batch with frames.

    Args:
        frame_chunks: frames with their further columns, in order.
        span_ns: first and last instant on the session's time axis; None: begins with the
            first of `frame_chunks`; the end is unknown.
        axis: time axis of the session.

    Raises:
        UsageError: there are no frames.
    """
    nonempty = ((frames, extra) for frames, extra in frame_chunks if len(frames))
    first = next(nonempty, None)
    if first is None:
        raise UsageError("the session has no frames")
    names = [column.name for column in MEASURED_COLUMNS] + list(first[1])
    flat = (_flatten_frames(frames, extra) for frames, extra in chain((first,), nonempty))
    begin_t_ns, end_t_ns = span_ns or (int(first[0].t_ns[0]), None)
    return FrameSource(names, lambda _: flat, begin_t_ns, end_t_ns, axis)


@dataclass(frozen=True)
class Export:
    """Input of an export format: frames of a session or slice, with metadata.

    Attributes:
        frame_source: source of the frames.
        array_info: array of the node.
        notes: notes of the session.
        selection: requested rows and columns.
        clock: clock table; adds `t_server_ns`, its bound, and a summary to the notes; None: none.
        markers: placed markers; adds `marker`, and each marker to the notes; None: none.
        provenance: session and its hashes.
        options: options of the format.
        take_offset_s: time of the session's first frame after the first of all sessions in the
            file, by the server's clock; seconds of the slice count from that one.
        remarks: remarks of the format for the user, complete with the file's first chunk.
    """

    frame_source: FrameSource
    array_info: ArrayInfo
    notes: Mapping[str, object]
    selection: Slice
    clock: ClockTable | None = None
    markers: PlacedMarkers | None = None
    provenance: Mapping[str, object] = field(default_factory=dict)
    options: FormatOptions = NO_OPTIONS
    take_offset_s: float = 0.0
    remarks: list[str] = field(default_factory=list, compare=False)

    @property
    def session_and_node_text(self) -> str:
        """Name of the session, for error messages and notes."""
        session = self.provenance.get("session")
        return (
            f"session {session} of {self.array_info.node}"
            if session
            else f"session of {self.array_info.node}"
        )

    @property
    def slice_zero_ns(self) -> int:
        """Instant on the session's time axis from which seconds of the slice count."""
        return self.frame_source.begin_t_ns - round(self.take_offset_s * 1e9)

    @property
    def provenance_and_slice_metadata(self) -> dict[str, object]:
        """Metadata of the file as JSON: session, slice, clock, completeness and axes.

        A format that resamples or fills replaces the facts concerned.
        """
        part, axis = self.selection, self.frame_source.axis
        complete, lost = read_completeness_and_losses(self.notes, self.provenance)
        return {
            **self.provenance,
            "node": self.array_info.node,
            "start_s": part.start_s,
            "end_s": part.end_s,
            "columns": list(part.columns),
            "clock": "node" if self.clock is None else "server",
            **({TIME_AXIS_NOTE: axis.to_json_list()} if axis.is_shifted else {}),
            "complete": complete,
            "lost": lost,
            "time_base": _NODE_TIME_BASE if self.clock is None else _SERVER_TIME_BASE,
            "axes": AXES_TEXT,
            "resampled": "nothing",
            "filled": "nothing",
            "masked": MASKED_TEXT,
        }

    @property
    def notes_with_clock_and_markers(self) -> dict[str, object]:
        """Notes of the session as JSON, with the clock's summary and the markers if included."""
        notes = dict(self.notes)
        if self.clock is not None:
            notes["clock"] = self.clock.summarize_streams().model_dump(mode="json")
        if self.markers is not None:
            notes["markers"] = [marker.to_json_dict() for marker in self.markers.markers]
        return notes

    @property
    def has_forces(self) -> bool:
        """True if the session has estimates."""
        return "grf_n" in self.frame_source.quantity_names

    def map_columns_to_quantities(self, columns: Sequence[str] = ()) -> dict[str, str]:
        """Return the quantity of each given, selected, or else any column by flat name, in order.

        Args:
            columns: names, of all tiles or of one; empty: the slice's columns, or all.

        Raises:
            UsageError: a column does not exist.
        """
        present = [*_TIME_NAMES, *self.frame_source.quantity_names, *self._derived_column_names]
        chosen = _resolve_columns(
            present, len(self.array_info.tiles), columns or self.selection.columns
        )
        if columns or self.selection.columns or self.options.times is not False:
            return chosen
        return {name: of for name, of in chosen.items() if of not in _TIME_NAMES}

    def to_session_axis_ns(self, columns: Mapping[str, Array]) -> Times:
        """Return the instants of frames on the session's time axis, int64[n].

        Args:
            columns: `t_ns`, and `part` if the session has parts.
        """
        return self.frame_source.axis.shift_to_axis(columns["t_ns"], columns.get("part"))

    def read_chunks(self, columns: Sequence[str] = ()) -> Iterator[dict[str, Array]]:
        """Read the flat columns of the slice's frames in chunks of some thousand rows.

        Args:
            columns: as for `map_columns_to_quantities`.

        Yields:
            At least one chunk; it has no rows if the slice has no frames, else all chunks have
            rows. Frames of a session that is not sealed can be read once.

        Raises:
            UsageError: a column does not exist, or the slice begins after the session's end;
                raised before the first chunk.
        """
        chosen, made, content = (
            self.map_columns_to_quantities(columns),
            self._derived_column_names,
            self.frame_source,
        )
        end_t_ns = content.begin_t_ns if content.end_t_ns is None else content.end_t_ns
        header: dict[str, Array] | None = None
        has_rows = False
        has_parts = bool(made) or content.axis.is_shifted
        for flat in content.read_columns(
            _columns_to_read(chosen, made, content.quantity_names, has_parts=has_parts)
        ):
            at_ns = self.to_session_axis_ns(flat)
            if content.end_t_ns is None:
                end_t_ns = max(end_t_ns, int(at_ns.max()))
            values = _select_rows(flat, self.selection.compute_row_mask(at_ns, self.slice_zero_ns))
            if self.clock is not None:
                times = (values["t_mono_ns"], values["t_ns"], values.get("part"))
                values |= self.clock.compute_server_time_columns_or_unknown(*times)
            if self.markers is not None:
                values["marker"] = self.markers.get_frame_labels_or_none(
                    values["seq"], values.get("part")
                )
            values["time_s"] = (self.to_session_axis_ns(values) - content.begin_t_ns) * 1e-9
            values["time_utc"] = values["t_ns"].view("datetime64[ns]")
            piece = {name: values[name] for name in chosen}
            header = header or piece
            if len(values["t_ns"]):
                has_rows = True
                yield piece
        if has_rows or header is None:
            return
        end_s = (end_t_ns - self.slice_zero_ns) * 1e-9
        start_s = self.selection.start_s
        if start_s is not None and start_s > end_s:
            raise UsageError(
                f"the slice starts at {start_s:g} s, and the session ends at {end_s:.3f} s",
                where=self.session_and_node_text,
                expected="a start before the session's end",
            )
        yield header

    def read_tables(self) -> Iterator[pa.Table]:
        """Read the slice's frames as Arrow tables, with units, array and notes as metadata."""
        chosen, notes = self.map_columns_to_quantities(), self.notes_with_clock_and_markers
        metadata: dict[bytes | str, bytes | str] = {
            ARRAY_INFO_KEY: self.array_info.model_dump_json().encode(),
            NOTES_KEY: json.dumps(notes, sort_keys=True).encode(),
            EXPORT_KEY: json.dumps(self.provenance_and_slice_metadata).encode(),
        }
        tiles = self._tile_numbers(chosen)
        for piece in self.read_chunks():
            fields, arrays = [], []
            for name, values in piece.items():
                plain, array = to_flat_column(COLUMNS_BY_NAME[chosen[name]], name, values, notes)
                fields.append(self._annotate_tile(plain, tiles[name]))
                arrays.append(array)
            yield pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=metadata))

    def read_all(self, columns: Sequence[str], *, frames_max: int) -> dict[str, Array]:
        """Read all frames of the slice at once, for a format that cannot be written in chunks.

        Args:
            columns: as for `map_columns_to_quantities`, including `t_ns`.
            frames_max: limit of the format.

        Raises:
            UsageError: as for `read_chunks`, or there are too many frames; the error names a slice
                that fits.
        """
        pieces: list[dict[str, Array]] = []
        left = frames_max
        for piece in self.read_chunks(columns):
            left -= len(piece["t_ns"])
            pieces.append(piece)
            if left < 0:
                fits_ns = int(self.to_session_axis_ns(piece)[left]) - self.slice_zero_ns
                start_s, end_s = self.selection.start_s or 0.0, np.floor(fits_ns * 1e-6) * 1e-3
                raise UsageError(
                    f"there are more than {frames_max} frames, the limit of this format",
                    where=self.session_and_node_text,
                    expected=f"a slice: here {start_s:g} s to {end_s:.3f} s fits",
                )
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}

    def _tile_numbers(self, chosen: Mapping[str, str]) -> dict[str, int | None]:
        return {
            name: int(name.removeprefix(f"{of}_")) if COLUMNS_BY_NAME[of].per_tile else None
            for name, of in chosen.items()
        }

    def _annotate_tile(self, plain: pa.Field[Any], tile: int | None) -> pa.Field[Any]:
        """Return the field with its tile as metadata, and the serial in its name on request."""
        if tile is None:
            return plain
        serial = self.array_info.tiles[tile].serial
        metadata: dict[bytes | str, bytes | str] = dict((plain.metadata or {}).items())
        metadata |= {b"tile": str(tile).encode(), b"serial": serial.encode()}
        if self.options.names == "serial":
            plain = plain.with_name(f"{plain.name.removesuffix(f'_{tile}')}_{serial}")
        return plain.with_metadata(metadata)

    @property
    def instant_columns(self) -> list[str]:
        """Names of the columns of instants and parts: of each clock, of each part."""
        parts = ["part"] if "part" in self.frame_source.quantity_names else []
        return ["t_ns", *parts, *self._server_time_columns]

    @property
    def marker_columns(self) -> list[str]:
        """Names of the columns of markers; empty without markers."""
        return [column.name for column in MARKER_COLUMNS] if self.markers is not None else []

    @property
    def _server_time_columns(self) -> list[str]:
        return [column.name for column in SERVER_TIME_COLUMNS] if self.clock is not None else []

    @property
    def _derived_column_names(self) -> list[str]:
        return [*self._server_time_columns, *self.marker_columns]


def make_sealed_export(
    reader: SealedFileReader,
    selection: Slice,
    *,
    clock: ClockName = "node",
    markers: PlacedMarkers | None = None,
    options: FormatOptions = NO_OPTIONS,
    take_offset_s: float = 0.0,
) -> Export:
    """Return the export of a sealed file, which reads only the data that the slice needs.

    Args:
        reader: the file.
        selection: rows and columns.
        clock: clock whose time is added.
        markers: placed markers; None: none.
        options: options of the format.
        take_offset_s: as for `Export`.

    Raises:
        UsageError: the server's time is requested, and the clock table is missing.
        FileFormatError: the file or its clock table is damaged.
    """
    extra = [
        name for name in COLUMNS_BY_NAME if name not in FRAME_COLUMNS and reader.has_columns(name)
    ]
    table = load_clock_table(reader) if clock == "server" else None
    begin_t_ns, end_t_ns = reader.read_span_on_axis_ns()
    bounds_ns = selection.compute_bounds_ns(begin_t_ns - round(take_offset_s * 1e9))
    names = [*(column.name for column in MEASURED_COLUMNS), *extra]
    return Export(
        FrameSource(
            names,
            lambda flat: reader.read_overlapping_row_groups(flat, *bounds_ns),
            begin_t_ns,
            end_t_ns,
            reader.time_axis,
        ),
        reader.info,
        reader.notes,
        selection,
        table,
        markers,
        reader.session_id_and_hashes,
        options,
        take_offset_s,
    )


def compute_take_offsets_s(readers: Sequence[SealedFileReader]) -> list[float]:
    """Return the time of each session's first frame after the first of all, by the server's clock.

    Raises:
        UsageError: the clock of a session's first frame was never compared, or its table is
            missing.
        FileFormatError: a file or its clock table is damaged.
    """
    begins_ns = []
    for reader in readers:
        first = reader.read_part_spans()[0]
        times = load_clock_table(reader).compute_server_time_columns_or_unknown(
            np.array(first.t_mono_ns[:1]), np.array(first.t_ns[:1]), np.array([first.number])
        )
        begin_ns = int(times["t_server_ns"][0])
        if begin_ns == UNKNOWN_T_NS:
            raise UsageError(
                "the server's time is not known for its first frame",
                where=f"session {reader.session_id_and_hashes.get('session')}",
                remedy="Export each session by itself, by the node's clock",
            )
        begins_ns.append(begin_ns)
    return [(begin_ns - min(begins_ns)) * 1e-9 for begin_ns in begins_ns]


def _flatten_frames(frames: FrameBatch, extra: Mapping[str, Array]) -> dict[str, Array]:
    measured = {column.name: getattr(frames, column.name) for column in MEASURED_COLUMNS}
    flat: dict[str, Array] = {}
    for name, value in {**measured, **extra}.items():
        parts = value.T if COLUMNS_BY_NAME[name].per_tile else value[None]
        flat |= zip(COLUMNS_BY_NAME[name].flat_names(len(parts)), parts, strict=True)
    return flat


def _select_rows(flat: FlatColumns, rows: Array) -> dict[str, Array]:
    """Return the selected rows, without a copy if they are contiguous."""
    at = np.flatnonzero(rows)
    begin, end = (int(at[0]), int(at[-1]) + 1) if len(at) else (0, 0)
    if end - begin == len(at):
        return {name: value[begin:end] for name, value in flat.items()}
    return {name: value[at] for name, value in flat.items()}


def _columns_to_read(
    chosen: Mapping[str, str], derived: Sequence[str], names: Sequence[str], *, has_parts: bool
) -> list[str]:
    """Return the columns to read: selected columns, and those needed to select rows and derive."""
    by = ["t_ns", *(("t_mono_ns", "seq") if derived else ()), *(("part",) if has_parts else ())]
    read = [name for name, of in chosen.items() if of not in (*derived, *_TIME_NAMES)]
    return list(dict.fromkeys([*read, *(name for name in by if name in names)]))


def _resolve_columns(
    present: Sequence[str], tiles: int, requested: Sequence[str]
) -> dict[str, str]:
    """Return the quantity of every requested column by flat name, in order, without duplicates."""
    flat = {f: name for name in present for f in COLUMNS_BY_NAME[name].flat_names(tiles)}
    if not requested:
        return flat
    chosen: dict[str, str] = {}
    for name in requested:
        if name in present:
            chosen |= dict.fromkeys(COLUMNS_BY_NAME[name].flat_names(tiles), name)
        elif name in flat:
            chosen[name] = flat[name]
        else:
            raise UsageError(
                f"no column {name[:80]!r} in this session",
                expected=f"some of {', '.join(present)}",
                remedy=_DERIVED_COLUMN_REMEDIES.get(name, ""),
            )
    return chosen
