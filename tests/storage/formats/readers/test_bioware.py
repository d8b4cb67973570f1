"""BioWare's text exports, in the layouts of versions 5.1 to 5.6."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import count_refused, read

ONE = """BioWare Version 5.2.1.3 Export
Device:\tPlate A 9287\tPlate A 9287\tPlate A 9287\tPlate A 9287
Samples (#):\t4\t4\t4\t4
Rate (Hz):\t1000.000000\t1000.000000\t1000.000000\t1000.000000
First sample time (s):\t0.000000\t0.000000\t0.000000\t0.000000
Normalized length (m):\t1.000000\t1.000000\t1.000000\t1.000000
File Information
Date\tOct 22, 2014  12:05:31
Name\t
abs time (s)\tFx\tFz\tAx\tAy
\tN\tN\tm\tm
0.000000\t1.5\t0.0\t0.000000\t0.000000
0.001000\t1.5\t90.25\t0.013748\t-0.010516
0.002000\t1.5\t100.5\t0.012769\t-0.010327
0.003000\t1.5\t80.0\t0.010753\t-0.009611
"""
TWO = """BioWare Version 5.3.2.9 Export
Device:\tleft\tleft\tright\tright\tright\tright
Samples (#):\t3\t3\t3\t3\t3\t3
abs time (s)\tFx\tFz\tFz\t|Ft|\tAx\tAy
\tN\tN\tN\tN\tm\tm
0.000000\t-5.0\t392.0\t523.0\t527.0\t0.1\t0.2
0.001000\t-5.0\t391.0\t520.0\t524.0\t0.1\t0.2
0.002000\t-5.0\t391.5\t521.0\t524.0\t0.1\t0.2
"""
FORMS: dict[str, Callable[[str], str | bytes]] = {
    "as it is": str,
    "lines end as on Windows": lambda text: text.replace("\n", "\r\n"),
    "a byte order mark": lambda text: text.encode("utf-8-sig"),
    "the unit of time in the line of units": lambda text: text.replace(
        "abs time (s)", "abs time"
    ).replace("\n\tN", "\ns\tN"),
    "decimal commas": lambda text: text.replace(".", ","),
    "commas between columns": lambda text: text.replace(",", "").replace("\t", ","),
    "milliseconds": lambda text: (
        text.replace("time (s)\tFx", "time (ms)\tFx")
        .replace("\n0.00", "\n")
        .replace("000\t1.5", ".0\t1.5")
    ),
    "a description in Latin-1": lambda text: text.replace("Name", "Größe").encode("latin-1"),
    "tabs at the end of numbers": lambda text: text[:-1].replace("\n0.", "\t\n0.") + "\t\n",
}


@pytest.mark.parametrize("form", FORMS)
def test_one_plate_needs_no_option_whatever_the_form(tmp_path: Path, form: str) -> None:
    found = read(tmp_path, FORMS[form](ONE))
    np.testing.assert_allclose(found.time_s, [0.0, 0.001, 0.002, 0.003], atol=1e-12)
    np.testing.assert_array_equal(found.grf_n, [0.0, 90.25, 100.5, 80.0])
    expected = [[np.nan] * 2, [0.013748, -0.010516], [0.012769, -0.010327], [0.010753, -0.009611]]
    np.testing.assert_array_equal(found.cop_m, expected)
    assert "plate1: 'Plate A 9287' of the file" in found.notes


def test_two_plates_are_told_by_their_devices_and_added_up(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"plate2_cop_x.*--map grf_n=COLUMN"):
        read(tmp_path, TWO)
    left = read(tmp_path, TWO, ReferenceOptions({"grf_n": "plate1_fz"}))
    np.testing.assert_array_equal(left.grf_n, [392.0, 391.0, 391.5])
    assert "plate1: 'left' of the file" in left.notes
    both = read(tmp_path, TWO, ReferenceOptions({"grf_n": "plate1_fz+plate2_fz"}))
    np.testing.assert_array_equal(both.grf_n, [915.0, 911.0, 912.5])
    right = {"grf_n": "plate2_fz", "cop_x_m": "plate2_cop_x", "cop_y_m": "-plate2_cop_y"}
    np.testing.assert_array_equal(
        read(tmp_path, TWO, ReferenceOptions(right)).cop_m, [[0.1, -0.2]] * 3
    )


def test_plates_of_one_name_follow_one_another(tmp_path: Path) -> None:
    same = TWO.replace("\tFz\tFz\t|Ft|\tAx\tAy", "\tFz\tFx\tFz\tAx\tAy")
    with pytest.raises(FileFormatError, match="cannot be assigned to devices"):
        read(tmp_path, same.replace("left", "right"), ReferenceOptions({"grf_n": "plate2_fz"}))
    lines = same.replace("left", "right").splitlines()
    text = "\n".join("\t".join(line.split("\t")[:5]) for line in lines)
    found = read(tmp_path, text, ReferenceOptions({"grf_n": "plate2_fz"}))
    np.testing.assert_array_equal(found.grf_n, [527.0, 524.0, 524.0])


def test_other_devices_are_left_out(tmp_path: Path) -> None:
    heads = {"Device:": "\tDAQ\tDAQ\tDAQ", "abs": "\tV1\tV1\tV2", "\tN": "\tV\tV\tV"}
    lines = [
        line + next((more for head, more in heads.items() if line.startswith(head)), "\t1\t2\t3")
        for line in ONE.splitlines()
    ]
    found = read(tmp_path, "\n".join(lines))
    np.testing.assert_array_equal(found.grf_n, [0.0, 90.25, 100.5, 80.0])


def test_units_are_those_of_the_file(tmp_path: Path) -> None:
    kilo = ONE.replace("\n\tN\tN\tm\tm", "\n\tN\tkN\tmm\tmm")
    found = read(tmp_path, kilo)
    np.testing.assert_allclose(found.grf_n, [0.0, 90250.0, 100500.0, 80000.0])
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1], [13.748e-6, -10.516e-6])
    body_weights = ONE.replace("\n\tN\tN", "\n\tN\tN/N")
    with pytest.raises(UsageError, match="the unit of column 'plate1_fz' is not stated"):
        read(tmp_path, body_weights, ReferenceOptions({"grf_n": "plate1_fz"}))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (ONE.replace("\tFz", "\tFy"), "no force plate"),
        (ONE.replace("abs time", "samples"), "no line of names"),
        (ONE[: ONE.index("0.000000\t1.5")], "there are no numbers below the names"),
        (ONE.replace("\t-0.010327", "\t-0.010327\t7"), "cannot be read"),
        (ONE.replace("\tAx\tAy\n\tN", "\n\tN"), "3 names for 5 columns"),
        (ONE.replace("100.5", "1OO.5"), "is not numeric: '1OO.5'"),
        (ONE.replace("(s)\tFx", "(min)\tFx"), "its time is in min"),
    ],
)
def test_what_is_no_measurement_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError, match=says):
        read(tmp_path, text)


def test_a_part_of_a_recording_is_read_and_said(tmp_path: Path) -> None:
    found = read(tmp_path, ONE[: ONE.index("0.003")])
    assert len(found.time_s) == 3
    assert found.notes[0] == "it holds 3 of the 4 samples that its head states"


def test_damaged_texts_are_refused_by_our_own_errors(tmp_path: Path) -> None:
    assert count_refused(tmp_path, ONE) > 50
    assert count_refused(tmp_path, TWO, ReferenceOptions({"grf_n": "plate2_fz"})) > 50
