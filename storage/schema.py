"""Table of columns from which the Arrow schemas of wire and disk are made.

On the wire (and in a journal) a column with one value per tile is a fixed-size list, so that a
message is read as numpy views without a copy. In a sealed file it is flat, `pressure_raw_0`,
`pressure_raw_1`, ..., because that compresses best and any tool can read it. Units and meaning are
in the field metadata of both, the array's description in the schema metadata.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.errors import DamagedFileError, FileFormatError
from devices.frames import (
    FRAME_COLUMNS,
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    ArrayInfo,
    FrameBatch,
)
from storage.arrow_alone import leave_pandas_out

leave_pandas_out()  # here: every process of ours imports a schema before it makes an array

ARRAY_INFO_KEY = b"foottile.array_info"
ARRAY_HASH_KEY = b"foottile.array_info_sha256"
"""Key of the description's checksum in a journal's segments, whose header has no other one."""
ROUNDED_TO = "rounded_to"
"""Key of a column's rounding step, in the notes of a file and in each field's metadata."""

Array = npt.NDArray[Any]
"""Numpy column; its element type is stated by the column table, not by the type checker."""


@dataclass(frozen=True)
class Column:
    """Quantity of a frame: its name carries its unit, its type is that of the file."""

    name: str
    type: pa.DataType
    unit: str
    description: str
    per_tile: bool = False
    missing: int | None = None
    """Stand-in for an unknown value in memory; null in files. Floats: NaN, null too."""

    def flat_names(self, tiles: int) -> list[str]:
        """Return the names of its columns in a flat file."""
        return [f"{self.name}_{i}" for i in range(tiles)] if self.per_tile else [self.name]

    def field(
        self, name: str, type_: pa.DataType, *, nullable: bool, step: float | None = None
    ) -> pa.Field[Any]:
        """Return an Arrow field with unit, description and rounding step in its metadata."""
        metadata = {"unit": self.unit, "description": self.description}
        if step is not None:
            metadata[ROUNDED_TO] = repr(step)
        return pa.field(name, type_, nullable=nullable, metadata=metadata)


def _frame(name: str, unit: str, description: str, missing: int | None = None) -> Column:
    dtype, per_tile = FRAME_COLUMNS[name]
    return Column(name, pa.from_numpy_dtype(dtype), unit, description, per_tile, missing)


FRAMES = (
    _frame("seq", "1", "number of the frame in its stream"),
    _frame("t_mono_ns", "ns", "CLOCK_MONOTONIC of the node at the sample of the first tile"),
    _frame("t_ns", "ns", "the same instant in UTC since 1970"),
    _frame("padc", "counts", "raw pressure counts, falling with pressure", NOT_READ),
    _frame("tadc", "counts", "raw temperature counts of the chip", NOT_READ),
    _frame("sample_offset_us", "us", "sample instant of the tile minus t_ns"),
    _frame("servo_counts", "counts", "newest servo position", NO_SERVO_COUNTS),
    _frame("servo_age_us", "us", "age of the servo position at t_ns", NO_SERVO_AGE),
    _frame(
        "status",
        "bits",
        "1 no_answer, 2 stale, 4 retried, 8 implausible, 16 over_range, 32 not_converted",
    ),
    _frame(
        "frame_status",
        "bits",
        "1 overrun, 2 servo_stale, 4 bus_fault, 8 lead, 16 new_array_info, 32 servo_turn_unknown",
    ),
    _frame("reference_force_n", "N", "force of the calibration rig's sensor"),
)
"""Columns that a node measures: `devices.frames.FrameBatch`."""

_F32 = pa.float32()

CONTACT_UNKNOWN = 255

ESTIMATES = (
    Column("gauge_kpa", _F32, "kPa", "gas pressure above the tile's own baseline", True),
    Column("force_n", _F32, "N", "force on the tile along its axis", True),
    Column("force_sigma_n", _F32, "N", "standard uncertainty of force_n", True),
    Column("grf_n", _F32, "N", "ground reaction force: sum of the tile forces"),
    Column("grf_sigma_n", _F32, "N", "standard uncertainty of grf_n"),
    Column("grf_at_least_n", _F32, "N", "lower bound of the GRF, also where grf_n is not known"),
    Column("cop_x_m", _F32, "m", "centre of pressure, foot frame, x forward"),
    Column("cop_y_m", _F32, "m", "centre of pressure, foot frame, y to the left"),
    Column("cop_sigma_x_m", _F32, "m", "standard uncertainty of cop_x_m"),
    Column("cop_sigma_y_m", _F32, "m", "standard uncertainty of cop_y_m"),
    Column("cop_index_x", _F32, "1", "paper eq. 4: pressure-weighted grid index along x, from 1"),
    Column("cop_index_y", _F32, "1", "paper eq. 4: pressure-weighted grid index along y, from 1"),
    Column("cop_ground_x_m", _F32, "m", "centre of pressure, ground frame (paper eq. 3)"),
    Column("cop_ground_y_m", _F32, "m", "centre of pressure, ground frame"),
    Column("angle_rad", _F32, "rad", "angle of the foot segment from the servo"),
    Column("contact", pa.uint8(), "1", "1: the foot bears load", missing=CONTACT_UNKNOWN),
    Column(
        "estimate_status",
        pa.uint16(),
        "bits",
        "1 saturated, 2 extrapolated, 4 outlier_replaced, 8 gap, 16 cop_masked, 32 tile_missing, "
        "64 assumed_scale, 128 tare_old, 256 over_rated, 512 tare_lost, "
        "1024 after_saturation, 2048 stuck, 4096 clipped, 8192 baseline_lost",
    ),
)
"""Columns that the estimator computes: `service.estimation.estimates.Estimates`."""

TRUTH = (
    Column("true_force_n", pa.float64(), "N", "emulation: force on the dome along its axis", True),
    Column("true_grf_n", pa.float64(), "N", "emulation: vertical sum of the dome forces"),
    Column("true_plate_n", pa.float64(), "N", "emulation: vertical force on the whole foot"),
    Column("true_cop_x_m", pa.float64(), "m", "emulation: true centre of pressure, foot frame"),
    Column("true_cop_y_m", pa.float64(), "m", "emulation: true centre of pressure, foot frame"),
    Column("true_angle_rad", pa.float64(), "rad", "emulation: true angle of the foot segment"),
)
"""Ground truth of an emulated scene: `devices.emulation.world.Truth`."""

MILL = (
    Column("pressed_tile", pa.string(), "1", "serial of the tile under the spindle"),
    Column("phase", pa.string(), "1", "rest, load, unload, hold, release, tap or soak"),
)
"""Columns that the operator of an indentation rig records beside the frames."""

PARTS = (Column("part", pa.uint16(), "1", "which part of the session, one for each start"),)
"""Part of a recorded session: `seq` begins at 0 again when the node restarts."""

NO_INSTANT = -(2**63)

SERVER_TIME = (
    Column("t_server_ns", pa.int64(), "ns", "t_ns in the server's UTC", missing=NO_INSTANT),
    Column(
        "t_server_uncertainty_ns",
        pa.int64(),
        "ns",
        "bound of t_server_ns: the truth is within plus or minus this",
        missing=NO_INSTANT,
    ),
)
"""Server's time, computed by a clock table when a session is read; never in a sealed file."""

