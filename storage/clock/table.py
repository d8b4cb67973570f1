"""Clock table of a session: maps each stream's own time to the server's UTC when it is read.

Raw instants stay as they are. A stream without a measured offset gets no server time at all: an
offset is never invented, nor copied from another stream, which has another anchor.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from devices.arrays import Bools, Times
from devices.errors import DamagedFileError, FileFormatError
from devices.types import OFFSET_NS_END, T_MONO_NS_END, T_NS_END
from storage.clock.bounds import ClockOffsets, OffsetRange, OffsetRows, OffsetStretch
from storage.clock.log import ClockOffset
from storage.parquet_hash import read_hashed_table, write_hashed_table
from storage.schema import UNKNOWN_T_NS, Array

UNCERTAINTY_END_NS = 2**59
"""Exclusive upper limit of an uncertainty, 18 years; with `OFFSET_NS_END` it fits 64 bits."""


@dataclass(frozen=True)
class StreamClockFacts:
    """Facts about a stream besides its measurements.

    Attributes:
        stream_id: its id.
        utc_offset_ns: `t_ns` minus `t_mono_ns` of its frames; None: unknown.
        clock_set: True: the node's clock was set before the stream started; None: unknown.
    """

    stream_id: str
    utc_offset_ns: int | None = None
    clock_set: bool | None = None


class ClockTable:
    """Map from instants of a session's streams to the server's UTC.

    Args:
        rows: measurements by stream_id, of any streams and in any order.
        streams: facts about the session's streams, each once.
        parts: stream_id of each part of the session, by its number.
        where: source of the rows, for errors.

    Raises:
        FileFormatError: a row has an impossible instant, offset or uncertainty.
    """

    def __init__(
        self,
        rows: Mapping[str, OffsetRows],
        streams: Sequence[StreamClockFacts],
        parts: Sequence[str],
        *,
        where: str = "",
    ) -> None:
        self._streams = tuple(streams)
        self.parts = tuple(parts)
        """Stream id of each part."""
        self._maps: dict[str, ClockOffsets] = {}
        for stream in streams:
            own = rows.get(stream.stream_id)
            if own is not None and len(own):
                _check_rows_in_range(own, stream.stream_id, where)
                self._maps[stream.stream_id] = ClockOffsets(own)

    def compute_server_time_columns_or_unknown(
        self, t_mono_ns: Times, t_ns: Times, part: Array | None
    ) -> dict[str, Array]:
        """Compute the server's time of frames and its bound, as two columns.

        Args:
            t_mono_ns: int64[n], of one or several parts, in any order.
            t_ns: int64[n], the same instants in the node's UTC.
            part: uint16[n]; None: all are of the first part.

        Returns:
            `t_server_ns` and `t_server_uncertainty_ns`, int64[n]; `UNKNOWN_T_NS` in both where the
                stream's offset was not measured.
        """
        t_server_ns = np.full(len(t_ns), UNKNOWN_T_NS, dtype=np.int64)
        uncertainty_ns = t_server_ns.copy()
        sane = _mask_within(t_mono_ns, T_MONO_NS_END) & _mask_within(t_ns, T_NS_END)
        for number, stream_id in enumerate(self.parts):
            clock = self._maps.get(stream_id)
            here = np.flatnonzero(sane if part is None else sane & (part == number))
            if clock is None or not len(here) or (part is None and number):
                continue
            offset, bound = clock.offset_and_bound_at(t_mono_ns[here])
            sums = t_ns[here] + offset
            fits = ((t_ns[here] ^ sums) & (offset ^ sums)) >= 0
            t_server_ns[here[fits]] = sums[fits]
            uncertainty_ns[here[fits]] = bound[fits]
        return {"t_server_ns": t_server_ns, "t_server_uncertainty_ns": uncertainty_ns}

    def bound_offset_in_ranges(
        self, begins_t_mono_ns: Times, ends_t_mono_ns: Times, part: int
    ) -> OffsetRange | None:
        """Compute bounds of `t_server_ns - t_ns` over n time ranges; None: never measured.

        Args:
            begins_t_mono_ns: int64[n], `t_mono_ns` of each begin.
            ends_t_mono_ns: int64[n], `t_mono_ns` of each end, not before its begin.
            part: number of the part.
        """
        clock = self._maps.get(self.parts[part]) if part < len(self.parts) else None
        if clock is None:
            return None
        sane = _mask_within(begins_t_mono_ns, T_MONO_NS_END) & _mask_within(
            ends_t_mono_ns, T_MONO_NS_END
        )
        found = clock.bound_offset_in_ranges(
            np.where(sane, begins_t_mono_ns, 0), np.where(sane, ends_t_mono_ns, 0)
        )
        return found._replace(is_certain=found.is_certain & sane)

    def summarize_streams(self) -> ClockSummary:
        """Return stretches, drifts, steps and state of every stream, in the session's order."""
        return ClockSummary(
            streams=tuple(self._summarize_stream(stream) for stream in self._streams)
        )

    def _summarize_stream(self, stream: StreamClockFacts) -> StreamSummary:
        clock = self._maps.get(stream.stream_id)
        state: ClockState = "measured"
        if clock is None:
            state = "unsynchronised" if stream.clock_set is False else "unmeasured"
        stretches = clock.stretches if clock is not None else ()
        return StreamSummary(
            stream_id=stream.stream_id,
            state=state,
            rows=len(clock.rows) if clock is not None else 0,
            stretches=tuple(_summarize_stretch(stretch, stream) for stretch in stretches),
            steps=tuple(
                _summarize_step(one, next_one, stream) for one, next_one in pairwise(stretches)
            ),
        )


