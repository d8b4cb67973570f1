"""A recorded load from a table or a session of ours: what is read, and what is refused and how."""

from __future__ import annotations

import codecs
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from devices.emulation.ground.load_trace import LoadTrace
from devices.errors import LoadTraceError
from storage.formats.export import make_one_pass_frame_source
from storage.formats.load_trace import read_load_to_emulate
from storage.formats.readers.registry import read_table
from storage.formats.reference import ReferenceOptions
from storage.formats.slice import FormatOptions, Slice
from storage.schema import Array
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import PERIOD_NS, make_array, make_tile
from tests.builders.c3d import c3d_bytes, two_plates
from tests.builders.frames import make_frames
from tests.storage.formats.exports import export
from tests.storage.formats.readers.reading import check

Read = Callable[[str | bytes], LoadTrace]

GOOD = """time_s,fz_n,cop_x_m,cop_y_m
0.00,0,,
0.01,10.5,0.01,-0.02
0.02,20,0.02,-0.03
"""


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Reads this text from a CSV file called trace.csv."""

    def reader(content: str | bytes) -> LoadTrace:
        path = tmp_path / "trace.csv"
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_load_to_emulate(path)

    return reader


def rows(header: str, *lines: str) -> str:
    return "\n".join([header, *lines]) + "\n"


# --- what is read ---------------------------------------------------------------------------------


def test_a_force_and_its_cop_are_read_and_empty_cops_are_nan(read: Read) -> None:
    trace = read(GOOD)
    expected = [[np.nan, np.nan], [0.01, -0.02], [0.02, -0.03]]
    check(trace, time_s=[0.0, 0.01, 0.02], fz_n=[0.0, 10.5, 20.0], cop_m=expected)
    assert trace.cells_n is trace.angle_rad is None
    assert trace.where.endswith("trace.csv")
    columns = [trace.time_s, trace.fz_n, trace.cop_m]
    assert {column.dtype for column in columns if column is not None} == {np.dtype(np.float64)}
    check(read(GOOD.replace("-0.02", "")), fz_n=[0.0, 10.5, 20.0])


def test_names_are_matched_without_regard_to_case(read: Read) -> None:
    check(read(GOOD.replace(FORCE, "Time_S,fz_N,COP_x_m,cop_Y_m")), fz_n=[0.0, 10.5, 20.0])
    check(read(rows("TIME_S,Cell1_N,CELL2_n", "0,1,2", "1,3,4")), cells_n=[[1, 2], [3, 4]])


def test_cells_are_put_in_the_order_of_their_numbers(read: Read) -> None:
    numbers = [10, 1, 3, 2, 4, 5, 6, 9, 8, 7]
    header = "time_s," + ",".join(f"cell{i}_n" for i in numbers)
    line = ",".join(f"{10 * i}" for i in numbers)
    trace = read(rows(header, f"0,{line}", f"1,{line}"))
    check(trace, cells_n=[[10.0 * i for i in range(1, 11)]] * 2)


def test_cells_force_and_angle_are_read_and_other_columns_ignored(read: Read) -> None:
    trace = read(rows("time_s,who,cell1_n,angle_rad,fz_n", '0,"a\nb",1,0.5,3', "1,=1+1,2,-0.5,4"))
    check(trace, fz_n=[3.0, 4.0], cells_n=[[1.0], [2.0]], angle_rad=[0.5, -0.5])


def read_parquet(folder: Path, **columns: object) -> LoadTrace:
    pq.write_table(pa.table(columns), folder / "trace.parquet")
    return read_load_to_emulate(folder / "trace.parquet")


@pytest.mark.parametrize("type_", [pa.float32(), pa.float64(), pa.int16(), pa.uint8()])
def test_parquet_is_read_of_any_type(tmp_path: Path, type_: pa.DataType) -> None:
    trace = read_parquet(
        tmp_path,
        Time_s=pa.array([0, 1, 2], type_),
        FZ_N=pa.array([0, 10, 20], type_),
        cop_x_m=pa.array([None, 0.25, 0.5], pa.float32()),
        cop_y_m=pa.array([float("nan"), 0.25, None], pa.float64()),
    )
    expected = [[np.nan, np.nan], [0.25, 0.25], [0.5, np.nan]]
    check(trace, time_s=[0.0, 1.0, 2.0], fz_n=[0.0, 10.0, 20.0], cop_m=expected)


def test_a_plate_a_little_below_zero_in_flight_is_not_upside_down(read: Read) -> None:
    # A hop: most of it in flight, where a drifted plate reads -0.5 N, and a stance of 800 N.
    lines = [f"{i / 100},{800 if 60 <= i < 80 else -0.5},0,0" for i in range(100)]
    assert np.max(np.asarray(read(rows(FORCE, *lines)).fz_n)) == 800.0


# --- files that are refused -----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", ["", ".csv", ".parquet"])
def test_a_folder_and_a_missing_file_are_refused_by_name(tmp_path: Path, suffix: str) -> None:
    with pytest.raises(LoadTraceError, match=rf"nothing{suffix}.*cannot be read"):
        read_load_to_emulate(tmp_path / f"nothing{suffix or '.csv'}")
    (tmp_path / f"folder{suffix}").mkdir()
    with pytest.raises(LoadTraceError, match="folder"):
        read_load_to_emulate(tmp_path / f"folder{suffix}")


FORCE = "time_s,fz_n,cop_x_m,cop_y_m"
NO_NUMBERS = [
    (FORCE, "1,{},0,0", "fz_n"),
    (FORCE, "{},1,0,0", "time_s"),
    ("time_s,cell1_n,cell2_n,x", "1,1,{},0", "cell2_n"),
    ("time_s,cell1_n,cell2_n,angle_rad", "1,1,1,{}", "angle_rad"),
]


def cells_numbered(*numbers: int) -> str:
    line = ",1" * len(numbers)
    return rows("time_s" + "".join(f",cell{i}_n" for i in numbers), f"0{line}", f"1{line}")


def at_times(*times: float) -> str:
    return rows("time_s,cell1_n", *(f"{t},1" for t in times))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", []),
        (bytes(range(256)) * 4, []),
        (rows(FORCE, "0,1,0,0", "1,1,0"), []),  # a short line
        ("0,1,0,0\n1,1,0,0\n", []),  # numbers without names
        *(
            (GOOD.replace(name, "other"), [f"column {name} is missing", "other"])
            for name in ("time_s", "cop_x_m", "cop_y_m")
        ),
        (GOOD.replace("fz_n", "fx_n"), ["no load in its columns", "fx_n", "cell1_n"]),
        *(
            (GOOD.replace(right, wrong), [f"{right}, converted from {wrong.lower()!r}"])
            for wrong, right in (("time_ms", "time_s"), ("time", "time_s"), ("Fz", "fz_n"))
        ),
        (GOOD.replace("cop_y_m", "cop_y_cm"), ["cop_y_m, converted from 'cop_y_cm'"]),
        (rows("time_s,fz_n,fz_N,cop_x_m,cop_y_m", "0,1,2,0,0", "1,1,2,0,0"), []),
        (rows("time_s,fz_n,fz_n,cop_x_m,cop_y_m", "0,1,2,0,0", "1,1,2,0,0"), []),
        (cells_numbered(1, 2, 4), ["numbered 1, 2, 4", "without a gap"]),
        (cells_numbered(2, 3), ["numbered 2, 3", "without a gap"]),
        (cells_numbered(0, 1), ["numbered 0, 1", "without a gap"]),
        (cells_numbered(3), ["numbered 3", "without a gap"]),
        (rows(FORCE), ["0 rows", "at least two"]),
        (rows(FORCE, "0,1,0,0"), ["1 rows", "at least two"]),
        (at_times(0.0, 0.1, 0.1, 0.2), ["at row 3;", "from 0.1 to 0.1", "Sort the rows"]),
        (at_times(0.0, 0.1, 0.2, 0.15), ["at row 4;", "from 0.2 to 0.15", "Sort the rows"]),
        (at_times(1.0, 0.5, 0.2, 0.1), ["at row 2;", "from 1 to 0.5", "Sort the rows"]),
        *(
            (rows(header, "0,0,0,0", line.format(value), "2,0,0,0"), [f"{name} is", "at row 2"])
            for header, line, name in NO_NUMBERS
            for value in ("", "NaN", "-inf")
        ),
        (GOOD.replace("-0.02", "inf"), ["cop_y_m is inf at row 2"]),
        *(
            (GOOD.replace("10.5", word), ["column fz_n is not numeric"])
            for word in ("heavy", "1.5 N", "1;5")
        ),
        # Pressed as it is, it would be clipped to no load at all without a word.
        (rows(FORCE, "0,0,0,0", "1,-300,0,0", "2,-700,0,0"), ["negative", "Change its sign"]),
        (
            rows("time_s,cell1_n,cell2_n", "0,0,0", "1,-300,-10", "2,-700,-30", "3,-1,2"),
            ["negative", "Change its sign"],
        ),
    ],
)
def test_a_table_that_is_no_load_is_refused_by_name(
    read: Read, content: str | bytes, words: list[str]
) -> None:
    with pytest.raises(LoadTraceError) as caught:
        read(content)
    for word in ("trace.csv", *words):
        assert word in str(caught.value)


def test_a_csv_that_is_called_parquet_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "trace.parquet"
    path.write_text(GOOD)
    with pytest.raises(LoadTraceError, match=r"trace\.parquet.*expected a Parquet file"):
        read_load_to_emulate(path)


@pytest.mark.parametrize(
    "time_s",
    [pa.array(["a", "b"]), pa.array([0, 1], pa.timestamp("ms")), pa.array([0, 2**60 + 1])],
    ids=["text", "instants", "too large for a float"],
)
def test_a_parquet_column_of_no_numbers_is_refused(tmp_path: Path, time_s: pa.Array[Any]) -> None:
    with pytest.raises(LoadTraceError, match="column time_s is not numeric"):
        read_parquet(tmp_path, time_s=time_s, cell1_n=[1.0, 2.0])


# --- size -----------------------------------------------------------------------------------------


def test_too_many_rows_are_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "trace.parquet"
    table = pa.table({"time_s": np.zeros(4_000_000), "fz_n": np.zeros(4_000_000)})
    with pq.ParquetWriter(path, table.schema, compression="zstd") as file:
        for _ in range(4):
            file.write_table(table)
    assert path.stat().st_size < 1_000_000

    def read_anyway(*_: object, **__: object) -> None:
        pytest.fail("it is read")

    monkeypatch.setattr(pq.ParquetFile, "read", read_anyway)
    with pytest.raises(LoadTraceError, match=r"16000000 rows of 2 columns"):
        read_load_to_emulate(path)


def test_a_text_that_is_too_long_is_refused_before_it_is_read(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    with path.open("wb") as file:
        file.truncate(300 << 20)  # a hole: it takes no room
    with pytest.raises(LoadTraceError, match="314572800 bytes"):
        read_load_to_emulate(path)


def test_a_plate_of_several_is_named_and_its_unit_stated(tmp_path: Path) -> None:
    load_n, nothing = np.linspace(0.0, 200.0, 50), np.zeros(50)
    wrench = [nothing, nothing, load_n, -20.0 * load_n, 10.0 * load_n, nothing]
    content = two_plates(ORIGIN=np.zeros((2, 3)))
    content["ANALOG"]["UNITS"] = ["V"] * 12
    path = tmp_path / "gait.c3d"
    path.write_bytes(c3d_bytes(content, np.stack([*[nothing] * 6, *wrench], axis=1)))
    with pytest.raises(LoadTraceError, match=r"plate2_fz.*--map time_s=COLUMN,grf_n=COLUMN"):
        read_load_to_emulate(path)
    columns = {"grf_n": "plate2_fz", "cop_x_m": "plate2_cop_x", "cop_y_m": "-plate2_cop_y"}
    with pytest.raises(LoadTraceError, match=r"not stated.*--units grf="):
        read_load_to_emulate(path, ReferenceOptions(columns))
    trace = read_load_to_emulate(path, ReferenceOptions(columns, {"grf": "N", "cop": "mm"}))
    check(trace, atol=1e-4, fz_n=load_n)
    check(trace, atol=1e-6, cop_m=[[np.nan, np.nan], *[[-0.01, -0.02]] * 49])


def test_names_units_and_sign_of_a_table_are_stated(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("Time,Fz,Px,Py\n0,0,,\n10,-0.2,4,-5\n20,-0.3,5,-6\n")
    columns = {"time_s": "Time", "grf_n": "Fz", "cop_x_m": "Px", "cop_y_m": "Py"}
    stated = ReferenceOptions(columns, {"time": "ms", "grf": "kN", "cop": "mm"}, "-")
    trace = read_load_to_emulate(path, stated)
    check(trace, rtol=1e-7, time_s=[0.0, 0.01, 0.02], fz_n=[0.0, 200.0, 300.0])
    check(trace, rtol=1e-7, cop_m=[[np.nan, np.nan], [0.004, -0.005], [0.005, -0.006]])


ROWS = 20
ARRAY = make_array([make_tile(0), make_tile(1, reference=True), make_tile(2)])
RNG = np.random.default_rng(3)
ESTIMATE_N = RNG.uniform(1.0, 20.0, (ROWS, 3)).astype(np.float32).astype(np.float64)
ESTIMATE_N[:, 1] = np.nan
TRUE_N = np.where(np.isnan(ESTIMATE_N), 0.0, ESTIMATE_N + 1.0)

ESTIMATES = {
    "force_n": ESTIMATE_N,
    "grf_n": np.nansum(ESTIMATE_N, axis=1),
    "cop_x_m": np.where(np.arange(ROWS) % 4, 0.01, np.nan),
    "cop_y_m": np.full(ROWS, -0.01),
    "angle_rad": np.where(np.arange(ROWS) < 2, np.nan, 0.1),  # before the servo's first answer
}
TRUTH = {
    "true_force_n": TRUE_N,
    "true_grf_n": TRUE_N.sum(axis=1),
    "true_cop_x_m": np.full(ROWS, 0.02),
    "true_cop_y_m": np.full(ROWS, 0.03),
    "true_angle_rad": np.full(ROWS, 0.2),
}


def written(path: Path, columns: dict[str, Array]) -> Path:
    with SealedFileWriter(path, ARRAY, {}) as file:
        file.append_frames(make_frames(ROWS, 3), columns)
    return path


def exported(folder: Path, to: str, columns: dict[str, Array], *names: str) -> Path:
    path = folder / f"out.{to}"
    pieces = [(make_frames(ROWS, 3), columns)]
    content = make_one_pass_frame_source(pieces)
    path.write_bytes(b"".join(export(content, ARRAY, {}, to, Slice(columns=names))))
    return path


def test_a_sealed_session_presses_its_estimates_on_loaded_tiles(tmp_path: Path) -> None:
    trace = read_load_to_emulate(written(tmp_path / "s.parquet", ESTIMATES))
    check(trace, cells_n=ESTIMATE_N[2:, [0, 2]])  # from the first angle on
    time_s = np.arange(2, ROWS) * PERIOD_NS * 1e-9
    check(trace, rtol=1e-6, angle_rad=[0.1] * (ROWS - 2))
    check(trace, rtol=1e-12, time_s=time_s)


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_true_forces_go_before_estimates(tmp_path: Path, to: str) -> None:
    trace = read_load_to_emulate(exported(tmp_path, to, ESTIMATES | TRUTH))
    check(trace, rtol=1e-15, cells_n=TRUE_N[:, [0, 2]])
    check(trace, rtol=1e-7, angle_rad=[0.2] * ROWS)
    assert len(trace.time_s) == ROWS


@pytest.mark.parametrize("to", ["parquet", "csv"])
def test_a_grf_with_its_cop_is_a_load_and_one_row_of_tiles_has_no_cop_across_it(
    tmp_path: Path, to: str
) -> None:
    names = ("t_ns", "grf_n", "cop_x_m", "cop_y_m")
    x_m, nothing = ESTIMATES["cop_x_m"], np.full(ROWS, np.nan)
    for known, expected in (
        ({}, [x_m, ESTIMATES["cop_y_m"]]),
        ({"cop_y_m": nothing}, [x_m, np.zeros(ROWS)]),
        ({"cop_y_m": nothing, "cop_x_m": nothing}, [nothing, nothing]),
    ):
        trace = read_load_to_emulate(exported(tmp_path, to, ESTIMATES | known, *names))
        assert trace.cells_n is None
        check(trace, rtol=1e-6, fz_n=ESTIMATES["grf_n"], cop_m=np.stack(expected, axis=1))


def test_rows_without_forces_are_left_out_at_the_ends_only(tmp_path: Path) -> None:
    columns = {"force_n": ESTIMATE_N.copy()}
    columns["force_n"][:3, 0] = np.nan
    columns["force_n"][-2:, 2] = np.nan
    trace = read_load_to_emulate(written(tmp_path / "s.parquet", columns))
    check(trace, cells_n=ESTIMATE_N[3:-2, [0, 2]])
    columns["force_n"][10, 0] = np.nan
    with pytest.raises(LoadTraceError, match=r"cell1_n is nan at row 8"):
        read_load_to_emulate(written(tmp_path / "s.parquet", columns))


def test_a_session_without_all_forces_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = written(tmp_path / "s.parquet", ESTIMATES)
    pq.write_table(pq.read_table(path), path)
    unknown = {"force_n": np.full((ROWS, 3), np.nan)}
    for file, says in (
        (path, "another program has rewritten it"),
        (written(tmp_path / "raw.parquet", {}), "Estimate it first"),
        (written(tmp_path / "unknown.parquet", unknown), "no row of it has a load"),
        (exported(tmp_path, "csv", ESTIMATES, "t_ns", "force_n_2"), "forces of tiles 2 only"),
        (exported(tmp_path, "arrow", ESTIMATES), r"ends in \.parquet"),
    ):
        with pytest.raises(LoadTraceError, match=says):
            read_load_to_emulate(file)


def test_an_export_for_excel_is_read_again_with_its_umlauts(tmp_path: Path) -> None:
    path = tmp_path / "out.csv"
    info = make_array([make_tile(0, serial="Größe"), make_tile(1)])
    content = make_one_pass_frame_source(
        [(make_frames(ROWS, 2), {"force_n": ESTIMATE_N[:, [0, 2]]})]
    )
    options = FormatOptions(names="serial", times=True, decimal="comma", about=True)
    path.write_bytes(b"".join(export(content, info, {}, "csv", Slice(), options=options)))
    assert path.read_bytes().startswith(codecs.BOM_UTF8)
    table = read_table(path, lambda name: name.startswith("force_n"))
    found = table.columns["force_n_Größe"].astype(np.float32)
    np.testing.assert_array_equal(found, ESTIMATE_N[:, 0])