MARKS = (Column("event", pa.string(), "1", "what people marked at this frame"),)
"""Markers, placed when a session is read (`storage.formats.marks`); never in a sealed file."""

TIMES = (
    Column(
        "time_s", pa.float64(), "s", "seconds after the session's first frame, on its time axis"
    ),
    Column("time_utc", pa.timestamp("ns", "UTC"), "UTC", "t_ns as a timestamp"),
)
"""Times computed from `t_ns` when a session is read; never in a sealed file."""

KNOWN = {
    column.name: column
    for column in (*FRAMES, *PARTS, *ESTIMATES, *TRUTH, *MILL, *SERVER_TIME, *MARKS, *TIMES)
}
"""Every column by its name."""


def numpy_dtype(kind: pa.DataType) -> np.dtype[Any]:
    """Return the numpy type of an Arrow type of numbers.

    `DataType.to_pandas_dtype` returns it, too, but imports pandas in pyarrow up to 25.
    """
    return pa.array([], kind).to_numpy().dtype


# --- wire -----------------------------------------------------------------------------------------


def wire_schema(info: ArrayInfo) -> pa.Schema:
    """Return the Arrow schema of a stream of frames of this array."""
    tiles, text = len(info.tiles), info.model_dump_json().encode()
    return pa.schema(
        [
            column.field(
                column.name,
                pa.list_(pa.field("item", column.type, nullable=False), tiles)
                if column.per_tile
                else column.type,
                nullable=False,
            )
            for column in FRAMES
        ],
        metadata={ARRAY_INFO_KEY: text, ARRAY_HASH_KEY: _digits(text)},
    )


def older_wire_schema(info: ArrayInfo) -> pa.Schema:
    """Return the wire schema of older versions, which has no checksum of the description."""
    return wire_schema(info).with_metadata({ARRAY_INFO_KEY: info.model_dump_json().encode()})


