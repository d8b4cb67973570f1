"""Tables of angles: points of another program belong to the film's pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.arrays import Floats
from devices.errors import FileFormatError
from service.video.angle import TrackOptions, read_points

ROWS = 30


def write_kinovea(path: Path, times_s: Floats) -> TrackOptions:
    rows = "".join(f"{t_s:.9f},100,10,{100 + 20 * np.sin(t_s)},110\n" for t_s in times_s)
    path.write_text(f"Time,low/0/X,low/0/Y,up/0/X,up/0/Y\n{rows}")
    return TrackOptions(points_file=path, points=("low", "up"))


@pytest.mark.parametrize("rate_hz", [30.0, 1000.0])
def test_rows_of_another_program_are_those_of_pictures(tmp_path: Path, rate_hz: float) -> None:
    even_s = np.arange(ROWS + 4) / rate_hz
    film_s = np.delete(even_s, np.arange(10, 14))  # pictures that were dropped
    for times_s in (film_s, film_s + 0.3 / rate_hz, film_s - 0.3 / rate_hz, film_s[2:10]):
        tracked = read_points(write_kinovea(tmp_path / "k.csv", times_s), film_s)
        assert tracked.table.film_s is not None
        np.testing.assert_allclose(tracked.table.film_s, times_s, atol=1e-6)


def test_rows_of_no_picture_are_refused_by_the_first(tmp_path: Path) -> None:
    even_s = np.arange(ROWS + 4) / 30.0
    film_s = np.delete(even_s, np.arange(10, 14))
    for times_s, said in (
        (even_s[:ROWS], "row 11 is at 0.333333 s, at which the film has no picture"),
        (film_s - 1.0, "row 1 is at -1 s"),
        (film_s + 0.4 / 30.0, "row 1 is at 0.0133333 s"),
        (film_s + 10.0, "row 1 is at 10 s"),
        (1000.0 * film_s, "rows are 33.3333 s apart"),
        (film_s[:9:2], "rows are 0.0666667 s apart"),
        # Both rows are within a third of an interval of the picture before the gap.
        (np.insert(film_s, 10, film_s[9] + 0.3 / 30.0), "row 11 is at 0.31 s"),
        (1e-3 * film_s, "rows are 3.3333e-05 s apart"),
    ):
        options = write_kinovea(tmp_path / "k.csv", times_s)
        with pytest.raises(FileFormatError, match=rf"k.csv: its {said}.*; expected seconds"):
            read_points(options, film_s)


def test_a_marker_named_first_that_is_above_the_other_is_refused(tmp_path: Path) -> None:
    film_s = np.arange(ROWS) / 50.0
    options = write_kinovea(tmp_path / "k.csv", film_s)
    straight = read_points(options, film_s).table
    upside_down = replace(options, zero_rad=math.pi)
    with pytest.raises(FileFormatError, match=r"beyond a quarter of a turn.* by --zero"):
        read_points(upside_down, film_s)
    turned = replace(options, zero_rad=-1.5)
    np.testing.assert_allclose(
        read_points(turned, film_s).table.angle_rad, straight.angle_rad + 1.5
    )
