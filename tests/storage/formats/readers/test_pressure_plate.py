"""Frames of a pressure plate: what they add up to, and what is refused."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import FileFormatError
from storage.formats.reference import ReferenceData, ReferenceOptions, read_reference

TIME_S = np.array([0.0, 0.01, 0.02])


def plate(**changes: Any) -> dict[str, Any]:
    """Three by two cells: nothing, then 3 N on one cell, then 1 N and 3 N on two."""
    force_n = np.zeros((3, 3, 2))
    force_n[1, 2, 1] = 3.0
    force_n[2, 0, 0], force_n[2, 2, 0] = 1.0, 3.0
    content = {"time_s": TIME_S, "force_n": force_n, "pitch_m": np.array([0.005, 0.01])}
    return {name: value for name, value in (content | changes).items() if value is not None}


def read(path: Path, content: dict[str, Any]) -> ReferenceData:
    np.savez(path, **content)
    return read_reference(path, ReferenceOptions())


def test_cells_add_up_to_force_and_centre_of_pressure(tmp_path: Path) -> None:
    found = read(tmp_path / "plate.npz", plate(origin_m=np.array([-0.005, 0.1])))
    assert found.grf_n.tolist() == [0.0, 3.0, 4.0]
    assert found.cop_m is not None
    nan = [np.nan, np.nan]
    np.testing.assert_allclose(found.cop_m, [nan, [0.005, 0.11], [0.0025, 0.1]])


def test_kilopascals_are_newtons_on_the_area_of_a_cell(tmp_path: Path) -> None:
    kpa = plate()["force_n"]
    found = read(tmp_path / "plate.npz", plate(force_n=None, pressure_kpa=kpa))
    # 1 kPa on 5 by 10 mm is 0.05 N.
    np.testing.assert_allclose(found.grf_n, [0.0, 0.15, 0.2])


def test_a_frame_with_a_cell_that_is_not_known_has_no_force(tmp_path: Path) -> None:
    content = plate()
    content["force_n"][1, 0, 0] = np.nan
    found = read(tmp_path / "plate.npz", content)
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
def test_what_is_no_plate_is_refused_in_a_sentence(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path / "plate.npz", plate(**changes))


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
    with pytest.raises(FileFormatError, match="numpy"):
        read_reference(path, ReferenceOptions())


@pytest.mark.parametrize("keep", [0.3, 0.6, 0.95])
def test_an_archive_that_is_cut_off_is_refused(tmp_path: Path, keep: float) -> None:
    path = tmp_path / "plate.npz"
    np.savez(path, **plate())
    content = path.read_bytes()
    path.write_bytes(content[: int(keep * len(content))])
    with pytest.raises(FileFormatError):
        read_reference(path, ReferenceOptions())
