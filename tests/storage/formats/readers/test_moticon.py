"""Texts of Moticon's OpenGo software: forces of two soles, and COP as part of the sole."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import read

FACTS = (
    "# Start time: 01.01.2026 09:00:00.000\n# Duration: 00:00.200\n"
    "# Sensor insoles: Left SN1, Right SN2\n# Size: 7\n# Notes: a: b\n# Tag: \n"
)
SIDE = (
    "{0} pressure 1[N/cm²]\t{0} acceleration X[g]\t{0} total force[N]\t"
    "{0} center of pressure X[-0.5...+0.5]\t{0} center of pressure Y[-0.5...+0.5]"
)
NAMES = "\t".join(("# time", SIDE.format("left"), SIDE.format("right"), "Events label[]"))
LEFT = ReferenceOptions({"grf_n": "left_fz"})
LEFT_COP = replace(LEFT, columns={**LEFT.columns, "cop_x_m": "left_cop_x", "cop_y_m": "left_cop_y"})
RIGHT_COP = ReferenceOptions(
    {"grf_n": "right_fz", "cop_x_m": "right_cop_x", "cop_y_m": "right_cop_y"}
)
SOLE_M = (0.25, 0.1)


def line(i: int) -> str:
    left = f"1.25\t0.1\t{i}.00\t-0.2\t0.{i:02}" if i > 2 else "\t" * 4
    right = f"1.25\t0.1\t{2 * i}.50\t" + ("0.000000\t0.000000" if i == 5 else f"0.{i:02}\t-0.1")
    return f"{i / 100:.2f}\t{left}\t{right}\t{'# heel' if i == 7 else ''}"


def text(*lines: str, names: str = NAMES) -> str:
    return FACTS + "\n".join((names, *(lines or map(line, range(20))), ""))


def test_each_sole_has_its_force(tmp_path: Path) -> None:
    found = read(tmp_path, text(), LEFT)
    np.testing.assert_array_equal(found.grf_n, np.arange(3.0, 20.0))
    np.testing.assert_allclose(found.time_s, np.arange(3, 20) / 100)
    assert "3 of 20 samples have no force: left out" in found.notes
    assert found.cop_m is None


def test_cop_needs_the_size_of_the_sole(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="sole lengths") as caught:
        read(tmp_path, text(), LEFT_COP)
    assert caught.value.remedy == "Add --sole-m LENGTH, of the insole in metres"
    with pytest.raises(UsageError, match="sole widths"):
        read(tmp_path, text(), replace(LEFT_COP, sole_m=SOLE_M[:1]))
    with pytest.raises(UsageError, match="is in sole lengths, not in mm"):
        read(tmp_path, text(), replace(LEFT_COP, sole_m=SOLE_M, units={"cop": "mm"}))


def test_cop_is_forward_and_to_the_left_of_both_soles(tmp_path: Path) -> None:
    left = read(tmp_path, text(), replace(LEFT_COP, sole_m=SOLE_M)).cop_m
    right = read(tmp_path, text(), replace(RIGHT_COP, sole_m=SOLE_M)).cop_m
    assert left is not None
    assert right is not None
    np.testing.assert_allclose(left[4], [-0.05, -0.007])
    np.testing.assert_allclose(right[7], [0.0175, -0.01])
    assert np.isnan(right[5]).all()  # (0, 0): next to no load


def test_the_length_alone_gives_cop_along_it(tmp_path: Path) -> None:
    along = replace(LEFT, columns={"grf_n": "left_fz", "cop_x_m": "left_cop_x"}, sole_m=SOLE_M[:1])
    cop_m = read(tmp_path, text(), along).cop_m
    assert cop_m is not None
    np.testing.assert_allclose(cop_m[:, 0], -0.05)
    assert np.isnan(cop_m[:, 1]).all()


def test_a_single_sole_is_read_without_mapping_and_without_cop(tmp_path: Path) -> None:
    names = "# time\tright total force[N]\tright center of pressure X[-0.5...+0.5]\t" + (
        "right center of pressure Y[-0.5...+0.5]"
    )
    lines = [f"{i / 100}\t{i}\t0.1\t0.1" for i in range(20)]
    found = read(tmp_path, text(*lines, names=names), ReferenceOptions())
    np.testing.assert_array_equal(found.grf_n, np.arange(20.0))
    assert found.cop_m is None


def test_times_in_milliseconds_are_told_by_their_steps(tmp_path: Path) -> None:
    lines = [f"{10 * i}\t" + line(i).partition("\t")[2] for i in range(20)]
    np.testing.assert_allclose(read(tmp_path, text(*lines), LEFT).time_s, np.arange(3, 20) / 100)


def test_cop_in_another_unit_is_not_read(tmp_path: Path) -> None:
    content = text(names=NAMES.replace("[-0.5...+0.5]", "[%]"))
    found = read(tmp_path, content, LEFT)
    assert "left: its centre of pressure is in units that are not read" in found.notes
    with pytest.raises(FileFormatError, match="no column 'left_cop_x'"):
        read(tmp_path, content, replace(LEFT_COP, sole_m=SOLE_M))


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (text(*(line(10 * i) for i in range(20))), "times go over 1.9 s, where Duration is 0.2 s"),
        (text(*map(line, range(9)), line(9).replace("\t9.00", "\tx")), "is not numeric: 'x'"),
        (text(*map(line, range(9)), "0.09\t1"), "cannot be read"),
        (FACTS + NAMES + "\n", "0 samples"),
    ],
)
def test_a_damaged_text_is_refused(tmp_path: Path, content: str, said: str) -> None:
    with pytest.raises(FileFormatError, match=said):
        read(tmp_path, content, LEFT)


def test_a_text_cut_off_anywhere_gives_no_other_force(tmp_path: Path) -> None:
    content = text()
    for end in range(0, len(content), 11):
        try:
            found = read(tmp_path, content[:end], LEFT)
        except FootTileError:
            continue
        assert set(found.grf_n) <= set(range(3, 20))
