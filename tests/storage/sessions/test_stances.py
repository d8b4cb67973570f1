"""The table of stances beside a session's frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.errors import DamagedFileError, OtherVersionError
from service.estimation.stances import STANCE_COLUMNS, Stance
from storage.parquet_hash import write_hashed_table
from storage.sessions.stances import (
    STORED_STANCE_COLUMNS,
    make_stance_table,
    read_stances,
    write_stances,
)

NAN = float("nan")
HOP = Stance(
    *(1, 0, 10, 30, 2e-9, 5.0, 20, 0.5, 9e-8, 8e-9, -0.01, 0.02, 0.03, 0.001),
    *(3, 0, 0, 0.0, 16, True, True),
)
HIDDEN = Stance(
    *(2, 1, 50, 90, NAN, NAN, None, NAN, NAN, NAN, NAN, NAN, NAN, NAN),
    *(2, 1, 3, 0.01, 1, True, False),
)
HASH = "0123456789abcdef" * 4


def written(path: Path) -> pa.Table:
    table = make_stance_table(stance.as_dict() for stance in (HOP, HIDDEN))
    write_stances(path, table, frames_sha256=HASH)
    return table


def test_the_table_has_what_is_said_of_a_stance_with_units(tmp_path: Path) -> None:
    assert tuple(column.name for column in STORED_STANCE_COLUMNS) == STANCE_COLUMNS
    written(tmp_path / "stances.parquet")
    schema = pq.read_schema(tmp_path / "stances.parquet")
    units = {field.name: (field.metadata or {})[b"unit"].decode() for field in schema}
    assert units["impulse_n_s"] == "N s"
    assert units["peak_grf_n"] == units["peak_sigma_n"] == "N"
    assert all(name.rsplit("_", 1)[-1] == "ns" for name, unit in units.items() if unit == "ns")


def test_what_was_written_is_read_and_what_is_not_known_is_null(tmp_path: Path) -> None:
    path = tmp_path / "stances.parquet"
    table = written(path)
    stored = read_stances(path)
    assert stored.frames_sha256 == HASH
    assert stored.table.equals(table)
    hop, hidden = stored.table.to_pylist()
    assert hop == HOP.as_dict()
    unknown = {name for name, value in hidden.items() if value is None}
    assert unknown == {
        name
        for name, value in HIDDEN.as_dict().items()
        if value is None or (isinstance(value, float) and np.isnan(value))
    }


def test_a_session_without_a_stance_has_a_table_without_rows(tmp_path: Path) -> None:
    write_stances(tmp_path / "stances.parquet", make_stance_table(()), frames_sha256=HASH)
    assert read_stances(tmp_path / "stances.parquet").table.to_pylist() == []


def test_another_table_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "stances.parquet"
    write_hashed_table(path, pa.table({"number": [1]}))
    with pytest.raises(DamagedFileError, match="no table of stances"):
        read_stances(path)
    pq.write_table(make_stance_table(()), path)
    with pytest.raises(DamagedFileError, match="its hash is gone"):
        read_stances(path)


def test_a_table_of_another_version_is_told_from_a_damaged_one(tmp_path: Path) -> None:
    path = tmp_path / "stances.parquet"
    older = written(path).drop_columns(["gap_s"])
    write_stances(path, older, frames_sha256=HASH)
    with pytest.raises(OtherVersionError, match="another version of foottile wrote it"):
        read_stances(path)
