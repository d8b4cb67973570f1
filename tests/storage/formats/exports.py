"""Frames and estimates of a session, exported in pieces and read back."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq

from devices.flags import CONTACT_UNKNOWN
from devices.frames import NO_SERVO_AGE, NO_SERVO_COUNTS, NOT_READ, ArrayInfo, FrameBatch
from storage.clock.table import ClockTable
from storage.formats.export import Export, FrameSource, make_one_pass_frame_source
from storage.formats.markers import PlacedMarkers
from storage.formats.slice import FormatOptions, Slice
from storage.formats.writers.registry import get_format
from storage.schema import Array
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames

BEGIN_NS = 10**18 + 123
ROWS = 50
NOTES: dict[str, object] = {"seed": 7, "scene": {"name": "mud"}}
Piece = tuple[FrameBatch, dict[str, Array]]


def frames(rows: int = ROWS, tiles: int = 2, *, period_ns: int = PERIOD_NS) -> FrameBatch:
    """Frames of which some values are not known."""
    rng = np.random.default_rng(5)
    pressure_raw = rng.integers(250, 420, (rows, tiles))
    pressure_raw[rng.random((rows, tiles)) < 0.2] = NOT_READ
    servo_counts = rng.integers(-5000, 5000, rows)
    servo_counts[::7] = NO_SERVO_COUNTS
    return make_frames(
        np.arange(rows) + 2**60,
        tiles,
        t_mono_ns=123 + period_ns * np.arange(rows),
        pressure_raw=pressure_raw,
        temperature_raw=rng.integers(470, 490, (rows, tiles)),
        sample_offset_us=rng.integers(-100, 3000, (rows, tiles)),
        servo_counts=servo_counts,
        servo_age_us=np.where(servo_counts == NO_SERVO_COUNTS, NO_SERVO_AGE, 5),
        tile_flags=rng.integers(0, 64, (rows, tiles)),
        frame_flags=rng.integers(0, 32, rows),
    )


def extra(rows: int = ROWS, tiles: int = 2) -> dict[str, Array]:
    rng = np.random.default_rng(6)
    force_n = rng.normal(0.0, 20.0, (rows, tiles))
    force_n[rng.random((rows, tiles)) < 0.2] = np.nan
    contact = rng.integers(0, 2, rows).astype(np.uint8)
    contact[::5] = CONTACT_UNKNOWN
    return {
        "part": np.zeros(rows, dtype=np.uint16),
        "force_n": force_n,
        "grf_n": force_n.sum(axis=1),
        "contact": contact,
        "estimate_flags": rng.integers(0, 512, rows).astype(np.uint16),
        "phase": np.array(["rest, or 'not'" if i % 3 else 'a "tap"' for i in range(rows)]),
    }


def cut(batch: FrameBatch, columns: Mapping[str, Array], every: int) -> Iterator[Piece]:
    for a in range(0, len(batch), every):
        yield (
            batch.slice_rows(a, a + every),
            {name: values[a : a + every] for name, values in columns.items()},
        )


TABLES = ("parquet", "arrow", "csv")
"""Formats that hold any columns, as a table."""
NO_TIMES = FormatOptions(times=False)
"""What is in the session, and nothing that is made of it."""


def export(
    content: FrameSource,
    info: ArrayInfo,
    notes: Mapping[str, object],
    to: str,
    part: Slice,
    clock: ClockTable | None = None,
    markers: PlacedMarkers | None = None,
    source: Mapping[str, object] | None = None,
    options: FormatOptions = NO_TIMES,
) -> Iterator[bytes]:
    wanted = Export(content, info, notes, part, clock, markers, source or {}, options)
    return get_format(to).encode(wanted)


def exported(
    to: str, part: Slice | None = None, *, every: int = 20, options: FormatOptions = NO_TIMES
) -> bytes:
    content = make_one_pass_frame_source(cut(frames(), extra(), every))
    chunks = export(content, make_array(), NOTES, to, part or Slice(), options=options)
    return b"".join(chunks)


def read(content: bytes, to: str) -> pa.Table:
    """The columns of frames; CSV has one more, of what is said of the file."""
    if to == "parquet":
        return pq.read_table(io.BytesIO(content))
    if to == "arrow":
        return pa.ipc.open_file(content).read_all()
    table = pacsv.read_csv(
        io.BytesIO(content),
        # A row of which the one column asked for is not known is an empty line.
        parse_options=pacsv.ParseOptions(ignore_empty_lines=False),
        convert_options=pacsv.ConvertOptions(null_values=[""], strings_can_be_null=False),
    )
    return table.drop_columns(["about"]) if "about" in table.column_names else table


def values(table: pa.Table) -> dict[str, list[object]]:
    """Values by column, floats in the precision of the file's type."""
    return {
        name: [np.float32(v) if isinstance(v, float) else v for v in table.column(name).to_pylist()]
        for name in table.column_names
    }


def names(part: Slice, to: str = "arrow") -> list[str]:
    return read(exported(to, part), to).column_names
