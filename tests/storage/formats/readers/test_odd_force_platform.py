"""Force platforms of C3D files that contradict themselves, as files of laboratories do."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.reference import ReferenceData, ReferenceOptions
from tests.builders.c3d import force_plate
from tests.storage.formats.readers.reading import read_c3d

SAMPLES = 200
LOAD_N = 100.0 + 400.0 * np.sin(np.linspace(0.0, np.pi, SAMPLES))
X_MM, Y_MM = np.linspace(-80.0, 120.0, SAMPLES), np.linspace(40.0, -30.0, SAMPLES)
"""Of the load in the plate's own axes, of which y and z are turned in the laboratory's."""
COLUMNS = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}


def wrench() -> Floats:
    nothing = np.zeros(SAMPLES)
    return np.stack([nothing, nothing, LOAD_N, Y_MM * LOAD_N, -X_MM * LOAD_N, nothing], axis=1)


def is_right(found: ReferenceData, *, y: float = -1.0) -> None:
    np.testing.assert_allclose(found.grf_n, LOAD_N, rtol=1e-5)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m, 1e-3 * np.stack([X_MM, y * Y_MM], axis=1), atol=2e-6)


def test_channels_in_place_of_samples_are_told_by_the_rates(tmp_path: Path) -> None:
    found = read_c3d(tmp_path, force_plate(2, 6), wrench(), measures_in_header=6)
    is_right(found)
    assert found.time_s[1] == pytest.approx(0.001)


def test_of_two_analog_rates_that_of_the_frames_is_used(tmp_path: Path) -> None:
    content = force_plate(2, 6)
    content["ANALOG"]["RATE"] = 980.0
    found = read_c3d(tmp_path, content, wrench())
    assert found.time_s[1] == pytest.approx(0.001)
    assert "ANALOG:RATE states 980 Hz, and 10 samples in each frame at 100 Hz are" in found.notes[0]


def test_zeros_behind_the_last_sample_of_unsigned_channels_are_no_load(tmp_path: Path) -> None:
    counts = np.zeros((5000, 6))
    counts[:2000] = 2048.0
    counts[500:1000, 2] += 800.0
    content = force_plate(2, 6)
    content["ANALOG"] |= {"OFFSET": np.full(6, 2048), "SCALE": np.full(6, -1.0)}
    content["POINT"]["SCALE"] = 1.0
    found = read_c3d(tmp_path, content, counts, is_integer=True)
    assert len(found.grf_n) == 2000
    assert (found.grf_n.max(), found.grf_n.min()) == (800.0, 0.0)
    assert "plate1: 3000 of its samples are stored as zeros and were not recorded" in found.notes


@pytest.mark.parametrize(
    ("position", "stated", "held"), [("mm", "Nm", "Nmm"), ("m", "Nmm", "Nm"), ("mm", "Nm", "Nm")]
)
def test_moments_in_another_unit_are_told_by_the_size_of_the_plate(
    tmp_path: Path, position: str, stated: str, held: str
) -> None:
    analog, content = wrench(), force_plate(2, 6)
    if held == "Nm":
        analog[:, 3:5] *= 1e-3
    if position == "m":
        for name in ("CORNERS", "ORIGIN"):
            content["FORCE_PLATFORM"][name] = 1e-3 * content["FORCE_PLATFORM"][name]
    content["POINT"]["UNITS"] = [position]
    content["ANALOG"]["UNITS"] = ["N"] * 3 + [stated] * 3
    found = read_c3d(tmp_path, content, analog)
    is_right(found)
    is_said = any("are not in" in note for note in found.notes)
    assert is_said == (stated != held)


def test_a_plate_whose_corners_run_the_other_way_round_faces_up(tmp_path: Path) -> None:
    content = force_plate(2, 6)
    content["FORCE_PLATFORM"]["CORNERS"] = content["FORCE_PLATFORM"]["CORNERS"][:, [3, 2, 1, 0]]
    found = read_c3d(tmp_path, content, wrench())
    is_right(found, y=1.0)  # each corner is in the quadrant that its number says
    assert any("CORNERS run counterclockwise" in note for note in found.notes)


@pytest.mark.parametrize(("factor", "said"), [(3.0, "off the plate in"), (1e-3, "the middle")])
def test_a_cop_that_no_foot_has_is_noted(tmp_path: Path, factor: float, said: str) -> None:
    analog = wrench()
    analog[:, 3:5] *= factor
    notes = read_c3d(tmp_path, force_plate(2, 6), analog).notes
    assert any(said in note for note in notes)
    assert not any(said in note for note in read_c3d(tmp_path, force_plate(2, 6), wrench()).notes)


# --- Matrices -------------------------------------------------------------------------------------


def with_matrix(matrix: Floats, **more: Any) -> dict[str, Any]:
    """Parameters of a plate whose matrix is stored by columns."""
    content = force_plate(4, matrix.shape[1], CAL_MATRIX=matrix.T[None], **more)
    content["ANALOG"]["UNITS"] = ["V"] * matrix.shape[1]
    return content


MIXED = np.eye(6) + 0.1 * np.random.default_rng(3).normal(size=(6, 6))


@pytest.mark.parametrize("is_by_row", [False, True])
def test_a_matrix_is_read_by_row_where_the_file_says_so(tmp_path: Path, is_by_row: bool) -> None:
    volts = np.asarray(np.linalg.solve(MIXED, wrench().T).T, dtype=np.float64)
    content = with_matrix(MIXED.T if is_by_row else MIXED)
    content["FORCE_PLATFORM"]["MATRIX_STORE"] = ["BYROW" if is_by_row else "BYCOLUMN"]
    is_right(
        read_c3d(tmp_path, content, volts, ReferenceOptions(COLUMNS, {"grf": "N", "cop": "mm"}))
    )


def test_a_matrix_of_another_size_is_refused(tmp_path: Path) -> None:
    content = force_plate(4, 6, CAL_MATRIX=np.ones((1, 8, 8)))
    with pytest.raises(FileFormatError, match="type 4, with a CAL_MATRIX of 8 by"):
        read_c3d(tmp_path, content, np.ones((SAMPLES, 6)))


def channels_of_four_sensors(x_mm: float, y_mm: float) -> Floats:
    """Return horizontal, then vertical forces, with sensors at (x, y) in each quadrant."""
    right, front = 0.5 + X_MM / (2.0 * x_mm), 0.5 + Y_MM / (2.0 * y_mm)
    parts = [right * front, (1 - right) * front, (1 - right) * (1 - front), right * (1 - front)]
    shear = 0.05 * LOAD_N
    return np.stack([shear, shear, -shear, -shear, *(part * LOAD_N for part in parts)], axis=1)


def test_bending_of_a_plate_is_corrected_as_ezc3d_does(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    polynomial = np.array(
        [1e-15, -5e-11, 3e-07, 2e-15, -1e-9, 1e-2, -2e-15, 2e-11, -7e-07, 1e-15, 3e-9, 2e-2]
    )
    content = force_plate(
        3,
        8,
        ORIGIN=np.array([[150.0, 80.0, -40.0]]),
        CAL_MATRIX=np.zeros((1, 6, 6)),
        FPCOPPOLY=polynomial.reshape(1, 2, 6),
    )
    content["ANALOG"]["UNITS"] = ["N"] * 8
    found = read_c3d(tmp_path, content, channels_of_four_sensors(150.0, 80.0))
    path = str(tmp_path / "gait.c3d")
    plate = ezc3d.c3d(path, extract_forceplat_data=True)["data"]["platform"][0]
    assert found.cop_m is not None
    np.testing.assert_allclose(1e3 * found.cop_m, plate["center_of_pressure"][:2].T, atol=1e-6)
    assert float(np.ptp(1e3 * found.cop_m[:, 0] - X_MM)) > 1.0
    assert any("FPCOPPOLY" in note for note in found.notes)
