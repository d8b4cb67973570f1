"""Parquet, Arrow and CSV in programs that are not ours: pandas, DuckDB, polars."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import duckdb
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from tests.storage.formats.exports import ROWS, exported, extra, frames

COLUMNS = ("time_s", "time_utc", "t_ns", "grf_n", "phase")


def put(folder: Path, to: str, options: FormatOptions = NO_OPTIONS) -> Path:
    path = folder / f"session.{to}"
    path.write_bytes(exported(to, Slice(columns=COLUMNS), options=options))
    return path


def check(found: pd.DataFrame) -> None:
    batch, columns = frames(), extra()
    assert found["t_ns"].tolist() == batch.t_ns.tolist()
    times = pd.DatetimeIndex(found["time_utc"]).tz_convert("UTC")
    assert times.as_unit("ns").asi8.tolist() == batch.t_ns.tolist()
    since_s = (batch.t_ns - batch.t_ns[0]) * 1e-9
    np.testing.assert_allclose(found["time_s"].astype(float), since_s, atol=1e-12)
    np.testing.assert_allclose(found["grf_n"].astype(float), columns["grf_n"], rtol=1e-6)
    assert found["phase"].tolist() == columns["phase"].tolist()


def test_parquet_has_what_readers_of_2021_know(tmp_path: Path) -> None:
    """Format 2.6 of 2018: no encoding, codec or logical type is newer."""
    path = tmp_path / "all.parquet"
    options = FormatOptions(times=True, names="serial")
    path.write_bytes(exported("parquet", options=options))
    file = pq.ParquetFile(path)
    group = file.metadata.row_group(0)
    chunks = [group.column(i) for i in range(group.num_columns)]
    assert {"time_utc", "pressure_raw_T01", "grf_n", "phase"} <= {c.path_in_schema for c in chunks}
    assert {e for chunk in chunks for e in chunk.encodings} == {"PLAIN", "RLE", "RLE_DICTIONARY"}
    assert {chunk.compression for chunk in chunks} == {"ZSTD"}
    types = {
        json.loads(file.schema.column(i).logical_type.to_json())["Type"] for i in range(len(chunks))
    }
    assert types == {"None", "Int", "String", "Timestamp"}


def test_pandas_reads_tables_with_instants_to_the_nanosecond(tmp_path: Path) -> None:
    check(pd.read_parquet(put(tmp_path, "parquet")))
    check(pd.read_feather(put(tmp_path, "arrow")))
    check(pd.read_csv(put(tmp_path, "csv"), parse_dates=["time_utc"]))
    comma = put(tmp_path, "csv", FormatOptions(decimal="comma"))
    check(pd.read_csv(comma, sep=";", decimal=",", parse_dates=["time_utc"]))


def test_duckdb_reads_parquet_and_csv(tmp_path: Path) -> None:
    paths = put(tmp_path, "parquet"), put(tmp_path, "csv")
    for path, how in zip(paths, ("read_parquet", "read_csv"), strict=True):
        question = f"SELECT count(*), max(time_s), sum(t_ns % 1000), max(grf_n) FROM {how}(?)"  # noqa: S608  # our own words
        (row,) = duckdb.execute(question, [str(path)]).fetchall()
        count, time_s, rest, grf_n = row
        batch = frames()
        assert (count, rest) == (ROWS, int((batch.t_ns % 1000).sum()))
        assert time_s == pytest.approx((batch.t_ns[-1] - batch.t_ns[0]) * 1e-9)
        assert grf_n == pytest.approx(np.nanmax(extra()["grf_n"]), rel=1e-6)


@pytest.mark.skipif(importlib.util.find_spec("polars") is None, reason="polars is not installed")
def test_polars_reads_parquet_and_arrow(tmp_path: Path) -> None:
    polars = importlib.import_module("polars")
    for found in (
        polars.read_parquet(put(tmp_path, "parquet")),
        polars.read_ipc(put(tmp_path, "arrow")),
    ):
        assert found["t_ns"].to_list() == frames().t_ns.tolist()
        assert found["time_utc"].to_physical().to_list() == frames().t_ns.tolist()
        assert found["phase"].to_list() == extra()["phase"].tolist()
