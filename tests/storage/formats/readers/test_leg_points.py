"""Two points of a leg in files of Kinovea, DeepLabCut, TRC and C3D; wrong ones are refused."""

from __future__ import annotations

import io
from pathlib import Path

import c3d
import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.readers.leg_points import LegPoints, read_leg_points

KINOVEA = '"Time","heel/0/X","heel/0/Y","toe/0/X","toe/0/Y","knee/0/X","knee/0/Y"\n'
DLC = (
    "scorer,net,net,net,net,net,net\n"
    "bodyparts,heel,heel,heel,knee,knee,knee\n"
    "coords,x,y,likelihood,x,y,likelihood\n"
)
TRC = (
    "PathFileType\t4\t(X/Y/Z)\ttrial.trc\n"
    "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\t"
    "OrigNumFrames\n"
    "100\t100\t2\t2\tmm\t100\t1\t2\n"
    "Frame#\tTime\theel\t\t\tknee\t\t\n"
    "\t\tX1\tY1\tZ1\tX2\tY2\tZ2\n"
    "\n"
)
NAMES = "heel", "knee"


def read(path: Path, text: str, forward: str | None = None) -> LegPoints:
    path.write_text(text)
    return read_leg_points(path, NAMES, forward)


def test_points_of_kinovea_are_read_with_points_and_with_commas(tmp_path: Path) -> None:
    text = KINOVEA + '"0","1.5","0",,,"2.5","100"\n"0.02","1.5","0","1","1",,\n'
    found = read(tmp_path / "k.csv", text)
    assert found.instants.tolist() == [0.0, 0.02]
    assert found.places[0].tolist() == [[1.5, 0.0], [2.5, 100.0]]
    assert np.isnan(found.places[1, 1]).all()
    commas = text.replace('","', '";"').replace(",,,", ";;;").replace(",,", ";;").replace(".", ",")
    np.testing.assert_array_equal(read(tmp_path / "k.csv", commas).places, found.places)
    left = read(tmp_path / "k.csv", text, "left")
    assert left.places[0].tolist() == [[-1.5, 0.0], [-2.5, 100.0]]


def test_points_of_deeplabcut_are_known_where_they_are_likely(tmp_path: Path) -> None:
    found = read(tmp_path / "d.csv", DLC + "0,10,300,0.99,20,100,0.9\n3,10,300,0.99,20,100,0.3\n")
    assert found.is_picture
    assert found.instants.tolist() == [0.0, 3.0]
    assert found.places[0].tolist() == [[10.0, -300.0], [20.0, -100.0]]
    assert np.isnan(found.places[1, 1]).all()


def test_points_of_trc_have_y_upwards(tmp_path: Path) -> None:
    found = read(
        tmp_path / "t.trc", TRC + "1\t0\t1\t2\t3\t4\t500\t6\n2\t0.01\t1\t2\t3\t\t\t\n", "-z"
    )
    assert found.instants.tolist() == [0.0, 0.01]
    assert found.places[0].tolist() == [[-3.0, 2.0], [-6.0, 500.0]]
    assert np.isnan(found.places[1, 1]).all()


@pytest.mark.filterwarnings("ignore:No analog data")
@pytest.mark.parametrize("scale", [-1.0, 0.1])
def test_points_of_c3d_have_z_upwards(tmp_path: Path, scale: float) -> None:
    writer = c3d.Writer(point_rate=200.0, analog_rate=200.0, point_scale=scale)
    writer.set_point_labels(["heel", "knee"])
    hidden = np.array([[1, 2, 3, 0, 0], [0, 0, 0, -1, 0]], dtype=float)
    seen = np.array([[1, 2, 3, 0, 0], [4, 5, 600, 0, 0]], dtype=float)
    writer.add_frames([(seen, np.zeros((0, 1))), (hidden, np.zeros((0, 1)))])
    file = io.BytesIO()
    writer.write(file)
    path = tmp_path / "m.c3d"
    path.write_bytes(file.getvalue())
    found = read_leg_points(path, NAMES, "y")
    assert found.instants.tolist() == [0.0, 0.005]
    np.testing.assert_allclose(found.places[0], [[2.0, 3.0], [5.0, 600.0]], atol=0.11)
    assert np.isnan(found.places[1, 1]).all()
    path.write_bytes(file.getvalue()[:-100])
    with pytest.raises(FileFormatError, match=r"m\.c3d"):
        read_leg_points(path, ("heel", "hip"), None)


@pytest.mark.parametrize(
    ("name", "text", "problem"),
    [
        ("k.csv", KINOVEA + "1,0,0,0,0,0,9\n0,0,0,0,0,0,9\n", "line 3 is not later"),
        ("k.csv", KINOVEA + "1,0,0,0,0,0,9\n2,0,low,0,0,0,9\n", "line 3 has 'low'"),
        ("k.csv", KINOVEA + "1,0,0,0,0,0,9,7\n", "line 2 has 8 cells"),
        ("k.csv", KINOVEA + "1,0,9,0,0,0,1\n", "'knee' is not above 'heel'.*lower point first"),
        ("k.csv", KINOVEA + "1,0,,0,0,0,1\n", "at no instant"),
        ("k.csv", KINOVEA, "at no instant"),
        ("k.csv", KINOVEA.replace("knee", "hip"), "no point 'knee'.*two of heel, toe, hip"),
        ("k.csv", "time,x,y\n1,2,3\n", "line 1 is 'time,x,y'"),
        ("k.csv", "", "line 1 is ''"),
        ("d.csv", DLC.replace("bodyparts", "individuals"), "scorer, bodyparts and coords"),
        ("d.csv", DLC + "0,1,2,0.1,3,1,0.1\n", "at no instant"),
        ("t.trc", TRC + "1\t0\t1\t2\t3\t4\t500\t6\n", "ends after 1 frames of 2"),
        ("t.trc", TRC.replace("mm", "ft") + "1\t0\n", "line 3: its unit is 'ft'"),
        ("t.trc", "PathFileType\n", "no TRC file"),
        ("p.kva", "<xml/>", "another kind.*Export it from Kinovea as CSV"),
        ("m.c3d", "x" * 600, "no C3D file"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, name: str, text: str, problem: str) -> None:
    with pytest.raises(FileFormatError, match=problem):
        read(tmp_path / name, text)


def test_a_direction_that_the_file_does_not_have_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="right or left"):
        read(tmp_path / "k.csv", KINOVEA + "1,0,0,0,0,0,9\n", "x")
    with pytest.raises(UsageError, match="x or -x or z or -z"):
        read(tmp_path / "t.trc", TRC + "1\t0\t1\t2\t3\t4\t500\t6\n2\t1\t1\t2\t3\t4\t500\t6\n", "y")
    with pytest.raises(FileFormatError, match=r"gone\.csv"):
        read_leg_points(tmp_path / "gone.csv", NAMES, None)
