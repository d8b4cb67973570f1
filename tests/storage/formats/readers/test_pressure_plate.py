"""Frames of pressure plates: numpy archives and Tekscan's movies; force and COP of their cells."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError
from storage.formats.readers.registry import read_table
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference
from tests.storage.formats.readers.reading import check, read

TIME_S = np.array([0.0, 0.01, 0.02])
NAN = [np.nan, np.nan]


def plate(**changes: Any) -> dict[str, Any]:
    """Three by two cells: nothing, then 3 N on one cell, then 1 N and 3 N on two."""
    force_n = np.zeros((3, 3, 2))
    force_n[1, 2, 1] = 3.0
    force_n[2, 0, 0], force_n[2, 2, 0] = 1.0, 3.0
    content = {"time_s": TIME_S, "force_n": force_n, "pitch_m": np.array([0.005, 0.01])}
    return {name: value for name, value in (content | changes).items() if value is not None}


def read_arrays(path: Path, content: dict[str, Any]) -> ReferenceData:
    np.savez(path, **content)
    return read_reference(path, ReferenceOptions())


def test_cells_add_up_to_force_and_cop(tmp_path: Path) -> None:
    found = read_arrays(tmp_path / "plate.npz", plate(origin_m=np.array([-0.005, 0.1])))
    assert found.grf_n.tolist() == [0.0, 3.0, 4.0]
    check(found, rtol=1e-7, cop_m=[NAN, [0.005, 0.11], [0.0025, 0.1]])


def test_kilopascals_are_newtons_on_the_area_of_a_cell(tmp_path: Path) -> None:
    kpa = plate()["force_n"]
    found = read_arrays(tmp_path / "plate.npz", plate(force_n=None, pressure_kpa=kpa))
    # 1 kPa on 5 by 10 mm is 0.05 N.
    np.testing.assert_allclose(found.grf_n, [0.0, 0.15, 0.2])


def test_a_frame_with_a_cell_that_is_not_known_has_no_force(tmp_path: Path) -> None:
    content = plate()
    content["force_n"][1, 0, 0] = np.nan
    found = read_arrays(tmp_path / "plate.npz", content)
    assert found.time_s.tolist() == [0.0, 0.02]
    assert any("1 of 3 samples have no force" in note for note in found.notes)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"force_n": None}, "neither of force_n and pressure_kpa"),
        ({"pressure_kpa": np.zeros((3, 3, 2))}, "force_n and pressure_kpa of"),
        ({"time_s": None}, r"time_s \(0,\)"),
        ({"time_s": TIME_S[:2]}, r"time_s \(2,\)"),
        ({"force_n": np.zeros((3, 6))}, r"force_n is \(3, 6\)"),
        ({"pitch_m": None}, "the positions of its cells are missing"),
        ({"pitch_m": np.array([0.005, 0.0])}, "the positions of its cells are missing"),
        ({"pitch_m": np.array([0.005, np.nan])}, "the positions of its cells are missing"),
        ({"pitch_m": np.array([0.005])}, "the positions of its cells are missing"),
        ({"origin_m": np.zeros(3)}, "the positions of its cells are missing"),
        ({"time_s": TIME_S[::-1]}, "time runs back"),
        ({"force_n": np.zeros((3, 3, 2))}, "0 N throughout"),
        ({"force_n": -plate()["force_n"]}, "negative under load"),
        ({"force_n": np.full((3, 3, 2), 1e12)}, "numbers below"),
        ({"force_n": np.array([{}, 1, 2], dtype=object)}, "no arrays of numpy"),
        ({"force_n": np.array(["a", "b", "c"])}, "no arrays of numpy"),
    ],
)
def test_what_is_no_plate_is_refused(tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read_arrays(tmp_path / "plate.npz", plate(**changes))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04junk", b"\x93NUMPY", b"time_s,grf_n\n0,1\n"])
def test_what_is_no_archive_of_numpy_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "plate.npz"
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="numpy"):
        read_reference(path, ReferenceOptions())


def test_an_array_that_says_it_is_endless_is_refused(tmp_path: Path) -> None:
    path, header = tmp_path / "plate.npz", io.BytesIO()
    shape = {"descr": "<f8", "fortran_order": False, "shape": (10**15,)}
    np.lib.format.write_array_header_1_0(header, shape)
    np.savez(path, **plate(force_n=None))
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("force_n.npy", header.getvalue() + b"\0" * 8)
    with pytest.raises(FileFormatError, match=r"not enough memory to read it: .*fits in memory"):
        read_reference(path, ReferenceOptions())


def test_arrays_that_are_too_large_are_refused_by_their_size(tmp_path: Path) -> None:
    np.savez(tmp_path / "plate.npz", **plate())
    with pytest.raises(
        FileFormatError, match=r"plate\.npz: \d+ bytes are too many .* 8 bytes.*Cut"
    ):
        read_table(tmp_path / "plate.npz", lambda name: True, values_max=1)


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_an_archive_with_a_flipped_bit_is_refused_or_has_the_same_numbers(
    tmp_path: Path, save: Callable[..., None]
) -> None:
    path = tmp_path / "plate.npz"
    save(path, **plate())
    content, whole = path.read_bytes(), read_reference(path, ReferenceOptions())
    refused = 0
    for at in range(len(content)):
        flipped = content[at] ^ 1 << at % 8
        path.write_bytes(content[:at] + bytes([flipped]) + content[at + 1 :])
        try:
            found = read_reference(path, ReferenceOptions())
        except FileFormatError:
            refused += 1
        else:
            np.testing.assert_array_equal(found.grf_n, whole.grf_n)
    assert refused > len(content) / 2


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_an_archive_that_is_cut_off_is_refused(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "plate.npz"
    np.savez(path, **plate())
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(FileFormatError):
        read_reference(path, ReferenceOptions())


# --- Tekscan --------------------------------------------------------------------------------------


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


def test_cells_of_a_movie_add_up_to_force_and_cop(tmp_path: Path) -> None:
    found = read(tmp_path, text(), name="walk.asf")
    # 1 kPa on 50 mm2 is 0.05 N.
    check(found, rtol=1e-7, grf_n=[0.0, 1.0, 4.0, 10.0], time_s=[0.0, 0.02, 0.04, 0.06])
    check(
        found, rtol=1e-7, cop_m=[NAN, [-0.01, -0.0025], [0.005, -0.00125], [0.0, 0.0]], atol=1e-15
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
def test_units_of_a_movie_are_those_of_the_file(
    tmp_path: Path, facts: dict[str, str], newtons: float
) -> None:
    np.testing.assert_allclose(
        read(tmp_path, text(**facts), name="walk.asf").grf_n[3], 10.0 * newtons
    )


def test_a_movie_saved_by_a_spreadsheet_is_read(tmp_path: Path) -> None:
    content = "\n".join(f"{line},," for line in text().replace("\r", "").split("\n"))
    np.testing.assert_allclose(
        read(tmp_path, content, name="walk.csv").grf_n, [0.0, 1.0, 4.0, 10.0]
    )


def test_saturated_cells_are_noted(tmp_path: Path) -> None:
    found = read(tmp_path, text(SATURATION_PRESSURE="99.6 KPa"), name="walk.asf")
    assert "in 1 of 4 frames a cell is saturated: their force is too small" in found.notes


def test_a_mirrored_sensor_has_no_centre_of_pressure(tmp_path: Path) -> None:
    found = read(tmp_path, text(MIRROR_COL="1"), name="walk.asf")
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
        (text((*FRAMES[:3], "1B,0\n100,100\n0,1")), "a cell is no number"),
        (text((*FRAMES[:3], "B,B1\n100,100\n0,1")), "a cell is no number"),
        (text((*FRAMES[:3], "B,0\n100,100\n0,4#9")), "a cell is no number"),
        (text((*FRAMES[:3], "B,0\n100,100\n0,inf")), "a cell is not finite"),
        (text((*FRAMES[:3], "B,0\n100,100\n0")), "frame 4 has not 3 rows of 2 cells"),
        (text().replace("Frame 2", "Frame 1"), "the numbers of its frames do not rise"),
        (text((), end="Frame 1"), "there is no frame in it"),
    ],
)
def test_what_is_no_movie_is_refused(tmp_path: Path, content: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path, content, name="walk.asf")


def test_a_movie_that_is_cut_off_anywhere_is_refused(tmp_path: Path) -> None:
    content = text()
    for end in range(content.rindex("100,100")):
        with pytest.raises(FootTileError):
            read(tmp_path, content[:end], name="walk.asf")
