"""Table of columns from which the Arrow schemas of wire and disk are made.

On the wire (and in a journal) a column with one value per tile is a fixed-size list, so that a
message is read as numpy views without a copy. In a sealed file it is flat, `pressure_raw_0`,
`pressure_raw_1`, ..., because that compresses best and any tool can read it. Units and meaning are
in the field metadata of both, the array's description in the schema metadata.

Where pandas is installed, pyarrow imports it when a process makes its first array, to recognise
pandas types: 0.45 s of CPU and 35 MB. It tries only once. A later call of `to_pandas` still imports
pandas.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.chips.pressure_chips import check_chips, get_raw_type
from devices.errors import DamagedFileError, FileFormatError
from devices.flags import CONTACT_UNKNOWN, EstimateFlag, FrameFlag, TileFlag, list_bits
from devices.frames import (
    FRAME_COLUMNS,
    NO_SERVO_AGE,
    NO_SERVO_COUNTS,
    NOT_READ,
    RAW_COLUMNS,
    ArrayInfo,
    FrameBatch,
)


class _PandasBlocker(MetaPathFinder):
    """Import finder, before all others, that reports pandas as missing."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if fullname == "pandas":
            raise ModuleNotFoundError("not needed here", name=fullname)
        return None


def _skip_pyarrow_pandas_import() -> None:
    """Make pyarrow's one attempt to import pandas fail; no effect if pandas is loaded already."""
    if "pandas" in sys.modules:
        return
    finder = _PandasBlocker()
    sys.meta_path.insert(0, finder)
    try:
        pa.array([0])
    finally:
        sys.meta_path.remove(finder)


_skip_pyarrow_pandas_import()  # here: a schema is imported before any array is made

ARRAY_INFO_KEY = b"foottile.array_info"
ARRAY_HASH_KEY = b"foottile.array_info_sha256"
"""Key of the description's checksum in a journal's segments, whose header has no other one."""
ROUNDING_STEP_KEY = "rounded_to"
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
    wide_type: pa.DataType | None = None
    """Type in an array with a chip of more than 16 bits, for counts."""
    missing_value: int | None = None
    """Stand-in for an unknown value in memory; null in files. Floats: NaN, null too."""

    def flat_names(self, tiles: int) -> list[str]:
        """Return the names of its columns in a flat file."""
        return [f"{self.name}_{i}" for i in range(tiles)] if self.per_tile else [self.name]

    def type_for(self, dtype: np.dtype[Any]) -> pa.DataType:
        """Return its type for values of a numpy type."""
        return self.wide_type if self.wide_type is not None and dtype == np.uint32 else self.type

    def make_field(
        self, name: str, type_: pa.DataType, *, nullable: bool, rounding_step: float | None = None
    ) -> pa.Field[Any]:
        """Return an Arrow field with unit, description and rounding step in its metadata."""
        metadata = {"unit": self.unit, "description": self.description}
        if rounding_step is not None:
            metadata[ROUNDING_STEP_KEY] = repr(rounding_step)
        return pa.field(name, type_, nullable=nullable, metadata=metadata)


def _frame_column(name: str, unit: str, description: str, missing: int | None = None) -> Column:
    dtype, per_tile = FRAME_COLUMNS[name]
    wide = pa.uint32() if name in RAW_COLUMNS else None
    return Column(name, pa.from_numpy_dtype(dtype), unit, description, per_tile, wide, missing)


MEASURED_COLUMNS = (
    _frame_column("seq", "1", "number of the frame in its stream"),
    _frame_column("t_mono_ns", "ns", "CLOCK_MONOTONIC of the node at the sample of the first tile"),
    _frame_column("t_ns", "ns", "the same instant in UTC since 1970"),
    _frame_column("pressure_raw", "counts", "raw pressure counts of the chip", NOT_READ),
    _frame_column("temperature_raw", "counts", "raw temperature counts of the chip", NOT_READ),
    _frame_column("sample_offset_us", "us", "sample instant of the tile minus t_ns"),
    _frame_column("servo_counts", "counts", "newest servo position", NO_SERVO_COUNTS),
    _frame_column("servo_age_us", "us", "age of the servo position at t_ns", NO_SERVO_AGE),
    _frame_column("tile_flags", "bits", list_bits(TileFlag)),
    _frame_column("frame_flags", "bits", list_bits(FrameFlag)),
    _frame_column("reference_force_n", "N", "force of the calibration rig's sensor"),
)
"""Columns that a node measures: `devices.frames.FrameBatch`."""

_F32 = pa.float32()

