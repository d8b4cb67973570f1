"""Readers of pressure plates: frames of an array, and the ASCII export of Tekscan sensors.

Arrays of numpy's `.npz` file: `time_s` (n,); `force_n` or `pressure_kpa` (n, cells along x, cells
along y); `pitch_m` (2,), distance of cells along x and y; and `origin_m` (2,), centre of the first
cell, zero if absent. x is forward and y to the left, as in the foot frame.

Facts, `NAME value`, precede `ASCII_DATA @@`. Each frame has a line `Frame N`, and a line of cells
for each row. `B` is a cell outside of the sensor. The first row is at the toes of an F-Scan insole,
seen from above: the first column is on the left.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.formats.readers.table import (
    ColumnFilter,
    ForceTable,
    PlateSignals,
    check_table_size,
    make_table_of_separate_plates,
    make_table_with_lowercase_standard_names,
)

NPZ_FORM = "a file that numpy.savez wrote"
_CELL_FACTORS = {"force_n": 1.0, "pressure_kpa": 1e3}
"""Factor of cells to newtons or to pascals, by name of the array."""


def read_npz_pressure_plate(path: Path, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Read a `.npz` file of cells as total force and centre of pressure; NaN if a cell is NaN.

    The centre of pressure is NaN without load.

    Raises:
        FileFormatError: unreadable, too large, or arrays are missing or do not fit one another.
    """
    arrays = _read_arrays(path, 8 * values_max)
    named = [name for name in _CELL_FACTORS if name in arrays]
    if len(named) != 1:
        raise FileFormatError(
            f"{' and '.join(named) or 'neither'} of {' and '.join(_CELL_FACTORS)} is there",
            expected="one of them, (frames, cells along x, cells along y)",
        )
    cells = arrays[named[0]]
    pitch_m, origin_m = arrays.get("pitch_m"), arrays.get("origin_m", np.zeros(2))
    time_s = arrays.get("time_s", np.empty(0))
    if cells.ndim != 3 or time_s.shape != cells.shape[:1]:
        raise FileFormatError(
            f"{named[0]} is {cells.shape} and time_s {time_s.shape}",
            expected="(n, cells along x, cells along y) and (n,)",
        )
    is_placed = pitch_m is not None and pitch_m.shape == origin_m.shape == (2,)
    if pitch_m is None or not is_placed or not (np.isfinite(pitch_m) & (pitch_m > 0.0)).all():
        raise FileFormatError(
            "the positions of its cells are missing",
            expected="pitch_m with two numbers above 0, and origin_m with two or not at all",
        )
    area_m2 = float(pitch_m.prod()) if named[0] == "pressure_kpa" else 1.0
    force_n = cells * (_CELL_FACTORS[named[0]] * area_m2)
    x_m, y_m = (origin_m[i] + pitch_m[i] * np.arange(cells.shape[i + 1]) for i in (0, 1))
    grf_n, (cop_x_m, cop_y_m) = _compute_total_force_and_cop(force_n, x_m, y_m)
    columns = {"time_s": time_s, "grf_n": grf_n, "cop_x_m": cop_x_m, "cop_y_m": cop_y_m}
    notes = (f"a plate of {cells.shape[1]} by {cells.shape[2]} cells, added up",)
    return make_table_with_lowercase_standard_names(columns, columns, notes=notes)


class TotalForce(NamedTuple):
    """Force of all cells (n,) in N, and its centre of pressure (2, n) in m, NaN without load."""

    force_n: Floats
    cop_m: Floats


def _compute_total_force_and_cop(force_n: Floats, x_m: Floats, y_m: Floats) -> TotalForce:
    """Add up the cells of each of n frames.

    Args:
        force_n: (n, cells along x, cells along y), force of each cell.
        x_m: (cells along x,), positions of the cells.
        y_m: (cells along y,), positions of the cells.
    """
    total_n = force_n.sum(axis=(1, 2))
    moments = np.stack([force_n.sum(axis=2) @ x_m, force_n.sum(axis=1) @ y_m])
    return TotalForce(total_n, moments / np.where(total_n > 0.0, total_n, np.nan))


def _read_arrays(path: Path, bytes_max: int) -> dict[str, Floats]:
    try:
        check_regular_file(path)
        with zipfile.ZipFile(path) as archive:
            _check_archive_size(archive, bytes_max)
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name], dtype=np.float64) for name in file.files}
    except (FileFormatError, MemoryError):
        raise
    except Exception as error:  # damaged bytes lead to any error of zipfile, zlib and numpy
        raise FileFormatError(f"no arrays of numpy: {error}") from error


def _check_archive_size(archive: zipfile.ZipFile, bytes_max: int) -> None:
    size = sum(member.file_size for member in archive.infolist())
    if size > bytes_max:
        raise FileFormatError(
            f"{size} bytes are too many for memory",
            expected=f"up to {bytes_max} bytes",
            remedy="Cut out the part that is needed",
        )


TEKSCAN_FORM = "facts above ASCII_DATA @@, then frames of ROWS lines with COLS cells"
_BEGIN = re.compile(r"^ASCII_DATA @@[\s,]*^Frame \d+\b", re.MULTILINE)
_FACT = re.compile(r"^([A-Z_0-9]+) +(.*?)[ ,]*$", re.MULTILINE)
_FRAME = re.compile(r"^Frame (\d+)\b.*\n", re.MULTILINE)
_QUANTITY = re.compile(r"([0-9.]+(?:[eE][+-]?\d+)?) *([A-Za-z]\w*)")
_PASCALS = {"kpa": 1e3, "mpa": 1e6, "psi": 6894.757293}
_METRES = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "inch": 0.0254, "inches": 0.0254}


