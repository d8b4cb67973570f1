"""`stances.parquet` beside a session's frames: a row for each stance.

The file can always be made again from the frames, byte for byte (`service.sessions.stances`): if it
is missing, damaged or of other frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa

from devices.errors import DamagedFileError, OtherVersionError
from storage.parquet_hash import read_hashed_table, write_hashed_table
from storage.schema import Column

STANCES_NAME = "stances.parquet"
FRAMES_HASH_KEY = b"foottile.frames_sha256"
"""Key of the file hash of the frames it was made from."""

_F64 = pa.float64()

STORED_STANCE_COLUMNS = (
    Column("number", pa.uint32(), "1", "of the stance in its session, from 1"),
    Column("part", pa.uint16(), "1", "part of the session in which it was"),
    Column("begin_t_ns", pa.int64(), "ns", "t_ns of its first frame"),
    Column("end_t_ns", pa.int64(), "ns", "t_ns of its last frame"),
    Column("duration_s", _F64, "s", "from the first frame to the last"),
    Column("duration_sigma_s", _F64, "s", "its standard uncertainty; null if an edge is not known"),
    Column("peak_grf_n", _F64, "N", "largest GRF less noise bias; null if unknown or saturated"),
    Column("peak_t_ns", pa.int64(), "ns", "t_ns of the frame with that GRF"),
    Column(
        "peak_sigma_n", _F64, "N", "its standard uncertainty; null if a gap may hide a higher peak"
    ),
    Column("impulse_n_s", _F64, "N s", "integral of the GRF; null if gaps exceed a quarter of it"),
    Column("impulse_sigma_n_s", _F64, "N s", "its standard uncertainty, gaps included"),
    Column("cop_x_first_m", _F64, "m", "cop_x_m where it is first stated"),
    Column("cop_x_last_m", _F64, "m", "cop_x_m where it is last stated"),
    Column(
        "cop_x_range_m", _F64, "m", "greatest cop_x_m less the least; a lower bound without a sigma"
    ),
    Column(
        "cop_x_range_sigma_m",
        _F64,
        "m",
        "its standard uncertainty; null if under 80 % of its frames have a COP",
    ),
    Column("frames", pa.uint32(), "1", "frames that are there, first and last included"),
    Column("unknown_frames", pa.uint32(), "1", "of these, without a GRF"),
    Column("missing_frames", pa.uint32(), "1", "numbers in between that are not there"),
    Column("gap_s", _F64, "s", "time without a frame or a GRF, within it and beside its ends"),
    Column("estimate_flags", pa.uint16(), "bits", "bits that any of its frames has"),
    Column("begun", pa.bool_(), "1", "the known contact before it is none, and near"),
    Column("ended", pa.bool_(), "1", "the known contact after it is none, and near"),
    Column("is_whole", pa.bool_(), "1", "begun, ended, and its impulse is known"),
)
"""Columns of a stance: `service.estimation.stances.Stance`."""

_NULLABLE_COLUMNS = frozenset(
    {"peak_t_ns", *(column.name for column in STORED_STANCE_COLUMNS if column.type == _F64)}
)
STANCE_SCHEMA = pa.schema(
    [
        column.make_field(column.name, column.type, nullable=column.name in _NULLABLE_COLUMNS)
        for column in STORED_STANCE_COLUMNS
    ]
)


def make_stance_table(rows: Iterable[Mapping[str, Any]]) -> pa.Table:
    """Convert stances to a table; NaN and None become null.

    Args:
        rows: values by the names of `STORED_STANCE_COLUMNS`.
    """
    content = list(rows)
    arrays = [
        # from_pandas: NaN is null
        pa.array([row[column.name] for row in content], column.type, from_pandas=True)
        for column in STORED_STANCE_COLUMNS
    ]
    return pa.Table.from_arrays(arrays, schema=STANCE_SCHEMA)


def write_stances(path: Path, table: pa.Table, *, frames_sha256: str) -> None:
    """Write `stances.parquet`; an existing one is replaced.

    Args:
        path: the file.
        table: of `make_stance_table`.
        frames_sha256: file hash of the stances' frames.

    Raises:
        StorageError: the disk is full or not writable; the old file is unchanged.
    """
    metadata = {FRAMES_HASH_KEY: frames_sha256.encode()}
    write_hashed_table(path, table.replace_schema_metadata(metadata), is_uncompressed=True)


@dataclass(frozen=True)
class StoredStances:
    """Content of `stances.parquet`.

    Attributes:
        table: table with the columns of `STORED_STANCE_COLUMNS`.
        frames_sha256: file hash of the frames it was made from.
    """

    table: pa.Table
    frames_sha256: str


def read_stances(path: Path) -> StoredStances:
    """Read `stances.parquet` and verify its hash.

    Raises:
        FileNotFoundError: there is no such file.
        DamagedFileError: its hash is wrong, or it is no table of stances.
        OtherVersionError: its columns are those of another version.
        StorageError: it cannot be read now.
    """
    table = read_hashed_table(path)
    metadata = table.schema.metadata or {}
    if FRAMES_HASH_KEY not in metadata:
        raise DamagedFileError(
            "is no table of stances",
            where=str(path),
            expected="a table with the hash of its frames",
            remedy="Delete it: it is made again from the frames",
        )
    if not table.schema.equals(STANCE_SCHEMA):
        raise OtherVersionError(
            "another version of foottile wrote it, with other columns",
            where=str(path),
            expected="columns " + ", ".join(STANCE_SCHEMA.names),
            remedy="None needed: it is made again from the frames",
        )
    return StoredStances(table, metadata[FRAMES_HASH_KEY].decode("ascii", "replace"))
