"""Texts of force plates' programs: BioWare 5.1 to 5.6, NetForce, Vicon Nexus 1 and 2, OpenSim."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from devices.errors import FileFormatError, FootTileError, UsageError
from storage.formats.reference import ReferenceOptions
from tests.storage.formats.readers.reading import check, count_refused, read

NAN = [np.nan, np.nan]


def plate(number: int, **more: Any) -> ReferenceOptions:
    """Force and COP of one of the plates."""
    columns = {"grf_n": "fz", "cop_x_m": "cop_x", "cop_y_m": "cop_y"}
    return ReferenceOptions(
        {name: f"plate{number}_{column}" for name, column in columns.items()}, **more
    )


def force(column: str, **more: Any) -> ReferenceOptions:
    return ReferenceOptions({"grf_n": column}, **more)


BIOWARE = """BioWare Version 5.2.1.3 Export
Device:\tPlate A 9287\tPlate A 9287\tPlate A 9287\tPlate A 9287
Samples (#):\t4\t4\t4\t4
Rate (Hz):\t1000.000000\t1000.000000\t1000.000000\t1000.000000
First sample time (s):\t0.000000\t0.000000\t0.000000\t0.000000
Normalized length (m):\t1.000000\t1.000000\t1.000000\t1.000000
File Information
Date\tOct 22, 2014  12:05:31
Name\t
abs time (s)\tFx\tFz\tAx\tAy
\tN\tN\tm\tm
0.000000\t1.5\t0.0\t0.000000\t0.000000
0.001000\t1.5\t90.25\t0.013748\t-0.010516
0.002000\t1.5\t100.5\t0.012769\t-0.010327
0.003000\t1.5\t80.0\t0.010753\t-0.009611
"""
BIOWARE_N = [0.0, 90.25, 100.5, 80.0]
BIOWARE_2 = """BioWare Version 5.3.2.9 Export
Device:\tleft\tleft\tright\tright\tright\tright
Samples (#):\t3\t3\t3\t3\t3\t3
abs time (s)\tFx\tFz\tFz\t|Ft|\tAx\tAy
\tN\tN\tN\tN\tm\tm
0.000000\t-5.0\t392.0\t523.0\t527.0\t0.1\t0.2
0.001000\t-5.0\t391.0\t520.0\t524.0\t0.1\t0.2
0.002000\t-5.0\t391.5\t521.0\t524.0\t0.1\t0.2
"""

NETFORCE_ROWS = np.array(
    [
        [7.25, 7.0, 0.0, 0.0, 0.0, -0.25],
        [7.5, 7.5, 800.0, 4.0, 8.0, -0.125],
        [7.25, 7.0, 400.0, 2.0, -12.0, -0.5],
        [7.0, 7.25, 100.0, -1.0, 2.0, -0.5],
    ]
)
NETFORCE_FACTS: dict[str, Any] = {"units": {"grf": "N", "cop": "m"}, "sign": "+", "rate_hz": 50.0}


def netforce(rows: np.ndarray) -> str:
    return "".join(",".join(f"{cell:.5f}" for cell in row) + "\n" for row in rows.tolist())


PARTS = 5
STEP = np.arange(8 * PARTS)
NEXUS_N = np.where((STEP > 4) & (STEP < 35), -600.0 - STEP, 0.0)
"""What plate 2 reads: the reaction on the foot, negative along z."""
NEXUS_MM = np.stack([210.0 + STEP, 300.0 - STEP])
NEXUS_HEAD = (
    "Devices\n500\n"
    ",,Imported AMTI 400 #1 - Force,,,Imported AMTI 400 #1 - Moment,,,Imported AMTI 400 #1 - CoP,,,"
    "Imported AMTI 400 #2 - Force,,,Imported AMTI 400 #2 - Moment,,,Imported AMTI 400 #2 - CoP,,,"
    "EMG - Voltage\n"
    "Frame,Sub Frame,Fx,Fy,Fz,Mx,My,Mz,Cx,Cy,Cz,Fx,Fy,Fz,Mx,My,Mz,Cx,Cy,Cz,Fz\n"
    ",,N,N,N,N.mm,N.mm,N.mm,mm,mm,mm,N,N,N,N.mm,N.mm,N.mm,mm,mm,mm,V\n"
)
NEXUS_MARKERS = (
    "Trajectories\n100\n,,Ana:LTOE,,\nFrame,Sub Frame,X,Y,Z\n,,mm,mm,mm\n"
    + "".join(f"{i + 11},0,1.5,2.5,\n" for i in range(8))
    + "\n"
)


def nexus_rows(first: str = "0,0,0,0,0,0,-200,750,0") -> str:
    return "".join(
        f"{i // PARTS + 11},{i % PARTS},{first},1.5,-2.5,{NEXUS_N[i]},10,20,30,{NEXUS_MM[0, i]},"
        f"{NEXUS_MM[1, i]},0,0.01\n"
        for i in STEP
    )


NEXUS = NEXUS_HEAD + nexus_rows() + "\n" + NEXUS_MARKERS
_CELLS = [line.split(",") for line in NEXUS.split("\n")]
NEXUS_1 = "\n".join(",".join(row[:2] + row[11:] if len(row) > 11 else row) for row in _CELLS)
"""The second plate alone."""

OPENSIM = """grf.mot
version=1
nRows=12001
nColumns=4
inDegrees=yes
endheader
time\tground_force_vy\tground_force_px\tground_force_pz
0.000\t0.0\t0.0\t0.0
0.001\t20.0\t0.1\t0.03
0.002\t10.0\t0.2\t0.02
"""
VECTORS = """DataType=Vec3
version=3
endheader
time\tground_force_v\tground_force_p
0.000\t0,0,0\t0,0,0
0.001\t1.5,20.0,2.5\t0.1,0,0.03
0.002\t1.5,10.0,2.5\t0.2,0,0.02
"""

NETFORCE_COP_M = [NAN, [-0.01, 0.005], [0.03, 0.005], [-0.02, -0.01]]
PROGRAMS: dict[str, tuple[str, ReferenceOptions, Any, Any, Any, tuple[str, ...]]] = {
    "bioware": (
        BIOWARE,
        ReferenceOptions(),
        [0.0, 0.001, 0.002, 0.003],
        BIOWARE_N,
        [NAN, [0.013748, -0.010516], [0.012769, -0.010327], [0.010753, -0.009611]],
        ("plate1: 'Plate A 9287' of the file",),
    ),
    "netforce": (
        netforce(NETFORCE_ROWS),
        plate(1, **NETFORCE_FACTS),
        [0.0, 0.02, 0.04, 0.06],
        NETFORCE_ROWS[:, 2],
        NETFORCE_COP_M,
        ("how far the surface is above it",),
    ),
    "nexus": (
        NEXUS,
        plate(2),
        STEP / 500.0,
        -NEXUS_N,
        np.where(NEXUS_N == 0.0, np.nan, NEXUS_MM * 1e-3).T,
        ("plate2: 'Imported AMTI 400 #2' of the file", "--sign -"),
    ),
    "opensim": (
        OPENSIM,
        ReferenceOptions(),
        [0.0, 0.001, 0.002],
        [0.0, 20.0, 10.0],
        [[0.0, 0.0], [0.1, -0.03], [0.2, -0.02]],
        (),
    ),
}
"""Text, what is stated, times, forces, COP, and notes."""

Form = Callable[[str], str | bytes]
FORMS: dict[str, dict[str, Form]] = {
    "bioware": {
        "as it is": str,
        "lines end as on Windows": lambda text: text.replace("\n", "\r\n"),
        "the unit of time in the line of units": lambda text: text.replace(
            "abs time (s)", "abs time"
        ).replace("\n\tN", "\ns\tN"),
        "decimal commas": lambda text: text.replace(".", ","),
        "commas between columns": lambda text: text.replace(",", "").replace("\t", ","),
        "milliseconds": lambda text: (
            text.replace("time (s)\tFx", "time (ms)\tFx")
            .replace("\n0.00", "\n")
            .replace("000\t1.5", ".0\t1.5")
        ),
        "a description in Latin-1": lambda text: text.replace("Name", "Größe").encode("latin-1"),
        "tabs at the end of numbers": lambda text: text[:-1].replace("\n0.", "\t\n0.") + "\t\n",
    },
    "netforce": {
        "as it is": str,
        "an empty line above, blanks and lines that end as on Windows": lambda text: (
            "\r\n" + text.replace(",", ", ").replace("\n", "\r\n")
        ),
        "no end of the last line": lambda text: text[:-1],
    },
    "nexus": {
        "as it is": str,
        "tabs": lambda text: text.replace(",", "\t"),
        "semicolons and decimal commas": lambda text: text.replace(",", ";").replace(".", ","),
        "saved again by a spreadsheet": lambda text: "".join(
            f"{line}{',' * (25 - line.count(','))}\n" for line in ("\n\n" + text).splitlines()
        ),
        "trajectories above the devices": lambda text: NEXUS_MARKERS + text,
    },
    "opensim": {
        "as it is": str,
        "a blank line below the header": lambda text: text.replace("endheader\n", "endheader\n\n"),
        "Latin-1 in the header": lambda text: text.replace("grf.mot", "Vorwärts").encode("latin-1"),
        "blanks between columns": lambda text: text.replace("\t", "    "),
        "a tab at the end of lines": lambda text: text[:-1].replace("\n0.", "\t\n0.") + "\t\n",
        "blanks before names and numbers": lambda text: text.replace("\n0.", "\n  0."),
        "blank lines at the end": lambda text: text + "\n\n",
        "cells of three numbers": lambda _: VECTORS,
        "cells of three numbers with blanks": lambda _: VECTORS.replace("\t", "  "),
    },
}


@pytest.mark.parametrize(
    ("program", "form"), [(name, form) for name, forms in FORMS.items() for form in forms]
)
def test_the_same_force_is_read_whatever_the_form(tmp_path: Path, program: str, form: str) -> None:
    text, stated, time_s, grf_n, cop_m, notes = PROGRAMS[program]
    ending = "mot" if program == "opensim" else "txt"
    found = read(tmp_path, FORMS[program][form](text), stated, f"grf.{ending}")
    check(found, grf_n=grf_n)
    check(found, rtol=1e-12, atol=1e-12, time_s=time_s, cop_m=cop_m)
    for note in notes:
        assert note in "\n".join(found.notes)


OTHER_DEVICES = {"Device:": "\tDAQ\tDAQ\tDAQ", "abs": "\tV1\tV1\tV2", "\tN": "\tV\tV\tV"}
SAME_DEVICES = BIOWARE_2.replace("\tFz\tFz\t|Ft|\tAx\tAy", "\tFz\tFx\tFz\tAx\tAy").replace(
    "left", "right"
)
NETFORCE_2 = netforce(np.hstack([NETFORCE_ROWS[::-1], NETFORCE_ROWS]))
LOADED_400 = np.where((np.arange(400) > 100) & (np.arange(400) < 300), -700.0, 0.0)
NETFORCE_LOADED = np.stack(
    [np.arange(400) % 2, np.arange(400) % 3, LOADED_400, *[0 * LOADED_400] * 3], axis=1
)
NETFORCE_TIMES = netforce(np.column_stack([np.arange(4) * 0.01, NETFORCE_ROWS[:, 1:]]))
FX_KN = BIOWARE.replace("\n\tN\tN\tm\tm", "\n\tN\tkN\tmm\tmm")
FIRST_AND_SECOND = NEXUS_HEAD + nexus_rows("1,2,-350.5,0,0,0,-200,750,0") + "\n" + NEXUS_MARKERS


@pytest.mark.parametrize(
    ("text", "stated", "grf_n"),
    [
        (BIOWARE_2, force("plate1_fz"), [392.0, 391.0, 391.5]),
        (BIOWARE_2, force("plate1_fz+plate2_fz"), [915.0, 911.0, 912.5]),
        (
            "\n".join("\t".join(line.split("\t")[:5]) for line in SAME_DEVICES.splitlines()),
            force("plate2_fz"),
            [527.0, 524.0, 524.0],
        ),
        (
            "\n".join(
                line
                + next((v for k, v in OTHER_DEVICES.items() if line.startswith(k)), "\t1\t2\t3")
                for line in BIOWARE.splitlines()
            ),
            ReferenceOptions(),
            BIOWARE_N,
        ),
        (
            NETFORCE_2,
            force("plate1_fz+plate2_fz", **NETFORCE_FACTS),
            NETFORCE_ROWS[::-1, 2] + NETFORCE_ROWS[:, 2],
        ),
        (
            netforce(NETFORCE_LOADED),
            force("plate1_fz", units={"grf": "N"}, rate_hz=1000.0),
            -LOADED_400,
        ),
        (
            NETFORCE_TIMES,
            ReferenceOptions({"time_s": "column1", "grf_n": "column3"}, {"grf": "N"}, "+"),
            NETFORCE_ROWS[:, 2],
        ),
        (NEXUS.replace("Imported AMTI 400 #1 -", "Combined"), ReferenceOptions(), -NEXUS_N),
        (FIRST_AND_SECOND, force("plate1_fz+plate2_fz"), 350.5 - NEXUS_N),
    ],
    ids=[
        *("one of two devices", "two devices", "two plates of one name", "beside other devices"),
        *("six columns of each plate", "the sign by the load", "a time before the columns"),
        *("beside the sum of all", "two plates of Nexus"),
    ],
)
def test_plates_are_chosen_and_added_up(
    tmp_path: Path, text: str, stated: ReferenceOptions, grf_n: Any
) -> None:
    check(read(tmp_path, text, stated), grf_n=grf_n)


def test_each_plate_has_its_cop_and_its_name(tmp_path: Path) -> None:
    columns = {"grf_n": "plate2_fz", "cop_x_m": "plate2_cop_x", "cop_y_m": "-plate2_cop_y"}
    check(read(tmp_path, BIOWARE_2, ReferenceOptions(columns)), cop_m=[[0.1, -0.2]] * 3)
    assert "plate1: 'left' of the file" in read(tmp_path, BIOWARE_2, force("plate1_fz")).notes
    second = read(tmp_path, NETFORCE_2, plate(2, **NETFORCE_FACTS))
    check(second, rtol=1e-12, grf_n=NETFORCE_ROWS[:, 2], cop_m=NETFORCE_COP_M)
    alone = read(tmp_path, NEXUS_1)
    check(alone, grf_n=-NEXUS_N)
    assert alone.cop_m is not None


def test_units_are_those_of_the_file(tmp_path: Path) -> None:
    found = read(tmp_path, FX_KN)
    check(found, rtol=1e-7, grf_n=[0.0, 90250.0, 100500.0, 80000.0])
    assert found.cop_m is not None
    np.testing.assert_allclose(found.cop_m[1], [13.748e-6, -10.516e-6])
    axes = {"grf_n": "vy", "cop_x_m": "px", "cop_y_m": "pz"}
    columns = {name: f"ground_force_{axis}" for name, axis in axes.items()}
    units = {"grf": "N", "cop": "m", "time": "s"}
    found = read(tmp_path, OPENSIM, ReferenceOptions(columns, units), "grf.mot")
    check(found, cop_m=[[0.0, 0.0], [0.1, 0.03], [0.2, 0.02]])
    with pytest.raises(UsageError, match="is in m, not in mm"):
        read(tmp_path, OPENSIM, ReferenceOptions(columns, {"cop": "mm"}), "grf.mot")


@pytest.mark.parametrize(
    ("text", "stated", "kind", "says"),
    [
        (BIOWARE_2, None, FileFormatError, r"plate2_cop_x.*--map grf_n=COLUMN"),
        (SAME_DEVICES, force("plate2_fz"), FileFormatError, "cannot be assigned to devices"),
        (
            BIOWARE.replace("\n\tN\tN", "\n\tN\tN/N"),
            force("plate1_fz"),
            UsageError,
            "the unit of column 'plate1_fz' is not stated",
        ),
        (NETFORCE_2, None, FileFormatError, r"it has plate1_fz.*column6"),
        (
            NETFORCE_2,
            force("plate1_fz", units=NETFORCE_FACTS["units"], sign="+"),
            FileFormatError,
            "state --rate-hz",
        ),
        (
            NETFORCE_2,
            plate(1, **NETFORCE_FACTS | {"units": {"grf": "N"}}),
            UsageError,
            "unit of column 'plate1_cop_x' is not stated",
        ),
        (NETFORCE_TIMES, None, FileFormatError, r"it has column1, .*column6\)"),
        (NEXUS, force("plate1_fz"), UsageError, "does not tell the sign"),  # nobody stood on it
        (
            OPENSIM.replace("ground_force_px", "1_ground_force_vy"),
            None,
            FileFormatError,
            "no column 'grf_n'",
        ),
    ],
)
def test_what_the_file_does_not_state_is_asked_for(
    tmp_path: Path,
    text: str,
    stated: ReferenceOptions | None,
    kind: type[FootTileError],
    says: str,
) -> None:
    name = "grf.mot" if "endheader" in text else "trial.txt"
    with pytest.raises(kind, match=says):
        read(tmp_path, text, stated, name)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (BIOWARE.replace("\tFz", "\tFy"), "no force plate"),
        (BIOWARE.replace("abs time", "samples"), "no line of names"),
        (BIOWARE[: BIOWARE.index("0.000000\t1.5")], "there are no numbers below the names"),
        (BIOWARE.replace("\t-0.010327", "\t-0.010327\t7"), "cannot be read"),
        (BIOWARE.replace("\tAx\tAy\n\tN", "\n\tN"), "3 names for 5 columns"),
        (BIOWARE.replace("100.5", "1OO.5"), "is not numeric: '1OO.5'"),
        (
            BIOWARE.replace("100.5", "100,5"),
            r"'100,5' has a comma; .*\. Save it with decimal points",
        ),
        (BIOWARE.replace("(s)\tFx", "(min)\tFx"), "its time is in min"),
        (NEXUS_MARKERS, "no force plate in it"),
        (NEXUS_1.replace("Devices\n500\n", "Devices\n\n"), "the rate of its devices is ''"),
        (NEXUS_1.replace("1.5,-2.5", "1.5,-1e4"), "Fy of 'Imported AMTI 400 #2' is greater"),
        (NEXUS_HEAD, "there are no numbers below the names"),
        (NEXUS_1.replace("\n12,0", "\n11,0"), "do not rise"),
        (NEXUS_1.replace("-610.0", "much"), "is not numeric: 'much'"),
    ],
)
def test_what_is_no_measurement_is_refused(tmp_path: Path, text: str, says: str) -> None:
    with pytest.raises(FileFormatError, match=says):
        read(tmp_path, text)


def test_a_header_without_text_names_no_option_that_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileFormatError, match=r"it is no text; expected a header.*numbers$"):
        read(tmp_path, "\0" + OPENSIM, name="grf.mot")


def test_many_sections_without_plates_are_skipped(tmp_path: Path) -> None:
    begin_s = time.process_time()  # other processes take none of it
    check(read(tmp_path, NEXUS_MARKERS * 6000 + NEXUS, plate(2)), time_s=STEP / 500.0)
    assert time.process_time() - begin_s < 10.0


def test_a_part_of_a_recording_and_a_gap_of_frames_are_read_and_said(tmp_path: Path) -> None:
    found = read(tmp_path, BIOWARE[: BIOWARE.index("0.003")])
    assert len(found.time_s) == 3
    assert found.notes[0] == "it holds 3 of the 4 samples that its head states"
    rows = nexus_rows().splitlines(keepends=True)
    found = read(tmp_path, NEXUS_HEAD + "".join(rows[:15] + rows[25:]), plate(2))
    check(found, atol=1e-12, time_s=np.delete(STEP, np.s_[15:25]) / 500.0)
    assert any("1 gaps" in note for note in found.notes)


@pytest.mark.parametrize(
    ("text", "stated", "least"),
    [
        (BIOWARE, None, 50),
        (BIOWARE_2, force("plate2_fz"), 50),
        (netforce(NETFORCE_ROWS), plate(1, **NETFORCE_FACTS), 20),
        (NEXUS_1, None, 50),
    ],
    ids=["bioware", "bioware of two", "netforce", "nexus"],
)
def test_damaged_texts_are_refused_by_our_own_errors(
    tmp_path: Path, text: str, stated: ReferenceOptions | None, least: int
) -> None:
    assert count_refused(tmp_path, text, stated) > least
