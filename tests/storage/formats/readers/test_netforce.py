"""NetForce's texts: numbers alone, six of each plate."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import count_refused, read

ROWS = np.array(
    [
        [7.25, 7.0, 0.0, 0.0, 0.0, -0.25],
        [7.5, 7.5, 800.0, 4.0, 8.0, -0.125],
        [7.25, 7.0, 400.0, 2.0, -12.0, -0.5],
        [7.0, 7.25, 100.0, -1.0, 2.0, -0.5],
    ]
)
PLATE = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
UNITS = {"grf": "N", "cop": "m"}


def text_of(rows: np.ndarray) -> str:
    return "".join(",".join(f"{cell:.5f}" for cell in row) + "\n" for row in rows.tolist())


ONE = text_of(ROWS)
FORMS: dict[str, Callable[[str], str]] = {
    "as it is": str,
    "an empty line above, blanks and lines that end as on Windows": lambda text: (
        "\r\n" + text.replace(",", ", ").replace("\n", "\r\n")
    ),
    "no end of the last line": lambda text: text[:-1],
}


@pytest.mark.parametrize("form", FORMS)
def test_force_and_cop_are_read_with_rate_units_and_sign_stated(tmp_path: Path, form: str) -> None:
    found = read(tmp_path, FORMS[form](ONE), ReferenceOptions(PLATE, UNITS, "+", rate_hz=50.0))
    np.testing.assert_allclose(found.time_s, [0.0, 0.02, 0.04, 0.06])
    np.testing.assert_array_equal(found.grf_n, ROWS[:, 2])
    expected = [[np.nan, np.nan], [-0.01, 0.005], [0.03, 0.005], [-0.02, -0.01]]
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m, expected)
    assert any("how far the surface is above it" in note for note in found.notes)


def test_what_the_file_does_not_state_is_asked_for(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"it has plate1_fz.*column6"):
        read(tmp_path, ONE, ReferenceOptions())
    with pytest.raises(FileFormatError, match="state --rate-hz"):
        read(tmp_path, ONE, ReferenceOptions({"grf_n": "plate1_fz"}, UNITS, "+"))
    with pytest.raises(UsageError, match="unit of column 'plate1_cop_x' is not stated"):
        read(tmp_path, ONE, ReferenceOptions(PLATE, {"grf": "N"}, "+", rate_hz=50.0))


def test_each_plate_has_six_columns(tmp_path: Path) -> None:
    two = text_of(np.hstack([ROWS[::-1], ROWS]))
    columns = {"grf_n": "plate2_fz", "cop_x_m": "plate2_cop_x", "cop_y_m": "plate2_cop_y"}
    second = read(tmp_path, two, ReferenceOptions(columns, UNITS, "+", rate_hz=50.0))
    first = read(tmp_path, ONE, ReferenceOptions(PLATE, UNITS, "+", rate_hz=50.0))
    np.testing.assert_array_equal(second.grf_n, first.grf_n)
    np.testing.assert_array_equal(second.cop_m, first.cop_m)
    both = ReferenceOptions({"grf_n": "plate1_fz+plate2_fz"}, UNITS, "+", rate_hz=50.0)
    np.testing.assert_array_equal(read(tmp_path, two, both).grf_n, ROWS[::-1, 2] + ROWS[:, 2])


def test_the_load_tells_the_sign(tmp_path: Path) -> None:
    steps = np.arange(400)
    force = np.where((steps > 100) & (steps < 300), -700.0, 0.0)
    rows = np.stack([steps % 2, steps % 3, force, 0 * force, 0 * force, 0 * force], axis=1)
    stated = ReferenceOptions({"grf_n": "plate1_fz"}, {"grf": "N"}, rate_hz=1000.0)
    found = read(tmp_path, text_of(rows), stated)
    np.testing.assert_array_equal(found.grf_n, -force)


def test_six_columns_of_which_the_first_is_a_time_are_not_a_plate(tmp_path: Path) -> None:
    rows = np.column_stack([np.arange(4) * 0.01, ROWS[:, 1:]])
    with pytest.raises(FileFormatError, match=r"it has column1, .*column6\)"):
        read(tmp_path, text_of(rows), ReferenceOptions())
    stated = ReferenceOptions({"time_s": "column1", "grf_n": "column3"}, {"grf": "N"}, "+")
    found = read(tmp_path, text_of(rows), stated)
    np.testing.assert_array_equal(found.grf_n, ROWS[:, 2])


def test_damaged_texts_are_refused_by_our_own_errors(tmp_path: Path) -> None:
    stated = ReferenceOptions(PLATE, UNITS, "+", rate_hz=50.0)
    assert count_refused(tmp_path, ONE, stated) > 20
