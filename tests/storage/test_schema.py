"""Frames as Arrow: the same bits, the same memory, units on every column, nothing foreign."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from dataclasses import fields
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import FRAME_COLUMNS, ArrayInfo, FrameBatch
from service.estimation.records import Estimates
from storage.schema import (
    ARRAY_INFO_KEY,
    COLUMNS_BY_NAME,
    ESTIMATE_COLUMNS,
    INDENTER_COLUMNS,
    MARKER_COLUMNS,
    MEASURED_COLUMNS,
    TRUTH_COLUMNS,
    frames_from_record_batch,
    frames_to_record_batch,
    read_array_info,
    to_flat_columns,
    wire_schema,
)
from tests.builders.arrays import make_array, make_servo, make_tile
from tests.builders.frames import LAYOUTS, any_frames, assert_same_bits, laid_out

SUFFIXES = {"kpa": "kPa", "n": "N", "utc": "UTC"}
SUFFIXES |= {unit: unit for unit in ("m", "rad", "ns", "us", "s", "counts")}


def array(tiles: int) -> ArrayInfo:
    """Text and numbers that are easily mistaken on their way through JSON."""
    return make_array(
        [make_tile(i, x_m=0.1 / 3 * i, y_m=-0.1, reference=i == 1) for i in range(tiles)],
        node="node-7 'µ'",
        servo=make_servo(sign=-1, ratio=0.1, ankle_travel_m_per_rad=None),
        nominal_rate_hz=395.1234567890123,
    )


def message(record: pa.RecordBatch) -> pa.Buffer:
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, record.schema) as writer:
        writer.write_batch(record)
    return sink.getvalue()


def record_of(batch: FrameBatch) -> pa.RecordBatch:
    return frames_to_record_batch(batch, wire_schema(array(batch.tile_count)))


def lies_in(values: np.ndarray, buffer: pa.Buffer) -> bool:
    address = values.__array_interface__["data"][0]
    return bool(buffer.address <= address < buffer.address + buffer.size)


# --- wire -----------------------------------------------------------------------------------------


@given(rows=st.integers(0, 40), tiles=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
def test_frames_and_array_survive_an_arrow_stream(rows: int, tiles: int, seed: int) -> None:
    batch = any_frames(rows, tiles, seed)
    with pa.ipc.open_stream(message(record_of(batch))) as reader:
        assert read_array_info(reader.schema, where="stream") == array(tiles)
        received = frames_from_record_batch(reader.read_next_batch())
    del reader
    assert_same_bits(received, batch)


@pytest.mark.parametrize(("start", "stop"), [(0, 5), (3, 17), (19, 20)])
def test_a_slice_of_a_message_gives_its_own_rows(start: int, stop: int) -> None:
    batch = any_frames(20, 4)
    part = record_of(batch).slice(start, stop - start)
    assert_same_bits(frames_from_record_batch(part), batch.slice_rows(start, stop))


@pytest.mark.parametrize("how", LAYOUTS)
def test_frames_of_any_memory_layout_are_sent_right(how: str) -> None:
    batch = any_frames(20, 4)
    assert_same_bits(frames_from_record_batch(record_of(laid_out(batch, how))), batch)


def test_sending_copies_nothing() -> None:
    batch = any_frames(20, 4)
    record = record_of(batch)
    for column in MEASURED_COLUMNS:
        sent = record.column(column.name)
        values = sent.values if isinstance(sent, pa.FixedSizeListArray) else sent
        buffer = values.buffers()[1]
        assert buffer is not None
        assert buffer.address == getattr(batch, column.name).ctypes.data, column.name


def test_receiving_copies_nothing() -> None:
    received = message(record_of(any_frames(20, 4)))
    with pa.ipc.open_stream(received) as reader:
        batch = frames_from_record_batch(reader.read_next_batch())
    for column in MEASURED_COLUMNS:
        values = getattr(batch, column.name)
        assert lies_in(values, received), column.name
        assert values.flags.c_contiguous, column.name


def test_the_wire_is_a_fixed_number_of_bytes_a_frame_beside_its_header() -> None:
    # 8 + 8 + 8 + 4 + 4 + 1 + 4 of a frame, and 2 + 2 + 4 + 1 of each tile (docs/formats.md)
    record = record_of(any_frames(64, 4))
    assert record.nbytes == 64 * (37 + 4 * 9)


# --- units and names ------------------------------------------------------------------------------


def assert_described(field: pa.Field[Any]) -> None:
    metadata = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    assert set(metadata) == {"unit", "description"}, field.name
    assert metadata["unit"], field.name
    assert metadata["description"], field.name
    name = re.sub(r"_\d+$", "", field.name)
    suffix = name.rsplit("_", 1)[-1]
    if suffix in SUFFIXES:
        assert metadata["unit"] == SUFFIXES[suffix], field.name


def test_every_column_on_the_wire_says_its_unit() -> None:
    schema = wire_schema(array(4))
    assert schema.names == list(FRAME_COLUMNS)
    for field in schema:
        assert_described(field)
        assert not field.nullable


def test_every_column_on_disk_says_its_unit() -> None:
    values: dict[str, Any] = {}
    for column in COLUMNS_BY_NAME.values():
        type_ = "datetime64[ns]" if column.name == "time_utc" else column.type.to_pandas_dtype()
        values[column.name] = np.zeros((3, 2) if column.per_tile else 3, dtype=type_)
    for column in (*INDENTER_COLUMNS, *MARKER_COLUMNS):
        values[column.name] = np.array(["a", "b", "c"])
    made = [field for field, _ in to_flat_columns(tuple(COLUMNS_BY_NAME.values()), values)]
    assert len(made) == sum(1 + column.per_tile for column in COLUMNS_BY_NAME.values())
    for field in made:
        assert_described(field)


def test_a_number_with_a_unit_carries_it_as_a_suffix() -> None:
    for column in COLUMNS_BY_NAME.values():
        if column.unit not in ("1", "bits") and column.name not in (
            "pressure_raw",
            "temperature_raw",
        ):
            assert SUFFIXES[column.name.rsplit("_", 1)[-1]] == column.unit


def test_the_tables_hold_just_the_columns_of_the_contract() -> None:
    assert [column.name for column in MEASURED_COLUMNS] == [f.name for f in fields(FrameBatch)]
    estimates = [f.name for f in fields(Estimates) if f.name not in ("seq", "t_ns")]
    made = (
        "gauge_kpa force_n force_sigma_n grf_n grf_sigma_n grf_lower_bound_n cop_x_m cop_y_m "
        "cop_sigma_x_m cop_sigma_y_m cop_index_x cop_index_y cop_ground_x_m cop_ground_y_m "
        "angle_rad contact estimate_flags"
    )
    assert [column.name for column in ESTIMATE_COLUMNS] == estimates == made.split()
    truth = "true_force_n true_grf_n true_plate_n true_cop_x_m true_cop_y_m true_angle_rad"
    assert [column.name for column in TRUTH_COLUMNS] == truth.split()
    assert [column.name for column in INDENTER_COLUMNS] == ["pressed_tile", "phase"]
    assert {column.name for column in COLUMNS_BY_NAME.values() if column.per_tile} == {
        *("pressure_raw", "temperature_raw", "sample_offset_us", "tile_flags"),
        *("gauge_kpa", "force_n", "force_sigma_n", "true_force_n"),
    }
    item = pa.field("item", pa.uint16(), nullable=False)
    assert wire_schema(array(2)).field("pressure_raw").type == pa.list_(item, 2)


def test_the_array_travels_as_json_that_others_can_read() -> None:
    text = wire_schema(array(3)).metadata[ARRAY_INFO_KEY]
    content = json.loads(text)
    assert content["tiles"][2]["serial"] == "T03"
    assert content["tiles"][1]["reference"] is True
    assert content["nominal_rate_hz"] == 395.1234567890123


# --- foreign data ---------------------------------------------------------------------------------


def refused(record: pa.RecordBatch, name: str, column: pa.Array[Any]) -> None:
    """The record is no message of frames with this column in the place of its own."""
    changed = record.set_column(record.schema.get_field_index(name), name, column)
    with pytest.raises(FileFormatError, match="holds no frames"):
        frames_from_record_batch(changed)


@pytest.mark.parametrize("name", list(FRAME_COLUMNS))
def test_a_column_that_is_missing_or_of_another_type_or_empty_is_refused(name: str) -> None:
    record = record_of(any_frames(5, 4))
    empty = [None if i == 2 else v for i, v in enumerate(record.column(name).to_pylist())]
    for other in (
        pa.array(np.arange(5.0)),
        pa.array(["a", "b", "c", "d", "e"]),
        pa.array([[1], [2], [3], [4], [5]], pa.list_(pa.uint16())),
        pa.array([True, False, True, False, True]),
        record_of(any_frames(5, 3)).column("tile_flags"),
        pa.array(empty, record.schema.field(name).type),
    ):
        refused(record, name, other)
    with pytest.raises(FileFormatError, match="holds no frames"):
        frames_from_record_batch(record.drop_columns([name]))
    twice = [*record.schema.names, name]
    with pytest.raises(FileFormatError, match="holds no frames"):
        frames_from_record_batch(
            pa.RecordBatch.from_arrays([*record.columns, record.column(name)], names=twice)
        )


@pytest.mark.parametrize(("rows", "tiles"), [(4, 4), (5, 4), (3, 3), (2, 1)])
def test_an_empty_row_or_value_of_tiles_is_refused(rows: int, tiles: int) -> None:
    """An empty list in a column hides its values; what is left must not be dealt out anew."""
    record = record_of(any_frames(rows, tiles))
    mask = pa.array([i == 1 for i in range(rows)])
    for field, column in zip(record.schema, record.columns, strict=True):
        if isinstance(column, pa.FixedSizeListArray):
            values = column.flatten()
            refused(
                record,
                field.name,
                pa.FixedSizeListArray.from_arrays(values, type=field.type, mask=mask),
            )
            one = pa.array([None, *values.to_pylist()[1:]], values.type)
            refused(record, field.name, pa.FixedSizeListArray.from_arrays(one, tiles))


def test_a_schema_without_an_array_is_refused_by_name() -> None:
    for schema in (pa.schema([("a", pa.int32())]), pa.schema([], metadata={"other": "x"})):
        with pytest.raises(FileFormatError, match=r"thing\.arrows: no description"):
            read_array_info(schema, where="thing.arrows")


@pytest.mark.parametrize("text", [b"", b"{}", b"null", b"\xff\xfe", b'{"node": 3}'])
def test_an_array_that_cannot_be_read_is_refused_by_name(text: bytes) -> None:
    schema = pa.schema([], metadata={ARRAY_INFO_KEY: text})
    with pytest.raises(FileFormatError, match=r"thing\.arrows: .*not readable"):
        read_array_info(schema, where="thing.arrows")


def test_an_array_with_an_unknown_fact_is_refused() -> None:
    content = json.loads(array(2).model_dump_json()) | {"colour": "red"}
    schema = pa.schema([], metadata={ARRAY_INFO_KEY: json.dumps(content)})
    with pytest.raises(FileFormatError, match="colour"):
        read_array_info(schema, where="thing.arrows")


def _said(code: str) -> str:
    """Run it in a process of its own: pyarrow looks for pandas once."""
    pytest.importorskip("pandas")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return done.stdout.strip()


@pytest.mark.slow
def test_our_arrays_do_not_load_pandas_and_it_can_be_loaded_afterwards() -> None:
    code = """
import sys
import storage.schema
import numpy, pyarrow
pyarrow.array(numpy.arange(3.0)).to_numpy()
print("pandas" in sys.modules)
frame = pyarrow.table({"grf_n": [1.0, None]}).to_pandas()
frame["t"] = ["a", "b"]
column = pyarrow.array(frame["grf_n"], from_pandas=True)
print(len(pyarrow.Table.from_pandas(frame)), column.null_count)
"""
    assert _said(code).split() == ["False", "2", "1"]


@pytest.mark.slow
def test_pandas_that_is_there_already_stays_as_it_is() -> None:
    code = """
import pandas, pyarrow
import storage.schema
column = pyarrow.array(pandas.Series([1.0, None]), from_pandas=True)
print(column.null_count, pandas.Series.__name__)
"""
    assert _said(code) == "1 Series"
