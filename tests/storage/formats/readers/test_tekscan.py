"""Frames of a Tekscan sensor: what cells add up to, and where."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference

FACTS = {
    "DATA_TYPE": "MOVIE",
    "SENSOR_TYPE": "FSCAN",
    "ROWS": "3",
    "COLS": "2",
    "ROW_SPACING": "10 mm",
    "COL_SPACING": "5 mm",
    "SENSEL_AREA": "50 mm2",
    "SECONDS_PER_FRAME": "0.02",
    "SATURATION_PRESSURE": "300.5 KPa ",
    "START_FRAME": "1",
    "END_FRAME": "4",
    "UNITS": "KPa",
    "MIRROR_ROW": "0",
    "MIRROR_COL": "0",
}
FRAMES = ("B,0\n0,0\n0,0", "B,0\n0,0\n0,20", "B,60\n0,0\n20,0", "B,0\n100,100\n0,0")


def text(frames: Sequence[str] = FRAMES, /, *, end: str = "@@\n", **facts: str) -> str:
    stated = {name: value for name, value in (FACTS | facts).items() if value}
    head = "".join(f"{name} {value}\r\n" for name, value in stated.items())
    body = "".join(f"Frame {i + 1}\n{frame}\n\n" for i, frame in enumerate(frames))
    return f"{head}ASCII_DATA @@\r\n\r\n{body}{end}"


def read(folder: Path, content: str, name: str = "walk.asf") -> ReferenceData:
    path = folder / name
    path.write_text(content, encoding="utf-8")
    return read_reference(path, ReferenceOptions())


def test_cells_add_up_to_force_and_centre_of_pressure(tmp_path: Path) -> None:
    found = read(tmp_path, text())
    # 1 kPa on 50 mm2 is 0.05 N.
    np.testing.assert_allclose(found.grf_n, [0.0, 1.0, 4.0, 10.0])
    np.testing.assert_allclose(found.time_s, [0.0, 0.02, 0.04, 0.06])
    nan = [np.nan, np.nan]
    assert found.cop_m is not None
    np.testing.assert_allclose(
        found.cop_m, [nan, [-0.01, -0.0025], [0.005, -0.00125], [0.0, 0.0]], atol=1e-15
    )


@pytest.mark.parametrize(
    ("facts", "newtons"),
    [
        ({"UNITS": "MPa", "SATURATION_PRESSURE": ""}, 1e3),
        ({"UNITS": "PSI"}, 6.894757293),
        ({"SENSEL_AREA": "5e-05 m2"}, 1.0),
        ({"SENSEL_AREA": "0.5 cm2"}, 1.0),
    ],
)
def test_units_are_those_of_the_file(tmp_path: Path, facts: dict[str, str], newtons: float) -> None:
    np.testing.assert_allclose(read(tmp_path, text(**facts)).grf_n[3], 10.0 * newtons)


def test_what_a_spreadsheet_has_padded_with_commas_is_read(tmp_path: Path) -> None:
    content = "\n".join(f"{line},," for line in text().replace("\r", "").split("\n"))
    np.testing.assert_allclose(read(tmp_path, content, "walk.csv").grf_n, [0.0, 1.0, 4.0, 10.0])


def test_saturated_cells_are_told(tmp_path: Path) -> None:
    found = read(tmp_path, text(SATURATION_PRESSURE="99.6 KPa"))
    assert "in 1 of 4 frames a cell is saturated: their force is too small" in found.notes


def test_a_mirrored_sensor_has_no_centre_of_pressure(tmp_path: Path) -> None:
    found = read(tmp_path, text(MIRROR_COL="1"))
    assert found.cop_m is None
    assert found.grf_n[3] == pytest.approx(10.0)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (text(UNITS="Raw"), "UNITS is Raw"),
        (text(UNITS=""), "UNITS is not there"),
        (text(ROWS="4"), "frame 1 has not 4 rows of 2 cells"),
        (text(COLS="²"), "COLS is ²"),
        (text(SENSEL_AREA="50"), "SENSEL_AREA is 50"),
        (text(ROW_SPACING="5,08 mm"), "ROW_SPACING is 5,08 mm"),
        (text(SECONDS_PER_FRAME="inf"), "SECONDS_PER_FRAME is no time"),
        (text(FRAMES[:3], end=""), "it is cut off: its last frame is 3 of 4"),
        (text((*FRAMES[:3], "B,0\n100,100\n0,x")), "a cell is no number"),
        (text((*FRAMES[:3], "B,0\n100,100\n0,inf")), "a cell is not finite"),
        (text((*FRAMES[:3], "B,0\n100,100\n0")), "frame 4 has not 3 rows of 2 cells"),
        (text().replace("Frame 2", "Frame 1"), "the numbers of its frames do not rise"),
        (text((), end="Frame 1"), "there is no frame in it"),
    ],
)
def test_what_is_no_movie_is_refused_in_a_sentence(tmp_path: Path, content: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path, content)


def test_a_movie_that_is_cut_off_anywhere_is_refused(tmp_path: Path) -> None:
    content = text()
    for end in range(content.rindex("100,100")):
        with pytest.raises(FootTileError):
            read(tmp_path, content[:end])
