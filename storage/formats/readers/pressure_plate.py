"""Reader of a pressure plate's frames, reduced to force and centre of pressure.

Arrays of numpy's `.npz` file: `time_s` (n,); `force_n` or `pressure_kpa` (n, cells along x, cells
along y); `pitch_m` (2,), distance of cells along x and y; and `origin_m` (2,), centre of the first
cell, zero if absent. x is forward and y to the left, as in the foot frame.
"""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import NamedTuple

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from devices.input_files import check_regular_file
from storage.formats.readers.table import ForceTable, make_table_with_standard_names

_CELL_FACTORS = {"force_n": 1.0, "pressure_kpa": 1e3}
"""Factor of cells to newtons or to pascals, by name of the array."""


def read_npz_pressure_plate(path: Path, values_max: int) -> ForceTable:
    """Read a `.npz` file of cells as total force and centre of pressure; NaN if a cell is NaN.

    The centre of pressure is NaN without load.

    Raises:
        FileFormatError: unreadable, too large, or arrays are missing or do not fit one another.
    """
    where = str(path)
    arrays = _read_arrays(path, 8 * values_max)
    named = [name for name in _CELL_FACTORS if name in arrays]
    if len(named) != 1:
        raise FileFormatError(
            f"{' and '.join(named) or 'neither'} of {' and '.join(_CELL_FACTORS)} is there",
            where=where,
            expected="one of them, (frames, cells along x, cells along y)",
        )
    cells = arrays[named[0]]
    pitch_m, origin_m = arrays.get("pitch_m"), arrays.get("origin_m", np.zeros(2))
    time_s = arrays.get("time_s", np.empty(0))
    if cells.ndim != 3 or time_s.shape != cells.shape[:1]:
        raise FileFormatError(
            f"{named[0]} is {cells.shape} and time_s {time_s.shape}",
            where=where,
            expected="(n, cells along x, cells along y) and (n,)",
        )
    is_placed = pitch_m is not None and pitch_m.shape == origin_m.shape == (2,)
    if pitch_m is None or not is_placed or not (np.isfinite(pitch_m) & (pitch_m > 0.0)).all():
        raise FileFormatError(
            "the positions of its cells are missing",
            where=where,
            expected="pitch_m with two numbers above 0, and origin_m with two or not at all",
        )
    area_m2 = float(pitch_m.prod()) if named[0] == "pressure_kpa" else 1.0
    force_n = cells * (_CELL_FACTORS[named[0]] * area_m2)
    x_m, y_m = (origin_m[i] + pitch_m[i] * np.arange(cells.shape[i + 1]) for i in (0, 1))
    grf_n, (cop_x_m, cop_y_m) = compute_total_force_and_cop(force_n, x_m, y_m)
    columns = {"time_s": time_s, "grf_n": grf_n, "cop_x_m": cop_x_m, "cop_y_m": cop_y_m}
    notes = (f"a plate of {cells.shape[1]} by {cells.shape[2]} cells, added up",)
    return make_table_with_standard_names(where, columns, columns, notes=notes)


class TotalForce(NamedTuple):
    """Force of all cells (n,), and its centre of pressure (2, n), NaN without load."""

    force_n: Floats
    cop_m: Floats


def compute_total_force_and_cop(force_n: Floats, x_m: Floats, y_m: Floats) -> TotalForce:
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
    where = str(path)
    try:
        check_regular_file(path)
        with zipfile.ZipFile(path) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > bytes_max:
            raise FileFormatError(
                f"{size} bytes are too many for memory",
                where=where,
                expected=f"up to {bytes_max}",
            )
        with np.load(path, allow_pickle=False) as file:
            return {name: np.asarray(file[name], dtype=np.float64) for name in file.files}
    except (
        *(OSError, ValueError, EOFError, KeyError, TypeError),
        *(zipfile.BadZipFile, MemoryError),  # a header that states more than the file has
    ) as error:
        raise FileFormatError(
            f"no arrays of numpy: {error}", where=where, expected="a file that numpy.savez wrote"
        ) from error
