"""Parquet, Arrow and CSV: times, serials, commas and options; and programs that are not ours."""

from __future__ import annotations

import importlib.util
import io
import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

from devices.errors import UsageError
from storage.formats.export import make_one_pass_frame_source
from storage.formats.markers import PlacedMarker, PlacedMarkers
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers.registry import FORMATS, get_format
from storage.sessions.folder import Marker
from tests.builders.arrays import PERIOD_NS, make_array
from tests.storage.formats.exports import (
    BEGIN_NS,
    NOTES,
    ROWS,
    TABLES,
    cut,
    export,
    exported,
    extra,
    frames,
    read,
)
from tests.waiting import PATIENCE_S

SERIALS = [tile.serial for tile in make_array().tiles]


def test_names_and_endings_of_formats_differ_and_each_says_what_opens_it() -> None:
    assert len({known.ending for known in FORMATS.values()}) == len(FORMATS)
    assert all(known.opened_by and "/" in known.media_type for known in FORMATS.values())


def test_a_format_that_nobody_knows_is_refused_with_those_there_are() -> None:
    with pytest.raises(UsageError, match=r"no format 'x+'; expected one of parquet, arrow, csv"):
        get_format("x" * 10_000)


@pytest.mark.parametrize("to", TABLES)
def test_an_option_of_another_format_is_refused_before_the_first_chunk(to: str) -> None:
    known = {"names", "times"} | ({"decimal", "about"} if to == "csv" else set())
    asked = {"names": "serial", "times": False, "decimal": "comma", "about": True}
    for name, value in asked.items():
        options = FormatOptions.model_validate({name: value})
        if name in known:
            assert exported(to, options=options)
        else:
            with pytest.raises(UsageError, match=f"no option '{name}'"):
                exported(to, options=options)


@pytest.mark.parametrize("to", TABLES)
@pytest.mark.parametrize("start", [0, 20])
def test_seconds_and_timestamps_come_first(to: str, start: int) -> None:
    part = Slice(start * PERIOD_NS * 1e-9)
    table = read(exported(to, part, options=NO_OPTIONS), to)
    assert table.column_names[:3] == ["time_s", "time_utc", "seq"]
    since_ns = PERIOD_NS * np.arange(start, ROWS)
    assert np.abs(table["time_s"].to_numpy() - since_ns * 1e-9).max() < 1e-12
    times = table["time_utc"].cast(pa.timestamp("ns", "UTC")).cast(pa.int64())
    assert times.to_pylist() == table["t_ns"].to_pylist()
    assert times[0].as_py() == int(frames().t_ns[start])
    assert times[0].as_py() >= BEGIN_NS


@pytest.mark.parametrize("to", TABLES)
def test_with_serials_columns_of_a_tile_end_in_its_serial(to: str) -> None:
    part = Slice(columns=("grf_n", "force_n", "pressure_raw_1"))
    table = read(exported(to, part, options=FormatOptions(names="serial")), to)
    first, second = SERIALS
    expected = ["grf_n", f"force_n_{first}", f"force_n_{second}", f"pressure_raw_{second}"]
    assert table.column_names == expected
    by_number = read(exported(to, part), to)
    assert [column.to_pylist() for column in table.columns] == [
        column.to_pylist() for column in by_number.columns
    ]


@pytest.mark.parametrize("to", ["parquet", "arrow"])
def test_which_tile_is_which_is_in_the_metadata_of_its_columns(to: str) -> None:
    schema = read(exported(to), to).schema
    for number, serial in enumerate(SERIALS):
        said = schema.field(f"force_n_{number}").metadata or {}
        assert (said[b"tile"], said[b"serial"]) == (str(number).encode(), serial.encode())
    assert b"serial" not in (schema.field("grf_n").metadata or {})


def test_with_a_decimal_comma_csv_says_the_same_numbers_and_words() -> None:
    comma = exported("csv", options=FormatOptions(times=False, decimal="comma", about=False))
    read_back = pacsv.read_csv(
        io.BytesIO(comma),
        parse_options=pacsv.ParseOptions(delimiter=";"),
        convert_options=pacsv.ConvertOptions(decimal_point=","),
    )
    assert read_back.equals(read(exported("csv"), "csv"))
    assert set(read_back["phase"].to_pylist()) == set(extra()["phase"])
    assert b"." not in comma


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


