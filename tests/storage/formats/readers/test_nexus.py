"""ASCII exports of Vicon Nexus, in the layout of versions 1 and 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import count_refused, read

FRAMES = 8
PARTS = 5
STEP = np.arange(FRAMES * PARTS)
FORCE = np.where((STEP > 4) & (STEP < 35), -600.0 - STEP, 0.0)
"""What plate 2 reads: the reaction on the foot, negative along z."""
COP = np.stack([210.0 + STEP, 300.0 - STEP])


def device_rows(*, is_loaded_1: bool = False) -> str:
    one = "1,2,-350.5,0,0,0,-200,750,0" if is_loaded_1 else "0,0,0,0,0,0,-200,750,0"
    return "".join(
        f"{i // PARTS + 11},{i % PARTS},{one},1.5,-2.5,{FORCE[i]},10,20,30,{COP[0, i]},"
        f"{COP[1, i]},0,0.01\n"
        for i in range(FRAMES * PARTS)
    )


HEAD = (
    "Devices\n500\n"
    ",,Imported AMTI 400 #1 - Force,,,Imported AMTI 400 #1 - Moment,,,Imported AMTI 400 #1 - CoP,,,"
    "Imported AMTI 400 #2 - Force,,,Imported AMTI 400 #2 - Moment,,,Imported AMTI 400 #2 - CoP,,,"
    "EMG - Voltage\n"
    "Frame,Sub Frame,Fx,Fy,Fz,Mx,My,Mz,Cx,Cy,Cz,Fx,Fy,Fz,Mx,My,Mz,Cx,Cy,Cz,Fz\n"
    ",,N,N,N,N.mm,N.mm,N.mm,mm,mm,mm,N,N,N,N.mm,N.mm,N.mm,mm,mm,mm,V\n"
)
MARKERS = (
    "Trajectories\n100\n,,Ana:LTOE,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n"
    + "".join(f"{i + 11},0,1.5,2.5,\n" for i in range(FRAMES))
    + "\n"
)
TWO = HEAD + device_rows() + "\n" + MARKERS
SECOND = {"grf_n": "plate2_fz", "cop_x_m": "plate2_cop_x", "cop_y_m": "plate2_cop_y"}


def without_first(text: str) -> str:
    """Leave out the columns of the first plate."""
    lines = []
    for line in text.split("\n"):
        cells = line.split(",")
        lines.append(",".join(cells[:2] + cells[11:]) if len(cells) > 11 else line)
    return "\n".join(lines)


FORMS: dict[str, Callable[[str], str | bytes]] = {
    "as it is": str,
    "lines end as on Windows": lambda text: text.replace("\n", "\r\n"),
    "a byte order mark": lambda text: text.encode("utf-8-sig"),
    "tabs": lambda text: text.replace(",", "\t"),
    "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
    "saved again by a spreadsheet": lambda text: "".join(
        f"{line}{',' * (25 - line.count(','))}\n" for line in ("\n\n" + text).splitlines()
    ),
    "trajectories above the devices": lambda text: MARKERS + HEAD + text[len(HEAD) :],
}


@pytest.mark.parametrize("form", FORMS)
def test_a_plate_is_read_at_the_rate_of_the_devices(tmp_path: Path, form: str) -> None:
    found = read(tmp_path, FORMS[form](TWO), ReferenceOptions(SECOND))
    np.testing.assert_allclose(found.time_s, STEP / 500.0, atol=1e-12)
    np.testing.assert_array_equal(found.grf_n, -FORCE)
    expected = np.where(FORCE == 0.0, np.nan, COP * 1e-3).T
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m, expected, rtol=1e-12)
    assert "plate2: 'Imported AMTI 400 #2' of the file" in found.notes
    assert any("--sign -" in note for note in found.notes)


def test_a_single_plate_needs_no_option_beside_the_sum_of_all(tmp_path: Path) -> None:
    one = without_first(TWO)
    found = read(tmp_path, one)
    np.testing.assert_array_equal(found.grf_n, -FORCE)
    assert found.cop_m is not None
    combined = TWO.replace("Imported AMTI 400 #1 -", "Combined")
    np.testing.assert_array_equal(read(tmp_path, combined).grf_n, -FORCE)


def test_a_plate_that_nobody_stood_on_does_not_tell_its_sign(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not tell the sign"):
        read(tmp_path, TWO, ReferenceOptions({"grf_n": "plate1_fz"}))


def test_plates_are_added_up(tmp_path: Path) -> None:
    text = HEAD + device_rows(is_loaded_1=True) + "\n" + MARKERS
    found = read(tmp_path, text, ReferenceOptions({"grf_n": "plate1_fz+plate2_fz"}))
    np.testing.assert_array_equal(found.grf_n, 350.5 - FORCE)


def test_a_gap_of_frames_stays_a_gap(tmp_path: Path) -> None:
    rows = device_rows().splitlines(keepends=True)
    text = HEAD + "".join(rows[:15] + rows[25:])
    found = read(tmp_path, text, ReferenceOptions(SECOND))
    np.testing.assert_allclose(found.time_s, np.delete(STEP, np.s_[15:25]) / 500.0, atol=1e-12)
    assert any("1 gaps" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (MARKERS, "no force plate in it"),
        (TWO.replace("Devices\n500\n", "Devices\n\n"), "the rate of its devices is ''"),
        (TWO.replace("1.5,-2.5", "1.5,-1e4"), "Fy of 'Imported AMTI 400 #2' is greater"),
        (HEAD, "there are no numbers below the names"),
        (HEAD + device_rows().replace("\n12,0", "\n11,0"), "do not rise"),
        (TWO.replace("-610.0", "much"), "is not numeric: 'much'"),
    ],
)
def test_what_is_no_measurement_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError, match=says):
        read(tmp_path, text, ReferenceOptions(SECOND))


def test_damaged_texts_are_refused_by_our_own_errors(tmp_path: Path) -> None:
    assert count_refused(tmp_path, without_first(TWO)) > 50
