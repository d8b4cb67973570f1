"""A reference from a file: what is read, what is refused and how, and what is said of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.readers.table import fit_constant_rate_if_times_repeat
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference
from storage.parquet_hash import write_hashed_table
from tests.storage.formats.readers.reading import check

LAB = ReferenceOptions(
    {"time_s": "Time", "grf_n": "Fz", "cop_x_m": "COPx", "cop_y_m": "COPy"},
    {"grf": "N", "cop": "mm"},
    "+",
)
NAN = [np.nan, np.nan]
GOOD = "Time,Fz,COPx,COPy\n0.00,0,,\n0.01,10.5,10,-20\n0.02,20,20,-30\n0.03,0,,\n"


def read(
    tmp_path: Path, text: str, stated: ReferenceOptions = LAB, name: str = "plate.csv"
) -> ReferenceData:
    path = tmp_path / name
    path.write_text(text, "utf-8")
    return read_reference(path, stated)


def test_columns_are_mapped_and_units_converted(tmp_path: Path) -> None:
    found = read(tmp_path, GOOD)
    assert found.time_s.tolist() == [0.0, 0.01, 0.02, 0.03]
    assert found.grf_n.tolist() == [0.0, 10.5, 20.0, 0.0]
    check(found, rtol=1e-7, cop_m=[NAN, [0.01, -0.02], [0.02, -0.03], NAN])
    assert (found.epoch_ns, found.notes) == (None, ())


def test_our_own_names_say_unit_and_sign(tmp_path: Path) -> None:
    found = read(tmp_path, "time_s,grf_n\n0,1\n1,5\n", ReferenceOptions())
    assert found.grf_n.tolist() == [1.0, 5.0]
    assert found.cop_m is None


def test_a_negative_sign_and_a_turned_coordinate_are_turned(tmp_path: Path) -> None:
    stated = ReferenceOptions({**LAB.columns, "cop_y_m": "-COPy"}, {"grf": "kN", "cop": "cm"}, "-")
    found = read(tmp_path, GOOD.replace("10.5", "-10.5").replace("20,20", "-20,20"), stated)
    assert found.grf_n.tolist() == [0.0, 10_500.0, 20_000.0, 0.0]
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1], [0.1, 0.2])


def test_parquet_is_read_as_csv_is(tmp_path: Path) -> None:
    path = tmp_path / "plate.parquet"
    columns = {"Time": [0.0, 0.5], "Fz": [1, 9], "COPx": [1.0, None], "COPy": [2.0, None]}
    pq.write_table(pa.table(columns), path)
    found = read_reference(path, LAB)
    assert found.grf_n.tolist() == [1.0, 9.0]
    check(found, rtol=1e-7, cop_m=[[0.001, 0.002], [np.nan, np.nan]])


def test_a_table_of_ours_that_is_no_session_is_read_as_any_other(tmp_path: Path) -> None:
    path = tmp_path / "stances.parquet"
    write_hashed_table(path, pa.table({"Time": [0.0, 0.5], "Fz": [1, 9]}))
    stated = ReferenceOptions({"time_s": "Time", "grf_n": "Fz"}, {"grf": "N"}, "+")
    assert read_reference(path, stated).grf_n.tolist() == [1.0, 9.0]


def test_samples_without_a_force_and_gaps_are_left_out_and_said(tmp_path: Path) -> None:
    rows = [f"{0.01 * i:.2f},{i % 7}" for i in range(20) if not 8 <= i < 12]
    rows[3] = "0.03,"
    found = read(tmp_path, "Time,Fz\n" + "\n".join(rows) + "\n", ReferenceOptions(
        {"time_s": "Time", "grf_n": "Fz"}, {"grf": "N"}, "+"))  # fmt: skip
    assert len(found.time_s) == 15
    assert "1 of 16 samples have no force" in found.notes[0]
    assert "1 gaps, the longest of 0.050 s" in found.notes[1]


HEAD = "Time,Fz,COPx,COPy\n"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "cannot be read"),
        (HEAD, "0 samples"),
        (HEAD + "0,1,1,1\n", "1 samples"),
        (HEAD + "0,5,1,1\n0,6,1,1\n", "time is repeated"),
        (HEAD + "0,5,1,1\n2,6,1,1\n1,6,1,1\n", "time runs back: 2 s, then 1 s, at sample 3"),
        (HEAD + ",5,1,1\n1,6,1,1\n", "1 samples"),
        (HEAD + "0,,1,1\n1,,1,1\n", "no sample has a force"),
        (HEAD + "0,0,1,1\n1,0,1,1\n", "0 N throughout"),
        (HEAD + "0,0,1,1\n1,-30,1,1\n2,-20,1,1\n", "negative under load"),
        (HEAD + "0,1e12,1,1\n1,5,1,1\n", "1e+12 at sample 1"),
        (HEAD + "0,inf,1,1\n1,5,1,1\n", "inf at sample 1"),
        (HEAD + "0,much,1,1\n1,5,1,1\n", "not numeric"),
        ("t,Fz,COPx,COPy\n0,1,1,1\n1,2,1,1\n", "no column 'Time' for time_s"),
        ("Time,Fz,Fz,COPx,COPy\n0,1,1,1,1\n1,2,1,1,1\n", "Fz is there twice"),
    ],
)
def test_what_is_no_measurement_is_refused_by_name(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError) as caught:
        read(tmp_path, text)
    assert "plate.csv" in str(caught.value)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("stated", "says"),
    [
        (ReferenceOptions(LAB.columns, {"cop": "mm"}, "+"), "--units grf=N|kN|mN"),
        (ReferenceOptions(LAB.columns, {"grf": "N"}, "+"), "--units cop=m|cm|mm"),
        (ReferenceOptions(LAB.columns, LAB.units), "--sign +"),
    ],
)
def test_units_and_sign_that_are_not_stated_are_not_guessed(
    tmp_path: Path, stated: ReferenceOptions, says: str
) -> None:
    with pytest.raises(UsageError) as caught:
        read(tmp_path, GOOD, stated)
    assert says in str(caught.value)


@pytest.mark.parametrize(
    ("columns", "units", "sign", "says"),
    [
        ({"fz": "Fz"}, {}, None, "--map fz"),
        ({}, {"force": "N"}, None, "--units force"),
        ({}, {"grf": "lbf"}, None, "--units grf=lbf"),
        ({}, {}, "up", "--sign 'up'"),
    ],
)
def test_what_cannot_be_stated_is_refused(
    columns: dict[str, str], units: dict[str, str], sign: str | None, says: str
) -> None:
    with pytest.raises(UsageError, match=says):
        ReferenceOptions(columns, units, sign)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("grf.mot", "no header\n1 2 3\n"),
        ("grf.mot", "endheader\n"),
        ("grf.mot", "endheader\ntime a b\n0 1\n"),
        ("grf.sto", "endheader\ntime a\n0 x\n"),
        ("plate.parquet", "no parquet"),
        ("plate.xlsx", "table"),
    ],
)
def test_files_of_another_shape_are_refused(tmp_path: Path, name: str, content: str) -> None:
    with pytest.raises(FootTileError, match=name):
        read(tmp_path, content, LAB, name)


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"away\.csv"):
        read_reference(tmp_path / "away.csv", LAB)


# --- times ----------------------------------------------------------------------------------------


@given(
    count=st.integers(20, 300),
    hz=st.sampled_from([50.0, 75.0, 100.0, 128.0, 200.0, 1000.0]),
    quantum_s=st.sampled_from([0.005, 0.01]),
    begin_s=st.floats(0.0, 100.0),
)
def test_rounded_times_are_spread_evenly_within_their_rounding(
    count: int, hz: float, quantum_s: float, begin_s: float
) -> None:
    true_s = begin_s + np.arange(count) / hz
    rounded_s = np.round(true_s / quantum_s) * quantum_s
    found_s, note = fit_constant_rate_if_times_repeat(rounded_s)
    np.testing.assert_allclose(found_s, true_s, atol=quantum_s)
    assert bool(note) == bool((np.diff(rounded_s) == 0.0).any())
    if note:
        assert (np.diff(found_s) > 0.0).all()


def test_times_that_pause_or_fall_are_not_spread() -> None:
    time_s = np.repeat(np.arange(20.0), 2)
    for other_s in (np.where(time_s > 10.0, time_s + 5.0, time_s), time_s[::-1]):
        found_s, note = fit_constant_rate_if_times_repeat(other_s)
        assert found_s is other_s
        assert note == ""


@pytest.mark.parametrize(
    ("text", "columns"),
    [
        ("n,Fz\n10,0\n11,5\n13,6\n", {"time_s": "n", "grf_n": "Fz"}),
        ("Fz,x\n0,1\n5,1\n6,1\n", {"grf_n": "Fz"}),
    ],
)
def test_samples_are_at_a_stated_rate(tmp_path: Path, text: str, columns: dict[str, str]) -> None:
    found = read(tmp_path, text, ReferenceOptions(columns, {"grf": "N"}, "+", rate_hz=100.0))
    expected = [0.1, 0.11, 0.13] if "time_s" in columns else [0.0, 0.01, 0.02]
    np.testing.assert_allclose(found.time_s, expected)


def test_a_rate_beside_times_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="--rate-hz needs sample numbers"):
        read(tmp_path, GOOD, ReferenceOptions(LAB.columns, LAB.units, "+", rate_hz=100.0))


def test_a_centre_of_pressure_of_one_axis_is_read(tmp_path: Path) -> None:
    found = read(tmp_path, "time_s,grf_n,cop_y_m\n0,0,\n1,5,0.1\n", ReferenceOptions())
    np.testing.assert_array_equal(found.cop_m, [[np.nan, np.nan], [np.nan, 0.1]])
    assert "along y only" in found.notes[0]


def test_plates_are_added_up(tmp_path: Path) -> None:
    text = "time_s,a (N),b (N),c (kN)\n0,1,2,0\n1,5,7,1\n"
    found = read(tmp_path, text, ReferenceOptions({"grf_n": "a (N) + b (N)"}, {}, "+"))
    assert found.grf_n.tolist() == [3.0, 12.0]
    with pytest.raises(UsageError, match="have different units"):
        read(tmp_path, text, ReferenceOptions({"grf_n": "a (N)+c (kN)"}, {}, "+"))
    with pytest.raises(FileFormatError, match="no column 'd'"):
        read(tmp_path, text, ReferenceOptions({"grf_n": "a (N)+d"}, {}, "+"))