ESTIMATE_COLUMNS = (
    Column("gauge_kpa", _F32, "kPa", "gas pressure above the tile's own baseline", True),
    Column("force_n", _F32, "N", "force on the tile along its axis", True),
    Column("force_sigma_n", _F32, "N", "standard uncertainty of force_n", True),
    Column("grf_n", _F32, "N", "ground reaction force: sum of the tile forces"),
    Column("grf_sigma_n", _F32, "N", "standard uncertainty of grf_n"),
    Column("grf_lower_bound_n", _F32, "N", "lower bound of the GRF, also where grf_n is not known"),
    Column("cop_x_m", _F32, "m", "centre of pressure, foot frame, x forward"),
    Column("cop_y_m", _F32, "m", "centre of pressure, foot frame, y to the left"),
    Column("cop_sigma_x_m", _F32, "m", "standard uncertainty of cop_x_m"),
    Column("cop_sigma_y_m", _F32, "m", "standard uncertainty of cop_y_m"),
    Column("cop_index_x", _F32, "1", "paper eq. 4: pressure-weighted grid index along x, from 1"),
    Column("cop_index_y", _F32, "1", "paper eq. 4: pressure-weighted grid index along y, from 1"),
    Column("cop_ground_x_m", _F32, "m", "centre of pressure, ground frame (paper eq. 3)"),
    Column("cop_ground_y_m", _F32, "m", "centre of pressure, ground frame"),
    Column("angle_rad", _F32, "rad", "angle of the foot segment from the servo"),
    Column("contact", pa.uint8(), "1", "1: the foot bears load", missing_value=CONTACT_UNKNOWN),
    Column("estimate_flags", pa.uint16(), "bits", list_bits(EstimateFlag)),
)
"""Columns that the estimator computes: `service.estimation.records.Estimates`."""

ANGLE_COLUMNS = (
    Column("angle_source", pa.string(), "1", "what measured angle_rad: video, or none"),
    Column("angle_sigma_rad", _F32, "rad", "standard uncertainty of angle_rad"),
    Column("cop_ground_sigma_x_m", _F32, "m", "standard uncertainty of cop_ground_x_m"),
)
"""Columns beside the estimates if their angle is from a table: `foottile estimate --angle`."""

TRUTH_COLUMNS = (
    Column("true_force_n", pa.float64(), "N", "emulation: force on the dome along its axis", True),
    Column("true_grf_n", pa.float64(), "N", "emulation: vertical sum of the dome forces"),
    Column("true_plate_n", pa.float64(), "N", "emulation: vertical force on the whole foot"),
    Column("true_cop_x_m", pa.float64(), "m", "emulation: true centre of pressure, foot frame"),
    Column("true_cop_y_m", pa.float64(), "m", "emulation: true centre of pressure, foot frame"),
    Column("true_angle_rad", pa.float64(), "rad", "emulation: true angle of the foot segment"),
)
"""Ground truth of an emulated scene: `devices.emulation.world.GroundTruth`."""

INDENTER_COLUMNS = (
    Column("pressed_tile", pa.string(), "1", "serial of the tile under the spindle"),
    Column("phase", pa.string(), "1", "rest, load, unload, hold, release, tap or soak"),
)
"""Columns that the operator of an indentation rig records beside the frames."""

PART_COLUMNS = (Column("part", pa.uint16(), "1", "which part of the session, one for each start"),)
"""Part of a recorded session: `seq` begins at 0 again when the node restarts."""

UNKNOWN_T_NS = -(2**63)

SERVER_TIME_COLUMNS = (
    Column("t_server_ns", pa.int64(), "ns", "t_ns in the server's UTC", missing_value=UNKNOWN_T_NS),
    Column(
        "t_server_uncertainty_ns",
        pa.int64(),
        "ns",
        "bound of t_server_ns: the truth is within plus or minus this",
        missing_value=UNKNOWN_T_NS,
    ),
)
"""Server's time, computed by a clock table when a session is read; never in a sealed file."""

MARKER_COLUMNS = (Column("marker", pa.string(), "1", "what people marked at this frame"),)
"""Markers, placed when a session is read (`storage.formats.markers`); never in a sealed file."""

TIME_COLUMNS = (
    Column(
        "time_s", pa.float64(), "s", "seconds after the session's first frame, on its time axis"
    ),
    Column("time_utc", pa.timestamp("ns", "UTC"), "UTC", "t_ns as a timestamp"),
)
"""Times computed from `t_ns` when a session is read; never in a sealed file."""

COLUMNS_BY_NAME = {
    column.name: column
    for column in (
        *MEASURED_COLUMNS,
        *PART_COLUMNS,
        *ESTIMATE_COLUMNS,
        *ANGLE_COLUMNS,
        *TRUTH_COLUMNS,
        *INDENTER_COLUMNS,
        *SERVER_TIME_COLUMNS,
        *MARKER_COLUMNS,
        *TIME_COLUMNS,
    )
}
"""Every column by its name."""


def numpy_dtype_of(number_type: pa.DataType) -> np.dtype[Any]:
    """Return the numpy type of an Arrow type of numbers.

    `DataType.to_pandas_dtype` returns it, too, but imports pandas in pyarrow up to 25.
    """
    return pa.array([], number_type).to_numpy().dtype


# --- wire -----------------------------------------------------------------------------------------


