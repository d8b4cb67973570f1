"""Tables of angles: what is written is read again, and a wrong one is refused by its line."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.angle_table import AngleTable, read_angle_table

HEAD = "t_ns,angle_rad,sigma_rad\n"


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_table_is_read_as_it_was_written(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"angle{suffix}"
    written = AngleTable(
        angle_rad=np.array([0.1, math.nan, -0.25]),
        sigma_rad=np.array([1e-3, math.nan, 2e-3]),
        film_s=np.array([0.0, 0.02, 0.04]),
        t_ns=np.array([1, 2, 3]) + 1_700_000_000_123_456_789,
        angle_source=np.array(["video"] * 3),
    )
    written.write(path, {"lower_x_px": np.array([1.5, math.nan, 2.5])})
    found = read_angle_table(path)
    for name in ("angle_rad", "sigma_rad", "film_s", "t_ns"):
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))
    assert found.angle_source is not None
    assert found.angle_source.tolist() == ["video"] * 3
    assert found.sigma_ns is None


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        (HEAD + "1,0.1,0.01\n3,0.1,0.01\n2,0.1,0.01\n", "t_ns does not rise in row 3"),
        (HEAD + "1,0.1,0.01\n1,0.1,0.01\n", "t_ns does not rise in row 2"),
        (
            HEAD + "1,0.1,0.01\n2,5.0,0.01\n",
            "beyond a quarter of a turn in row 2.*radians, not degrees",
        ),
        (HEAD + "1,0.1,0.01\n2,0.1,\n", "sigma_rad is no uncertainty in row 2"),
        (HEAD + "1,0.1,0.01\n2,0.1,-1\n", "sigma_rad is no uncertainty in row 2"),
        (HEAD + "1,0.1,0.01\n2,left,0.01\n", "[Rr]ow #3.*left"),
        (HEAD + "1.5e18,0.1,0.01\n2e18,0.1,0.01\n", "1.5e18"),
        (HEAD + ",0.1,0.01\n2,0.1,0.01\n", "t_ns is empty in row 1"),
        (HEAD + "1,,\n2,0.1,0.01\n", "less than two angles"),
        (HEAD, "less than two angles"),
        ("", "cannot be read"),
        ("t_ns,angle_deg,sigma_deg\n1,2,3\n", "column angle_rad, sigma_rad is missing"),
        ("time_s,angle_rad,sigma_rad\n1,2,3\n", "column film_s is missing"),
        ("t_ns;angle_rad;sigma_rad\n1;0,1;0,01\n", "cannot be read"),
    ],
)
def test_a_wrong_table_is_refused_by_its_line(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "angle.csv"
    path.write_text(text)
    with pytest.raises(FileFormatError, match=problem):
        read_angle_table(path)


def test_a_file_of_another_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no table"):
        read_angle_table(tmp_path / "angle.xlsx")
    with pytest.raises(FileFormatError, match=r"angle\.csv"):
        read_angle_table(tmp_path / "angle.csv")
    (tmp_path / "angle.parquet").write_bytes(b"PAR1 and no more PAR1")
    with pytest.raises(FileFormatError, match="cannot be read"):
        read_angle_table(tmp_path / "angle.parquet")
    times = np.array([1.0, 2.0])
    table = AngleTable(np.zeros(2), np.ones(2), film_s=times)
    table.write(tmp_path / "angle.parquet")
    changed = pq.read_table(tmp_path / "angle.parquet").rename_columns(
        ["film", "angle_rad", "sigma_rad"]
    )
    pq.write_table(changed, tmp_path / "angle.parquet")
    with pytest.raises(FileFormatError, match="film_s is missing"):
        read_angle_table(tmp_path / "angle.parquet")
