"""Texts of Novel's Loadsol app: soles, regions, times of their own, lost packets; and of Pedar."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import read

LEFT, RIGHT = ReferenceOptions({"grf_n": "left_fz"}), ReferenceOptions({"grf_n": "right_fz"})
SOLES = (
    "\tAB1-L::heel\tAB1-L::medial\tAB1-L\t\tAB1-L::xAcc\t\tAB2-R::heel\tAB2-R::medial\tAB2-R\t\t"
)
QUANTITIES = (
    "Time[secs]\tForce[N]\tForce[N]\tForce[N]\tTime[secs]\t[g]\t"
    "Time[secs]\tForce[N]\tForce[N]\tForce[N]\t"
)


def line(i: int, left: str = "", right: str = "") -> str:
    left = left or f"{i}.5\t{10 * i}.25\t{11 * i}.75"
    right = right or f"{2 * i}.0\t0.5\t{2 * i}.5"
    return f"{i / 100:.3f}\t{left}\t{i / 100:.3f}\t0.1\t{i / 100 + 0.01:.3f}\t{right}\t\t"


def text(*lines: str) -> str:
    head = ("loadapp_2026_01_01_09_00_00_000.loadflux", "comment a, b and c", SOLES, QUANTITIES)
    return "\n".join((*head, *(lines or map(line, range(20))), ""))


def test_each_sole_has_its_force_and_its_times(tmp_path: Path) -> None:
    left = read(tmp_path, text(), LEFT)
    np.testing.assert_allclose(left.grf_n, [11 * i + 0.75 for i in range(20)])
    np.testing.assert_allclose(left.time_s, np.arange(20) / 100)
    right = read(tmp_path, text(), RIGHT)
    np.testing.assert_allclose(right.grf_n, [2 * i + 0.5 for i in range(20)])
    np.testing.assert_allclose(right.time_s, np.arange(20) / 100 + 0.01)


def test_the_sum_of_soles_needs_their_times_to_agree(tmp_path: Path) -> None:
    both = ReferenceOptions({"grf_n": "left_fz+right_fz"})
    found = read(tmp_path, text(), both)
    np.testing.assert_allclose(found.grf_n, [13 * i + 1.25 for i in range(20)])
    late = [line(i).replace("\t0.1\t", "\t0.1\t9") for i in range(20)]
    with pytest.raises(FileFormatError, match=r"the soles' times are up to 90 s apart"):
        read(tmp_path, text(*late), both)
    assert len(read(tmp_path, text(*late), LEFT).grf_n) == 20


def test_a_packet_that_did_not_arrive_is_no_force_of_zero(tmp_path: Path) -> None:
    lines = [line(i, "-1.000\t-1.000\t0.000" if i in (4, 5) else "") for i in range(20)]
    found = read(tmp_path, text(*lines), LEFT)
    assert found.grf_n.min() == 0.75
    assert len(found.grf_n) == 18
    assert "left: 2 of 20 packets did not arrive" in found.notes
    assert len(read(tmp_path, text(*lines), RIGHT).grf_n) == 20


def test_a_single_sole_needs_no_mapping(tmp_path: Path) -> None:
    head = "run.loadflux\ncomment \n\tP1-R\t\t\nTime[secs]\tForce[N]\t\n"
    content = head + "".join(f"{i / 100:.3f}\t{i}.5\t\t\n" for i in range(20))
    np.testing.assert_allclose(read(tmp_path, content).grf_n, np.arange(20) + 0.5)
    milliseconds = content.replace("Time[secs]", "Time[ms]")
    assert read(tmp_path, milliseconds).time_s[-1] == pytest.approx(19e-5)


def test_regions_without_a_sum_are_added_up(tmp_path: Path) -> None:
    head = "run.loadflux\ncomment\n\tP1-L::heel\tP1-L::toe\nTime[secs]\tForce[N]\tForce[N]\n"
    content = head + "".join(f"{i / 100}\t{i}\t1\n" for i in range(20))
    np.testing.assert_allclose(read(tmp_path, content).grf_n, np.arange(20) + 1.0)


def test_commas_for_tabs_are_read(tmp_path: Path) -> None:
    found = read(tmp_path, text().replace("a, b", "a b").replace("\t", ","), LEFT, "walk.csv")
    np.testing.assert_allclose(found.grf_n, read(tmp_path, text(), LEFT).grf_n)


def test_stamps_that_the_app_rounds_are_spread(tmp_path: Path) -> None:
    lines = [line(i) for i in range(20)]
    lines[7] = lines[7].replace("0.070\t", "0.060\t", 1)
    found = read(tmp_path, text(*lines), LEFT)
    assert any("spread evenly" in note for note in found.notes)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (text(*(line(i, "1\tx\t2" if i == 3 else "") for i in range(20))), "is not numeric: 'x'"),
        (text(*(line(i) for i in range(20)), "0.2\t1"), "cannot be read"),
        (text().partition("0.000")[0], "0 samples"),
        (text().replace("AB2-R", "AB2-L"), "two soles are of one side"),
        (text().replace("AB1-L::medial", ""), "the force in column 3 belongs to no sole"),
        (text().replace("AB1-L::medial", "AB1-L"), "sole AB1-L is there twice"),
    ],
)
def test_a_damaged_text_is_refused(tmp_path: Path, content: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path, content, LEFT)


def test_a_text_cut_off_anywhere_gives_no_other_force(tmp_path: Path) -> None:
    content = text()
    for end in range(0, len(content), 7):
        try:
            found = read(tmp_path, content[:end], LEFT)
        except (FileFormatError, UsageError):
            continue
        assert set(found.grf_n[:-1]) <= {11 * i + 0.75 for i in range(20)}


# --- Pedar ----------------------------------------------------------------------------------------


def test_pressures_of_a_pedar_insole_are_refused_without_their_areas(tmp_path: Path) -> None:
    content = (
        "file name:  A.sol\tdate/time  01.01.26 09.00\nsensor type:  v_1 \n"
        "total time [secs]:  0.020\ttime per frame [secs]:  0.02000\tscanning rate [Hz]:   50\n"
        "pressure values in  kPa\n\nmask definition: \nleft insole: 1,2,\nright insole: 1,2,\n\n"
        "time[secs]    \t      1\t      2\t      1\t      2\n"
        "    0.02000\t  0.000\t 15.000\t  2.500\t  0.000\n"
    )
    with pytest.raises(FileFormatError, match="pressures of 4 sensors in kPa") as caught:
        read(tmp_path, content, name="walk.asc")
    assert "areas" in caught.value.what
