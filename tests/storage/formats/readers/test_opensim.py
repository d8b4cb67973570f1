"""OpenSim's tables in the forms that its users and other programs write."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from devices.errors import FileFormatError, UsageError
from storage.formats.reference import ReferenceData, ReferenceOptions
from tests.storage.formats.readers.reading import read

PLAIN = """grf.mot
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
FORMS: dict[str, Callable[[str], str | bytes]] = {
    "as it is": str,
    "a blank line below the header": lambda text: text.replace("endheader\n", "endheader\n\n"),
    "Latin-1 in the header": lambda text: text.replace("grf.mot", "Vorwärts").encode("latin-1"),
    "a byte order mark": lambda text: text.encode("utf-8-sig"),
    "lines end as on Windows": lambda text: text.replace("\n", "\r\n"),
    "blanks between columns": lambda text: text.replace("\t", "    "),
    "a tab at the end of lines": lambda text: text[:-1].replace("\n0.", "\t\n0.") + "\t\n",
    "blanks before names and numbers": lambda text: text.replace("\n0.", "\n  0."),
    "blank lines at the end": lambda text: text + "\n\n",
    "cells of three numbers": lambda text: VECTORS,
    "cells of three numbers with blanks": lambda text: VECTORS.replace("\t", "  "),
}


def read_mot(
    folder: Path, content: str | bytes, stated: ReferenceOptions | None = None
) -> ReferenceData:
    return read(folder, content, stated, "grf.mot")


@pytest.mark.parametrize("form", FORMS)
def test_the_same_force_is_read_whatever_the_form(tmp_path: Path, form: str) -> None:
    found = read_mot(tmp_path, FORMS[form](PLAIN))
    np.testing.assert_array_equal(found.time_s, [0.0, 0.001, 0.002])
    np.testing.assert_array_equal(found.grf_n, [0.0, 20.0, 10.0])
    np.testing.assert_array_equal(found.cop_m, [[0.0, 0.0], [0.1, -0.03], [0.2, -0.02]])


@pytest.mark.parametrize("cell", ["-nan(ind)", "nan", "NaN", "1.#QNAN"])
def test_no_number_is_none_in_the_words_of_any_program(tmp_path: Path, cell: str) -> None:
    found = read_mot(tmp_path, PLAIN.replace("0.1\t0.03", f"{cell}\t{cell}"))
    np.testing.assert_array_equal(found.cop_m, [[0.0, 0.0], [np.nan, np.nan], [0.2, -0.02]])


def test_its_units_are_its_own(tmp_path: Path) -> None:
    columns = {
        "grf_n": "ground_force_vy",
        "cop_x_m": "ground_force_px",
        "cop_y_m": "ground_force_pz",
    }
    found = read_mot(
        tmp_path, PLAIN, ReferenceOptions(columns, {"grf": "N", "cop": "m", "time": "s"})
    )
    assert found.cop_m is not None
    assert found.cop_m[1].tolist() == [0.1, 0.03]
    with pytest.raises(UsageError, match="is in m, not in mm"):
        read_mot(tmp_path, PLAIN, ReferenceOptions(columns, {"cop": "mm"}))


def test_of_several_forces_none_is_chosen_for_the_user(tmp_path: Path) -> None:
    text = PLAIN.replace("ground_force_px", "1_ground_force_vy")
    with pytest.raises(FileFormatError, match="no column 'grf_n'"):
        read_mot(tmp_path, text)
