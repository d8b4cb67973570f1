"""Reader of Kistler BioWare's text export: facts of each device, names, units, numbers.

The line `Device:` has the device of each column. Forces act on the plate and are positive under
load. `Ax` and `Ay` are the centre of pressure on the surface, from its middle, in the plate's axes.
"""

from __future__ import annotations

import re

from devices.errors import FileFormatError
from storage.formats.readers.device_columns import (
    DeviceColumn,
    get_vertical_force_and_cop_columns,
    group_lower_case_columns_by_plate,
    make_plate_signals_in_file_units,
    parse_device_columns,
)
from storage.formats.readers.plate_signals import make_table_of_separate_plates
from storage.formats.readers.table import ForceTable
from storage.formats.readers.text import is_number, split_trimmed_cells_without_empty_end

FORM = "lines of facts, a line of names that begins with a time, lines of numbers"
_NAMES = re.compile(
    r"^\"?(?:\w+\.? )?time(?: *[\[(](?P<unit>\w+)[\])])?\"?(?P<delimiter>[\t;,])", re.I | re.M
)
_SECONDS = {"": 1.0, "s": 1.0, "ms": 1e-3}


def is_bioware(head: str) -> bool:
    """Return whether a text is an export of BioWare."""
    return re.match(r"\s*\"?bioware\b", head, re.IGNORECASE) is not None


def parse_bioware_force_and_cop(text: str, where: str, values_max: int) -> ForceTable:
    """Parse the vertical force and centre of pressure of every plate, needed or not.

    Raises:
        FileFormatError: names or force plates are missing, or numbers do not fit the names.
    """
    found = _NAMES.search(text)
    if found is None:
        raise FileFormatError("there is no line of names", where=where, expected=FORM)
    delimiter = found["delimiter"]
    facts = {
        cells[0].strip(" :").lower(): cells[1:]
        for line in text[: found.start()].split("\n")
        if (cells := split_trimmed_cells_without_empty_end(line, delimiter))
    }
    line, _, rows = text[found.start() :].partition("\n")
    names = split_trimmed_cells_without_empty_end(line, delimiter)[1:]
    devices = [*facts.get("device", []), *[""] * len(names)]
    units = [""] * (len(names) + 1)
    below = split_trimmed_cells_without_empty_end(rows.partition("\n")[0], delimiter)
    if not any(map(is_number, below)):
        units = [*below, *units]
        rows = rows.partition("\n")[2]
    second = _SECONDS.get((found["unit"] or units[0]).strip("[]() ").lower())
    if second is None:
        raise FileFormatError(
            f"its time is in {found['unit'] or units[0]}", where=where, expected="seconds"
        )
    columns = [
        DeviceColumn("", "abs time", "s"),
        *(
            DeviceColumn(device or "plate", name, unit.strip("[]() "))
            for name, device, unit in zip(names, devices, units[1:], strict=False)
        ),
    ]
    plates = group_lower_case_columns_by_plate(columns, where)
    indices = [0, *(i for plate in plates for i in get_vertical_force_and_cop_columns(plate))]
    numbers = parse_device_columns(rows, delimiter, columns, indices, values_max, where)
    notes = []
    stated = next(iter(facts.get("samples (#)", [])), "")
    if stated.isdecimal() and int(stated) > len(numbers[0]):
        notes = [f"it holds {len(numbers[0])} of the {stated} samples that its head states"]
    return make_table_of_separate_plates(
        where,
        numbers[0] * second,
        [
            make_plate_signals_in_file_units(
                f"plate{i + 1}", plate, columns, numbers, is_positive_under_load=True
            )
            for i, plate in enumerate(plates)
        ],
        notes,
    )