def _digits(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest().encode()


def to_record_batch(batch: FrameBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return frames as one Arrow record batch; buffers are shared, not copied."""
    arrays = []
    for column, field in zip(FRAMES, schema, strict=True):
        values = getattr(batch, column.name)
        flat = pa.array(values.reshape(-1))
        arrays.append(
            pa.FixedSizeListArray.from_arrays(flat, type=field.type) if column.per_tile else flat
        )
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def from_record_batch(record: pa.RecordBatch) -> FrameBatch:
    """Return frames as numpy views of a record batch; inverse of `to_record_batch`.

    Raises:
        FileFormatError: the record batch does not hold frames.
    """
    try:
        return FrameBatch(**{column.name: _view(record, column) for column in FRAMES})
    except (KeyError, ValueError, TypeError, AttributeError, pa.ArrowException) as error:
        raise FileFormatError(
            f"the Arrow message holds no frames: {error}",
            expected="the columns " + ", ".join(column.name for column in FRAMES),
        ) from error


def _view(record: pa.RecordBatch, column: Column) -> Array:
    array = record.column(column.name)
    if array.null_count:  # a null row has no values, so later rows would shift
        raise ValueError(f"column {column.name} has {array.null_count} empty rows")
    if isinstance(array, pa.FixedSizeListArray):
        values = array.flatten().to_numpy(zero_copy_only=True)
        return values.reshape(len(record), array.type.list_size)
    return array.to_numpy(zero_copy_only=True)


def array_info(schema: pa.Schema, *, where: str) -> ArrayInfo:
    """Return the array description in a schema's metadata.

    Raises:
        FileFormatError: there is none, it is of another version, or it was changed.
    """
    metadata = schema.metadata or {}
    text = metadata.get(ARRAY_INFO_KEY)
    if text is None:
        raise FileFormatError(
            "no description of the tile array in it",
            where=where,
            expected="a file written by foottile",
        )
    if metadata.get(ARRAY_HASH_KEY, _digits(text)) != _digits(text):
        raise DamagedFileError(
            "its description of the tile array was changed: its checksum is wrong",
            where=where,
        )
    try:
        return ArrayInfo.model_validate_json(text)
    except ValueError as error:
        raise FileFormatError(
            f"its description of the tile array is not readable: {error}", where=where
        ) from error


# --- flat -----------------------------------------------------------------------------------------


def flat_of(tiles: int) -> dict[str, Column]:
    """Return the quantity of every possible flat column of an array, by the column's name."""
    return {flat: column for column in KNOWN.values() for flat in column.flat_names(tiles)}


def flat_columns(
    columns: Sequence[Column],
    values: Mapping[str, Array],
    notes: Mapping[str, object] | None = None,
) -> list[tuple[pa.Field[Any], pa.Array[Any]]]:
    """Return fields and arrays of a flat table, in the order of `columns`; missing values are null.

    Args:
        columns: quantities to convert.
        values: values by column name, (n,) or (n, tiles).
        notes: notes of the file, which may state rounding steps.
    """
    out = []
    for column in columns:
        data = values[column.name]
        parts = data.T if column.per_tile else data[None]
        for name, part in zip(column.flat_names(len(parts)), parts, strict=True):
            out.append(flat_column(column, name, part, notes))
    return out


def flat_column(
    column: Column, name: str, values: Array, notes: Mapping[str, object] | None = None
) -> tuple[pa.Field[Any], pa.Array[Any]]:
    """Return field and array of one flat column, n rows; missing values are null."""
    may_miss = column.missing is not None or not np.issubdtype(values.dtype, np.integer)
    steps = (notes or {}).get(ROUNDED_TO)
    step = steps.get(name) if isinstance(steps, dict) else None
    field = column.field(
        name, column.type, nullable=may_miss, step=step if isinstance(step, float) else None
    )
    return field, _to_arrow(np.ascontiguousarray(values), column)


def _to_arrow(values: Array, column: Column) -> pa.Array[Any]:
    mask = None
    if column.missing is not None:
        mask = values == column.missing
    # from_pandas: NaN is null. Arrow refuses a cast that would lose an integer's value.
    return pa.array(values, mask=mask, from_pandas=True).cast(column.type, safe=column.type != _F32)


def from_flat(column: Column, table: pa.Table, tiles: int) -> Array:
    """Read a quantity from a flat table, (n,) or (n, tiles); nulls become missing values.

    Raises:
        KeyError: the table has no such column.
        ValueError: its type is not the column's.
    """
    parts = [flat_values(column, name, table) for name in column.flat_names(tiles)]
    return np.stack(parts, axis=1) if column.per_tile else parts[0]


def flat_values(column: Column, name: str, table: pa.Table) -> Array:
    """Read one flat column, (n,); nulls become missing values.

    Raises:
        KeyError: the table has no such column.
        ValueError: its type is not the column's.
    """
    array = table.column(name).combine_chunks()
    if array.type != column.type:
        raise ValueError(f"column {name} is {array.type}, not {column.type}")
    if column.missing is not None:
        array = array.fill_null(column.missing)
    elif array.null_count and pa.types.is_integer(array.type):
        raise ValueError(f"column {name} has {array.null_count} empty values")
    return array.to_numpy(zero_copy_only=False)