def wire_schema(info: ArrayInfo) -> pa.Schema:
    """Return the Arrow schema of a stream of frames of this array."""
    tiles, text = len(info.tiles), info.model_dump_json().encode()
    raw_type = get_raw_type(info.tiles)
    return pa.schema(
        [
            column.make_field(
                column.name,
                pa.list_(pa.field("item", column.type_for(raw_type), nullable=False), tiles)
                if column.per_tile
                else column.type,
                nullable=False,
            )
            for column in MEASURED_COLUMNS
        ],
        metadata={ARRAY_INFO_KEY: text, ARRAY_HASH_KEY: _sha256_hex(text)},
    )


def _sha256_hex(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest().encode()


def frames_to_record_batch(batch: FrameBatch, schema: pa.Schema) -> pa.RecordBatch:
    """Return frames as one Arrow record batch; buffers are shared, not copied."""
    arrays = []
    for column, field in zip(MEASURED_COLUMNS, schema, strict=True):
        values = getattr(batch, column.name)
        flat = pa.array(values.reshape(-1))
        arrays.append(
            pa.FixedSizeListArray.from_arrays(flat, type=field.type) if column.per_tile else flat
        )
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def frames_from_record_batch(record: pa.RecordBatch) -> FrameBatch:
    """Return frames as numpy views of a record batch; inverse of `frames_to_record_batch`.

    Raises:
        FileFormatError: the record batch does not hold frames.
    """
    try:
        return FrameBatch(**{column.name: _view(record, column) for column in MEASURED_COLUMNS})
    except (KeyError, ValueError, TypeError, AttributeError, pa.ArrowException) as error:
        raise FileFormatError(
            f"the Arrow message holds no frames: {error}",
            expected="the columns " + ", ".join(column.name for column in MEASURED_COLUMNS),
        ) from error


def _view(record: pa.RecordBatch, column: Column) -> Array:
    array = record.column(column.name)
    if array.null_count:  # a null row has no values, so later rows would shift
        raise ValueError(f"column {column.name} has {array.null_count} empty rows")
    if isinstance(array, pa.FixedSizeListArray):
        values = array.flatten().to_numpy(zero_copy_only=True)
        return values.reshape(len(record), array.type.list_size)
    return array.to_numpy(zero_copy_only=True)


def read_array_info(schema: pa.Schema, *, where: str) -> ArrayInfo:
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
    if metadata.get(ARRAY_HASH_KEY, _sha256_hex(text)) != _sha256_hex(text):
        raise DamagedFileError(
            "its description of the tile array was changed: its checksum is wrong", where=where
        )
    try:
        return check_chips(ArrayInfo.model_validate_json(text))
    except ValueError as error:
        raise FileFormatError(
            f"its description of the tile array is not readable: {error}", where=where
        ) from error


# --- flat -----------------------------------------------------------------------------------------


def map_flat_columns(tiles: int) -> dict[str, Column]:
    """Return the quantity of every possible flat column of an array, by the column's name."""
    return {
        flat: column for column in COLUMNS_BY_NAME.values() for flat in column.flat_names(tiles)
    }


def to_flat_columns(
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
            out.append(to_flat_column(column, name, part, notes))
    return out


def to_flat_column(
    column: Column, name: str, values: Array, notes: Mapping[str, object] | None = None
) -> tuple[pa.Field[Any], pa.Array[Any]]:
    """Return field and array of one flat column, n rows; missing values are null."""
    may_miss = column.missing_value is not None or not np.issubdtype(values.dtype, np.integer)
    steps = (notes or {}).get(ROUNDING_STEP_KEY)
    step = steps.get(name) if isinstance(steps, dict) else None
    field = column.make_field(
        name,
        column.type_for(values.dtype),
        nullable=may_miss,
        rounding_step=step if isinstance(step, float) else None,
    )
    return field, _to_arrow(np.ascontiguousarray(values), column)


def _to_arrow(values: Array, column: Column) -> pa.Array[Any]:
    mask = None
    if column.missing_value is not None:
        mask = values == column.missing_value
    type_ = column.type_for(values.dtype)
    # from_pandas: NaN is null. Arrow refuses a cast that would lose an integer's value.
    return pa.array(values, mask=mask, from_pandas=True).cast(type_, safe=type_ != _F32)


def read_quantity(column: Column, table: pa.Table, tiles: int) -> Array:
    """Read a quantity from a flat table, (n,) or (n, tiles); nulls become missing values.

    Raises:
        KeyError: the table has no such column.
        ValueError: its type is not the column's.
    """
    parts = [
        read_flat_column_and_fill_nulls(column, name, table) for name in column.flat_names(tiles)
    ]
    return np.stack(parts, axis=1) if column.per_tile else parts[0]


def read_flat_column_and_fill_nulls(column: Column, name: str, table: pa.Table) -> Array:
    """Read one flat column, (n,); nulls become missing values.

    Raises:
        KeyError: the table has no such column.
        ValueError: its type is not the column's.
    """
    array = table.column(name).combine_chunks()
    if array.type not in (column.type, column.wide_type):
        raise ValueError(f"column {name} is {array.type}, not {column.type}")
    if column.missing_value is not None:
        array = array.fill_null(column.missing_value)
    elif array.null_count and pa.types.is_integer(array.type):
        raise ValueError(f"column {name} has {array.null_count} empty values")
    return array.to_numpy(zero_copy_only=False)