OFFICE = shutil.which("soffice")
POINT, COMMA = "CSV:44,34,76,1", "CSV:59,34,76,1,,1031"
"""What a user chooses when asked: what is between columns, quotes, UTF-8, from the first line on,
and the language of numbers: none, German."""
LABELS = ["=1+1", "+SUM(A1:A9)", "links; rechts, 1,5", "@x", 'a "stone" 😀']
_OFFICE = "{urn:oasis:names:tc:opendocument:xmlns:office:1.0}"
_TABLE = "{urn:oasis:names:tc:opendocument:xmlns:table:1.0}"
_TEXT = "{urn:oasis:names:tc:opendocument:xmlns:text:1.0}"


def exported_with_marks(to: str, options: FormatOptions) -> bytes:
    first = int(frames().seq[0])
    markers = [
        PlacedMarker(Marker(id=str(i), label=label, t_ns=0), (0, first + i), 0, 0)
        for i, label in enumerate(LABELS)
    ]
    content = make_one_pass_frame_source(cut(frames(), extra(), 20))
    chunks = export(
        *(content, make_array(), NOTES, to, Slice()),
        markers=PlacedMarkers(markers),
        options=options,
    )
    return b"".join(chunks)


def cells(path: Path, how: str) -> list[list[Any]]:
    """What LibreOffice makes of a file: numbers, texts, None; a formula is an error."""
    folder = path.parent
    assert OFFICE is not None
    subprocess.run(
        [
            *(OFFICE, f"-env:UserInstallation=file://{folder}/profile", "--headless"),
            *(f"--infilter={how}", "--convert-to", "fods", "--outdir", folder, path),
        ],
        check=True,
        capture_output=True,
        timeout=PATIENCE_S,
        env={**os.environ, "HOME": str(folder)},
    )
    tree = ElementTree.parse(path.with_suffix(".fods"))  # noqa: S314  # LibreOffice's
    return [
        [value for cell in row for value in _values(cell)]
        for row in tree.iter(f"{_TABLE}table-row")
    ]


def _values(cell: ElementTree.Element) -> list[Any]:
    assert cell.get(f"{_TABLE}formula") is None
    times = int(cell.get(f"{_TABLE}number-columns-repeated", "1"))
    number = cell.get(f"{_OFFICE}value")
    texts = ["".join(text.itertext()) for text in cell.iter(f"{_TEXT}p")]
    value = float(number) if number is not None else "\n".join(texts) or None
    return [value] * times


@pytest.mark.slow
@pytest.mark.process
@pytest.mark.soak
@pytest.mark.skipif(OFFICE is None, reason="LibreOffice is not installed: libreoffice-calc-nogui")
@pytest.mark.parametrize(
    ("how", "options"),
    [(POINT, NO_OPTIONS), (COMMA, FormatOptions(decimal="comma"))],
    ids=["point", "comma"],
)
def test_a_spreadsheet_reads_numbers_as_numbers_and_marks_as_text(
    tmp_path: Path, how: str, options: FormatOptions
) -> None:
    path = tmp_path / "session.csv"
    path.write_bytes(exported_with_marks("csv", options))
    names, *rows = cells(path, how)
    expected = read(exported_with_marks("arrow", NO_OPTIONS), "arrow")
    assert len(rows) == len(expected)
    for name in expected.column_names:
        column = [row[names.index(name)] if len(row) > names.index(name) else None for row in rows]
        values = expected[name].to_pylist()
        if name == "marker":
            shown = [f"'{label}" if label[0] in "=+@" else label for label in LABELS]
            assert column == [*shown, *[None] * (len(rows) - len(LABELS))]
        elif name in ("phase", "time_utc"):
            assert all(isinstance(cell, str) for cell in column)
        else:
            # A spreadsheet has 15 digits.
            assert column == [v if v is None else pytest.approx(v, rel=1e-7) for v in values], name
