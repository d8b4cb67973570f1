"""Parquet, Arrow and CSV: seconds and timestamps, serials, decimal commas, and options refused."""

from __future__ import annotations

import io

import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pytest

from devices.errors import UsageError
from storage.formats.slice import NO_OPTIONS, FormatOptions, Slice
from storage.formats.writers.registry import FORMATS, get_format
from tests.builders.arrays import PERIOD_NS, make_array
from tests.storage.formats.exports import BEGIN_NS, ROWS, TABLES, exported, extra, frames, read

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
def test_seconds_can_be_chosen_as_any_column(to: str) -> None:
    asked = ("grf_n", "time_s")
    assert read(exported(to, Slice(columns=asked)), to).column_names == list(asked)


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