def group_rows_by_stream_in_given_order(
    rows: Iterable[ClockOffset], *, where: str = ""
) -> dict[str, OffsetRows]:
    """Group the measurements of a session by stream_id, as columns.

    Raises:
        FileFormatError: a number is too large for a column.
    """
    found: dict[str, list[tuple[int, int, int]]] = {}
    for row in rows:
        numbers = (row.t_mono_ns, row.server_minus_node_ns, row.uncertainty_ns)
        found.setdefault(row.stream_id, []).append(numbers)
    try:
        return {
            stream_id: OffsetRows(*np.array(numbers, dtype=np.int64).T.copy())
            for stream_id, numbers in found.items()
        }
    except OverflowError as error:
        raise FileFormatError(f"a clock row is out of range: {error}", where=where) from error


def _check_rows_in_range(rows: OffsetRows, stream_id: str, where: str) -> None:
    """Refuse measurements that no clock can give.

    Raises:
        FileFormatError: a row is out of range.
    """
    sane = {
        "t_mono_ns": _mask_within(rows.t_mono_ns, T_MONO_NS_END),
        "server_minus_node_ns": _mask_within(rows.offset_ns, OFFSET_NS_END),
        "uncertainty_ns": (rows.uncertainty_ns >= 0) & (rows.uncertainty_ns < UNCERTAINTY_END_NS),
    }
    for (name, good), values in zip(
        sane.items(), (rows.t_mono_ns, rows.offset_ns, rows.uncertainty_ns), strict=True
    ):
        if not good.all():
            raise FileFormatError(
                f"a clock row of stream {stream_id} has {name} = {values[~good][0]}",
                where=where,
                expected=f"t_mono_ns within {T_MONO_NS_END} ns, an offset within {OFFSET_NS_END}, "
                f"an uncertainty from 0 to {UNCERTAINTY_END_NS}",
            )


def _mask_within(values: Times, end: int) -> Bools:
    return (values > -end) & (values < end)


def _summarize_stretch(stretch: OffsetStretch, stream: StreamClockFacts) -> StretchSummary:
    middle_ns = (stretch.begin_t_mono_ns + stretch.end_t_mono_ns) // 2
    low, high = _bounds_at(stretch, middle_ns)
    drift = stretch.narrowed_mean_rate_bounds
    return StretchSummary(
        begin_t_ns=_to_utc_ns(stretch.begin_t_mono_ns, stream),
        end_t_ns=_to_utc_ns(stretch.end_t_mono_ns, stream),
        rows=len(stretch.rows),
        offset_ns=(low + high) // 2,
        uncertainty_ns=(high - low + 1) // 2,
        drift_ppm=None if drift is None else (drift[0] + drift[1]) / 2 * 1e6,
        drift_uncertainty_ppm=None if drift is None else (drift[1] - drift[0]) / 2 * 1e6,
    )


def _summarize_step(
    one: OffsetStretch, next_one: OffsetStretch, stream: StreamClockFacts
) -> StepSummary:
    middle_ns = (one.end_t_mono_ns + next_one.begin_t_mono_ns) // 2
    low, high = _bounds_at(one, middle_ns)
    later_low, later_high = _bounds_at(next_one, middle_ns)
    least, most = later_low - high, later_high - low
    return StepSummary(
        after_t_ns=_to_utc_ns(one.end_t_mono_ns, stream),
        before_t_ns=_to_utc_ns(next_one.begin_t_mono_ns, stream),
        jump_ns=(least + most) // 2,
        jump_uncertainty_ns=(most - least + 1) // 2,
    )


def _bounds_at(stretch: OffsetStretch, t_mono_ns: int) -> tuple[int, int]:
    low, high = stretch.offset_bounds_at(np.array([t_mono_ns], dtype=np.int64))
    return int(low[0]), int(high[0])


def _to_utc_ns(t_mono_ns: int, stream: StreamClockFacts) -> int | None:
    return None if stream.utc_offset_ns is None else t_mono_ns + stream.utc_offset_ns


ClockState = Literal["measured", "unmeasured", "unsynchronised"]
"""Clock state of a stream."""


