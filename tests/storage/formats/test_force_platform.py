"""Force platforms of C3D files that are written byte by byte: what is read, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats import force_platform
from storage.formats.reference import ReferenceData, Stated, read_reference
from tests.builders.c3d import c3d_bytes, force_plate

pytest.importorskip("ezc3d")

LOAD_N = np.linspace(0.0, 98.0, 50)
X_MM, Y_MM = 10.0, 20.0
"""Of the load, in the plate's own axes, of which y and z are turned in the laboratory's."""


def channels(kind: int) -> npt.NDArray[np.float64]:
    """What a plate of this type measures of `LOAD_N` at (`X_MM`, `Y_MM`) on its surface."""
    nothing = np.zeros(50)
    if kind == 1:  # forces, the centre of pressure itself, free moment
        return np.stack([nothing, nothing, LOAD_N, nothing + X_MM, nothing + Y_MM, nothing], axis=1)
    if kind == 3:  # four corners of 200 by 100 mm, x12, x34, y14, y23, then z1 to z4
        right, front = 0.5 + X_MM / 200.0, 0.5 + Y_MM / 100.0
        parts = [right * front, (1 - right) * front, (1 - right) * (1 - front), right * (1 - front)]
        return np.stack([*[nothing] * 4, *(part * LOAD_N for part in parts)], axis=1)
    return np.stack([nothing, nothing, LOAD_N, Y_MM * LOAD_N, -X_MM * LOAD_N, nothing], axis=1)


MORE: dict[int, dict[str, Any]] = {
    1: {},
    2: {},
    3: {"ORIGIN": np.array([[100.0, 50.0, -40.0]])},
    4: {"CAL_MATRIX": np.eye(6).reshape(1, 6, 6)},
}


def written(path: Path, kind: int = 2, **more: Any) -> Path:
    analog = channels(kind if kind in MORE else 2)
    content = force_plate(kind, analog.shape[1], **{**MORE.get(kind, {}), **more})
    if kind == 3:
        content["ANALOG"]["UNITS"] = ["N"] * 8
    path.write_bytes(c3d_bytes(content, analog))
    return path


def read(path: Path, stated: Stated | None = None) -> ReferenceData:
    return read_reference(path, stated or Stated())


@pytest.mark.parametrize("kind", MORE)
def test_plates_of_four_types_say_what_bears_on_them(tmp_path: Path, kind: int) -> None:
    columns = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
    volts = Stated(columns, {"grf": "N", "cop": "mm"}, "+")
    found = read(written(tmp_path / "gait.c3d", kind), volts if kind == 4 else Stated())
    np.testing.assert_allclose(found.time_s, np.arange(50) / 1000.0)
    np.testing.assert_allclose(found.grf_n, LOAD_N, atol=1e-4)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1:], [[0.01, -0.02]] * 49, atol=1e-6)


def test_a_plate_is_chosen_and_its_axes_turned_by_the_mapping(tmp_path: Path) -> None:
    stated = Stated({"grf_n": "plate1_fz", "cop_x_m": "-plate1_cop_y", "cop_y_m": "plate1_cop_x"})
    found = read(written(tmp_path / "gait.c3d"), stated)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1:], [[0.02, 0.01]] * 49, atol=1e-6)


def test_a_plate_that_was_not_zeroed_is_said_and_nothing_taken_off(tmp_path: Path) -> None:
    path = tmp_path / "gait.c3d"
    analog = channels(2)
    analog[:, 2] += 5.0
    path.write_bytes(c3d_bytes(force_plate(2, 6, ZERO=[1, 2]), analog))
    found = read(path)
    np.testing.assert_allclose(found.grf_n, LOAD_N + 5.0, atol=1e-4)
    assert "frames 1 to 2 are to be its zero, in which plates read 24.000" in found.notes[0]


def test_a_plate_that_says_the_foots_force_upside_down_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "gait.c3d"
    path.write_bytes(c3d_bytes(force_plate(2, 6), -channels(2)))
    with pytest.raises(FileFormatError, match="negative under load"):
        read(path)
    np.testing.assert_allclose(read(path, Stated(sign="-")).grf_n, LOAD_N, atol=1e-4)


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ({"USED": 0}, "no force platform"),
        ({"TYPE": [7]}, "Type 7"),
        ({"CHANNEL": np.array([[1, 2, 3, 4, 5, 60]])}, "C3D"),
    ],
)
def test_what_is_no_plate_is_refused_in_a_sentence(
    tmp_path: Path, more: dict[str, Any], said: str
) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(written(tmp_path / "gait.c3d", **more))


@pytest.mark.parametrize(
    ("units", "said"),
    [
        (["lbf"] * 3 + ["Nmm"] * 3, "unit of column 'plate1_fz'"),
        ([""] * 6, "unit of column 'plate1_fz'"),
        (["N"] * 3 + ["Nm"] * 3, "unit of column 'plate1_cop_x'"),
    ],
)
def test_a_unit_that_the_file_does_not_say_has_to_be_stated(
    tmp_path: Path, units: list[str], said: str
) -> None:
    content = force_plate(2, 6)
    content["ANALOG"]["UNITS"] = [unit or " " for unit in units]
    path = tmp_path / "gait.c3d"
    path.write_bytes(c3d_bytes(content, channels(2)))
    columns = {"grf_n": "plate1_fz", "cop_x_m": "plate1_cop_x", "cop_y_m": "plate1_cop_y"}
    with pytest.raises(UsageError, match=said):
        read(path, Stated(columns))
    found = read(path, Stated(columns, {"grf": "kN", "cop": "mm"}, "+"))
    np.testing.assert_allclose(found.grf_n, 1e3 * LOAD_N, atol=0.1)
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1:], [[0.01, -0.02]] * 49, atol=1e-6)


def test_forces_that_a_matrix_makes_of_volts_have_no_unit_of_their_own(tmp_path: Path) -> None:
    content = force_plate(4, 6, **MORE[4])
    path = tmp_path / "gait.c3d"
    path.write_bytes(c3d_bytes(content, channels(4)))
    with pytest.raises(FileFormatError, match="no column 'grf_n'"):
        read(path)


def test_of_two_plates_none_is_chosen_for_the_user(tmp_path: Path) -> None:
    more = {
        "USED": 2,
        "TYPE": [2, 2],
        "CORNERS": np.repeat(force_plate(2, 6)["FORCE_PLATFORM"]["CORNERS"], 2, axis=0),
        "ORIGIN": np.array([[0.0, 0.0, -40.0]] * 2),
        "CHANNEL": np.arange(1, 13).reshape(2, 6),
    }
    content = force_plate(2, 12, **more)
    content["ANALOG"]["UNITS"] = 2 * (["N"] * 3 + ["Nmm"] * 3)
    path = tmp_path / "gait.c3d"
    path.write_bytes(c3d_bytes(content, np.concatenate([channels(2), 0.5 * channels(2)], axis=1)))
    with pytest.raises(FileFormatError, match="no column 'grf_n'"):
        read(path)
    found = read(path, Stated({"grf_n": "plate2_fz"}))
    np.testing.assert_allclose(found.grf_n, 0.5 * LOAD_N, atol=1e-4)
    assert "there are 2 plates: --map says which one" in found.notes


@pytest.mark.parametrize("content", [b"", b"junk", b"\x02\x50" + b"\xff" * 600])
def test_what_is_no_c3d_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "gait.c3d"
    path.write_bytes(content)
    with pytest.raises(FileFormatError):
        read(path)


@pytest.mark.parametrize(("at", "byte"), [(615, 193), (766, 134), (722, 254)])
def test_what_the_library_crashes_or_hangs_over_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, at: int, byte: int
) -> None:
    # Of ezc3d 1.7.2: the first two end it with a segmentation fault, the third is endless.
    monkeypatch.setattr(force_platform, "_PATIENCE_S", 3.0)
    path = written(tmp_path / "gait.c3d")
    content = bytearray(path.read_bytes())
    content[at] = byte
    path.write_bytes(content)
    with pytest.raises(FileFormatError, match="no force platforms of C3D"):
        read(path)