def is_tekscan(head: str) -> bool:
    """Return whether a text is an ASCII export of a Tekscan sensor."""
    return _BEGIN.search(head) is not None


def parse_tekscan_force_and_cop(text: str, is_needed: ColumnFilter, values_max: int) -> ForceTable:
    """Parse the frames of cells to total force and centre of pressure, from the sensor's middle.

    Raises:
        FileFormatError: a fact is missing, frames are truncated, or a cell is no number.
    """
    head, _, body = text.partition("ASCII_DATA @@")
    facts = {match[1]: match[2] for match in _FACT.finditer(head)}
    rows, columns = _parse_count(facts, "ROWS"), _parse_count(facts, "COLS")
    pitch_m = [_parse_metres(facts, name, 1) for name in ("ROW_SPACING", "COL_SPACING")]
    area_m2 = _parse_metres(facts, "SENSEL_AREA", 2)
    unit = facts.get("UNITS", "")
    if unit.lower() not in _PASCALS:
        raise FileFormatError(
            f"UNITS is {unit or 'not there'}",
            expected="KPa, MPa or PSI, of a sensor that was calibrated",
            remedy="Save it again with a calibration, in one of these units",
        )
    try:
        step_s = float(facts.get("SECONDS_PER_FRAME", ""))
    except ValueError:
        step_s = 0.0
    if not 0.0 < step_s < np.inf:
        raise FileFormatError("SECONDS_PER_FRAME is no time")
    numbers, pressure = _parse_frames(body, rows, columns, values_max)
    last = facts.get("END_FRAME", "")
    if last.isdecimal() and int(last) > numbers[-1]:
        raise FileFormatError(f"it is cut off: its last frame is {numbers[-1]:.0f} of {last}")
    x_m, y_m = (
        np.asarray(pitch * ((count - 1) / 2 - np.arange(count)), dtype=np.float64)
        for pitch, count in zip(pitch_m, (rows, columns), strict=True)
    )
    force_n, cop_m = _compute_total_force_and_cop(
        pressure * (_PASCALS[unit.lower()] * area_m2), x_m, y_m
    )
    notes = [f"a sensor of {rows} by {columns} cells, added up"]
    is_mirrored = any(facts.get(name, "0") != "0" for name in ("MIRROR_ROW", "MIRROR_COL"))
    if is_mirrored:
        notes.append("it is mirrored (MIRROR_ROW, MIRROR_COL): no centre of pressure")
    else:
        notes.append("COP is from the sensor's middle, x to its first row, y to its first column")
    notes += _saturation_notes(facts, unit, pressure)
    plate = PlateSignals(
        "sensor", force_n, None if is_mirrored else cop_m, "N", "m", is_positive_under_load=True
    )
    return make_table_of_separate_plates(step_s * (numbers - numbers[0]), [plate], notes)


def _parse_frames(body: str, rows: int, columns: int, values_max: int) -> tuple[Floats, Floats]:
    """Return the numbers of the frames (n,), and their cells (n, rows, columns).

    Raises:
        FileFormatError: a frame has another number of cells, or frame numbers do not rise.
    """
    parts = _FRAME.split(body.partition("@@")[0].lstrip(" ,"))
    numbers = np.array([float(number) for number in parts[1::2]])
    if not len(numbers):
        raise FileFormatError("there is no frame in it")
    check_table_size(len(numbers), rows * columns, values_max)
    lines: list[str] = []
    for number, part in zip(parts[1::2], parts[2::2], strict=True):
        own = [line.strip(" ,") for line in part.split("\n") if line.strip(" ,")]
        if len(own) != rows or any(line.count(",") != columns - 1 for line in own):
            raise FileFormatError(f"frame {number} has not {rows} rows of {columns} cells")
        lines += own
    if not (np.diff(numbers) > 0.0).all():
        raise FileFormatError("the numbers of its frames do not rise")
    try:
        cells = np.loadtxt(
            (re.sub(r"\bB\b", "0", line.upper()) for line in lines),
            delimiter=",",
            ndmin=2,
            comments=None,
        )
    except ValueError as error:
        raise FileFormatError(f"a cell is no number: {error}") from error
    if not np.isfinite(cells).all():
        raise FileFormatError("a cell is not finite")
    return numbers, cells.reshape(len(numbers), rows, columns)


def _saturation_notes(facts: Mapping[str, str], unit: str, pressure: Floats) -> list[str]:
    """Return a note about frames with a saturated cell; empty if there are none."""
    match = _QUANTITY.match(facts.get("SATURATION_PRESSURE", ""))
    if match is None or match[2].lower() != unit.lower():
        return []
    frames = int((pressure.max(axis=(1, 2)) >= np.floor(float(match[1]))).sum())
    if not frames:
        return []
    return [f"in {frames} of {len(pressure)} frames a cell is saturated: their force is too small"]


def _parse_count(facts: Mapping[str, str], name: str) -> int:
    text = facts.get(name, "")
    if not (text.isdecimal() and 0 < int(text) < 10_000):
        raise FileFormatError(f"{name} is {text or 'not there'}")
    return int(text)


def _parse_metres(facts: Mapping[str, str], name: str, power: int) -> float:
    """Return a length in m, or an area in m2."""
    match = _QUANTITY.match(facts.get(name, ""))
    unit = match[2].lower().removesuffix("2" if power == 2 else "") if match else ""
    try:
        value = float(match[1]) if match else 0.0
    except ValueError:
        value = 0.0
    if unit not in _METRES or not value > 0.0:
        raise FileFormatError(
            f"{name} is {facts.get(name) or 'not there'}",
            expected=f"{'an area' if power == 2 else 'a length'} in mm, cm, m or inches",
        )
    return float(value * _METRES[unit] ** power)
