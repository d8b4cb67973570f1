"""Force plates in texts that state device, quantity and unit of each column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from devices.arrays import Floats
from devices.errors import FileFormatError
from storage.formats.readers.plate_signals import PlateSignals
from storage.formats.readers.text import (
    TextLayout,
    parse_columns,
    split_csv_cells,
    split_trimmed_cells_without_empty_end,
)

FORCE_UNITS = {"n": "N", "kn": "kN"}
LENGTH_UNITS = frozenset(("m", "cm", "mm"))
COP_NAMES = (("ax", "ay"), ("cx", "cy"))
"""Names of the centre of pressure's coordinates in programs' texts, in lower case."""


@dataclass(frozen=True)
class DeviceColumn:
    """Head of a column of numbers.

    Attributes:
        device: name of the plate; empty for times and frame numbers.
        name: name of the quantity, such as `Fz`.
        unit: stated unit; empty if the file states none.
    """

    device: str
    name: str
    unit: str


def group_lower_case_columns_by_plate(
    columns: Sequence[DeviceColumn], where: str
) -> list[dict[str, int]]:
    """Return the columns of each device with a vertical force: indices by lower-case name.

    Devices may share a name: a repeated quantity then begins the next device.

    Raises:
        FileFormatError: no device has a vertical force, or the grouping is ambiguous.
    """
    groups: dict[str, list[dict[str, int]]] = {}
    for i, column in enumerate(columns):
        if not (column.device and column.name):
            continue
        of_device = groups.setdefault(column.device, [{}])
        if column.name.lower() in of_device[-1]:
            of_device.append({})
        of_device[-1][column.name.lower()] = i
    groups = {
        device: found for device, found in groups.items() if any("fz" in one for one in found)
    }
    for device, found in groups.items():
        if any(one.keys() != found[0].keys() for one in found):
            raise FileFormatError(
                f"the columns of {device!r} cannot be assigned to devices",
                where=where,
                expected="a name of its own for each device, or the same columns for all",
            )
    plates = [one for found in groups.values() for one in found if "fz" in one]
    if not plates:
        names = ", ".join(dict.fromkeys(column.name for column in columns if column.name))
        raise FileFormatError(
            f"there is no force plate in it (its columns are {names[:200]})",
            where=where,
            expected="a column Fz",
            remedy="Export the forces as well",
        )
    return plates


def parse_device_columns(
    rows: str,
    delimiter: str,
    columns: Sequence[DeviceColumn],
    indices: Sequence[int],
    values_max: int,
    where: str,
) -> dict[int, Floats]:
    """Return the numbers of the given columns by index.

    Raises:
        FileFormatError: a line has more numbers than names, a cell is no number, or there are no
            lines.
    """
    first = rows.partition("\n")[0]
    if not first.strip():
        raise FileFormatError(
            "there are no numbers below the names", where=where, expected="a whole file"
        )
    width = len(split_csv_cells(first, delimiter))
    if len(split_trimmed_cells_without_empty_end(first, delimiter)) > len(columns) or width <= max(
        indices
    ):
        raise FileFormatError(
            f"there are {len(columns)} names for {width} columns of numbers",
            where=where,
            expected="a name over each column",
        )
    heads: list[Any] = [*columns[:width], *[None] * (width - len(columns))]
    names = [f"{i + 1} ({head.name})" if head else "" for i, head in enumerate(heads)]
    layout = TextLayout(tuple(names), delimiter, 0, {})
    found = parse_columns(rows, layout, [names[i] for i in indices], values_max, where)
    return {i: np.asarray(found[names[i]], dtype=np.float64) for i in indices}


def get_vertical_force_and_cop_columns(plate_columns: dict[str, int]) -> list[int]:
    """Return the indices of a plate's vertical force and centre of pressure."""
    return [plate_columns["fz"], *_get_cop_columns(plate_columns)]


def make_plate_signals_in_file_units(
    name: str,
    plate_columns: dict[str, int],
    columns: Sequence[DeviceColumn],
    numbers: dict[int, Floats],
    *,
    is_positive_under_load: bool = False,
) -> PlateSignals:
    """Return a plate made of its columns, with a note about its name in the file."""
    head = columns[plate_columns["fz"]]
    cop = _get_cop_columns(plate_columns)
    lengths = {columns[i].unit.lower() for i in cop}
    length = lengths.pop() if len(lengths) == 1 else ""
    return PlateSignals(
        name,
        numbers[plate_columns["fz"]],
        np.stack([numbers[i] for i in cop]) if cop else None,
        FORCE_UNITS.get(head.unit.lower()),
        length if length in LENGTH_UNITS else None,
        is_positive_under_load,
        (f"{head.device!r} of the file",),
    )


def _get_cop_columns(plate_columns: dict[str, int]) -> list[int]:
    return next(
        (
            [plate_columns[x], plate_columns[y]]
            for x, y in COP_NAMES
            if x in plate_columns and y in plate_columns
        ),
        [],
    )
