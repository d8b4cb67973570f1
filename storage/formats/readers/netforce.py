"""Reader of AMTI NetForce's text: six numbers a line and plate, separated by commas, no head.

The numbers are Fx, Fy, Fz, Mx, My and Mz. The file states neither times nor units, nor the height
of the surface above the origin of the moments.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.plate_signals import PlateSignals, make_table_of_separate_plates
from storage.formats.readers.table import ForceTable
from storage.formats.readers.text import (
    FORM,
    is_number,
    parse_text_table,
    split_trimmed_cells_without_empty_end,
)

_CHANNELS = 6
_INSPECTED_LINES = 20
"""Number of lines by which the format is recognised."""


def is_netforce(head: str) -> bool:
    """Return whether a text is an export of NetForce.

    A first column that rises from line to line is a time, not a force.
    """
    lines = islice((line for line in head.split("\n") if line.strip()), _INSPECTED_LINES)
    rows = [split_trimmed_cells_without_empty_end(line, ",") for line in lines]
    if len(rows) == _INSPECTED_LINES or not head.endswith("\n"):
        rows = rows[:-1]  # the last line may be truncated
    width = len(rows[0]) if rows else 0
    if len(rows) < 2 or not width or width % _CHANNELS:
        return False
    if not all(len(row) == width and all(map(is_number, row)) for row in rows):
        return False
    first = [float(row[0]) for row in rows]
    return not all(a < b for a, b in pairwise(first))


def parse_netforce_force_and_cop_without_time(text: str, where: str, values_max: int) -> ForceTable:
    """Parse the vertical force and centre of pressure of each plate, beside the numbered columns.

    Raises:
        FileFormatError: lines have different numbers of cells, or a cell is no number.
    """
    raw = parse_text_table(text, where, lambda name: True, values_max)
    if len(raw.names) % _CHANNELS:
        raise FileFormatError(f"it has {len(raw.names)} columns", where=where, expected=FORM)
    channels = [np.asarray(raw.columns[name], dtype=np.float64) for name in raw.names]
    plates = [
        _make_plate(i // _CHANNELS + 1, channels[i : i + _CHANNELS])
        for i in range(0, len(channels), _CHANNELS)
    ]
    notes = (
        f"{_CHANNELS} columns without names are taken for Fx, Fy, Fz, Mx, My and Mz of a plate, as "
        "AMTI's NetForce saves them",
    )
    table = make_table_of_separate_plates(
        where, np.arange(len(channels[0]), dtype=np.float64), plates, notes
    )
    found = {name: column for name, column in table.columns.items() if name != "time_s"}
    return replace(
        table,
        names=(*found, *raw.names),
        columns={**found, **raw.columns},
        units={},
    )


def _make_plate(number: int, channels: list[Floats]) -> PlateSignals:
    _, _, fz, mx, my, _ = channels
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cop = np.stack([-my, mx]) / fz
    cop[:, ~np.isfinite(cop).all(axis=0)] = np.nan
    note = (
        "COP is -My/Fz and Mx/Fz, at the height of the origin of its moments: how far the surface "
        "is above it the file does not state"
    )
    return PlateSignals(f"plate{number}", fz, cop, None, None, notes=(note,))