class _FrozenModel(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class StretchSummary(_FrozenModel):
    """Measurements between which neither clock was set."""

    begin_t_ns: int | None = Field(
        description="First measurement, in the node's `t_ns`; null: the stream has no known UTC."
    )
    end_t_ns: int | None = Field(description="Last measurement, in the node's `t_ns`.")
    rows: int = Field(description="Measurements that cannot belong to another stretch.")
    offset_ns: int = Field(description="Server's UTC minus the node's, half-way through.")
    uncertainty_ns: int = Field(description="Bound of `offset_ns`: the truth is within it.")
    drift_ppm: float | None = Field(
        description="Mean rate at which the server's clock gains on the node's; null: the rows do "
        "not narrow it beyond the tolerance of two crystals."
    )
    drift_uncertainty_ppm: float | None = Field(description="Bound of `drift_ppm`.")


class StepSummary(_FrozenModel):
    """Step of one of the clocks: it was set, or stood still while its machine slept."""

    after_t_ns: int | None = Field(
        description="Lower bound of the step's instant, in the node's `t_ns`."
    )
    before_t_ns: int | None = Field(description="Upper bound of the step's instant.")
    jump_ns: int = Field(description="Change of the offset.")
    jump_uncertainty_ns: int = Field(description="Bound of `jump_ns`.")


class StreamSummary(_FrozenModel):
    """Clock of one stream."""

    stream_id: str
    state: ClockState = Field(
        description="unmeasured: offset unknown; unsynchronised: the node's clock was unset, too."
    )
    rows: int = Field(description="Measurements of the offset.")
    stretches: tuple[StretchSummary, ...]
    steps: tuple[StepSummary, ...]


class ClockSummary(_FrozenModel):
    """Clocks of a session's streams against the server's."""

    streams: tuple[StreamSummary, ...]


CLOCK_NAME = "clock.parquet"
STREAMS_KEY = b"foottile.streams"

_NUMBERS = ("t_mono_ns", "server_minus_node_ns", "uncertainty_ns")
_FIELDS: list[pa.Field[Any]] = [
    pa.field("stream_id", pa.string(), nullable=False),
    *(pa.field(name, pa.int64(), nullable=False) for name in _NUMBERS),
]
_SCHEMA = pa.schema(_FIELDS)


_STREAMS = TypeAdapter(tuple[StreamClockFacts, ...])


def write_clock_file(
    path: Path, rows: Sequence[ClockOffset], streams: Sequence[StreamClockFacts]
) -> None:
    """Write a session's clock measurements, with the facts about its streams as metadata.

    Raises:
        StorageError: the disk is full or not writable.
        OverflowError: a number does not fit an int64.
    """
    facts = [vars(stream) for stream in streams]
    columns = {name: [getattr(row, name) for row in rows] for name in _SCHEMA.names}
    schema = _SCHEMA.with_metadata({STREAMS_KEY: json.dumps(facts).encode()})
    write_hashed_table(path, pa.table(columns, schema=schema))


@dataclass(frozen=True)
class StoredClock:
    """Content of `clock.parquet`.

    Attributes:
        rows_by_stream: measurements by stream_id.
        facts: facts about streams, by stream_id.
    """

    rows_by_stream: dict[str, OffsetRows]
    facts: dict[str, StreamClockFacts]

    @property
    def offsets(self) -> tuple[ClockOffset, ...]:
        """Measurements as single rows, stream by stream."""
        return tuple(
            ClockOffset(
                stream_id=stream_id,
                t_mono_ns=t_mono_ns,
                server_minus_node_ns=offset_ns,
                uncertainty_ns=uncertainty_ns,
            )
            for stream_id, rows in self.rows_by_stream.items()
            for t_mono_ns, offset_ns, uncertainty_ns in zip(
                rows.t_mono_ns.tolist(),
                rows.offset_ns.tolist(),
                rows.uncertainty_ns.tolist(),
                strict=True,
            )
        )


def read_clock_file(path: Path) -> StoredClock:
    """Read `clock.parquet` and verify it.

    Raises:
        FileNotFoundError: there is no such file.
        FileFormatError: it is damaged, no clock table, or a row has impossible numbers.
    """
    stored = read_hashed_table(path)
    try:
        table = stored.select(_SCHEMA.names).cast(_SCHEMA)
        table.validate(full=True)
        facts = _STREAMS.validate_json((stored.schema.metadata or {})[STREAMS_KEY])
        stream_ids = np.asarray(table.column("stream_id").to_pylist(), dtype=object)
        arrays = [table.column(name).to_numpy() for name in _NUMBERS]
    except Exception as error:  # other content may cause any error
        raise DamagedFileError(
            f"cannot be read as a clock table: {' '.join(str(error).split())[:300]}",
            where=str(path),
            expected=f"columns stream_id, {', '.join(_NUMBERS)} without empty values",
        ) from error
    rows = {
        str(stream_id): OffsetRows(*(values[stream_ids == stream_id] for values in arrays))
        for stream_id in dict.fromkeys(stream_ids.tolist())
    }
    for stream_id, own in rows.items():
        _check_rows_in_range(own, stream_id, str(path))
    return StoredClock(rows, {stream.stream_id: stream for stream in facts})
