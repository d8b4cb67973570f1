"""Texts of soles: Novel's Loadsol app and Pedar, Moticon's OpenGo."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import check, read

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
    check(left, rtol=1e-7, grf_n=[11 * i + 0.75 for i in range(20)], time_s=np.arange(20) / 100)
    right = read(tmp_path, text(), RIGHT)
    check(
        right, rtol=1e-7, grf_n=[2 * i + 0.5 for i in range(20)], time_s=np.arange(20) / 100 + 0.01
    )


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


# --- Moticon --------------------------------------------------------------------------------------


FACTS = (
    "# Start time: 01.01.2026 09:00:00.000\n# Duration: 00:00.200\n"
    "# Sensor insoles: Left SN1, Right SN2\n# Size: 7\n# Notes: a: b\n# Tag: \n"
)
SIDE = (
    "{0} pressure 1[N/cm²]\t{0} acceleration X[g]\t{0} total force[N]\t"
    "{0} center of pressure X[-0.5...+0.5]\t{0} center of pressure Y[-0.5...+0.5]"
)
NAMES = "\t".join(("# time", SIDE.format("left"), SIDE.format("right"), "Events label[]"))
LEFT_COP = ReferenceOptions({"grf_n": "left_fz", "cop_x_m": "left_cop_x", "cop_y_m": "left_cop_y"})
RIGHT_COP = ReferenceOptions(
    {"grf_n": "right_fz", "cop_x_m": "right_cop_x", "cop_y_m": "right_cop_y"}
)
SOLE_M = (0.25, 0.1)


def moticon_line(i: int) -> str:
    left = f"1.25\t0.1\t{i}.00\t-0.2\t0.{i:02}" if i > 2 else "\t" * 4
    right = f"1.25\t0.1\t{2 * i}.50\t" + ("0.000000\t0.000000" if i == 5 else f"0.{i:02}\t-0.1")
    return f"{i / 100:.2f}\t{left}\t{right}\t{'# heel' if i == 7 else ''}"


def moticon(*lines: str, names: str = NAMES) -> str:
    return FACTS + "\n".join((names, *(lines or map(moticon_line, range(20))), ""))


def test_each_sole_of_moticon_has_its_force(tmp_path: Path) -> None:
    found = read(tmp_path, moticon(), LEFT)
    np.testing.assert_array_equal(found.grf_n, np.arange(3.0, 20.0))
    np.testing.assert_allclose(found.time_s, np.arange(3, 20) / 100)
    assert "3 of 20 samples have no force: left out" in found.notes
    assert found.cop_m is None


def test_cop_needs_the_size_of_the_sole(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="sole lengths") as caught:
        read(tmp_path, moticon(), LEFT_COP)
    assert caught.value.remedy == "Add --sole-m LENGTH, of the insole in metres"
    with pytest.raises(UsageError, match="sole widths"):
        read(tmp_path, moticon(), replace(LEFT_COP, sole_m=SOLE_M[:1]))
    with pytest.raises(UsageError, match="is in sole lengths, not in mm"):
        read(tmp_path, moticon(), replace(LEFT_COP, sole_m=SOLE_M, units={"cop": "mm"}))


def test_cop_is_forward_and_to_the_left_of_both_soles(tmp_path: Path) -> None:
    left = read(tmp_path, moticon(), replace(LEFT_COP, sole_m=SOLE_M)).cop_m
    right = read(tmp_path, moticon(), replace(RIGHT_COP, sole_m=SOLE_M)).cop_m
    assert left is not None
    assert right is not None
    np.testing.assert_allclose([left[4], right[7]], [[-0.05, -0.007], [0.0175, -0.01]])
    assert np.isnan(right[5]).all()  # (0, 0): next to no load
    along = replace(LEFT, sole_m=SOLE_M[:1])
    along = replace(along, columns={"grf_n": "left_fz", "cop_x_m": "left_cop_x"})
    check(
        read(tmp_path, moticon(), along),
        rtol=1e-7,
        cop_m=[[-0.05, np.nan]] * 17,
    )


def test_a_single_sole_is_read_without_mapping_and_without_cop(tmp_path: Path) -> None:
    names = "# time\tright total force[N]\tright center of pressure X[-0.5...+0.5]\t" + (
        "right center of pressure Y[-0.5...+0.5]"
    )
    lines = [f"{i / 100}\t{i}\t0.1\t0.1" for i in range(20)]
    found = read(tmp_path, moticon(*lines, names=names), ReferenceOptions())
    np.testing.assert_array_equal(found.grf_n, np.arange(20.0))
    assert found.cop_m is None


def test_times_in_milliseconds_are_told_by_their_steps(tmp_path: Path) -> None:
    lines = [f"{10 * i}\t" + moticon_line(i).partition("\t")[2] for i in range(20)]
    np.testing.assert_allclose(read(tmp_path, moticon(*lines), LEFT).time_s, np.arange(3, 20) / 100)


def test_cop_in_another_unit_is_not_read(tmp_path: Path) -> None:
    content = moticon(names=NAMES.replace("[-0.5...+0.5]", "[%]"))
    found = read(tmp_path, content, LEFT)
    assert "left: its centre of pressure is in units that are not read" in found.notes
    with pytest.raises(FileFormatError, match="no column 'left_cop_x'"):
        read(tmp_path, content, replace(LEFT_COP, sole_m=SOLE_M))


@pytest.mark.parametrize(
    ("content", "stated", "said"),
    [
        (text(*(line(i, "1\tx\t2" if i == 3 else "") for i in range(20))), LEFT, "numeric: 'x'"),
        (text(*(line(i) for i in range(20)), "0.2\t1"), LEFT, "cannot be read"),
        (text().partition("0.000")[0], LEFT, "0 samples"),
        (text().replace("AB2-R", "AB2-L"), LEFT, "two soles are of one side"),
        (text().replace("AB1-L::medial", ""), LEFT, "the force in column 3 belongs to no sole"),
        (text().replace("AB1-L::medial", "AB1-L"), LEFT, "sole AB1-L is there twice"),
        (
            moticon(*(moticon_line(10 * i) for i in range(20))),
            LEFT,
            "times go over 1.9 s, where Duration is 0.2 s",
        ),
        (
            moticon(*map(moticon_line, range(9)), moticon_line(9).replace("\t9.00", "\tx")),
            LEFT,
            "is not numeric: 'x'",
        ),
        (moticon(*map(moticon_line, range(9)), "0.09\t1"), LEFT, "cannot be read"),
        (FACTS + NAMES + "\n", LEFT, "0 samples"),
    ],
)
def test_a_damaged_text_is_refused(
    tmp_path: Path, content: str, stated: ReferenceOptions, said: str
) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path, content, stated)


@pytest.mark.parametrize(
    ("content", "forces_n", "is_last_cut"),
    [
        # The last number of a line may be cut within, and this force may be the last.
        pytest.param(text(), {11 * i + 0.75 for i in range(20)}, True, id="novel"),
        pytest.param(moticon(), set(range(3, 20)), False, id="moticon"),
    ],
)
def test_a_text_cut_off_anywhere_gives_no_other_force(
    tmp_path: Path, content: str, forces_n: set[float], is_last_cut: bool
) -> None:
    for end in range(0, len(content), 7):
        with suppress(FootTileError):
            found = read(tmp_path, content[:end], LEFT).grf_n
            assert set(found[:-1] if is_last_cut else found) <= forces_n
